"""Render trained parameters from any camera and under any light, on the host.

Images average many samples: the light that arrives is gathered once a light, in several passes of
a size that fits memory, and serves every view.
"""

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.types import Camera, EnvLight, Mesh
from geosplat_jax.fit.config import Config
from geosplat_jax.geometry import isosurface, vertex_normals
from geosplat_jax.io.images import encode_srgb
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.render import (
    Asset,
    RenderOutput,
    grid_center_and_extent,
    illuminate_asset,
    reconstruct,
    render_lit,
)
from geosplat_jax.transport.base import Illumination, Transport
from geosplat_jax.transport.denoise import DenoiseSpec

EVALUATION_AOVS = ("albedo", "roughness", "metallic", "normal")
DEFAULT_SAMPLES = 128
"""Rays a splat, over all passes, in images that people look at and figures are made from."""

_PASS_SAMPLES = 16
"""Samples of each kind in a pass, at most."""

_SPECULAR_PASSES = 4
"""Passes that specular light is averaged over; each keeps its samples of the light in memory."""

RELIGHT_BOUNCES = 2
"""How often light goes from surface to surface under a new light."""

RELIGHT_KINDS = ("traced", "none", "unshadowed")
"""How blocked directions look under a new light: see `relight_transport`."""

_reconstruct = partial(jax.jit, static_argnames=("model", "capacities", "sampling"))(reconstruct)
_illuminate = partial(jax.jit, static_argnames=("model",))(illuminate_asset)
_render_lit = partial(jax.jit, static_argnames=("model", "capacities", "aov_names"))(render_lit)
_isosurface = partial(jax.jit, static_argnames=("capacities", "training"))(isosurface)
_vertex_normals = jax.jit(vertex_normals)


