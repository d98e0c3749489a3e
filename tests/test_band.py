"""Laws of a band of cells: it gives the surface of the whole grid, and follows this surface."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.banded import BandedFlexiCubes
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Geometry, Grid
from geosplat_jax.fit import loop as loop_module
from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.config import Rate
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.loop import new_loop, resumed_loop
from geosplat_jax.fit.pyramid import to_levels
from geosplat_jax.fit.step import StepReport
from geosplat_jax.fit.train import fit
from geosplat_jax.geometry import FlexiCubes, initial_geometry
from geosplat_jax.pipeline import LossReport
from geosplat_jax.surface import band as band_module
from geosplat_jax.surface.flexicubes_tables import CORNERS

ROUNDING = 2e-6  # relative to the largest value: sums of some hundred float32 in another order
SHAPE = (9, 8, 10)
ROOM = Capacities(surface_cubes=512, dual_vertices=512, quads=512)


def grid_of(shape=SHAPE):
    return Grid(jnp.array([-1.0, -0.8, -0.9]), jnp.float32(0.2), shape, 0.4)


def ball(radius, grid=None, *, noise=0.0, seed=0):
    """Return signed distances, in cells, to a ball in the middle of the grid (NumPy)."""
    grid = grid or grid_of()
    vx, vy, vz = grid.vertex_shape
    z, y, x = np.meshgrid(np.arange(vz), np.arange(vy), np.arange(vx), indexing="ij")
    middle = np.array(grid.shape) / 2
    steps = np.stack([x, y, z], -1).reshape(-1, 3) - middle
    values = np.sqrt((steps**2).sum(1)) - radius
    wobble = noise * np.random.default_rng(seed).uniform(-1, 1, values.shape)
    return (values + wobble).astype(np.float32)


def cell_corners(numbers, shape=SHAPE):
    """Return the numbers of the vertices at the corners of cells, (8, n)."""
    nx, ny, _ = shape
    at = np.stack([numbers % nx, numbers // nx % ny, numbers // (nx * ny)])
    x, y, z = at[:, None, :] + CORNERS.T[:, :, None]
    return x + (nx + 1) * (y + (ny + 1) * z)


def surface_of(sdf, shape=SHAPE):
    """Numbers of the cells whose corners differ in sign."""
    inside = sdf[cell_corners(np.arange(np.prod(shape)), shape)] < 0
    return np.flatnonzero(inside.any(0) & ~inside.all(0))


def cells_of(model):
    return np.asarray(model.band.cells)[: int(model.band.bits.count)]


def vertices_of(model):
    return np.asarray(model.band.vertices)[: np.asarray(model.band.corners).max() + 1]


VERTEX_NUMBERS = tuple((name, vertices_of) for name in ("sdf", "deform"))
CELL_NUMBERS = tuple((name, cells_of) for name in ("alpha", "beta", "gamma"))


def rows_from(dense, model):
    """Take the rows of a band from a geometry of the whole grid; the padding is zero."""

    def taken(array, grid_rows, rows):
        array = np.asarray(array)
        band_rows = np.zeros((rows, *array.shape[1:]), array.dtype)
        band_rows[: len(grid_rows)] = array[grid_rows]
        return jnp.asarray(band_rows)

    cells, vertices, band = cells_of(model), vertices_of(model), model.band
    return Geometry(
        *(taken(x, vertices, band.vertex_rows) for x in (dense.sdf, dense.deform)),
        *(taken(x, cells, band.cell_rows) for x in (dense.alpha, dense.beta, dense.gamma)),
    )


def varied(geometry):
    """Give deformations and weights random values."""
    rng = np.random.default_rng(1)

    def one(array):
        return jnp.asarray(rng.uniform(-0.6, 0.6, array.shape), jnp.float32)

    varied_geometry = jax.tree.map(one, geometry)
    return replace(varied_geometry, sdf=geometry.sdf)


@pytest.mark.parametrize("layers", [1, 2])
def test_the_band_is_the_cells_within_some_layers_of_the_surface(layers):
    sdf = ball(2.4, noise=0.4)
    model, shape = BandedFlexiCubes.around(sdf, grid_of(), layers)
    nx, ny, nz = SHAPE
    near = np.zeros((nz, ny, nx), bool)
    for cell in surface_of(sdf):
        k, j, i = cell // (nx * ny), cell // nx % ny, cell % nx
        low = [max(at - layers, 0) for at in (k, j, i)]
        near[tuple(slice(a, at + layers + 1) for a, at in zip(low, (k, j, i), strict=True))] = True
    expected = np.flatnonzero(near)
    assert 0 < len(expected) < near.size
    np.testing.assert_array_equal(cells_of(model), expected)
    corners = cell_corners(expected)
    np.testing.assert_array_equal(vertices_of(model), np.unique(corners))
    band = model.band
    corner_vertices = np.asarray(band.vertices)[np.asarray(band.corners)[:, : len(expected)]]
    np.testing.assert_array_equal(corner_vertices, corners)
    np.testing.assert_array_equal(
        band.rows_of_cells(band.cells)[: len(expected)], range(len(expected))
    )
    values = np.asarray(shape.sdf)[: len(vertices_of(model))]
    np.testing.assert_array_equal(values, sdf[vertices_of(model)])


def test_a_vertex_is_held_where_a_cell_around_it_is_not_in_the_band():
    sdf = ball(2.4, noise=0.4)
    model, _ = BandedFlexiCubes.around(sdf, grid_of(), 1)
    outside_cells = np.setdiff1d(np.arange(np.prod(SHAPE)), cells_of(model))
    vertices = vertices_of(model)
    is_border = np.isin(vertices, cell_corners(outside_cells))
    assert 0 < is_border.sum() < len(vertices)
    side = np.where(is_border, np.where(sdf[vertices] < 0, -1, 1), 0)
    np.testing.assert_array_equal(np.asarray(model.band.fixed)[: len(vertices)], side)


@jax.jit
def _evaluated(model, shape):
    def scalar(shape):
        surface = model.extract(shape, capacities=ROOM)
        penalties = model.penalties(shape, surface)
        total = jnp.sum(jnp.sin(3 * surface.mesh.vertices)) + jnp.sum(
            jnp.stack(list(penalties.values()))
        )
        return total, (surface, penalties, model.nearby_points(shape))

    return jax.value_and_grad(scalar, has_aux=True)(shape)


@pytest.fixture(scope="module")
def whole():
    """Evaluate a rough ball on all cells: its mesh has ambiguous cells and several patches."""
    sdf = ball(2.4, noise=0.9)
    dense = varied(initial_geometry(grid_of(), jnp.asarray(sdf)))
    # Far from the surface, weights keep their initial value 0, where their penalty vanishes.
    is_far = np.ones(np.prod(SHAPE), bool)
    is_far[band_module.cells_around(surface_of(sdf), SHAPE, 1)] = False
    for name in ("alpha", "beta"):
        weights = jnp.where(is_far[:, None], 0.0, getattr(dense, name))
        dense = replace(dense, **{name: weights})
    return dense, _evaluated(FlexiCubes(grid_of()), dense)


# Six layers reach every cell of this grid.
@pytest.mark.parametrize("layers", [1, 6])
def test_mesh_penalties_and_gradients_are_those_of_the_whole_grid(whole, layers):
    dense, ((_, expected), gradient) = whole
    model, _ = BandedFlexiCubes.around(np.asarray(dense.sdf), grid_of(), layers)
    assert (len(cells_of(model)) == np.prod(SHAPE)) == (layers == 6)
    (_, (surface, penalties, nearby_points)), band_gradient = _evaluated(
        model, rows_from(dense, model)
    )
    assert int(surface.mesh.face_count) > 200
    jax.tree.map(np.testing.assert_array_equal, surface, expected[0])
    for name, value in expected[1].items():
        np.testing.assert_allclose(penalties[name], value, rtol=ROUNDING)
    points, weights = (np.asarray(x) for x in expected[2])
    own_points, own_weights = (np.asarray(x) for x in nearby_points)
    np.testing.assert_array_equal(own_points[own_weights > 0], points[weights > 0])
    for name, numbers_of in (*VERTEX_NUMBERS, *CELL_NUMBERS):
        rows = numbers_of(model)
        dense_leaf = np.asarray(getattr(gradient, name))
        band_leaf = np.asarray(getattr(band_gradient, name))
        tolerance = ROUNDING * np.abs(dense_leaf).max()
        assert tolerance > 0
        np.testing.assert_allclose(band_leaf[: len(rows)], dense_leaf[rows], rtol=0, atol=tolerance)
        assert not band_leaf[len(rows) :].any(), "padding has a gradient"
        assert not np.delete(dense_leaf, rows, axis=0).any(), (
            "what is not in the band has a gradient"
        )


def test_first_capacities_are_those_of_the_whole_grid(whole):
    dense, _ = whole
    model, _ = BandedFlexiCubes.around(np.asarray(dense.sdf), grid_of(), 1)
    expected = FlexiCubes(grid_of()).first_capacities(dense)
    assert model.first_capacities(rows_from(dense, model)) == expected


def numbered(shape):
    """Fill arrays with distinct numbers, which tell the array and the row that they come from."""
    leaves, structure = jax.tree.flatten(shape)
    next_number, numbered_leaves = 1, []
    for leaf in leaves:
        numbered_leaves.append(
            jnp.arange(next_number, next_number + leaf.size, dtype=jnp.float32).reshape(leaf.shape)
        )
        next_number += leaf.size
    return jax.tree.unflatten(structure, numbered_leaves)


def with_values(model, shape, sdf):
    """Set the SDF of a band's shape to values that are given on the whole grid."""
    return replace(
        shape, sdf=rows_from(initial_geometry(model.band.grid, jnp.asarray(sdf)), model).sdf
    )


