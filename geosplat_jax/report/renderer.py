"""Render trained parameters from any camera and under any light, on the host.

Images average many samples: the light that arrives is gathered once per light, in several passes of
a size that fits memory, and serves every view.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.color import expose, tone_map
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.core.types import Camera, EnvLight, Mesh, Splats
from geosplat_jax.fit.cameras import Subject
from geosplat_jax.fit.train import Trained
from geosplat_jax.io.images import encode_srgb, straight
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Asset, Params, RenderOutput, RenderPipeline
from geosplat_jax.surface.base import Surface
from geosplat_jax.transport.base import Illumination
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.paths import PathSettings

EVALUATION_AOVS = ("albedo", "roughness", "metallic", "normal")
DEFAULT_SAMPLES = 128
"""Rays per splat, over all passes, in images that people look at and metrics are made from."""

LARGEST_SAMPLES = 1_000_000
"""Rays per splat at most, over all passes."""

_PASS_SAMPLES = 16
"""Samples of each kind in a pass, at most."""

_SPECULAR_PASSES = 4
"""Passes that specular light is averaged over at most; each keeps its samples of the light."""

_SPECULAR_SAMPLES_PER_PIXEL = 128
"""Samples of the specular lobe that are enough for a covered pixel, over its splats and passes."""

_PIXEL_PASSES = 2
"""Passes of an image whose points are pixels, to one of an image of splats, of which a pixel
averages several."""

_HEADROOM = 1.25
"""Of the lists, over what the first view of a size needs, where they must grow."""

RELIGHT_BOUNCES = 2
"""How often light goes from surface to surface under a new light."""

RELIGHT_KINDS = ("traced", "paths", "none", "unshadowed")
"""How blocked directions look under a new light: see `relight_transport`."""

_reconstruct = jax.jit(Pipeline.reconstruct)
_illuminate = jax.jit(Pipeline.illuminate)
_render_lit = partial(jax.jit, static_argnames=("aov_names",))(Pipeline.render_lit)
_vertex_normals = jax.jit(vertex_normals)


@partial(jax.jit, static_argnames=("final",))
def _extract(pipeline: RenderPipeline, params: Params, *, final: bool) -> Surface:
    return pipeline.surface.extract(params.geometry, capacities=pipeline.capacities, final=final)


@jax.jit
def _needs(pipeline: RenderPipeline, splats: Splats, camera: Camera) -> Usage:
    """Count what the lists of a view need."""
    return pipeline.visible(splats, camera).usage


@dataclass(frozen=True)
class RenderedView:
    """One rendered view on the host: premultiplied by alpha, float32.

    Attributes
    ----------
    rgb : (H, W, 3) linear, exposed and tone mapped.
    alpha : (H, W).
    linear : (H, W, 3) exposed radiance, of any size: what is tone mapped.
    aovs : albedo, roughness, metallic, normal, and those of `Renderer.with_aovs`; (H, W, c) each.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    linear: np.ndarray
    aovs: dict[str, np.ndarray]


def build_asset(pipeline: Pipeline, params: Params) -> Asset:
    """Run what depends on neither light nor view, growing buffers as needed."""
    unlit = pipeline.unlit()

    def attempt(capacities: Capacities) -> tuple[Asset, Usage]:
        asset = _reconstruct(replace(unlit, capacities=capacities), params)
        return asset, asset.usage

    return capacity_module.retry(attempt, pipeline.capacities)[0]


def relight_transport(indirect: str = "traced") -> MonteCarloSettings | PathSettings:
    """Return the light transport under a light that was never trained on.

    What was learned of indirect light does not hold there: blocked directions bring traced light,
    light that paths bring by way of as many surfaces, or none. Unshadowed, only a splat's own face
    blocks, as for those who do not trace rays.

    Raises
    ------
    ValueError
        If ``indirect`` is not one of `RELIGHT_KINDS`.
    """
    if indirect not in RELIGHT_KINDS:
        raise ValueError(f"indirect must be one of {RELIGHT_KINDS}, got {indirect!r}")
    if indirect == "paths":
        return PathSettings(bounce_count=RELIGHT_BOUNCES + 1)
    is_shadowed = indirect != "unshadowed"
    return MonteCarloSettings(
        occlusion=is_shadowed,
        indirect=indirect if is_shadowed else "none",  # pyright: ignore[reportArgumentType]
        bounces=RELIGHT_BOUNCES,
    )


