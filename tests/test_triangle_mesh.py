"""The surface of a given mesh: extraction, penalties, and training in a run."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import MONTE_CARLO, TINY, sphere_dataset

from geosplat_jax import cli
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.config import config_from_dict
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config, with_mesh
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.fit.train import TrainingError, fit
from geosplat_jax.io.meshes import read_mesh
from geosplat_jax.io.start_mesh import digest_of, read_start
from geosplat_jax.report.facts import changed_from_preset
from geosplat_jax.run import Run, mesh_of_run, train
from geosplat_jax.surface.triangle_mesh import TriangleMesh, VertexOffsets, connectivity

SMALL = (
    *(text for text in TINY if not text.startswith("geometry.")),
    "geometry.edge_pixels=2",
)


def ball(subdivisions=1, radius=0.45):
    body = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(body.vertices), np.asarray(body.faces, np.int32)


def bowl():
    """The lower two thirds of a ball; the border is not planar."""
    vertices, faces = ball()
    faces = faces[vertices[faces][..., 2].mean(axis=1) < 0.15]
    kept_rows, rows = np.unique(faces, return_inverse=True)
    return vertices[kept_rows], rows.reshape(-1, 3).astype(np.int32)


def moved(model, seed=0, size=0.1):
    rng = np.random.default_rng(seed)
    return VertexOffsets(jnp.asarray(rng.uniform(-size, size, model.home.shape), jnp.float32))


@jax.jit
def _penalties(model, shape):
    return model.penalties(shape, model.extract(shape, capacities=Capacities()))


def penalties_of(model, shape):
    return {name: float(x) for name, x in _penalties(model, shape).items()}


def slow_penalties(model, shape):
    """Penalties by their definitions, face by face and vertex by vertex, in float64."""
    half_extent, unit = float(model.box.half_extent), float(model.unit)
    rest_positions = np.asarray(model.home, np.float64)
    positions = rest_positions + half_extent * np.asarray(shape.offsets, np.float64)
    edges, normals = {}, []
    for face_index, (a, b, c) in enumerate(np.asarray(model.faces)):
        normal = np.cross(positions[b] - positions[a], positions[c] - positions[a])
        normals.append(normal / np.linalg.norm(normal))
        for start, end in ((a, b), (b, c), (c, a)):
            edge_key = (min(start, end), max(start, end))
            edges.setdefault(edge_key, []).append((face_index, start < end))
    neighbors = {v: set() for v in range(len(positions))}
    border = {v for edge, edge_faces in edges.items() if len(edge_faces) == 1 for v in edge}
    for edge, edge_faces in edges.items():
        for v, neighbor in (edge, edge[::-1]):
            if v not in border or len(edge_faces) == 1:
                neighbors[v].add(neighbor)
    umbrella = [positions[sorted(neighbors[v])].mean(axis=0) - positions[v] for v in neighbors]
    cosines = [
        normals[s[0][0]] @ normals[s[1][0]] * (1 if s[0][1] != s[1][1] else -1)
        for s in edges.values()
        if len(s) == 2
    ]
    length_changes = [
        np.linalg.norm(positions[a] - positions[b])
        - np.linalg.norm(rest_positions[a] - rest_positions[b])
        for a, b in edges
    ]
    lengths = [np.linalg.norm(rest_positions[a] - rest_positions[b]) for a, b in edges]
    np.testing.assert_allclose(unit, np.mean(lengths), rtol=1e-5)
    return {
        "laplacian": np.mean(np.sum(np.square(umbrella), axis=1)) / unit**2,
        "normal_consistency": np.mean(1 - np.array(cosines)),
        "edge_length": np.mean(np.square(length_changes)) / unit**2,
        "offset": np.mean(np.sum((positions - rest_positions) ** 2, axis=1)) / unit**2,
    }


def wound_badly(mesh):
    vertices, faces = mesh
    faces = faces.copy()
    faces[3] = faces[3, ::-1]
    return vertices, faces


@pytest.mark.parametrize(
    ("mesh", "is_sheet"),
    [(ball(), False), (bowl(), True), (bowl(), False), (wound_badly(bowl()), True)],
)
def test_penalties_are_those_of_their_definitions(mesh, is_sheet):
    model = TriangleMesh.of(*mesh, is_sheet=is_sheet)
    shape = moved(model)
    actual, expected = penalties_of(model, shape), slow_penalties(model, shape)
    assert set(actual) == set(expected)
    for name, value in expected.items():
        assert value > 1e-3
        assert actual[name] == pytest.approx(value, rel=2e-4), name


def test_penalties_know_neither_the_scale_nor_the_place_of_a_scene():
    vertices, faces = bowl()
    model = TriangleMesh.of(vertices, faces, is_sheet=True)
    scaled_model = TriangleMesh.of(300 * vertices + 70, faces, is_sheet=True)
    shape = moved(model)
    for name, value in penalties_of(model, shape).items():
        assert penalties_of(scaled_model, shape)[name] == pytest.approx(value, rel=1e-3)


def test_nothing_changes_at_the_start_and_flat_surfaces_cost_nothing():
    vertices, faces = ball()
    model = TriangleMesh.of(vertices, faces, is_sheet=False)
    start_penalties = penalties_of(model, model.start)
    assert start_penalties["offset"] == 0
    assert start_penalties["edge_length"] < 1e-10
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    square = trimesh.Trimesh(np.c_[grid, 0 * grid[:, 0]], _grid_faces(5), process=False)
    flat_model = TriangleMesh.of(np.array(square.vertices), np.array(square.faces), is_sheet=True)
    flat_penalties = penalties_of(flat_model, flat_model.start)
    assert flat_penalties["normal_consistency"] < 1e-6
    # Every vertex inside or along a side is the mean of its neighbours; the four corners are half a
    # diagonal away from the mean of theirs.
    corner = 0.5 / float(flat_model.unit) ** 2
    assert flat_penalties["laplacian"] == pytest.approx(4 * corner / 25, rel=1e-4)


def _grid_faces(n):
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    lower_faces = np.stack([corner, corner + 1, corner + n + 1], -1)
    return np.concatenate([lower_faces, np.stack([corner, corner + n + 1, corner + n], -1)])


def test_a_mesh_with_an_edge_of_three_faces_has_no_wings_there():
    fan = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    adjacency = connectivity(fan)
    assert len(adjacency.edges) == 7
    assert len(adjacency.wings) == 0


def test_faces_without_height_do_not_pull_on_their_neighbours():
    """Closed T-junctions and boolean operations leave such faces."""
    vertices, faces = ball(2)
    split = np.arange(0, len(faces), 40)
    middles = vertices[faces[split]][:, :2].mean(axis=1)
    added_rows = len(vertices) + np.arange(len(split))
    first, second, third = faces[split].T
    rows = [
        np.delete(faces, split, axis=0),
        np.stack([first, added_rows, third], axis=1),
        np.stack([added_rows, second, third], axis=1),
        np.stack([first, second, added_rows], axis=1),
    ]
    positions = np.concatenate([vertices, middles])
    model = TriangleMesh.of(positions, np.concatenate(rows), is_sheet=False)

    @jax.jit
    @jax.grad
    def gradient(shape):
        surface = model.extract(shape, capacities=Capacities())
        return model.penalties(shape, surface)["normal_consistency"]

    gradient_norms = np.linalg.norm(np.asarray(gradient(moved(model, size=1e-4)).offsets), axis=1)
    other_rows = np.delete(np.arange(len(vertices)), np.unique(faces[split]))
    assert gradient_norms.max() < 20 * np.median(gradient_norms[other_rows])
    assert len(model.wings) == 3 * len(model.faces) // 2 - 3 * len(split)


def test_a_sheet_has_two_sides_in_training_and_one_in_the_file():
    model = TriangleMesh.of(*bowl(), is_sheet=True)
    shape = moved(model)
    count = len(model.faces)
    mesh = model.extract(shape, capacities=Capacities()).mesh
    assert int(mesh.face_count) == 2 * count
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    np.testing.assert_array_equal(corners[:count], corners[count:, ::-1])
    # The two sides share no vertex, so that their normals do not cancel.
    assert not set(np.asarray(mesh.faces)[:count].ravel()) & set(
        np.asarray(mesh.faces)[count:].ravel()
    )
    final = model.extract(shape, capacities=Capacities(), final=True).mesh
    assert int(final.face_count) == count
    np.testing.assert_array_equal(np.asarray(final.vertices), np.asarray(model.positions(shape)))


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(count=3, size=16)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    paths = {}
    for name, mesh in (("ball", ball()), ("bowl", bowl())):
        paths[name] = folder / f"{name}.ply"
        trimesh.Trimesh(*mesh, process=False).export(paths[name])
    return paths


def test_presets_give_the_rates_of_their_surface_to_the_vertices(files):
    for preset in ("default", "paper", "code"):
        plain_config, config = make_config(preset), make_config(preset, mesh=files["ball"])
        assert config.geometry.kind == "mesh"
        assert config.raster.cull_backfaces
        for plain_stage, stage in zip(plain_config.stages, config.stages, strict=True):
            moves = plain_stage.rates["sdf"].value > 0
            assert (stage.rates["vertices"].value > 0) == moves
            assert ("laplacian" in stage.weights) == moves
            assert not {"sdf", "deform", "weights"} & set(stage.rates)
            assert not {"entropy", "deviation", "weights"} & set(stage.weights)
            assert stage.vertex_fraction == 0 or preset == "default"
        assert config_from_dict(json.loads(json.dumps(config.to_dict()))) == config
    changed_config = make_config(
        mesh=files["ball"], overrides=("stages.split_sum.rates.vertices=0.5",)
    )
    assert changed_config.stages[0].rates["vertices"].value == 0.5
    with pytest.raises(ValueError, match="there is no mesh file"):
        make_config(mesh="nowhere.ply")


def leaves_equal(first, second):
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_a_run_starts_from_the_file_says_so_and_resumes_bit_for_bit(dataset, files, tmp_path):
    config = make_config(mesh=files["ball"], overrides=SMALL)
    whole_state = fit(dataset, config, tmp_path / "whole")
    lines = [json.loads(x) for x in (tmp_path / "whole/metrics.jsonl").read_text().splitlines()]
    assert {line["faces"] for line in lines} == {80}
    assert {"term.laplacian", "term.normal_consistency"} <= set(lines[0])
    assert all(np.isfinite(line["loss"]) for line in lines)
    # Four steps move vertices by about the rate each, in half extents of the box.
    assert 3e-3 < float(jnp.max(jnp.abs(whole_state.params.geometry.offsets))) < 2e-2
    record = json.loads((tmp_path / "whole/run.json").read_text())
    assert record["config"]["geometry"]["path"] == str(Path(files["ball"]).resolve())
    assert len(record["config"]["geometry"]["digest"]) == 16
    assert any("start: 42 vertices, 80 faces, one side" in note for note in record["notes"])
    copy = tmp_path / "copy.ply"
    copy.write_bytes(Path(files["ball"]).read_bytes())
    copy_config = make_config(mesh=copy, overrides=SMALL)
    fit(dataset, copy_config, tmp_path / "halves", stop_after=2)
    # Resuming needs neither the file nor its name.
    copy.unlink()
    read_start.cache_clear()
    resumed_config = make_config(mesh=mesh_of_run(RunFolder(tmp_path / "halves")), overrides=SMALL)
    leaves_equal(whole_state, fit(dataset, resumed_config, tmp_path / "halves", begin=Resume()))
    # The same mesh at another place is the same mesh.
    leaves_equal(whole_state, fit(dataset, config, tmp_path / "halves", begin=Resume()))
    # Reading a finished run does not need the file either.
    trained = Run(tmp_path / "whole").trained
    leaves_equal(trained.params, whole_state.params)
    vertices, faces, _ = Run(tmp_path / "whole").renderer().mesh()
    assert (len(vertices), len(faces)) == (42, 80)


def test_a_mesh_that_cannot_be_used_stops_before_anything_is_written(dataset, files, tmp_path):
    large_path = tmp_path / "large.ply"
    vertices, faces = read_mesh(files["ball"])
    trimesh.Trimesh(100 * vertices, faces, process=False).export(large_path)
    config = make_config(mesh=large_path, overrides=SMALL)
    with pytest.raises(TrainingError, match=r"if it were 0\.01 times as large"):
        fit(dataset, config, tmp_path / "run")
    assert not (tmp_path / "run/run.json").exists()
    changed_config = with_mesh(make_config(overrides=TINY), large_path)
    large_path.write_bytes(Path(files["ball"]).read_bytes())
    read_start.cache_clear()
    with pytest.raises(TrainingError, match="is not the mesh that it was"):
        fit(dataset, changed_config, tmp_path / "run")


def test_the_inward_shift_of_a_mesh_starts_smaller_unless_it_was_set(files):
    def start(preset="default", *overrides):
        return make_config(preset, mesh=files["ball"], overrides=overrides).material

    assert start().initial_shift_logit == -1
    assert start("paper").initial_shift_logit == 0
    assert start("default", "material.initial_shift_logit=0").initial_shift_logit == 0
    by_hand = make_config(overrides=("material.initial_shift_logit=-0.5",))
    assert with_mesh(by_hand, files["ball"]).material.initial_shift_logit == -0.5


def test_settings_of_a_mesh_are_kept(files):
    path, digest = str(files["ball"]), digest_of(files["ball"])
    given = MeshSettings(path=path, digest=digest, edge_pixels=7, sides="both", max_faces=500)
    config = make_config(quality="draft", mesh=given)
    assert config.geometry == given
    assert set(changed_from_preset(config)) == {
        f"geometry.{name}" for name in ("edge_pixels", "sides", "max_faces")
    }
    assert make_config(quality="draft", mesh=given.file).geometry.edge_pixels == 3


def test_a_mesh_that_is_given_twice_counts_once_and_two_are_refused(files):
    config = make_config(mesh=files["ball"], overrides=("geometry.max_faces=5000",))
    assert with_mesh(config, files["ball"]) == config
    with pytest.raises(ValueError, match=r"start from the mesh .*, but .* was given as well"):
        with_mesh(config, files["bowl"])


def test_an_open_mesh_needs_culling(dataset, files, tmp_path):
    config = make_config(mesh=files["bowl"], overrides=(*SMALL, "raster.cull_backfaces=false"))
    with pytest.raises(TrainingError, match="fronts and the backs of an open mesh"):
        fit(dataset, config, tmp_path / "run")
    assert not (tmp_path / "run/run.json").exists()


def test_an_open_mesh_is_not_shaded_behind_its_faces(dataset, files, tmp_path):
    """The far wall shows through a little, which draws blended positions into the body."""
    changes = ("stages.refine.steps=1", "stages.refine.domain.kind=per_pixel")
    config = make_config(mesh=files["bowl"], overrides=(*SMALL, *changes))
    with pytest.raises(
        TrainingError, match=r"behind the faces of an open mesh; set stages.refine.domain.points"
    ):
        fit(dataset, config, tmp_path / "run")
    # The preset `paper` shades that way, and is refused before anything is written.
    with pytest.raises(TrainingError, match="geometry.sides=one"):
        fit(
            dataset,
            make_config("paper", "draft", mesh=files["bowl"], overrides=("stages.refine.steps=1",)),
            tmp_path / "run",
        )
    assert not (tmp_path / "run/run.json").exists()


def test_the_command_refuses_a_mesh_that_is_no_file(tmp_path, capsys):
    assert cli.main(["train", str(tmp_path), "--mesh", str(tmp_path / "none.ply")]) == 2
    assert "there is no mesh file" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.slow
@pytest.mark.long
def test_an_open_mesh_is_traced_and_exported(dataset, files, tmp_path):
    config = make_config(
        mesh=files["bowl"],
        overrides=(
            *SMALL,
            *MONTE_CARLO,
            "stages.split_sum.steps=0",
            "stages.monte_carlo.steps=2",
        ),
    )
    run = train(dataset, tmp_path / "run", config)
    assert [line["stage"] for line in run.steps()] == ["monte_carlo"] * 2
    count = len(bowl()[1])
    assert {line["faces"] for line in run.steps()} == {2 * count}
    run.export(tmp_path / "out", vertex_colors=True)
    _, faces = read_mesh(tmp_path / "out/mesh.glb")
    assert len(faces) == count