def test_what_stays_in_the_band_keeps_its_numbers_and_the_rest_starts_anew():
    grid = grid_of()
    model, shape = BandedFlexiCubes.around(ball(2.0), grid, 1)
    shape = with_values(model, varied(shape), ball(2.4))
    following = model.following(shape)
    assert following is not None
    new_model = following.model
    # The surface is the same as before, and the band is around it.
    np.testing.assert_array_equal(
        cells_of(new_model), band_module.cells_around(surface_of(ball(2.4)), SHAPE, 1)
    )
    assert new_model.following(following.shape) is None
    moments = numbered(shape)
    carried_moments = following.carried(moments)
    for name, numbers_of in (*VERTEX_NUMBERS, *CELL_NUMBERS):
        old_numbers, new_numbers = numbers_of(model), numbers_of(new_model)
        is_kept = np.isin(new_numbers, old_numbers)
        assert 0 < is_kept.sum() < len(new_numbers)
        rows = np.searchsorted(old_numbers, new_numbers[is_kept])
        for source, result in ((moments, carried_moments), (shape, following.shape)):
            old_values = np.asarray(getattr(source, name))
            new_values = np.asarray(getattr(result, name))
            np.testing.assert_array_equal(new_values[: len(new_numbers)][is_kept], old_values[rows])
            assert not new_values[len(new_numbers) :].any()
            if result is carried_moments or name != "sdf":
                assert not new_values[: len(new_numbers)][~is_kept].any()


