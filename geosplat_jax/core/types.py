"""The types that travel between the stages: frozen dataclasses, registered as pytrees.

Conventions. World axes are those of the capture (Blender scenes are z-up). Cameras use OpenCV
axes: x right, y down, z forward; pixel centres lie at integers + 0.5. Colours are linear.
Rows past a count are padding: opacity 0, scale 1, unit quaternion, zero normal, faces on row 0,
so that every function is finite on them.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key


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
        return -jnp.einsum("vji,vj->vi", rotation, translation)


class Batch(eqx.Module):
    """What one training step sees; all randomness of the step derives from ``key``.

    Attributes
    ----------
    camera : `Camera` of V views.
    image : (V, H, W, 4) linear RGB with straight alpha; alpha is the mask.
    key : typed PRNG key.
    """

    camera: Camera
    image: Float[Array, "V H W 4"]
    key: Key[Array, ""]


class Grid(eqx.Module):
    """A box of cubic cells; vertices are numbered with x fastest.

    Attributes
    ----------
    origin : (3,) world position of the lowest corner.
    cell_size : () edge length of a cell, world units.
    shape : static (nx, ny, nz), the number of *cells* along each axis.
    """

    origin: Float[Array, " 3"]
    cell_size: Float[Array, ""]
    shape: tuple[int, int, int] = eqx.field(static=True)

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
    deform : (grid vertices, 3); a vertex moves by ``tanh(deform) * cell_size / 2``.
    alpha : (cells, 8) corner weights; beta : (cells, 12) edge weights; gamma : (cells,) split
        weights, all raw.
    """

    sdf: Float[Array, " G"]
    deform: Float[Array, "G 3"]
    alpha: Float[Array, "K 8"]
    beta: Float[Array, "K 12"]
    gamma: Float[Array, " K"]


class Mesh(eqx.Module):
    """Triangles with padding; outward faces are counter-clockwise.

    Attributes
    ----------
    vertices : (Cv, 3) world positions; faces : (Cf, 3) int32 vertex rows.
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

    @property
    def vertex_mask(self) -> Bool[Array, " Cv"]:
        """True for real vertices."""
        return jnp.arange(self.vertices.shape[0], dtype=jnp.int32) < self.vertex_count


class Gaussians(eqx.Module):
    """Oriented anisotropic Gaussians; row i is real when ``i < count``.

    Attributes
    ----------
    means : (N, 3) world; quats : (N, 4) unit (w, x, y, z); scales : (N, 3) standard deviations,
        world units; opacities : (N,) in [0, 1]; normals : (N, 3) unit shading normals.
    count : () int32.
    """

    means: Float[Array, "N 3"]
    quats: Float[Array, "N 4"]
    scales: Float[Array, "N 3"]
    opacities: Float[Array, " N"]
    normals: Float[Array, "N 3"]
    count: Int[Array, ""]

    @property
    def mask(self) -> Bool[Array, " N"]:
        """True for real rows."""
        return jnp.arange(self.means.shape[0], dtype=jnp.int32) < self.count


class Materials(eqx.Module):
    """Surface attributes at N points.

    Attributes
    ----------
    albedo : (N, 3) linear base colour in [0, 1]; roughness : (N,) perceptual, GGX alpha is its
        square; metallic : (N,) in [0, 1].
    """

    albedo: Float[Array, "N 3"]
    roughness: Float[Array, " N"]
    metallic: Float[Array, " N"]


class EnvLight(eqx.Module):
    """Environment light as a lat-long map in the z-up world.

    ``u = 0.5 - atan2(y, x) / (2 pi)`` runs along a row, ``v = acos(z) / pi`` downwards.

    Attributes
    ----------
    radiance : (H, W, 3) linear, non-negative.
    """

    radiance: Float[Array, "H W 3"]
