"""How light reaches the splats and leaves them towards the cameras: one interface, two methods.

``"split_sum"`` shades with prefiltered light and ignores occlusion (stage 1); ``"monte_carlo"``
traces rays against the surface (stage 2). `illuminate` does what no view has a part in, and
`shade_rows` shades the visible splats of a view, or of several views at once.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.adapter import GAUSSIANS_PER_FACE
from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.types import EnvLight, Materials
from geosplat_jax.rays.grid_index import Accelerator
from geosplat_jax.splats.rasterize import gather_visible
from geosplat_jax.transport.denoise import DenoiseSpec, denoise
from geosplat_jax.transport.environment import PrefilteredLight, PrefilterOperators, prefilter
from geosplat_jax.transport.indirect import INDIRECT_KINDS, Indirect, outgoing
from geosplat_jax.transport.light_sampling import LightSampler, light_sampler
from geosplat_jax.transport.monte_carlo import (
    Gathered,
    SampleCounts,
    SurfacePoints,
    draw_samples,
    gather,
    reflect,
)
from geosplat_jax.transport.split_sum import Shaded, split_sum

METHODS = ("split_sum", "monte_carlo")

DENOISER_INPUTS = (
    "diffuse",
    "specular",
    "specular_radiance",
    "albedo",
    "metallic",
    "normal",
    "depth",
)
"""Images that `denoised` needs beside the colours."""

_DARKEST = 1e-6
"""Light below this has no tint."""


@dataclass(frozen=True)
class Transport:
    """Static choices of light transport; hashable.

    Attributes
    ----------
    method : one of `METHODS`; what follows concerns ``"monte_carlo"`` only.
    light, diffuse, specular : samples a splat, see `SampleCounts`.
    residual : samples of each kind of a second image, from which Eq. 13 takes its residual; with 0
        it takes that of the image that it differentiates, which biases the gradient.
    occlusion : trace rays against the surface; without it only directions below a splat's own
        face are blocked.
    indirect : light from blocked directions, one of `indirect.INDIRECT_KINDS`.
    bounces : for traced indirect light, how often light goes from surface to surface.
    shares_views : all views of a batch use the same samples of light and cosine, which are then
        traced once. The images' noise is then correlated between views; its mean is the same.
    denoise : filter of the demodulated light in the image, off by default; see `denoised`.
    """

    method: str = "split_sum"
    light: int = 4
    diffuse: int = 4
    specular: int = 4
    residual: int = 0
    occlusion: bool = True
    indirect: str = "none"
    bounces: int = 1
    shares_views: bool = True
    denoise: DenoiseSpec = DenoiseSpec(iterations=0)

    def __post_init__(self) -> None:
        """Refuse unknown names, bad counts, and no bounce at all."""
        if self.method not in METHODS:
            raise ValueError(f"transport.method must be one of {METHODS}, got {self.method!r}")
        if self.indirect not in INDIRECT_KINDS:
            raise ValueError(
                f"transport.indirect must be one of {INDIRECT_KINDS}, got {self.indirect!r}"
            )
        if self.bounces < 1:
            raise ValueError(f"transport.bounces must be at least 1, got {self.bounces}")
        if self.residual < 0:
            raise ValueError(f"transport.residual must not be negative, got {self.residual}")
        SampleCounts(self.light, self.diffuse, self.specular)

    @property
    def judges_apart(self) -> bool:
        """Whether a loss takes its residual from an image with samples of its own."""
        return self.method == "monte_carlo" and self.residual > 0

    def for_residual(self) -> "Transport":
        """Return the transport of that image."""
        return replace(
            self, light=self.residual, diffuse=self.residual, specular=self.residual, residual=0
        )

    @property
    def counts(self) -> SampleCounts:
        """Samples a splat."""
        return SampleCounts(self.light, self.diffuse, self.specular)

    @property
    def is_traced(self) -> bool:
        """Whether rays are traced against the surface."""
        return self.method == "monte_carlo" and self.occlusion

    @property
    def is_denoised(self) -> bool:
        """Whether images are filtered."""
        return self.method == "monte_carlo" and self.denoise.iterations > 0

    @property
    def finds_nearest(self) -> bool:
        """Whether rays must know what they hit."""
        return self.is_traced and self.indirect == "traced"


class Receivers(eqx.Module):
    """N splats as light sees them.

    Attributes
    ----------
    anchors : (N, 3) where rays start: on the face, not below it.
    normals, outward : (N, 3) unit, shading and geometric.
    mask : (N,) splats to shade.
    materials : of the N splats.
    coefficients : (N, c) learned indirect light, or None.
    accelerator : the surface, or None.
    """

    anchors: Float[Array, "N 3"]
    normals: Float[Array, "N 3"]
    outward: Float[Array, "N 3"]
    mask: Bool[Array, " N"]
    materials: Materials
    coefficients: Float[Array, "N c"] | None
    accelerator: Accelerator | None

    def points(self) -> SurfacePoints:
        """Start of the rays; row i lies on face i // 6."""
        count = self.mask.shape[0]
        faces = jnp.arange(count, dtype=jnp.int32) // GAUSSIANS_PER_FACE
        return SurfacePoints(self.anchors, self.normals, self.outward, faces, self.mask)


