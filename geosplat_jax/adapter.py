"""MGadapter: turn every triangle into six splats, or every vertex into one (Eq. 8-12).

Differentiable in vertices and vertex normals. The number of splats is static (six per face row, or
one per vertex row); rows beyond the mesh's counts are inert padding.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.core.mesh import face_normals_and_areas, vertex_normals
from geosplat_jax.core.numerics import safe_divide, safe_norm, safe_normalize, safe_sqrt
from geosplat_jax.core.rotation import axes_to_quaternion, frame_from_normal, matrix_to_quaternion
from geosplat_jax.core.settings import Number, Positive, PositiveShare, Share, Variant, settings
from geosplat_jax.core.types import Box, Mesh, Splats
from geosplat_jax.materials import Attributes
from geosplat_jax.surface.base import Surface

SPLATS_PER_FACE = 6


@settings
class AdapterConstants:
    """Constants of the sampling; static and hashable."""

    u: Number = 0.07
    """Outer points have the barycentric coordinates (u, u, 1 - 2u) in any order; in [0, 1/3)."""
    v: Number = 0.22
    """Inner points have the barycentric coordinates (v, v, 1 - 2v) in any order; in [0, 1/3)."""
    alpha: tuple[Positive, Positive] = (0.80, 2.08)
    """(outer, inner) ratio of S_x to half the length of the sampled segment."""
    beta: tuple[Positive, Positive] = (15.0, 13.0)
    """(outer, inner) divisor of S_y."""
    thickness: Positive = 4.54e-5
    """S_z in half extents of the scene's box (the paper's box is [-1, 1]^3). The paper prints
    4.5e-7; the authors' code has exp(-10), which is this."""
    opacity: PositiveShare = 0.99
    """Opacity of every splat."""
    shading_frame: bool = False
    """Orient by the interpolated normal (the paper's text) instead of the face's (the authors'
    code)."""
    shift: Share = 0.0
    """Inward shift of the splats of a face, in units of the square root of its area, where none is
    learned (``material.has_shift`` is off); see `shift_inwards`."""
    vertex_area_divisor: Positive = 2.5
    """The k in ``S = sqrt(area / k)`` of the vertex sampling."""

    def __post_init__(self) -> None:
        """Refuse constants that flip a triple of points."""
        if not (0 <= self.u < 1 / 3 and 0 <= self.v < 1 / 3):
            raise ValueError(f"u and v must lie in [0, 1/3), got {self.u} and {self.v}")


PAPER = AdapterConstants(opacity=1.0, shading_frame=True)
CODE = AdapterConstants(u=1 / 9 - 1 / 24, v=2 / 9)


def with_inert_padding(splats: Splats) -> Splats:
    """Overwrite the rows past the count with harmless values; they get no gradient."""
    is_real = splats.mask
    dtype = splats.means.dtype
    unit_quat = jnp.array([[1.0, 0.0, 0.0, 0.0]], dtype)
    return replace(
        splats,
        means=jnp.where(is_real[:, None], splats.means, 0.0),
        quats=jnp.where(is_real[:, None], splats.quats, unit_quat),
        scales=jnp.where(is_real[:, None], splats.scales, 1.0),
        opacities=jnp.where(is_real, splats.opacities, 0.0),
        normals=jnp.where(is_real[:, None], splats.normals, 0.0),
        anchors=jnp.where(is_real[:, None], splats.anchors, 0.0),
    )


def _blend(
    corners: Float[Array, "3 3 F"], opposite: float
) -> tuple[Float[Array, "3 F"], Float[Array, "3 F"], Float[Array, "3 F"]]:
    """Blend corner values at the midpoints m12, m23, m31 of a triple of barycentric points.

    The paper's points b1, b2, b3 lie nearest to P3, P2, P1. The midpoint m12 is opposite to P1: it
    has the weight ``opposite`` on P1 and equal weights on P2 and P3.
    """
    p1, p2, p3 = corners
    side = 0.5 * (1.0 - opposite)
    return (
        opposite * p1 + side * (p2 + p3),
        opposite * p3 + side * (p1 + p2),
        opposite * p2 + side * (p1 + p3),
    )