def _passes_of(samples: int) -> tuple[int, int]:
    """Return the number of passes for so many rays per splat, and of samples of each kind in one.

    Raises
    ------
    ValueError
        If the number is not from 1 to `LARGEST_SAMPLES`.
    """
    if not 1 <= samples <= LARGEST_SAMPLES:
        raise ValueError(
            f"an image needs from 1 to {LARGEST_SAMPLES} samples per splat, got {samples}"
        )
    passes = -(-samples // (2 * _PASS_SAMPLES))
    return passes, -(-samples // (2 * passes))


class Renderer:
    """Render views of fixed parameters one at a time, growing buffers as needed.

    Parameters
    ----------
    pipeline, params : see `train.load_trained`.
    samples : rays per splat for the diffuse light, half of them towards the light and half after
        the cosine, where the transport traces any; rounded up to equal passes of at most 32, see
        `samples`. The noise falls as the square root. The specular lobe, which every view
        integrates anew, has half as many of its own, from four passes at most, and from fewer where
        the splats of a pixel average it anyway.
    seed : of the samples.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        params: Params,
        *,
        samples: int = DEFAULT_SAMPLES,
        seed: int = 0,
    ) -> None:
        self._trained = pipeline
        self._params = params
        self._key = jax.random.key(seed)
        self._passes, self._pass_samples = _passes_of(samples)
        self._light = params.light
        self._log_exposure = params.log_exposure
        self._albedo_scale = np.ones(3, np.float32)
        self._keeps_indirect = True
        self._planned: set[tuple[int, int]] = set()
        self._pipeline = self._for_images(pipeline)
        self._asset: Asset | None = None
        self._illuminations: list[Illumination] = []
        self._aov_names = EVALUATION_AOVS

    @classmethod
    def of(cls, trained: Trained, *, samples: int = DEFAULT_SAMPLES) -> "Renderer":
        """Return a renderer of a run's parameters as they were trained."""
        return cls(trained.pipeline, trained.params, samples=samples)

    @property
    def samples(self) -> int:
        """Rays per splat that are traced for the diffuse light, over all passes."""
        return 2 * self._passes * self._pass_samples

    def _for_images(self, pipeline: Pipeline) -> Pipeline:
        """Return the pipeline with the samples of one pass, and without shortcuts of training."""
        # The weights of the loss do not matter here; without them programs are shared.
        transport = pipeline.transport.for_images(self._pass_samples)
        return replace(pipeline, transport=transport, weights={})

    def relit(
        self,
        light: EnvLight,
        *,
        albedo_scale: Sequence[float] | np.ndarray = (1.0, 1.0, 1.0),
        indirect: str = "traced",
    ) -> "Renderer":
        """Return a renderer of the same surface and materials under another light.

        Always Monte Carlo, whatever the parameters were trained with, and at exposure 1.

        Parameters
        ----------
        light : in the layout of `EnvLight`, of any size.
        albedo_scale : (3,) factors of the albedo, which photographs leave open.
        indirect : one of `RELIGHT_KINDS`.
        """
        transport = relight_transport(indirect).build(LightSpec())  # keeps no table of a light
        other = Renderer(
            replace(self._trained, transport=transport), self._params, samples=self.samples
        )
        other._keeps_indirect = False
        other._key = self._key
        other._light = light
        other._log_exposure = jnp.zeros(())
        other._albedo_scale = np.asarray(albedo_scale, np.float32)
        other._aov_names = self._aov_names
        return other

    def under(self, light: EnvLight) -> "Renderer":
        """Return a renderer that differs in the light alone; the surface is not built again."""
        other = self._copy()
        other._light = light
        other._illuminations = []
        return other

    def with_samples(self, samples: int) -> "Renderer":
        """Return a renderer of the same surface with another number of rays per splat."""
        self.asset()
        other = self._copy()
        other._passes, other._pass_samples = _passes_of(samples)
        other._pipeline = other._for_images(other._pipeline)
        other._illuminations = []
        return other

    def with_aovs(self, *names: str) -> "Renderer":
        """Return a renderer whose views have these AOVs too, some of `render.AOV_CHANNELS`."""
        other = self._copy()
        other._aov_names = tuple(dict.fromkeys((*self._aov_names, *names)))
        return other

    def hurried(self) -> "Renderer":
        """Return a renderer of a single pass: noisier, and made of the same programs."""
        other = self._copy()
        other._passes, other._illuminations = 1, []
        return other

    def _copy(self) -> "Renderer":
        """Return a renderer like this one, which remembers apart for what it has planned."""
        other = copy.copy(self)
        other._planned = set(self._planned)
        return other

    def center(self) -> np.ndarray:
        """Centre of the box around the object in the world, (3,) float64."""
        return np.asarray(self._pipeline.surface.box.center, np.float64)

    def asset(self) -> Asset:
        """Build surface and splats, once."""
        if self._asset is None:
            asset = build_asset(self._pipeline, self._params)
            attributes = asset.attributes
            if not self._keeps_indirect:
                attributes = replace(attributes, indirect=None)
            materials = attributes.materials
            materials = replace(materials, albedo=materials.albedo * self._albedo_scale[None, :])
            attributes = replace(attributes, materials=materials)
            self._asset = replace(asset, attributes=attributes)
        return self._asset

    def subject(self) -> Subject:
        """Return what cameras are refined against: this asset under this light.

        Diffuse light is the mean of all passes, the specular lobe that of the first.
        """
        illumination = self._illuminated()[0]
        key = jax.random.fold_in(self._key, self._passes)
        exposure = jnp.asarray(self._log_exposure)
        return Subject(self._pipeline, self.asset(), illumination, exposure, key)

    def _illuminated(self) -> list[Illumination]:
        """Gather the light, once: the mean of all passes, with the light's samples of a few."""
        if self._illuminations:
            return self._illuminations
        passes = self._passes if self._pipeline.transport.needs_key else 1
        total, first = None, []
        for number in range(passes):
            key = jax.random.fold_in(self._key, number)
            prepared, _ = _illuminate(self._pipeline, self.asset(), self._light, key=key)
            parts = prepared.averaged_parts()
            total = parts if total is None else jax.tree.map(jnp.add, total, parts)
            if number < _SPECULAR_PASSES:
                first.append(prepared)
        mean = jax.tree.map(lambda x: x * (1.0 / passes), total)
        self._illuminations = [prepared.with_parts(mean) for prepared in first]
        return self._illuminations

    def plan(self, camera: Camera) -> None:
        """Grow the lists for the first view of a size, before a larger program is compiled.

        Rendering does so by itself; renderers made `under` other lights afterwards need not.
        """
        size, unlit = (camera.height, camera.width), self._pipeline.unlit()
        if size in self._planned:
            return

        def attempt(capacities: Capacities) -> tuple[None, Usage]:
            pipeline = replace(unlit, capacities=capacities)
            return None, _needs(pipeline, self.asset().splats, camera)

        # Other views of this size may need more than the first.
        _, capacities = capacity_module.retry(attempt, unlit.capacities, headroom=_HEADROOM)
        self._pipeline = replace(self._pipeline, capacities=capacities)
        self._planned.add(size)

    def _render(self, camera: Camera, illumination: Illumination, number: int) -> RenderOutput:
        """Render one pass of a view, growing buffers as needed."""
        self.plan(camera)
        key = jax.random.fold_in(self._key, self._passes + number)

        def attempt(capacities: Capacities) -> tuple[RenderOutput, Usage]:
            pipeline = replace(self._pipeline, capacities=capacities)
            output = _render_lit(
                pipeline, self.asset(), illumination, camera, aov_names=self._aov_names, key=key
            )
            # The surface's needs are those of an asset that is whole.
            names = set(output.usage) - set(self.asset().usage)
            return output, {name: output.usage[name] for name in names}

        output, capacities = capacity_module.retry(attempt, self._pipeline.capacities)
        self._pipeline = replace(self._pipeline, capacities=capacities)
        return output

    def __call__(self, camera: Camera) -> RenderedView:
        """Render the single view of ``camera``, with every AOV of the evaluation."""
        illuminations = self._illuminated()
        outputs = [self._render(camera, illuminations[0], 0)]
        for number in range(1, self._passes_needed(outputs[0])):
            illumination = illuminations[number % len(illuminations)]
            outputs.append(self._render(camera, illumination, number))
        linear = jnp.mean(jnp.stack([output.rgb[0] for output in outputs]), axis=0)
        first = outputs[0]
        return RenderedView(
            np.asarray(tone_map(linear, self._log_exposure)),
            np.asarray(first.alpha[0]),
            np.asarray(expose(linear, self._log_exposure)),
            {name: np.asarray(image[0]) for name, image in first.aovs.items()},
        )

    def _passes_needed(self, output: RenderOutput) -> int:
        """Count the passes after which a covered pixel has its samples of the specular lobe.

        Pixels that are points themselves have samples of their own in every pass.
        """
        if not self._pipeline.domain.shades_splats:
            return self._passes * _PIXEL_PASSES if self._pipeline.transport.needs_key else 1
        covered, drawn = float(jnp.sum(output.alpha)), int(output.usage["visible"])
        wanted = _SPECULAR_SAMPLES_PER_PIXEL * covered
        needed = math.ceil(wanted / max(drawn * self._pass_samples, 1))
        return min(needed, len(self._illuminations))

    @property
    def is_two_sided(self) -> bool:
        """Whether both sides of the mesh are surface."""
        return self._pipeline.surface.is_two_sided

    def mesh(self, *, training: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Extract the surface: vertices (n, 3), faces (m, 3) and vertex normals (n, 3).

        ``training`` : the mesh that splats sit on, instead of the one that is exported.
        """
        unlit = self._pipeline.unlit()

        def attempt(capacities: Capacities) -> tuple[Surface, Usage]:
            pipeline = replace(unlit, capacities=capacities)
            surface = _extract(pipeline, self._params, final=not training)
            return surface, surface.usage

        return trim_mesh(capacity_module.retry(attempt, self._pipeline.capacities)[0].mesh)


def trim_mesh(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drop padding: vertices, faces and vertex normals on the host."""
    normals = np.asarray(_vertex_normals(mesh))
    vertex_count, face_count = int(mesh.vertex_count), int(mesh.face_count)
    return (
        np.asarray(mesh.vertices)[:vertex_count],
        np.asarray(mesh.faces)[:face_count],
        normals[:vertex_count],
    )


def to_picture(linear: np.ndarray) -> np.ndarray:
    """Return sRGB in [0, 1] on the host."""
    return np.clip(encode_srgb(np.clip(linear, 0.0, 1.0)), 0.0, 1.0)


def render_on_white(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Show linear colour that is premultiplied by ``alpha`` on white, in sRGB."""
    return to_picture(rgb + (1.0 - alpha[..., None]))


def photograph_on_white(image: np.ndarray) -> np.ndarray:
    """Show (H, W, 4) linear colour with straight alpha on white, in sRGB."""
    return render_on_white(image[..., :3] * image[..., 3:], image[..., 3])


def straight_rgba(view: RenderedView) -> np.ndarray:
    """Return sRGB with straight alpha, (H, W, 4); colour is zero where nothing was hit."""
    colors = to_picture(straight(view.rgb, view.alpha))
    return np.concatenate([colors, np.clip(view.alpha, 0.0, 1.0)[..., None]], axis=-1)