class Illumination(eqx.Module):
    """Light, prepared for every view: the fields of one of the two methods, the others are None.

    Attributes
    ----------
    prefiltered : maps of the split sum.
    light, sampler, indirect : environment, its tables, and indirect light (N or F rows).
    gathered : what arrives at every splat, where views share it.
    """

    prefiltered: PrefilteredLight | None = None
    light: EnvLight | None = None
    sampler: LightSampler | None = None
    indirect: Indirect | None = None
    gathered: Gathered | None = None


def _gather_with_bounces(
    key: Key[Array, ""],
    receivers: Receivers,
    light: EnvLight,
    sampler: LightSampler,
    *,
    transport: Transport,
) -> tuple[Gathered, Indirect]:
    """Light of all splats; traced indirect light is what it was, one bounce ago."""
    points, accelerator = receivers.points(), receivers.accelerator
    samples = draw_samples(
        key,
        points,
        sampler,
        accelerator,
        counts=transport.counts,
        finds_nearest=transport.finds_nearest,
    )
    if transport.indirect != "traced":
        indirect = Indirect(receivers.coefficients, transport.indirect)
        return gather(points, samples, light, indirect), indirect
    faces = receivers.mask.shape[0] // GAUSSIANS_PER_FACE
    dtype = receivers.normals.dtype
    indirect = Indirect(jnp.zeros((faces, 3), dtype), "traced")
    gathered = gather(points, samples, light, indirect)
    for _ in range(transport.bounces):
        sent = outgoing(receivers.materials, gathered.diffuse_light, GAUSSIANS_PER_FACE)
        indirect = Indirect(sent, "traced")
        gathered = gather(points, samples, light, indirect)
    return gathered, indirect


def illuminate(
    key: Key[Array, ""] | None,
    receivers: Receivers,
    light: EnvLight,
    operators: PrefilterOperators,
    *,
    transport: Transport,
) -> Illumination:
    """Prepare a light for all views.

    Parameters
    ----------
    key : of all samples; the split sum needs none.
    receivers : all splats of the surface; face sampling, for Monte Carlo.
    light, operators : the environment, and what prefilters it.
    transport : static.

    Raises
    ------
    ValueError
        If Monte Carlo gets no key.
    """
    if transport.method == "split_sum":
        return Illumination(prefiltered=prefilter(light, operators))
    if key is None:
        raise ValueError("Monte Carlo shading needs a key for its samples")
    sampler = light_sampler(light)
    if transport.shares_views or transport.indirect == "traced":
        gathered, indirect = _gather_with_bounces(
            key, receivers, light, sampler, transport=transport
        )
    else:
        gathered, indirect = None, Indirect(receivers.coefficients, transport.indirect)
    if not transport.shares_views:
        gathered = None
    return Illumination(light=light, sampler=sampler, indirect=indirect, gathered=gathered)


