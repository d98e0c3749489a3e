"""Fields on the vertices of a box of cubic cells: positions, initial shapes, change of grid."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from geosplat_jax.core.numerics import absolute, safe_norm
from geosplat_jax.core.types import Geometry, Grid
from geosplat_jax.surface.flexicubes_tables import CORNERS
from geosplat_jax.surface.lattice import Lattice, grid_vertices, lattice_of


def deformed_vertices(geometry: Geometry, grid: Grid) -> Float[Array, "G 3"]:
    """World positions of the grid vertices, moved by at most ``grid.reach`` cells on each axis."""
    return grid_vertices(grid) + grid.cell_size * grid.reach * jnp.tanh(geometry.deform)


def initial_geometry(grid: Grid, sdf: Float[Array, " G"]) -> Geometry:
    """Geometry with this SDF (in units of a cell), no deformation and neutral weights.

    Raises
    ------
    ValueError
        If ``sdf`` does not have one value per vertex of the grid.
    """
    if sdf.shape != (grid.vertex_count,):
        raise ValueError(
            f"sdf must have one value for each of the {grid.vertex_count} grid vertices, "
            f"got shape {sdf.shape}"
        )
    return neutral_geometry(sdf, grid.cube_count)


def neutral_geometry(sdf: Float[Array, " G"], cells: int) -> Geometry:
    """Geometry with this SDF (in units of a cell), no deformation and neutral weights.

    Parameters
    ----------
    sdf : (G,) values of any number of vertices.
    cells : number of rows of the weights.
    """
    dtype = sdf.dtype
    return Geometry(
        sdf=sdf,
        deform=jnp.zeros((*sdf.shape, 3), dtype),
        alpha=jnp.zeros((cells, 8), dtype),
        beta=jnp.zeros((cells, 12), dtype),
        gamma=jnp.zeros((cells,), dtype),
    )


def sphere_sdf(grid: Grid, *, radius: float | Float[Array, ""]) -> Float[Array, " G"]:
    """Signed distance, in cells, to a sphere of ``radius`` world units about the grid's centre."""
    centre = 0.5 * jnp.asarray(grid.shape, grid.origin.dtype) * grid.cell_size + grid.origin
    return (safe_norm(grid_vertices(grid) - centre[None, :]) - radius) / grid.cell_size


def closed_at_border(sdf: Float[Array, " G"], grid: Grid) -> Float[Array, " G"]:
    """Cut a shape off half a cell inside the box, so that its surface has no holes there.

    Parameters
    ----------
    sdf : (G,) in cells, negative inside.
    grid : the box.

    Returns
    -------
    (G,) in cells.
    """
    last = jnp.asarray(grid.shape, sdf.dtype) * grid.cell_size
    points = grid_vertices(grid) - grid.origin[None, :]
    distance = jnp.max(jnp.maximum(-points, points - last[None, :]), axis=-1) / grid.cell_size
    return jnp.maximum(sdf, distance + 0.5)


def random_sdf(key: Key[Array, ""], grid: Grid) -> Float[Array, " G"]:
    """Uniform noise in [-0.1, 0.9): scattered small components all over the volume."""
    return jax.random.uniform(key, (grid.vertex_count,), grid.origin.dtype) - 0.1


def _interpolate(
    values: Float[Array, "G c"], grid: Grid, coordinates: Float[Array, "n 3"]
) -> Float[Array, "n c"]:
    """Trilinear values at points given in cells from the grid's origin, clamped to the box."""
    vx, vy, _ = grid.vertex_shape
    last = jnp.asarray(grid.shape, coordinates.dtype)[None, :]
    clamped = jnp.clip(coordinates, 0.0, last)
    lowest = jnp.minimum(jnp.floor(clamped), last - 1.0)
    fractions = clamped - lowest
    i, j, k = lowest.astype(jnp.int32).T
    result = jnp.zeros((coordinates.shape[0], values.shape[1]), values.dtype)
    for corner in CORNERS.tolist():
        index = i + corner[0] + vx * (j + corner[1] + vy * (k + corner[2]))
        weights = [fractions[:, a] if corner[a] else 1.0 - fractions[:, a] for a in range(3)]
        result = result + (weights[0] * weights[1] * weights[2])[:, None] * values[index]
    return result


def resample(geometry: Geometry, grid: Grid, new_grid: Grid) -> Geometry:
    """Resample a shape on another grid: trilinear SDF, no deformation, neutral weights.

    The deformation of the old grid is inverted by three fixed-point steps. SDF values are rescaled
    to the new cell. A vertex outside of the old box takes the value at the nearest point of the box
    plus the distance to that point, so that a closed surface stays closed.
    """
    points = (grid_vertices(new_grid) - grid.origin[None, :]) / grid.cell_size
    displacements = grid.reach * jnp.tanh(geometry.deform)
    rest_positions = points
    for _ in range(3):
        rest_positions = points - _interpolate(displacements, grid, rest_positions)
    last = jnp.asarray(grid.shape, points.dtype)[None, :]
    distance = safe_norm(points - jnp.clip(points, 0.0, last))
    sdf = _interpolate(geometry.sdf[:, None], grid, rest_positions)[:, 0] + distance
    return initial_geometry(new_grid, sdf * (grid.cell_size / new_grid.cell_size))


def sdf_entropy(
    geometry: Geometry, grid: Grid | Lattice, *, reduction: Literal["mean", "sum"] = "mean"
) -> Float[Array, ""]:
    """Cross entropy of signs over the grid edges whose ends differ in sign (paper Eq. 14).

    ``BCE(sigmoid(a), sign(b)) + BCE(sigmoid(b), sign(a))``, summed or averaged over those edges.
    Zero counts as outside. An SDF of one sign gives 0 with zero gradient.

    Parameters
    ----------
    geometry : of which ``sdf`` is used.
    grid : the grid, or the `Lattice` that says which of its vertices hold values.
    reduction : static; mean or sum over the edges.

    Returns
    -------
    () not negative; differentiable in the SDF.
    """
    lattice = lattice_of(grid)
    sdf = lattice.values(geometry.sdf)
    # Eq. 14. For ends of opposite sign BCE(sigmoid(a), sign(b)) = softplus(|a|). The sum over edges
    # is therefore a sum over vertices, each weighted by the number of its crossed edges.
    crossings = lattice.crossed_edges(sdf)
    magnitude = jnp.where(sdf < 0, -sdf, sdf)
    total = jnp.sum(crossings.astype(magnitude.dtype) * jax.nn.softplus(magnitude))
    if reduction == "sum":
        return total
    return total / jnp.maximum(jnp.sum(crossings, dtype=jnp.int32) // 2, 1).astype(magnitude.dtype)


def weight_magnitude(geometry: Geometry, cell_count: int | None = None) -> Float[Array, ""]:
    """Mean magnitude of all raw alpha and beta weights; gamma is not penalised (FlexiCubes).

    It is zero, with zero gradient, for neutral weights, with which training starts.

    Parameters
    ----------
    geometry : of which ``alpha`` and ``beta`` are used.
    cell_count : number of cells in the mean; by default the rows of the weights. For a geometry
        that holds weights of some cells, the number of all cells: the others have neutral weights.
    """
    weights = (geometry.alpha, geometry.beta)
    total = jnp.sum(jnp.stack([jnp.sum(absolute(weight)) for weight in weights]))
    count = geometry.gamma.shape[0] if cell_count is None else cell_count
    return total / float(count * sum(weight.shape[1] for weight in weights))
