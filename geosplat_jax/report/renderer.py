"""Render trained parameters from any camera and under any light, on the host.

Images average many samples. Incident light is computed once per light, in several passes that fit
into the memory, and used for every view.
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
from geosplat_jax.render import Asset, Params, PerSplat, RenderOutput, RenderPipeline
from geosplat_jax.surface.base import Surface
from geosplat_jax.transport.base import Illumination
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.paths import PathSettings

EVALUATION_AOVS = ("albedo", "roughness", "metallic", "normal")
DEFAULT_SAMPLES = 128
"""Rays per splat, over all passes, in final images and for metrics."""

LARGEST_SAMPLES = 1_000_000
"""Most rays per splat, over all passes."""

_PASS_SAMPLES = 16
"""Most samples of each kind in a pass."""

_SPECULAR_PASSES = 4
"""Most passes that specular light is averaged over; the light samples of each stay in memory."""

_SPECULAR_SAMPLES_PER_PIXEL = 128
"""Samples of the specular lobe that suffice for a covered pixel, over all its splats and passes."""

_PIXEL_PASSES = 2
"""Factor on the number of passes where pixels are shaded instead of splats: a pixel averages
several splats, and so their samples."""

_HEADROOM = 1.25
"""Where buffers must grow: their size over what the first view of an image size needs."""

RELIGHT_BOUNCES = 2
"""Number of bounces of light between surfaces under a new light."""

RELIGHT_KINDS = ("traced", "paths", "none", "unshadowed")
"""What blocked directions bring under a new light, see `relight_transport`."""

_reconstruct = jax.jit(Pipeline.reconstruct)
_illuminate = jax.jit(Pipeline.illuminate)
_render_lit = partial(jax.jit, static_argnames=("aov_names",))(Pipeline.render_lit)
_vertex_normals = jax.jit(vertex_normals)


@partial(jax.jit, static_argnames=("final",))
def _extract(pipeline: RenderPipeline, params: Params, *, final: bool) -> Surface:
    return pipeline.surface.extract(params.geometry, capacities=pipeline.capacities, final=final)


@jax.jit
def _needs(pipeline: RenderPipeline, splats: Splats, camera: Camera) -> Usage:
    """Count the entries that the buffers of a view need."""
    return pipeline.visible(splats, camera).usage


@dataclass(frozen=True)
class RenderedView:
    """One rendered view on the host: premultiplied by alpha, float32.

    Attributes
    ----------
    rgb : (H, W, 3) linear, exposed and tone mapped.
    alpha : (H, W) coverage in [0, 1].
    linear : (H, W, 3) exposed radiance before tone mapping, without upper bound.
    aovs : albedo, roughness, metallic, normal, and those of `Renderer.with_aovs`; (H, W, c) each.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    linear: np.ndarray
    aovs: dict[str, np.ndarray]


def build_asset(pipeline: Pipeline, params: Params) -> Asset:
    """Compute surface, splats and attributes, growing buffers as needed."""
    unlit = pipeline.unlit()

    def attempt(capacities: Capacities) -> tuple[Asset, Usage]:
        asset = _reconstruct(replace(unlit, capacities=capacities), params)
        return asset, asset.usage

    # A pipeline that traced no rays so far has no sizes for their index.
    guess = {**pipeline.surface.first_capacities(params.geometry), **pipeline.capacities}
    return capacity_module.retry(attempt, Capacities(**guess))[0]


def exposed_radiance(params: Params) -> np.ndarray:
    """Radiance of the light times the learned exposure, (H, W, 3), as bright as the photographs."""
    return np.asarray(params.light.radiance) * np.exp(float(params.log_exposure))


