"""The types that travel between the parts of the method, as pytrees.

Conventions. World axes are those of the capture (Blender scenes are z-up). Cameras use OpenCV
axes: x right, y down, z forward; pixel centres lie at integers + 0.5. Colours are linear.
Rows past a count are padding: opacity 0, scale 1, identity quaternion, zero normal, faces whose
corners are all vertex 0. Every function is finite on them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.core.numerics import safe_divide

Bounds = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]
"""The lowest and the highest corner of a box in the world, on the host."""

RATE_GROUP = "rate group"
"""Key of a field's metadata; see `learned`."""


def learned(group: str, **options: Any) -> Any:
    """Declare a field of learned parameters, and the learning rate of all leaves below it.

    A nested field without a group of its own takes the group of the nearest enclosing field.

    Parameters
    ----------
    group : name of the learning rate.
    options : passed on to `equinox.field`.
    """
    return eqx.field(metadata={RATE_GROUP: group}, **options)


def rate_groups(params: Any) -> list[str]:
    """Name the learning rate of every leaf, in the order of `jax.tree.leaves`.

    Raises
    ------
    ValueError
        If a leaf lies below no field that declares one.
    """
    groups = []
    for path, _ in jax.tree_util.tree_flatten_with_path(params)[0]:
        node, group = params, None
        for key in path:
            if isinstance(key, jax.tree_util.GetAttrKey):
                field = type(node).__dataclass_fields__[key.name]
                group = field.metadata.get(RATE_GROUP, group)
                node = getattr(node, key.name)
            else:
                node = node[getattr(key, "idx", getattr(key, "key", None))]
        if group is None:
            raise ValueError(
                f"the parameter {jax.tree_util.keystr(path)} has no learning rate; declare its "
                "group with core.types.learned"
            )
        groups.append(group)
    return groups


def without_gradient(params: Any, groups: tuple[str, ...]) -> Any:
    """Stop the gradients of the parameters whose learning rates ``groups`` name."""
    return _replaced(params, groups, jax.lax.stop_gradient)


def zero_gradient(gradient: Any, groups: tuple[str, ...]) -> Any:
    """Set the gradients of the parameters whose learning rates ``groups`` name to zero."""
    return _replaced(gradient, groups, jnp.zeros_like)


def _replaced(params: Any, groups: tuple[str, ...], change: Callable[[Array], Array]) -> Any:
    """Apply ``change`` to the leaves of some groups."""
    leaves, structure = jax.tree.flatten(params)
    new_leaves = [
        change(leaf) if name in groups else leaf
        for leaf, name in zip(leaves, rate_groups(params), strict=True)
    ]
    return jax.tree.unflatten(structure, new_leaves)


class Camera(eqx.Module):
    """Pinhole cameras of V views that share one static image size.

    Attributes
    ----------
    world_to_camera : (V, 4, 4) rigid transforms to OpenCV camera axes.
    intrinsics : (V, 3, 3) ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in pixels.
    height, width : static image size in pixels.
    """

    world_to_camera: Float[Array, "V 4 4"]
    intrinsics: Float[Array, "V 3 3"]
    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)

    @property
    def centers(self) -> Float[Array, "V 3"]:
        """Camera positions in the world, (V, 3)."""
        rotation, translation = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        return -jnp.einsum("vji,vj->vi", rotation, translation, precision="highest")

    @property
    def count(self) -> int:
        """Number of views."""
        return self.world_to_camera.shape[0]

    def view(self, number: int) -> "Camera":
        """Return the camera of a single view."""
        view_slice = slice(number, number + 1)
        pose, intrinsics = self.world_to_camera[view_slice], self.intrinsics[view_slice]
        return Camera(pose, intrinsics, self.height, self.width)