def face_splats(
    mesh: Mesh,
    normals: Float[Array, "Cv 3"],
    *,
    constants: AdapterConstants,
    unit: Float[Array, ""] | float = 1.0,
) -> Splats:
    """Sample six splats per face (Eq. 8-11), one face after the other.

    The first three sit at the midpoints of the outer triple of barycentric points, the others at
    those of the inner triple. Differentiable in the mesh's vertices and in ``normals``; a triangle
    without area gives finite splats of zero width.

    Parameters
    ----------
    mesh : faces to sample; rows past ``face_count`` become inert splats.
    normals : (Cv, 3) unit vertex normals.
    constants : static; see `AdapterConstants`.
    unit : () length of one unit of ``constants.thickness``, world units.

    Returns
    -------
    `Splats`, six for every row of faces.
    """
    # Components come first, (corner, xyz, face): the arithmetic runs along contiguous faces.
    values = jnp.concatenate([mesh.vertices, normals], axis=1)[mesh.faces.T].transpose(0, 2, 1)
    corners, corner_normals = values[:, :3], values[:, 3:]
    face_normal, area = (x.T for x in face_normals_and_areas(mesh))
    # The segments of both rings are parallel to the same three edges: P2-P3, P1-P2, P3-P1, in the
    # order of the midpoints m12, m23, m31.
    p1, p2, p3 = corners
    edges = (p2 - p3, p1 - p2, p3 - p1)
    lengths = [safe_norm(edge, axis=0) for edge in edges]

    means, shading_normals, scales = [], [], []
    for ring, opposite in enumerate((constants.u, constants.v)):
        means += _blend(corners, opposite)
        ring_normals = [safe_normalize(n, axis=0) for n in _blend(corner_normals, opposite)]
        shading_normals += ring_normals
        for length in lengths:
            segment = (1.0 - 3.0 * opposite) * length
            scale_x = 0.5 * constants.alpha[ring] * segment  # Eq. 10
            scale_y = safe_divide(2.0 * area, constants.beta[ring] * segment)  # Eq. 10
            thickness = jnp.full_like(scale_x, constants.thickness * unit)
            scales.append(jnp.stack([scale_x, scale_y, thickness]))
    if constants.shading_frame:  # Eq. 10, R_x R_y R_z
        quats = [_frame(edge, n) for edge, n in zip(edges * 2, shading_normals, strict=True)]
    else:
        quats = [_frame(edge, face_normal) for edge in edges] * 2

    # Without the barrier XLA fuses these chains into the stacks below, and compiles each several
    # times.
    means, shading_normals, scales, quats = jax.lax.optimization_barrier(
        (means, shading_normals, scales, quats)
    )

    def rows(arrays: list[Float[Array, "c F"]]) -> Float[Array, "N c"]:
        stacked = jnp.stack(arrays)  # (6, c, F)
        return stacked.transpose(2, 0, 1).reshape(-1, stacked.shape[1])

    means = rows(means)
    faces = jnp.arange(area.shape[0], dtype=jnp.int32)
    splats = Splats(
        means=means,
        quats=rows(quats),
        scales=rows(scales),
        opacities=jnp.full((SPLATS_PER_FACE * area.shape[0],), constants.opacity, area.dtype),
        normals=rows(shading_normals),
        outward=jnp.repeat(face_normal.T, SPLATS_PER_FACE, axis=0),
        anchors=means,
        parents=jnp.repeat(faces, SPLATS_PER_FACE),
        count=mesh.face_count * SPLATS_PER_FACE,
    )
    return with_inert_padding(splats)


def _frame(along: Float[Array, "3 F"], up: Float[Array, "3 F"]) -> Float[Array, "4 F"]:
    """Quaternions whose x axis follows ``along`` (made orthogonal to ``up``) and z is ``up``."""
    # Twice: where the two are nearly parallel, little but rounding is left after the first time.
    for _ in range(2):
        along = along - jnp.sum(along * up, axis=0, keepdims=True) * up
    x = safe_normalize(along, axis=0)
    return axes_to_quaternion(x, jnp.cross(up, x, axis=0), up)