def test_a_vertex_that_enters_the_band_lies_as_far_out_as_those_beside_it_and_the_way_from_there():
    grid = grid_of()
    model, shape = BandedFlexiCubes.around(ball(2.0), grid, 1)
    sdf = ball(2.4)
    shape = with_values(model, shape, sdf)
    np.testing.assert_array_equal(model.band.values(shape.sdf), shape.sdf)
    following = model.following(shape)
    assert following is not None
    old_vertices, new_vertices = vertices_of(model), vertices_of(following.model)
    values = np.asarray(following.shape.sdf)[: len(new_vertices)]
    entering_rows = np.flatnonzero(~np.isin(new_vertices, old_vertices))
    assert len(entering_rows) > 20
    known_values = np.full(np.prod(grid.vertex_shape), np.nan)
    known_values[old_vertices] = sdf[old_vertices]
    corners = cell_corners(cells_of(following.model))
    for row in entering_rows:
        cells = corners[:, (corners == new_vertices[row]).any(0)]
        adjacent_vertices = cells[~np.isnan(known_values[cells])]
        coordinates = np.stack(
            np.unravel_index(
                np.append(adjacent_vertices, new_vertices[row]), grid.vertex_shape[::-1]
            ),
            1,
        )
        distances = np.sqrt(((coordinates[:-1] - coordinates[-1]) ** 2).sum(1))
        expected = min(
            np.min(np.abs(known_values[adjacent_vertices]) + distances), band_module.REACH
        )
        assert values[row] == pytest.approx(
            np.sign(known_values[adjacent_vertices[0]]) * expected, rel=1e-6
        )


def test_a_surface_never_leaves_its_band_and_the_band_follows_it_to_the_sides_of_the_box():
    grid = grid_of((12, 12, 12))
    model, shape = BandedFlexiCubes.around(ball(1.6, grid), grid, 1)
    iterations = 0
    while True:
        iterations += 1
        assert iterations < 10, "the band does not arrive at the sides"
        # Whatever training might learn: here, all of the band moves inside.
        shape = replace(shape, sdf=jnp.full_like(shape.sdf, -1.0))
        values, side = np.asarray(model.band.values(shape.sdf)), np.asarray(model.band.fixed)
        assert (values[side > 0] > 0).all()
        assert (values[side <= 0] == -1.0).all()
        if not (side > 0).any():
            break
        old_cells = cells_of(model)
        following = model.following(shape)
        assert following is not None
        model, shape = following.model, following.shape
        assert not set(cells_of(model)) <= set(old_cells)
    assert iterations > 3
    assert {0, 11, 12**3 - 1} <= set(cells_of(model))