def relight_transport(indirect: str = "traced") -> MonteCarloSettings | PathSettings:
    """Return the light transport under a new light.

    Indirect light that was learned in training does not hold under a new light. Where a direction
    is blocked, ``indirect`` says what arrives instead: ``traced``, light looked up at the face that
    is hit; ``paths``, light along paths with `RELIGHT_BOUNCES` bounces between surfaces, as many as
    ``traced`` has; ``none``, nothing. With ``unshadowed`` no rays are traced, and a splat is only
    blocked by its own face.

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
    """Return the number of passes for a number of rays per splat, and samples per kind and pass.

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
    samples : rays per splat for diffuse light, for transports that sample: half of them follow the
        light, half the cosine. The number is rounded up to equal passes of at most 32, see the
        property `samples`; the noise falls as its square root. The specular lobe, which is
        integrated anew for every view, has half as many samples, from at most four passes, or fewer
        where a pixel averages enough splats.
    seed : seed of the samples.
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

        The transport is Monte Carlo, whatever the run was trained with; the exposure is 1.

        Parameters
        ----------
        light : environment map of any size.
        albedo_scale : (3,) factors of the albedo, which photographs do not determine.
        indirect : one of `RELIGHT_KINDS`, see `relight_transport`.

        Raises
        ------
        ValueError
            If ``indirect`` is not one of `RELIGHT_KINDS`.
        """
        transport = relight_transport(indirect).build(LightSpec())  # keeps no table of a light
        relit_renderer = Renderer(
            replace(self._trained, transport=transport), self._params, samples=self.samples
        )
        relit_renderer._keeps_indirect = False
        relit_renderer._key = self._key
        relit_renderer._light = light
        relit_renderer._log_exposure = jnp.zeros(())
        relit_renderer._albedo_scale = np.asarray(albedo_scale, np.float32)
        relit_renderer._aov_names = self._aov_names
        return relit_renderer

    def under(self, light: EnvLight) -> "Renderer":
        """Return a renderer that differs in the light alone; the surface is not built again."""
        renderer = self._copy()
        renderer._light = light
        renderer._illuminations = []
        return renderer

    def with_samples(self, samples: int) -> "Renderer":
        """Return a renderer of the same surface with another number of rays per splat."""
        self.asset()
        renderer = self._copy()
        renderer._passes, renderer._pass_samples = _passes_of(samples)
        renderer._pipeline = renderer._for_images(renderer._pipeline)
        renderer._illuminations = []
        return renderer

    def with_aovs(self, *names: str) -> "Renderer":
        """Return a renderer whose views have these AOVs too, some of `render.AOV_CHANNELS`."""
        renderer = self._copy()
        renderer._aov_names = tuple(dict.fromkeys((*self._aov_names, *names)))
        return renderer

    def hurried(self) -> "Renderer":
        """Return a renderer of a single pass: noisier, with the same compiled programs."""
        renderer = self._copy()
        renderer._passes, renderer._illuminations = 1, []
        return renderer

    def _copy(self) -> "Renderer":
        """Return a copy of this renderer, with its own set of planned image sizes."""
        renderer = copy.copy(self)
        renderer._planned = set(self._planned)
        return renderer

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
        """Return the scene that cameras are refined against: this asset under this light.

        Diffuse light is the mean over all passes; the specular lobe has the samples of the first.
        Splats are shaded, even where the run shades pixels.
        """
        asset, renderer = self.asset(), self._copy()
        if not isinstance(self._pipeline.domain, PerSplat):
            renderer._pipeline = replace(self._pipeline, domain=PerSplat())
            renderer._illuminations = []
        illumination = renderer._illuminated()[0]
        key = jax.random.fold_in(self._key, self._passes)
        exposure = jnp.asarray(self._log_exposure)
        return Subject(renderer._pipeline, asset, illumination, exposure, key)

    def _illuminated(self) -> list[Illumination]:
        """Compute incident light, once; one result for each pass of specular light.

        All of them hold the mean of diffuse light over all passes, each the light samples of its
        own pass.
        """
        if self._illuminations:
            return self._illuminations
        passes = self._passes if self._pipeline.transport.needs_key else 1
        total, illuminations = None, []
        for pass_index in range(passes):
            key = jax.random.fold_in(self._key, pass_index)
            illumination, _ = _illuminate(self._pipeline, self.asset(), self._light, key=key)
            parts = illumination.averaged_parts()
            total = parts if total is None else jax.tree.map(jnp.add, total, parts)
            if pass_index < _SPECULAR_PASSES:
                illuminations.append(illumination)
        mean = jax.tree.map(lambda x: x * (1.0 / passes), total)
        self._illuminations = [illumination.with_parts(mean) for illumination in illuminations]
        return self._illuminations

    def plan(self, camera: Camera) -> None:
        """Grow buffers for the first view of an image size, before the renderer is compiled.

        Rendering does this itself. When it is called first, renderers that are made by `under`
        afterwards share the result.
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

    def _render(self, camera: Camera, illumination: Illumination, pass_index: int) -> RenderOutput:
        """Render one pass of a view, growing buffers as needed."""
        self.plan(camera)
        key = jax.random.fold_in(self._key, self._passes + pass_index)

        def attempt(capacities: Capacities) -> tuple[RenderOutput, Usage]:
            pipeline = replace(self._pipeline, capacities=capacities)
            output = _render_lit(
                pipeline, self.asset(), illumination, camera, aov_names=self._aov_names, key=key
            )
            # The asset is complete, so that only needs of the view may exceed their buffers.
            names = set(output.usage) - set(self.asset().usage)
            return output, {name: output.usage[name] for name in names}

        output, capacities = capacity_module.retry(attempt, self._pipeline.capacities)
        self._pipeline = replace(self._pipeline, capacities=capacities)
        return output

    def __call__(self, camera: Camera) -> RenderedView:
        """Render the single view of ``camera``, with all AOVs of this renderer."""
        illuminations = self._illuminated()
        first_output = self._render(camera, illuminations[0], 0)
        pass_count, total = self._passes_needed(first_output), first_output.rgb[0]
        for pass_index in range(1, pass_count):
            illumination = illuminations[pass_index % len(illuminations)]
            total = total + self._render(camera, illumination, pass_index).rgb[0]
        linear = total / pass_count
        return RenderedView(
            np.asarray(tone_map(linear, self._log_exposure)),
            np.asarray(first_output.alpha[0]),
            np.asarray(expose(linear, self._log_exposure)),
            {name: np.asarray(image[0]) for name, image in first_output.aovs.items()},
        )

    def _passes_needed(self, output: RenderOutput) -> int:
        """Return the number of passes after which covered pixels have enough specular samples.

        Where pixels are shaded instead of splats, each pass adds samples to every pixel.
        """
        if not self._pipeline.domain.shades_splats:
            return self._passes * _PIXEL_PASSES if self._pipeline.transport.needs_key else 1
        covered_pixels, splat_count = float(jnp.sum(output.alpha)), int(output.usage["visible"])
        sample_count = _SPECULAR_SAMPLES_PER_PIXEL * covered_pixels
        pass_count = math.ceil(sample_count / max(splat_count * self._pass_samples, 1))
        return max(min(pass_count, len(self._illuminations)), 1)

    @property
    def is_two_sided(self) -> bool:
        """Whether both sides of the mesh are surface."""
        return self._pipeline.surface.is_two_sided

    def mesh(self, *, training: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Extract the surface: vertices (n, 3) world, faces (m, 3) and vertex normals (n, 3).

        ``training`` : return the mesh that splats lie on, instead of the one for export.
        """
        unlit = self._pipeline.unlit()

        def attempt(capacities: Capacities) -> tuple[Surface, Usage]:
            pipeline = replace(unlit, capacities=capacities)
            surface = _extract(pipeline, self._params, final=not training)
            return surface, surface.usage

        return trim_mesh(capacity_module.retry(attempt, self._pipeline.capacities)[0].mesh)


def trim_mesh(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices, faces and vertex normals of a mesh on the host, without padding."""
    normals = np.asarray(_vertex_normals(mesh))
    vertex_count, face_count = int(mesh.vertex_count), int(mesh.face_count)
    return (
        np.asarray(mesh.vertices)[:vertex_count],
        np.asarray(mesh.faces)[:face_count],
        normals[:vertex_count],
    )


def to_picture(linear: np.ndarray) -> np.ndarray:
    """Clip linear values to [0, 1] and encode them in sRGB, on the host."""
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
