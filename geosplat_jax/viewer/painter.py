"""The pictures of the viewer, drawn by the program's own renderer."""

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.train import Trained
from geosplat_jax.io.export import export_mesh_glb
from geosplat_jax.io.images import encode_srgb, straight
from geosplat_jax.io.meshes import nondegenerate
from geosplat_jax.report.assets import MaterialSampler
from geosplat_jax.report.pictures import normals_to_rgb
from geosplat_jax.report.relight import picture, turned
from geosplat_jax.report.renderer import RenderedView, Renderer, to_picture
from geosplat_jax.report.scales import DISTANCE_COLORS, Scale
from geosplat_jax.viewer.looks import AS_TRAINED, LEVELS, Ladder, Level, Look
from geosplat_jax.viewer.source import CheckpointWatch, same_size

_GREY = 0.2
"""Grey background, in sRGB, of pictures that do not show colour."""

_BEHIND_EVERYTHING = 150.0
"""Depth of the background; the largest that can be sent to a browser is 167."""


@dataclass(frozen=True)
class Picture:
    """A picture for a browser.

    Attributes
    ----------
    rgb : (H, W, 3) sRGB, bytes.
    depth : (H, W) depth along the camera's axis, world units; large on the background. None where
        the object is too far away for a browser; overlays then lie in front of it.
    level : quality of the picture.
    step : training step of the parameters.
    seconds : time that drawing took.
    """

    rgb: UInt8[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"] | None
    level: Level
    step: int
    seconds: float


@dataclass(frozen=True)
class Gaussians:
    """Splats in the form that viser draws.

    Attributes
    ----------
    means : (N, 3) world.
    covariances : (N, 3, 3) world.
    colors : (N, 3) albedo in sRGB, [0, 1].
    opacities : (N, 1) in [0, 1].
    """

    means: Float[np.ndarray, "N 3"]
    covariances: Float[np.ndarray, "N 3 3"]
    colors: Float[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, "N 1"]


class Painter:
    """Draws pictures of the parameters of one checkpoint.

    The recovered light is shown as in training, with exposure and learned indirect light. When it
    is rotated or scaled, it is treated like any new light: indirect light is traced.

    Parameters
    ----------
    trained : parameters of a run.
    lights : environment maps by name, all of one size, see `source.same_size`.
    """

    def __init__(self, trained: Trained, lights: Mapping[str, EnvLight]) -> None:
        self.trained = trained
        self._as_trained = Renderer.of(trained).with_aovs("depth")
        exposure = math.exp(float(trained.params.log_exposure))
        trained_light = EnvLight(trained.params.light.radiance * exposure)
        self._lights = {AS_TRAINED: same_size(trained_light), **lights}
        self._relit: Renderer | None = None
        self._prepared: dict[tuple[int, bool], tuple[tuple[str, float, float], Renderer]] = {}

    def _light_of(self, look: Look) -> EnvLight:
        light = turned(self._lights[look.light], math.radians(look.turn))
        return EnvLight(light.radiance * look.intensity)

    def _renderer(self, look: Look, samples: int) -> Renderer:
        """Return a renderer with the light of a look; the last one of each kind is cached."""
        key = look.light, look.turn, look.intensity
        is_as_trained = key == (AS_TRAINED, 0.0, 1.0)
        cache_entry = self._prepared.get((samples, is_as_trained))
        if cache_entry is not None and cache_entry[0] == key:
            return cache_entry[1]
        if is_as_trained:
            renderer = self._as_trained.with_samples(samples)
        elif cache_entry is not None:  # its buffers have grown to what this surface needs
            renderer = cache_entry[1].under(self._light_of(look))
        else:
            light = self._light_of(look)
            if self._relit is None:
                self._relit = self._as_trained.relit(light)
            renderer = self._relit.with_samples(samples).under(light)
        self._prepared[samples, is_as_trained] = key, renderer
        return renderer

    def paint(self, look: Look, level: Level) -> Picture:
        """Draw the picture of a look at a level.

        Raises
        ------
        KeyError
            If there is no light of the name in the look.
        """
        start_time = time.perf_counter()
        camera = look.camera(level)
        view = self._renderer(look, level.samples)(camera)
        if look.mode == "render":
            rgb = picture(view, camera, self._light_of(look), look.background)
        else:
            rgb = self._aov(look, view)
        depth = straight(view.aovs["depth"], view.alpha)[..., 0]
        depth = np.where(view.alpha > 0.5, depth, 0.0).astype(np.float32)
        is_too_far = depth.max() >= _BEHIND_EVERYTHING
        return Picture(
            np.round(255.0 * rgb).astype(np.uint8),
            None if is_too_far else np.where(depth > 0.0, depth, np.float32(_BEHIND_EVERYTHING)),
            level,
            self.trained.step,
            time.perf_counter() - start_time,
        )

    def _aov(self, look: Look, view: RenderedView) -> np.ndarray:
        """Return the picture of an AOV over grey, sRGB."""
        if look.mode == "normal":
            return normals_to_rgb(view.aovs["normal"], view.alpha)
        alpha = np.clip(view.alpha, 0.0, 1.0)[..., None]
        values = straight(view.aovs[look.mode], view.alpha)
        if look.mode == "depth":
            rgb = self._depth_scale(look).picture(values[..., 0])
        else:
            rgb = to_picture(values) if look.mode == "albedo" else np.clip(values, 0.0, 1.0)
        over_grey = alpha * rgb + (1.0 - alpha) * _GREY
        return np.broadcast_to(over_grey, (*view.alpha.shape, 3))

    def _depth_scale(self, look: Look) -> Scale:
        """Return a scale of depth from the near to the far end of the box around the object."""
        box = self.trained.pipeline.surface.box
        radius = math.sqrt(3.0) * float(box.half_extent)
        distance = float(np.linalg.norm(np.asarray(box.center) - np.asarray(look.position)))
        return Scale("depth", max(distance - radius, 0.0), distance + radius, DISTANCE_COLORS)

    def mesh_glb(self) -> bytes | None:
        """Return the mesh with colours on its vertices as GLB, y up; None for an empty surface."""
        vertices, faces, normals = self._as_trained.mesh()
        if not len(faces) or not nondegenerate(vertices, faces).any():
            return None
        sampler = MaterialSampler(self.trained, self._as_trained.asset())
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.glb"
            export_mesh_glb(
                path,
                vertices,
                faces,
                normals,
                sampler,
                has_specular=sampler.has_specular,
                vertex_colors=True,
            )
            return path.read_bytes()

    def gaussians(self) -> Gaussians:
        """Return the splats in the colour of their albedo."""
        asset = self._as_trained.asset()
        count = int(asset.splats.count)
        rotations = np.asarray(quaternion_to_matrix(jnp.asarray(asset.splats.quats[:count])))
        axes = rotations * np.asarray(asset.splats.scales[:count])[:, None, :]
        return Gaussians(
            np.asarray(asset.splats.means[:count]),
            axes @ axes.transpose(0, 2, 1),
            np.clip(encode_srgb(np.asarray(asset.attributes.materials.albedo[:count])), 0.0, 1.0),
            np.asarray(asset.splats.opacities[:count])[:, None],
        )


class Viewer:
    """Draws pictures of a run for several users, always of the newest checkpoint.

    Parameters
    ----------
    watch : reader of the run.
    lights : environment maps by name, all of one size.
    levels : levels from fast to good.
    clock : function that returns monotonic seconds.
    """

    def __init__(
        self,
        watch: CheckpointWatch,
        lights: Mapping[str, EnvLight],
        *,
        levels: Sequence[Level] = LEVELS,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._watch, self._new_lights = watch, dict(lights)
        self._levels, self._clock = levels, clock
        self._ladders: dict[int, Ladder] = {}
        trained = watch.newer()
        assert trained is not None, "the first look at a run reads it"
        self.painter = Painter(trained, self._new_lights)

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights, the recovered one first."""
        return (AS_TRAINED, *self._new_lights)

    def refresh(self) -> bool:
        """Read a newer checkpoint if there is one; return whether there was."""
        trained = self._watch.newer()
        if trained is None:
            return False
        self.painter = Painter(trained, self._new_lights)
        for ladder in self._ladders.values():
            ladder.forget()
        return True

    def draw(self, person: int, look: Look) -> Picture | None:
        """Draw the next picture for a user; None if there is nothing to draw at present."""
        if person not in self._ladders:
            self._ladders[person] = Ladder(self._levels, clock=self._clock)
        ladder = self._ladders[person]
        level = ladder.next(look)
        if level is None:
            return None
        next_picture = self.painter.paint(look, level)
        ladder.note(level, next_picture.seconds)
        return next_picture

    def leave(self, person: int) -> None:
        """Forget a user who has disconnected."""
        self._ladders.pop(person, None)