def test_a_band_keeps_its_rows_where_they_are_enough_and_not_far_too_many():
    count = band_module._row_count
    assert count(1000, 0) >= 1200
    assert count(1000, 1000) == 1000
    assert count(1001, 1000) >= 1201
    assert count(1000, 2 * count(1000, 0)) == 2 * count(1000, 0)
    assert count(1000, 2 * count(1000, 0) + 1) == count(1000, 0)


def test_where_there_is_no_surface_the_band_stays():
    # All of the band is outside, and no vertex is held inside by a cell beyond its border.
    model, shape = BandedFlexiCubes.around(ball(0.6), grid_of(), 1)
    assert not (np.asarray(model.band.fixed) < 0).any()
    assert model.following(replace(shape, sdf=jnp.ones_like(shape.sdf))) is None


CONFIG = tiny_config(
    "geometry.band=3",
    "geometry.resolution=10",
    "stages.split_sum.steps=8",
)


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(count=5, size=8)


def grown(state):
    """Move the surface of a state outwards by a third of a cell, and fill the moments of Adam."""
    geometry = replace(state.params.geometry, sdf=state.params.geometry.sdf - 0.3)
    moments = to_levels(replace(state.params, geometry=numbered(geometry)))
    optimizer = state.optimizer._replace(mu=moments, nu=jax.tree.map(jnp.square, moments))
    return replace(
        state,
        params=replace(state.params, geometry=geometry),
        optimizer=optimizer,
        step=state.step + 1,
    )


def steps_that_grow(monkeypatch):
    """Replace the training step by one that only moves the surface, and compilation by a record."""
    compiled = []

    def step(state, batch, pipeline, rule, *, run):
        one = jnp.float32(1.0)
        loss = LossReport({"l1": one}, one, jnp.int32(6), jnp.int32(1), {"hits": jnp.int32(1)})
        report = StepReport(one, loss, jnp.asarray(True), jnp.asarray(True))
        return grown(state), report

    monkeypatch.setattr(loop_module, "train_step", step)
    monkeypatch.setattr(loop_module, "compile_step", lambda *a, **k: compiled.append(a) is None)
    monkeypatch.setattr(loop_module, "plan_capacities", lambda *a, **k: Capacities(hits=128))
    monkeypatch.setattr(loop_module, "_FOLLOW_EVERY", 2)
    return compiled


@pytest.fixture
def folder(dataset, tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked():
        run.begin(dataset, CONFIG, replace=False)
    return run


def assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    jax.tree.map(np.testing.assert_array_equal, first, second)


def rows_of(model):
    return model.band.cell_rows, model.band.vertex_rows


def advanced(loop, steps):
    for _ in range(steps):
        loop.prepare(loop.step)
        loop.advance(loop.step)
    return loop


def test_between_two_steps_the_band_follows_with_all_that_adam_keeps(dataset, folder, monkeypatch):
    compiled = steps_that_grow(monkeypatch)
    loop = new_loop(dataset, CONFIG, folder)
    first_surface = loop.surface
    advanced(loop, 1)
    assert loop.surface is first_surface
    grown_state = grown(loop.state)
    count = len(compiled)
    advanced(loop, 1)
    assert loop.surface is loop.pipeline.surface
    assert cells_of(loop.surface).tolist() != cells_of(first_surface).tolist()
    following = first_surface.following(grown_state.params.geometry)
    assert following is not None
    assert_same(loop.state.params.geometry, following.shape)
    assert_same(
        loop.state.optimizer.mu.geometry, following.carried(grown_state.optimizer.mu.geometry)
    )
    assert_same(
        loop.state.optimizer.nu.geometry, following.carried(grown_state.optimizer.nu.geometry)
    )
    # The moments of parameters that are not part of the shape stay as they are.
    assert_same(loop.state.optimizer.mu.light, grown_state.optimizer.mu.light)
    has_grown = rows_of(first_surface) != rows_of(loop.surface)
    assert len(compiled) == count + has_grown


def test_a_run_that_goes_on_from_a_checkpoint_has_the_band_that_it_had(
    dataset, folder, monkeypatch
):
    compiled = steps_that_grow(monkeypatch)
    loop = advanced(new_loop(dataset, CONFIG, folder), 3)
    assert loop.save() is not None
    second_loop = resumed_loop(dataset, CONFIG, folder)
    count = len(compiled)
    second_loop.prepare(second_loop.step)
    # The programs are compiled side by side, before a step waits for them.
    assert len(compiled) == count + 1
    assert second_loop.has_compiled
    assert_same(second_loop.surface, loop.surface)
    assert_same(second_loop.state, loop.state)
    assert_same(second_loop.fallback, loop.fallback)
    assert cells_of(second_loop.surface).tolist() != cells_of(second_loop.fallback.surface).tolist()
    for active_loop in (loop, second_loop):
        advanced(active_loop, 3)
    assert_same(second_loop.surface, loop.surface)
    assert_same(second_loop.state, loop.state)


def test_a_stage_that_ends_earlier_than_before_an_interruption_leaves_one_end(
    dataset, folder, monkeypatch
):
    """A budget may shorten a stage that had already ended when its process was killed."""
    steps_that_grow(monkeypatch)
    loop = new_loop(dataset, CONFIG, folder)
    for steps in (8, 5):
        loop.state = replace(loop.state, step=jnp.int32(steps))
        loop.save_end()
    checkpoints = list(folder.end_of("split_sum").iterdir())
    assert [path.name for path in checkpoints] == ["checkpoint_00000005.npz"]


def test_the_memory_that_a_band_is_certain_to_take_is_less_than_it_takes(dataset):
    _, shape = CONFIG.geometry.start(dataset, jax.random.key(0))
    actual_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(shape))
    certain_bytes = CONFIG.geometry.parameter_bytes(dataset.bounds)
    assert 0.05 * actual_bytes < certain_bytes < actual_bytes
    dense_geometry = tiny_config("geometry.resolution=10").geometry
    assert certain_bytes < dense_geometry.parameter_bytes(dataset.bounds)