def vertex_splats(
    mesh: Mesh,
    normals: Float[Array, "Cv 3"],
    *,
    constants: AdapterConstants,
    unit: Float[Array, ""] | float = 1.0,
) -> Splats:
    """Sample one round splat per vertex (Eq. 12), for the first steps on a rough surface.

    The footprint follows the area of the faces around the vertex, projected along its normal, as
    in the authors' code: the paper's sum has no such cosine. The splats belong to no face.
    Differentiable in vertices and normals. The tangent frame (and so the quaternion) is arbitrary
    about the normal and jumps where ``n_z`` changes sign, which the round footprint hides.

    Parameters
    ----------
    mesh : vertices to sample; rows past ``vertex_count`` become inert splats.
    normals : (Cv, 3) unit vertex normals.
    constants : static; see `AdapterConstants`.
    unit : () length of one unit of ``constants.thickness``, world units.

    Returns
    -------
    `Splats`, one for every row of vertices.
    """
    face_normal, area = face_normals_and_areas(mesh)
    corner_normals = normals[mesh.faces]
    cosines = jnp.sum(face_normal[:, None, :] * corner_normals, axis=-1)
    # A third of each face's area as seen along the vertex normal (Eq. 12).
    share = jnp.where(mesh.face_mask[:, None], 2.0 * area[:, None] * cosines / 6.0, 0.0)
    zero = jnp.zeros((mesh.vertices.shape[0],), mesh.vertices.dtype)
    star_area = zero.at[mesh.faces.reshape(-1)].add(share.reshape(-1))
    radius = safe_sqrt(star_area / constants.vertex_area_divisor)
    thickness = constants.thickness * unit
    tangent, bitangent = frame_from_normal(normals)
    splats = Splats(
        means=mesh.vertices,
        quats=matrix_to_quaternion(jnp.stack([tangent, bitangent, normals], axis=-1)),
        scales=jnp.stack([radius, radius, jnp.full_like(radius, thickness)], axis=-1),
        opacities=jnp.full_like(radius, constants.opacity),
        normals=normals,
        outward=normals,
        anchors=mesh.vertices,
        parents=jnp.full(radius.shape, -1, jnp.int32),
        count=mesh.vertex_count,
    )
    return with_inert_padding(splats)


def shift_inwards(splats: Splats, mesh: Mesh, fraction: Float[Array, " N"]) -> Splats:
    """Move splats below their face: ``mean -= normal * sqrt(area) * fraction``.

    Splats are wider than the triangles they stand for, so the silhouette swells by part of a
    pixel; a learned fraction in (0, 1) takes that back. Face normal and area carry *no* gradient.
    Anchors stay on their faces. Splats without a face do not move.

    Parameters
    ----------
    splats : N splats.
    mesh : whose faces ``splats.parents`` number.
    fraction : (N,) distance in units of the square root of the face's area.
    """
    normal, area = face_normals_and_areas(mesh)
    face_steps = jax.lax.stop_gradient(normal * safe_sqrt(area)[:, None])
    splat_steps = face_steps.at[splats.parents].get(mode="clip")
    is_moving = splats.mask & (splats.parents >= 0)
    shifted_means = splats.means - splat_steps * fraction[:, None]
    return replace(splats, means=jnp.where(is_moving[:, None], shifted_means, splats.means))


class SplatModel(abc.ABC):
    """A way to put splats on a surface; static and hashable."""

    @abc.abstractmethod
    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """Build the splats of a surface.

        Parameters
        ----------
        surface : from `SurfaceModel.extract`.
        parameters : what the splats themselves have learned; None for those that follow the mesh.
        box : of the scene; its half extent is the unit of length.
        """

    def dress(self, attributes: Attributes, parameters: Any) -> Attributes:
        """Replace attributes of the field by those that the splats have learned themselves."""
        del parameters
        return attributes

    def without_indirect(self, parameters: Any) -> Any:
        """Return what the splats have learned themselves, but no indirect light."""
        return parameters

    def with_albedo(self, parameters: Any, albedo: Float[Array, " 3"]) -> Any:
        """Return what the splats have learned themselves, with one albedo for all of them."""
        del albedo
        return parameters

    def settle(self, splats: Splats, surface: Surface, attributes: Attributes) -> Splats:
        """Move the splats by their attributes, such as the inward shift; by default not at all."""
        del surface, attributes
        return splats