@dataclass(frozen=True)
class RenderedView:
    """One rendered view on the host: premultiplied by alpha, float32.

    Attributes
    ----------
    rgb : (H, W, 3) linear, exposed and tone mapped.
    alpha : (H, W).
    aovs : albedo, roughness, metallic, normal; (H, W, c) each.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    aovs: dict[str, np.ndarray]


def build_asset(config: Config, params: Params, context: Context, capacities: Capacities) -> Asset:
    """Run the stages that depend on neither light nor view, growing buffers as needed."""
    while True:
        asset = _reconstruct(
            params, context, model=config.model, capacities=capacities, sampling="face"
        )
        if not capacity_module.overflowed(asset.usage, capacities):
            return asset
        capacities = capacity_module.grow(capacities, asset.usage)


def relight_transport(indirect: str = "traced") -> Transport:
    """Return the light transport under a light that was never trained on.

    What was learned of indirect light does not hold there: blocked directions bring traced light or
    none. Unshadowed, only a splat's own face blocks, as for those who do not trace rays.
    """
    if indirect not in RELIGHT_KINDS:
        raise ValueError(f"indirect must be one of {RELIGHT_KINDS}, got {indirect!r}")
    is_shadowed = indirect != "unshadowed"
    return Transport(
        method="monte_carlo",
        occlusion=is_shadowed,
        indirect=indirect if is_shadowed else "none",
        bounces=RELIGHT_BOUNCES,
    )


class Renderer:
    """Render views of fixed parameters one at a time, growing buffers as needed.

    Parameters
    ----------
    config, params, context, capacities : see `train.load_run`.
    samples : rays a splat for the diffuse light, half of them towards the light and half after the
        cosine, where the model traces any; rounded up to equal passes of at most 32, see
        `samples`. The noise falls as the square root. The specular lobe, which every view
        integrates anew, has half as many of its own, from four passes at most, and the splats of
        a pixel average it further.
    seed : of the samples.
    """

    def __init__(
        self,
        config: Config,
        params: Params,
        context: Context,
        capacities: Capacities,
        *,
        samples: int = DEFAULT_SAMPLES,
        seed: int = 0,
    ) -> None:
        if samples < 1:
            raise ValueError(f"an image needs at least 1 sample a splat, got {samples}")
        self._config = config
        self._params = params
        self._context = context
        self._capacities = capacities
        self._key = jax.random.key(seed)
        self._passes = -(-samples // (2 * _PASS_SAMPLES))
        self._pass_samples = -(-samples // (2 * self._passes))
        self._light = params.light
        self._log_exposure = params.log_exposure
        self._albedo_scale = np.ones(3, np.float32)
        self._model = self._for_images(config.model)
        self._asset: Asset | None = None
        self._illuminations: list[Illumination] = []

    @property
    def samples(self) -> int:
        """Rays a splat that are traced for the diffuse light, over all passes."""
        return 2 * self._passes * self._pass_samples

    def _for_images(self, model: Model) -> Model:
        """Return the model with the samples of one pass, and without shortcuts of training."""
        if model.transport.method == "split_sum":
            return model
        counts = dict.fromkeys(("light", "diffuse", "specular"), self._pass_samples)
        transport = replace(
            model.transport, shares_views=True, denoise=DenoiseSpec(iterations=0), **counts
        )
        return replace(model, transport=transport)

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
        other = Renderer(
            self._config, self._params, self._context, self._capacities, samples=self.samples
        )
        other._key = self._key
        other._light = light
        other._log_exposure = jnp.zeros(())
        other._albedo_scale = np.asarray(albedo_scale, np.float32)
        material = replace(self._config.model.material, indirect_outputs=0)
        transport = relight_transport(indirect)
        other._model = self._for_images(
            replace(self._config.model, transport=transport, material=material, baked_diffuse=False)
        )
        return other

    def under(self, light: EnvLight) -> "Renderer":
        """Return a renderer that differs in the light alone; the surface is not built again."""
        other = copy.copy(self)
        other._light = light
        other._illuminations = []
        return other

    def center(self) -> np.ndarray:
        """Centre of the grid's box in the world, (3,) float64."""
        center, _ = grid_center_and_extent(self._context.grid)
        return np.asarray(center, np.float64)

    def asset(self) -> Asset:
        """Build surface and splats, once."""
        if self._asset is None:
            config = replace(self._config, model=self._model)
            asset = build_asset(config, self._params, self._context, self._capacities)
            albedo = asset.materials.albedo * self._albedo_scale[None, :]
            self._asset = replace(asset, materials=replace(asset.materials, albedo=albedo))
        return self._asset

    def _illuminated(self) -> list[Illumination]:
        """Gather the light, once: the mean of all passes, with the light's samples of a few."""
        if self._illuminations:
            return self._illuminations
        passes = 1 if self._model.transport.method == "split_sum" else self._passes
        total, kept = None, []
        for number in range(passes):
            found = _illuminate(
                self.asset(),
                self._light,
                self._context,
                model=self._model,
                key=jax.random.fold_in(self._key, number),
            )
            total = found if total is None else _added(total, found)
            if number < _SPECULAR_PASSES:
                kept.append(found)
        assert total is not None
        mean = _averaged_parts(_scaled(total, 1.0 / passes))
        self._illuminations = [_with_parts(one, mean) for one in kept]
        return self._illuminations

    def _render(self, camera: Camera, illumination: Illumination, number: int) -> RenderOutput:
        """Render one pass of a view, growing buffers as needed."""
        while True:
            output = _render_lit(
                self.asset(),
                illumination,
                camera,
                self._context,
                model=self._model,
                capacities=self._capacities,
                aov_names=EVALUATION_AOVS,
                key=jax.random.fold_in(self._key, self._passes + number),
            )
            view_needs = _without_surface(output.usage)
            if not capacity_module.overflowed(view_needs, self._capacities):
                return output
            self._capacities = capacity_module.grow(self._capacities, view_needs)

    def __call__(self, camera: Camera) -> RenderedView:
        """Render the single view of ``camera``, with every AOV of the evaluation."""
        outputs = [
            self._render(camera, illumination, number)
            for number, illumination in enumerate(self._illuminated())
        ]
        linear = jnp.mean(jnp.stack([output.rgb[0] for output in outputs]), axis=0)
        rgb = tone_map(linear, self._log_exposure)
        first = outputs[0]
        return RenderedView(
            np.asarray(rgb),
            np.asarray(first.alpha[0]),
            {name: np.asarray(image[0]) for name, image in first.aovs.items()},
        )

    def mesh(self, *, training: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Extract the surface: vertices (n, 3), faces (m, 3) and vertex normals (n, 3)."""
        while True:
            surface = _isosurface(
                self._params.geometry,
                self._context.grid,
                capacities=self._capacities,
                training=training,
            )
            if not capacity_module.overflowed(surface.usage, self._capacities):
                break
            self._capacities = capacity_module.grow(self._capacities, surface.usage)
        return trim_mesh(surface.mesh)


def _without_surface(usage: capacity_module.Usage) -> capacity_module.Usage:
    """Needs of the view alone: `build_asset` has seen to the surface's."""
    zero = jnp.zeros((), jnp.int32)
    names = ("surface_cubes", "dual_vertices", "quads", "cell_patches")
    return dataclasses.replace(usage, **dict.fromkeys(names, zero))


def _averaged_parts(illumination: Illumination) -> tuple:
    """Return what passes are averaged in: diffuse light, and traced indirect light."""
    gathered, indirect = illumination.gathered, illumination.indirect
    traced = indirect is not None and indirect.kind == "traced"
    return (
        None if gathered is None else gathered.diffuse_light,
        indirect.values if traced and indirect is not None else None,
    )


def _with_parts(illumination: Illumination, parts: tuple) -> Illumination:
    """Put averaged parts back."""
    diffuse_light, values = parts
    gathered, indirect = illumination.gathered, illumination.indirect
    if gathered is not None and diffuse_light is not None:
        gathered = replace(gathered, diffuse_light=diffuse_light)
    if indirect is not None and values is not None:
        indirect = replace(indirect, values=values)
    return replace(illumination, gathered=gathered, indirect=indirect)


def _added(first: Illumination, second: Illumination) -> Illumination:
    """Sum what is averaged; the samples of the light are those of the first."""
    parts = jax.tree.map(jnp.add, _averaged_parts(first), _averaged_parts(second))
    return _with_parts(first, parts)


def _scaled(illumination: Illumination, factor: float) -> Illumination:
    """Multiply what is averaged."""
    parts = jax.tree.map(lambda x: x * factor, _averaged_parts(illumination))
    return _with_parts(illumination, parts)


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
    alpha = view.alpha[..., None]
    straight = np.where(alpha > 0, view.rgb / np.where(alpha > 0, alpha, 1.0), 0.0)
    return np.concatenate([to_picture(straight), np.clip(alpha, 0.0, 1.0)], axis=-1)