def test_a_band_whose_rows_are_no_numbers_of_rows_is_refused():
    description = {"grid_shape": [4, 4, 4], "cell_rows": 128, "vertex_rows": 0}
    with pytest.raises(ValueError, match="cell_rows and vertex_rows"):
        CONFIG.geometry.template(description)


def test_a_stage_that_leaves_the_surface_alone_leaves_the_band_alone(dataset, folder, monkeypatch):
    steps_that_grow(monkeypatch)
    loop = new_loop(dataset, CONFIG, folder)
    rates = dict.fromkeys(CONFIG.geometry.rate_groups, Rate(0.0))
    loop.stage = replace(loop.stage, rates={**loop.stage.rates, **rates})
    loop.state = grown(grown(loop.state))
    first_surface = loop.surface
    assert first_surface.following(loop.state.params.geometry) is not None
    loop._follow(2)
    assert loop.surface is first_surface


def test_a_surface_that_vanishes_is_put_back_with_its_band(dataset, folder, monkeypatch):
    compiled = steps_that_grow(monkeypatch)
    loop = new_loop(dataset, CONFIG, folder)
    first_surface = loop.surface
    while rows_of(loop.surface) == rows_of(first_surface):
        advanced(loop, 2)
    count = len(compiled)
    loop._recover(loop.step)
    assert len(compiled) == count + 1
    assert loop.surface is loop.pipeline.surface is first_surface
    assert_same(loop.params.geometry, jax.tree.map(jnp.asarray, loop.fallback.shape))


@pytest.mark.slow
@pytest.mark.long
def test_training_in_a_band_is_training_on_the_whole_grid(dataset, tmp_path, monkeypatch):
    """The two agree up to the order of sums, until a cell leaves the band and comes back."""
    monkeypatch.setattr(loop_module, "_FOLLOW_EVERY", 2)
    dense_config = tiny_config("geometry.resolution=10", "stages.split_sum.steps=5")
    banded_config = tiny_config(
        "geometry.resolution=10", "stages.split_sum.steps=5", "geometry.band=3"
    )
    states = [
        fit(dataset, config, tmp_path / name)
        for name, config in (("whole", dense_config), ("band", banded_config))
    ]
    lines = [RunFolder(tmp_path / name).metric_lines() for name in ("whole", "band")]
    for dense_line, banded_line in zip(*lines, strict=True):
        assert dense_line["faces"] == banded_line["faces"]
        assert banded_line["loss"] == pytest.approx(dense_line["loss"], rel=1e-4)
    stopped_folder = tmp_path / "stopped"
    fit(dataset, banded_config, stopped_folder, stop_after=3)
    assert_same(fit(dataset, banded_config, stopped_folder, begin=Resume()), states[1])