class Batch(eqx.Module):
    """What one training step sees; all randomness of the step derives from ``key``.

    Attributes
    ----------
    camera : `Camera` of V views.
    image : (V, H, W, 4) linear RGB with straight alpha; alpha is the mask of the object. Colours
        are clipped at one, as tone-mapped renders are.
    key : typed PRNG key.
    views : (V,) int32 numbers of the views within their split; None where they have none.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.
    carry : state that the light transport returned in the step before; None for a transport without
        state.
    """

    camera: Camera
    image: Float[Array, "V H W 4"]
    key: Key[Array, ""]
    views: Int[Array, " V"] | None = None
    valid: Float[Array, "V H W"] | None = None
    carry: Any = None

    @property
    def shares(self) -> Float[Array, " V"]:
        """Shares of the views in a mean over all pixels that count, (V,); they sum up to one."""
        if self.valid is None:
            count = self.image.shape[0]
            return jnp.full((count,), 1.0 / count, self.image.dtype)
        pixel_counts = jnp.sum(self.valid, axis=(1, 2))
        return safe_divide(pixel_counts, jnp.sum(pixel_counts))

    @property
    def count(self) -> int:
        """Number of views."""
        return self.camera.count

    def view(self, number: Int[Array, ""] | int) -> "Batch":
        """Return the batch of a single view, with a random key of its own and without carry.

        Colour and alpha of pixels that do not count are set to zero.
        """

        def one(values: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(values, number, 1)

        camera = replace(
            self.camera,
            world_to_camera=one(self.camera.world_to_camera),
            intrinsics=one(self.camera.intrinsics),
        )
        image = one(self.image)
        valid = None if self.valid is None else one(self.valid)
        if valid is not None:
            # A weight of zero would not remove values that are not finite: 0 * NaN is NaN.
            image = jnp.where(valid[..., None] > 0, image, 0.0)
        return Batch(
            camera=camera,
            image=image,
            key=jax.random.fold_in(self.key, number),
            views=None if self.views is None else one(self.views),
            valid=valid,
        )


class Box(eqx.Module):
    """The cube that a scene's fields are defined on, around the object.

    Attributes
    ----------
    center : (3,) world.
    half_extent : () half of the cube's side, world units; the unit of length of the paper, whose
        box is [-1, 1]^3.
    """

    center: Float[Array, " 3"]
    half_extent: Float[Array, ""]


class Grid(eqx.Module):
    """A box of cubic cells; vertices are numbered with x fastest.

    Attributes
    ----------
    origin : (3,) world position of the lowest corner.
    cell_size : () edge length of a cell, world units.
    shape : static (nx, ny, nz), the number of *cells* along each axis.
    reach : static, at most 1/2; largest move of a vertex along each axis, in cells.
    """

    origin: Float[Array, " 3"]
    cell_size: Float[Array, ""]
    shape: tuple[int, int, int] = eqx.field(static=True)
    reach: float = eqx.field(static=True, default=0.5)

    @property
    def box(self) -> Box:
        """Centre of the grid and half of its longest side."""
        half = 0.5 * self.cell_size * jnp.array(self.shape, self.origin.dtype)
        return Box(self.origin + half, jnp.max(half))

    @property
    def vertex_shape(self) -> tuple[int, int, int]:
        """Number of grid vertices along x, y and z."""
        nx, ny, nz = self.shape
        return nx + 1, ny + 1, nz + 1

    @property
    def vertex_count(self) -> int:
        """Number of grid vertices."""
        vx, vy, vz = self.vertex_shape
        return vx * vy * vz

    @property
    def cube_count(self) -> int:
        """Number of cells."""
        nx, ny, nz = self.shape
        return nx * ny * nz


class Geometry(eqx.Module):
    """Learnable isosurface: raw values, before `tanh` and `sigmoid` bound them.

    Attributes
    ----------
    sdf : (grid vertices,) signed values, negative inside, in units of a cell.
    deform : (grid vertices, 3); a vertex moves by ``tanh(deform) * reach`` cells (see `Grid`).
    alpha : (cells, 8) raw weights of the corners.
    beta : (cells, 12) raw weights of the edges.
    gamma : (cells,) raw weights by which quads are split.
    """

    sdf: Float[Array, " G"] = learned("sdf")
    deform: Float[Array, "G 3"] = learned("deform")
    alpha: Float[Array, "K 8"] = learned("weights")
    beta: Float[Array, "K 12"] = learned("weights")
    gamma: Float[Array, " K"] = learned("weights")


class Mesh(eqx.Module):
    """Triangles with padding; outward faces are counter-clockwise.

    Attributes
    ----------
    vertices : (Cv, 3) world positions.
    faces : (Cf, 3) int32 vertex rows.
    vertex_count, face_count : () int32 true counts.
    """

    vertices: Float[Array, "Cv 3"]
    faces: Int[Array, "Cf 3"]
    vertex_count: Int[Array, ""]
    face_count: Int[Array, ""]

    @property
    def face_mask(self) -> Bool[Array, " Cf"]:
        """True for real faces."""
        return jnp.arange(self.faces.shape[0], dtype=jnp.int32) < self.face_count


class SurfacePoints(eqx.Module):
    """N points of a surface that are shaded, in world coordinates.

    Attributes
    ----------
    positions : (N, 3) points on the surface where rays start.
    normals : (N, 3) unit shading normals.
    outward : (N, 3) unit geometric normals; directions below them are blocked.
    faces : (N,) face of each point, which its rays never hit; -1 for none.
    mask : (N,) rows to shade; the others give zero.
    """

    positions: Float[Array, "N 3"]
    normals: Float[Array, "N 3"]
    outward: Float[Array, "N 3"]
    faces: Int[Array, " N"]
    mask: Bool[Array, " N"]


class Splats(eqx.Module):
    """Oriented anisotropic Gaussians; row i is real when ``i < count``.

    Attributes
    ----------
    means : (N, 3) world.
    quats : (N, 4) unit (w, x, y, z).
    scales : (N, 3) standard deviations, world units.
    opacities : (N,) in [0, 1].
    normals : (N, 3) unit shading normals.
    outward : (N, 3) unit geometric normals, by which back-facing splats are culled.
    anchors : (N, 3) points on the surface, world, where attributes are looked up and rays start.
    parents : (N,) int32 face that each splat belongs to; -1 for none.
    count : () int32.
    """

    means: Float[Array, "N 3"]
    quats: Float[Array, "N 4"]
    scales: Float[Array, "N 3"]
    opacities: Float[Array, " N"]
    normals: Float[Array, "N 3"]
    outward: Float[Array, "N 3"]
    anchors: Float[Array, "N 3"]
    parents: Int[Array, " N"]
    count: Int[Array, ""]

    @property
    def mask(self) -> Bool[Array, " N"]:
        """True for real rows."""
        return jnp.arange(self.means.shape[0], dtype=jnp.int32) < self.count

    def points(self, mask: Bool[Array, " N"] | None = None) -> SurfacePoints:
        """Return the splats as points to shade: all of them, or those of a mask."""
        point_mask = self.mask if mask is None else self.mask & mask
        return SurfacePoints(self.anchors, self.normals, self.outward, self.parents, point_mask)


class Materials(eqx.Module):
    """Surface attributes at N points.

    Attributes
    ----------
    albedo : (N, 3) linear base colour in [0, 1].
    roughness : (N,) perceptual; GGX alpha is its square.
    metallic : (N,) in [0, 1].
    has_specular : static; whether there is a specular lobe. Without one, roughness is 1, metallic
        is 0, and the light of the lobe is not computed.
    """

    albedo: Float[Array, "N 3"]
    roughness: Float[Array, " N"]
    metallic: Float[Array, " N"]
    has_specular: bool = eqx.field(static=True, default=True)


class EnvLight(eqx.Module):
    """Environment light as a lat-long map in the z-up world.

    ``u = 0.5 - atan2(y, x) / (2 pi)`` runs along a row, ``v = acos(z) / pi`` downwards.

    Attributes
    ----------
    radiance : (H, W, 3) linear, non-negative.
    """

    radiance: Float[Array, "H W 3"] = learned("light")