def shade_rows(
    key: Key[Array, ""] | None,
    receivers: Receivers,
    index: Int[Array, " M"],
    towards_viewer: Float[Array, "M 3"],
    materials: Materials,
    illumination: Illumination,
    fg_table: Float[Array, "V R 2"],
    *,
    transport: Transport,
    baked_diffuse: bool,
) -> Shaded:
    """Shade M visible splats, each towards its own viewer.

    Parameters
    ----------
    key : of the samples that depend on the viewer; the split sum needs none.
    receivers : all N splats.
    index : (M,) rows of the splats; N for padding, which gives zeros or what does no harm.
    towards_viewer : (M, 3) unit. materials : of the M splats.
    illumination : from `illuminate`.
    fg_table : of the split sum.
    transport, baked_diffuse : static; the latter as for `split_sum`.
    """

    def rows(values: Array) -> Array:
        return gather_visible(index, values)

    if illumination.prefiltered is not None:
        return split_sum(
            materials,
            rows(receivers.normals),
            towards_viewer,
            illumination.prefiltered,
            fg_table,
            baked_diffuse=baked_diffuse,
        )
    assert key is not None
    assert illumination.light is not None
    assert illumination.sampler is not None
    assert illumination.indirect is not None
    points = jax.tree.map(rows, receivers.points())
    indirect = illumination.indirect
    if indirect.belongs_to_points and indirect.values is not None:
        indirect = replace(indirect, values=rows(indirect.values))
    how = {"counts": transport.counts, "finds_nearest": transport.finds_nearest}
    arguments = (illumination.sampler, receivers.accelerator)
    own_key, shared_key = jax.random.split(key)
    if illumination.gathered is not None:
        gathered = jax.tree.map(rows, illumination.gathered)
    else:
        samples = draw_samples(shared_key, points, *arguments, **how)
        gathered = gather(points, samples, illumination.light, indirect)
    return reflect(
        own_key,
        points,
        materials,
        towards_viewer,
        gathered,
        illumination.light,
        *arguments,
        indirect,
        **how,
    )


def denoised(
    images: dict[str, Float[Array, "H W c"]],
    alpha: Float[Array, "H W"],
    *,
    spec: DenoiseSpec,
    focal: Float[Array, ""],
) -> dict[str, Float[Array, "H W c"]]:
    """Filter the light of one view and correct its colours by what the filter changed.

    ``rgb + base (F(L_d) - L_d) + tint (F(L_s) - L_s)``, with the filter F, the demodulated diffuse
    and specular light L, the albedo of the diffuse lobe and the mean tint of the specular one. A
    filter that changes nothing leaves the image as it was, to the bit.

    Parameters
    ----------
    images : by name, premultiplied by ``alpha``: ``rgb``, ``diffuse`` and ``specular`` (light),
        ``specular_radiance``, ``albedo``, ``metallic``, ``normal`` and ``depth``.
    alpha : (H, W) coverage.
    spec : static. focal : () focal length in pixels.

    Returns
    -------
    ``images`` with new ``rgb``, ``diffuse`` and ``specular``. The gradient is that of a filter with
    constant weights and of a constant tint.
    """
    light = jnp.concatenate([images["diffuse"], images["specular"]], axis=-1)
    filtered = denoise(
        light,
        alpha,
        images["normal"],
        images["depth"][..., 0],
        images["albedo"],
        spec=spec,
        focal=focal,
    )
    change = filtered - light
    coverage = alpha[..., None]
    base = safe_divide(images["albedo"], coverage)
    base = base * (1 - safe_divide(images["metallic"], coverage))
    tint = safe_divide(images["specular_radiance"], images["specular"], smallest=_DARKEST)
    tint = jax.lax.stop_gradient(jnp.clip(tint, 0.0, 1.0))
    rgb = images["rgb"] + base * change[..., :3] + tint * change[..., 3:]
    return {**images, "rgb": rgb, "diffuse": filtered[..., :3], "specular": filtered[..., 3:]}