@dataclass(frozen=True)
class FaceSplats(SplatModel):
    """Six splats per face, Eq. 8-11."""

    constants: AdapterConstants = AdapterConstants()

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """See `face_splats`."""
        normals = vertex_normals(surface.mesh)
        return face_splats(surface.mesh, normals, constants=self.constants, unit=box.half_extent)

    def settle(self, splats: Splats, surface: Surface, attributes: Attributes) -> Splats:
        """Sink below the faces by the learned shift, or by that of the constants."""
        fraction = attributes.shift
        if fraction is None:
            if self.constants.shift == 0:
                return splats
            fraction = jnp.full_like(splats.opacities, self.constants.shift)
        return shift_inwards(splats, surface.mesh, fraction)


@dataclass(frozen=True)
class VertexSplats(SplatModel):
    """One splat per vertex, Eq. 12."""

    constants: AdapterConstants = AdapterConstants()

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """See `vertex_splats`."""
        normals = vertex_normals(surface.mesh)
        return vertex_splats(surface.mesh, normals, constants=self.constants, unit=box.half_extent)


@dataclass(frozen=True)
class DiscSplats(FaceSplats):
    """Six round discs per face, in its plane, with the areas of the ellipses of `FaceSplats`.

    For ablations: discs follow the normal of the face but not its shape.
    """

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """Replace the ellipses of `face_splats` by discs."""
        splats = super().place(surface, parameters, box)
        radius = safe_sqrt(splats.scales[:, 0] * splats.scales[:, 1])
        scales = jnp.stack([radius, radius, splats.scales[:, 2]], axis=-1)
        tangent, bitangent = frame_from_normal(splats.outward)
        quats = matrix_to_quaternion(jnp.stack([tangent, bitangent, splats.outward], axis=-1))
        return with_inert_padding(replace(splats, scales=scales, quats=quats))


@settings
class SplatSettings(Variant, abc.ABC):
    """Settings of a splat model; every kind of them is a subclass."""

    @property
    def rate_groups(self) -> tuple[str, ...]:
        """Names of the learning rates of what the splats themselves learn."""
        return ()

    @property
    def takes_over(self) -> bool:
        """Whether a stage begins with the splats of the stage before, on a fixed surface."""
        return False

    @property
    def is_six_per_face(self) -> bool:
        """Whether splats come in the order of the faces, `SPLATS_PER_FACE` of each."""
        return False

    def begin(self, previous: Callable[[], tuple[Splats, Attributes]], box: Box) -> Any:
        """Return what the splats have learned at the start of a stage; None for nothing.

        Parameters
        ----------
        previous : makes the splats that the stage before ended with, and their attributes.
        box : of the scene.
        """
        del previous, box
        return None

    def describe(self, parameters: Any) -> Any:
        """Return the sizes of learned parameters, as values that JSON can hold, for `template`."""
        del parameters
        return None

    def template(self, description: Any) -> Any:
        """Make parameters of the described sizes, with any values; None where none are learned."""
        del description
        return None

    @abc.abstractmethod
    def build(self, constants: AdapterConstants) -> SplatModel:
        """Make the model."""


@settings
class FaceSplatSettings(SplatSettings, kind="face"):
    """Six splats per face."""

    @property
    def is_six_per_face(self) -> bool:
        """True."""
        return True

    def build(self, constants: AdapterConstants) -> FaceSplats:
        """Make the model."""
        return FaceSplats(constants)


@settings
class DiscSplatSettings(SplatSettings, kind="disc"):
    """Six round discs per face, which follow its normal and area but not its shape."""

    @property
    def is_six_per_face(self) -> bool:
        """True."""
        return True

    def build(self, constants: AdapterConstants) -> DiscSplats:
        """Make the model."""
        return DiscSplats(constants)


@settings
class VertexSplatSettings(SplatSettings, kind="vertex"):
    """One splat per vertex."""

    def build(self, constants: AdapterConstants) -> VertexSplats:
        """Make the model."""
        return VertexSplats(constants)
