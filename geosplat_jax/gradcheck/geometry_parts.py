"""Problems of the surface: isosurface, its regularisers, and the adapter."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from geosplat_jax.adapter import (
    CODE,
    PAPER,
    AdapterConstants,
    face_splats,
    shift_inwards,
    vertex_splats,
)
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Geometry, Grid, Mesh, Splats
from geosplat_jax.geometry import (
    face_normals_and_areas,
    isosurface,
    sdf_entropy,
    vertex_normals,
    weight_magnitude,
)
from geosplat_jax.gradcheck.differences import Problem
from geosplat_jax.surface.band import Band, band_from
from geosplat_jax.surface.grids import grid_vertices

_SHAPE = (3, 3, 4)
_WEIGHTS = ("alpha", "beta", "gamma")


def _grid(dtype: Any = jnp.float64) -> Grid:
    """Build a box of cubic cells about the origin."""
    cell = 0.25
    origin = -0.5 * cell * jnp.asarray(_SHAPE, dtype)
    return Grid(origin=origin, cell_size=jnp.asarray(cell, dtype), shape=_SHAPE)


def _blob(rng: np.random.Generator, grid: Grid) -> np.ndarray:
    """Signed values of a rough ball: closed, with vertices near neither zero nor each other."""
    points = np.asarray(grid_vertices(grid))
    values = (np.sqrt(np.sum(points**2, axis=1)) - 0.36) / float(grid.cell_size)
    values = values + rng.uniform(-0.25, 0.25, values.shape)
    return np.where(np.abs(values) < 0.05, np.copysign(0.05, values), values)


def isosurface_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate vertices, normals and regularisers in SDF, deformations and weights."""
    grid = _grid()
    cells, vertices = grid.cube_count, grid.vertex_count
    inputs = {
        "sdf": _blob(rng, grid),
        "deform": rng.uniform(-0.4, 0.4, (vertices, 3)),
        "alpha": rng.uniform(-0.6, 0.6, (cells, 8)),
        "beta": rng.uniform(-0.6, 0.6, (cells, 12)),
        "gamma": rng.uniform(-0.6, 0.6, (cells,)),
    }
    capacities = Capacities(surface_cubes=64, dual_vertices=64, quads=64)

    def surface(name: str, lattice: Any, inputs: dict[str, Any], *, training: bool) -> Problem:
        def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
            geometry = Geometry(**inputs)
            extraction = isosurface(geometry, constants, capacities=capacities, training=training)
            return {
                "vertices": extraction.mesh.vertices,
                "normals": vertex_normals(extraction.mesh),
                "L_dev": extraction.deviation,
                "entropy": sdf_entropy(geometry, constants),
                "weight magnitude": weight_magnitude(geometry),
            }

        return Problem(f"isosurface, {name}", function, inputs, lattice, full=500)

    band_arguments = _in_band(inputs, _grid())
    return [
        surface("training", grid, inputs, training=True),
        surface("evaluation", grid, inputs, training=False),
        surface("band", *band_arguments, training=True),
    ]


def _in_band(inputs: dict[str, Any], grid: Grid) -> tuple[Band, dict[str, Any]]:
    """Return the cells that the surface passes through, and rows of their values and weights."""
    band, sdf = band_from(grid, inputs["sdf"], 0)
    # Padding is left out: it has no gradient, and would be most of what is compared.
    cells = int(band.bits.count)
    vertices = int(np.asarray(band.corners).max()) + 1
    band = replace(
        band,
        cells=band.cells[:cells],
        vertices=band.vertices[:vertices],
        corners=band.corners[:, :cells],
        neighbours=band.neighbours[:, :vertices],
        fixed=band.fixed[:vertices],
    )
    rows = {name: np.asarray(inputs[name])[np.asarray(band.cells)] for name in _WEIGHTS}
    deform = np.asarray(inputs["deform"])[np.asarray(band.vertices)]
    return band, {"sdf": sdf[:vertices], "deform": deform, **rows}


def _tetrahedron(rng: np.random.Generator) -> dict[str, Any]:
    """Vertices and unit vertex normals of an irregular tetrahedron."""
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    vertices = 0.5 * corners + rng.uniform(-0.2, 0.2, corners.shape)
    normals = corners + rng.uniform(-0.3, 0.3, corners.shape)
    normals /= np.sqrt(np.sum(normals**2, axis=1, keepdims=True))
    return {"vertices": vertices, "normals": normals}


_FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)
"""Faces of `_tetrahedron`, outward: splats on vertices (Eq. 12) have no radius on inward ones."""


def _mesh(vertices: Any) -> Mesh:
    """Close the four vertices to a solid, with one row of padding."""
    faces = np.concatenate([_FACES, np.zeros((1, 3), np.int32)])
    return Mesh(vertices, jnp.asarray(faces), jnp.int32(4), jnp.int32(4))


def _splats(splats: Splats) -> dict[str, Any]:
    """Return the outputs of an adapter by name."""
    return {
        "means": splats.means,
        "scales": splats.scales,
        "quats": splats.quats,
        "normals": splats.normals,
        "opacities": splats.opacities,
    }


def adapter_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate both samplings, the normals of a mesh, and the inward shift."""
    inputs = _tetrahedron(rng)

    def faces(name: str, preset: AdapterConstants) -> Problem:
        def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
            mesh = _mesh(inputs["vertices"])
            return _splats(face_splats(mesh, inputs["normals"], constants=preset))

        return Problem(f"adapter, faces ({name})", function, inputs)

    def vertices(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        mesh = _mesh(inputs["vertices"])
        return _splats(vertex_splats(mesh, inputs["normals"], constants=CODE))

    def normals(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        mesh = _mesh(inputs["vertices"])
        face_normal, area = face_normals_and_areas(mesh)
        return {"vertex normals": vertex_normals(mesh), "face normals": face_normal, "areas": area}

    def shift(inputs: dict[str, Any], constants: dict[str, Any]) -> dict[str, Any]:
        mesh = _mesh(constants["vertices"])
        splats = face_splats(mesh, constants["normals"], constants=CODE)
        moved_splats = replace(splats, means=splats.means + inputs["means"])
        return {"means": shift_inwards(moved_splats, mesh, inputs["fraction"]).means}

    rows = 6 * (len(_FACES) + 1)
    shift_inputs = {"means": np.zeros((rows, 3)), "fraction": rng.uniform(0.2, 0.8, rows)}
    return [
        faces("paper", PAPER),
        faces("code", CODE),
        Problem("adapter, vertices", vertices, inputs),
        Problem("mesh normals", normals, {"vertices": inputs["vertices"]}),
        Problem("adapter, inward shift", shift, shift_inputs, inputs),
    ]
