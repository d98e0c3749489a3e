"""Agreement with the stored results of the slow references in `tests/references`.

`tests/data/make.py` writes them; they keep these tests independent of any other data.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import bsdf as slow_bsdf
from references import flexicubes, splatting
from references.cases import CASES, SPLAT_FRAME, adapter_outputs, unpacked
from references.lanes import contract, difference
from scipy.spatial import cKDTree
from support import double_precision

from geosplat_jax.adapter import CODE, PAPER, face_splats, vertex_splats
from geosplat_jax.core.capacity import Capacities, fits
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.core.types import Geometry, Grid, Materials, Mesh
from geosplat_jax.geometry import isosurface
from geosplat_jax.splats.projection import project
from geosplat_jax.splats.rasterize import rasterize
from geosplat_jax.surface.flexicubes_tables import EDGES, PATCH_EDGES, PROBLEM_OFFSET
from geosplat_jax.transport.bsdf import evaluate_lobes

DATA = Path(__file__).parent / "data"
# float64 on both sides, some hundred operations deep; the largest values have order 10 to 1e3.
VALUE_TOLERANCE = 1e-10
# The stored gradients come from complex steps, so they are as exact as the values.
GRADIENT_TOLERANCE = 1e-9
# Another machine may round differently, and the lobe of the smoothest surface amplifies that some
# ten thousand times.
REPRODUCTION_TOLERANCE = 1e-10
# Central differences, extrapolated twice, have smaller truncation and rounding errors than this.
# The step is small compared to the distance to every kink and threshold, and to the width of the
# sharpest lobe.
DIFFERENCE_TOLERANCE = 1e-7
DIFFERENCE_STEP = {"splats_small": 1e-5, "bsdf_rows": 1e-4}
ROOM = Capacities(
    surface_cubes=128, dual_vertices=128, quads=128, visible=32, hits=1024, chunks=256
)
ISOSURFACES = ["isosurface_blob", "isosurface_blob_eval", "isosurface_clash"]


def load(name):
    with np.load(DATA / f"{name}.npz") as data:
        return dict(data)


def relative(got, expected):
    """Relative L2 distance."""
    return np.linalg.norm(np.asarray(got) - expected) / np.linalg.norm(expected)


def assert_gradients(got, data):
    """Compare a dictionary of gradients with the stored ones, array by array."""
    expected = unpacked(data, "grad")
    assert got.keys() == expected.keys()
    for name, reference in expected.items():
        if not reference.any():
            np.testing.assert_array_equal(got[name], 0.0, err_msg=name)
            continue
        assert relative(got[name], reference) < GRADIENT_TOLERANCE, name


def puller(function):
    """Compile a function of a dictionary, to give its values and the gradient of a contraction."""

    def scalar(inputs, cotangents):
        outputs = function(inputs)
        return sum(jnp.sum(outputs[k] * c) for k, c in cotangents.items()), outputs

    compiled = jax.jit(jax.value_and_grad(scalar, has_aux=True))

    def pull_back(inputs, cotangents):
        inputs, cotangents = (
            {k: jnp.asarray(v) for k, v in group.items()} for group in (inputs, cotangents)
        )
        (_, outputs), gradient = compiled(inputs, cotangents)
        return outputs, gradient

    return pull_back


def pull_back(function, inputs, cotangents):
    return puller(function)(inputs, cotangents)


# The references themselves


@pytest.mark.parametrize("name", CASES)
def test_stored_files_are_what_the_references_say(name):
    stored_arrays, computed_arrays = load(name), CASES[name]()
    assert stored_arrays.keys() == computed_arrays.keys()
    for key, value in computed_arrays.items():
        scale = max(1.0, np.abs(value).max(initial=0.0))
        np.testing.assert_allclose(
            stored_arrays[key], value, rtol=0, atol=REPRODUCTION_TOLERANCE * scale, err_msg=key
        )


def reference_scalar(name, data):
    """Return the contraction that a file stores the gradient of, as a function of its inputs."""
    if name in ISOSURFACES:
        settings = {"shape": tuple(data["shape"]), "training": bool(data["training"])}
        function = partial(flexicubes.isosurface, **settings)
    else:
        function = {
            "splats_small": partial(splatting.render, **SPLAT_FRAME),
            "adapter_faces": adapter_outputs,
            "bsdf_rows": slow_bsdf.evaluate_rows,
        }[name]
    return lambda **inputs: contract(unpacked(data, "cotangent"), function(**inputs))


@pytest.mark.parametrize("name", CASES)
def test_complex_steps_agree_with_differences(name):
    data, random = load(name), np.random.RandomState(0)
    inputs, gradients = unpacked(data, "in"), unpacked(data, "grad")
    scalar = reference_scalar(name, data)
    for key, gradient in gradients.items():
        directions = {k: np.zeros(x.shape) for k, x in inputs.items()}
        directions[key] = random.normal(size=gradient.shape)
        directions[key] /= np.linalg.norm(directions[key])
        expected = difference(scalar, inputs, directions, step=DIFFERENCE_STEP.get(name, 1e-3))
        actual = np.sum(gradient * directions[key])
        scale = max(np.linalg.norm(gradient), 1e-3)
        assert abs(actual - expected) < DIFFERENCE_TOLERANCE * scale, key


# Isosurface


def test_patches_of_all_cases_are_the_closed_lines_on_the_cell():
    edges = [tuple(edge) for edge in EDGES.tolist()]
    assert edges == flexicubes.EDGES
    for case in range(256):
        inside = [bool(case >> c & 1) for c in range(8)]
        for cut_around, row in ((True, case), (False, 255 - case)):
            slow_patches = {frozenset(loop) for loop in flexicubes.patches(inside, cut_around)}
            table_patches = {
                frozenset(edges[e] for e in range(12) if bits >> e & 1)
                for bits in PATCH_EDGES[row].tolist()
                if bits
            }
            assert slow_patches == table_patches, case
        faces = [(a, (s + 1) // 2) for a, s in enumerate(PROBLEM_OFFSET[case].tolist()) if s]
        assert flexicubes.pinched_faces(inside) == faces, case


def face_set(faces):
    """Faces as oriented triples that start at their smallest row."""
    starts = np.argmin(faces, axis=1)[:, None] + np.arange(3)
    return {tuple(row) for row in np.take_along_axis(faces, starts % 3, axis=1).tolist()}


def extract(inputs, shape, training):
    grid = Grid(origin=inputs["origin"], cell_size=inputs["cell_size"], shape=shape)
    names = ("sdf", "deform", "alpha", "beta", "gamma")
    geometry = Geometry(**{name: inputs[name] for name in names})
    return isosurface(geometry, grid, capacities=ROOM, training=training)


@pytest.mark.parametrize("name", ISOSURFACES)
def test_isosurface_equals_the_slow_one(name):
    data = load(name)
    shape, training = tuple(data["shape"].tolist()), bool(data["training"])
    inputs, count = unpacked(data, "in"), len(data["out_vertices"])
    with double_precision():

        def outputs(inputs):
            surface = extract(inputs, shape, training)
            mesh = surface.mesh
            return {"vertices": mesh.vertices, "deviation": surface.deviation, "surface": surface}

        # Pair the rows of the package with those of the reference by position.
        pull = puller(outputs)
        cotangents = unpacked(data, "cotangent")
        rows = ROOM["dual_vertices"] + training * ROOM["quads"]
        surface = pull(inputs, cotangents | {"vertices": np.zeros((rows, 3))})[0]["surface"]
        assert bool(fits(surface.usage, ROOM))
        assert int(surface.mesh.vertex_count) == count
        vertices = np.asarray(surface.mesh.vertices)
        distance, row = cKDTree(vertices[:count]).query(data["out_vertices"])
        assert distance.max() < VALUE_TOLERANCE
        assert len(set(row)) == count
        vertex_cotangents = np.zeros(vertices.shape)
        vertex_cotangents[row] = cotangents["vertices"]
        _, gradient = pull(inputs, cotangents | {"vertices": vertex_cotangents})
    assert int(surface.usage["dual_vertices"]) == int(data["out_dual_count"])
    assert set(row[: int(data["out_dual_count"])]) == set(range(int(data["out_dual_count"])))
    faces = np.asarray(surface.mesh.faces)[: int(surface.mesh.face_count)]
    assert len(faces) == len(data["out_faces"])
    assert face_set(faces) == face_set(row[data["out_faces"]])
    np.testing.assert_allclose(surface.deviation, data["out_deviation"], rtol=VALUE_TOLERANCE)
    assert_gradients(gradient, data)


def test_the_clashing_cells_are_there_and_the_mesh_is_a_manifold_with_border():
    data = load("isosurface_clash")
    assert len(data["changed"]) == 4
    assert set(flexicubes.uses_of_edges(data["out_faces"])) == {1, 2}


# Splats


def test_projection_equals_the_slow_one():
    data = load("splats_small")
    inputs, visible = unpacked(data, "in"), data["visible"]
    assert set(data["out_clamped_axes"]) == {0, 1, 2}  # means leave the view in 0, 1 or 2 axes
    with double_precision():
        footprints = jax.jit(partial(project, **SPLAT_FRAME))(
            *(jnp.asarray(inputs[k]) for k in ("means", "quats", "scales")),
            world_to_camera=jnp.asarray(inputs["world_to_camera"]),
            intrinsics=jnp.asarray(inputs["intrinsics"]),
        )
    np.testing.assert_array_equal(np.flatnonzero(footprints.is_in_front), visible)
    for name in ("means2d", "conics", "depths", "compensation"):
        actual = np.asarray(getattr(footprints, name))[visible]
        scale = max(1.0, np.abs(data[f"out_{name}"]).max())
        np.testing.assert_allclose(
            actual, data[f"out_{name}"], rtol=0, atol=VALUE_TOLERANCE * scale
        )


def test_image_and_its_gradients_equal_the_slow_ones():
    data = load("splats_small")
    # All three branches of the thresholds occur, and no rounding can change the branch.
    assert min(data["kept"], data["cut"], data["clamped"]) > 0
    assert min(data["gap_cut"], data["gap_clamp"]) > 1e-6

    def draw(inputs):
        image, alpha, usage = rasterize(
            **inputs,
            is_eligible=jnp.ones(inputs["means"].shape[0], bool),
            capacities=ROOM,
            **SPLAT_FRAME,
        )
        return {"image": image, "alpha": alpha, "usage": usage}

    with double_precision():
        values, gradient = pull_back(draw, unpacked(data, "in"), unpacked(data, "cotangent"))
    assert bool(fits(values["usage"], ROOM))
    np.testing.assert_allclose(values["image"], data["out_image"], rtol=0, atol=VALUE_TOLERANCE)
    np.testing.assert_allclose(values["alpha"], data["out_alpha"], rtol=0, atol=VALUE_TOLERANCE)
    assert_gradients(gradient, data)


# Adapter and reflectance


def assert_values(got, data):
    for name, reference in unpacked(data, "out").items():
        np.testing.assert_allclose(
            got[name], reference, rtol=VALUE_TOLERANCE, atol=VALUE_TOLERANCE, err_msg=name
        )


@pytest.mark.slow
def test_splats_of_a_mesh_equal_the_slow_ones():
    data = load("adapter_faces")

    def outputs(inputs):
        faces = jnp.asarray(data["faces"], jnp.int32)
        mesh = Mesh(inputs["vertices"], faces, jnp.int32(5), jnp.int32(len(data["faces"])))
        result = {"vertex_normals": vertex_normals(mesh)}
        for preset, constants in (("paper", PAPER), ("code", CODE)):
            splats = face_splats(mesh, inputs["normals"], constants=constants)
            result |= {
                f"{preset}_means": splats.means,
                f"{preset}_rotations": quaternion_to_matrix(splats.quats),
                f"{preset}_scales": splats.scales,
                f"{preset}_normals": splats.normals,
            }
        round_splats = vertex_splats(mesh, inputs["normals"], constants=CODE)
        return result | {"vertex_radii": round_splats.scales[:, 0]}

    with double_precision():
        values, gradient = pull_back(outputs, unpacked(data, "in"), unpacked(data, "cotangent"))
    assert_values(values, data)
    assert_gradients(gradient, data)


def test_reflectance_equals_the_slow_one():
    data = load("bsdf_rows")

    def outputs(inputs):
        materials = Materials(inputs["albedo"], inputs["roughness"], inputs["metallic"])
        # Directions are normalised here, so that both implementations extend the model off the unit
        # sphere in the same way.
        directions = [safe_normalize(inputs[k]) for k in ("normals", "wi", "wo")]
        diffuse, specular = evaluate_lobes(materials, *directions)
        return {"diffuse": diffuse, "specular": specular}

    with double_precision():
        values, gradient = pull_back(outputs, unpacked(data, "in"), unpacked(data, "cotangent"))
    is_lit = data["out_specular"].any(axis=1)
    is_below_floor = data["in_roughness"] < slow_bsdf.ROUGHNESS_FLOOR
    assert 40 < is_lit.sum() < 64
    assert (is_lit & is_below_floor).any()
    np.testing.assert_array_equal(gradient["roughness"][is_below_floor], 0.0)
    assert_values(values, data)
    assert_gradients(gradient, data)
    # Mirror-like rows dominate the norm, so every row must also agree by itself.
    for name in gradient:
        for actual, reference in zip(np.asarray(gradient[name]), data[f"grad_{name}"], strict=True):
            assert np.linalg.norm(actual - reference) <= GRADIENT_TOLERANCE * max(
                1.0, np.linalg.norm(reference)
            )
