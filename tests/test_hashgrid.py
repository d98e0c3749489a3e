"""Hash encoding: interpolation laws, a slow reference, exact gradients, behaviour at borders."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax import hashgrid
from geosplat_jax.hashgrid import (
    HashGridSpec,
    _locate,
    _reference_encode,
    apply_mlp,
    init_mlp,
    init_tables,
)

# One compilation costs less than a hundred eager operations.
encode = jax.jit(hashgrid.encode, static_argnames=("spec", "position_gradient"))

ROUNDING = 2e-6  # float32, sums of eight products of unit-size numbers
EXACT = 1e-11  # float64, the same in another order

# Levels of 2, 4, 8 and 16 cells: two dense ones (27 and 125 vertices), two hashed into 256 rows.
SMALL = HashGridSpec(levels=4, features=2, log2_entries=8, coarsest=2, finest=16)
DENSE = HashGridSpec(levels=3, features=3, log2_entries=10, coarsest=2, finest=8)


def _table(spec, seed=0, dtype=jnp.float32):
    shape = (spec.total_entries, spec.features)
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape), dtype)


def _points(count=50, seed=1, dtype=jnp.float32):
    return jnp.asarray(np.random.default_rng(seed).uniform(size=(count, 3)), dtype)


def level_rows(table, spec):
    """Split the common table into the tables of its levels."""
    ends = np.cumsum(spec.entries)
    return [table[end - count : end] for end, count in zip(ends, spec.entries, strict=True)]


def _slow_row(spec, level, x, y, z):
    """Row of a vertex, in Python integers."""
    cells = spec.resolutions[level]
    if spec.is_dense[level]:
        return (z * (cells + 1) + y) * (cells + 1) + x
    hash_value = ((y * 2654435761) ^ (z * 805459861)) % 2**32
    hash_value = ((hash_value ^ (hash_value >> 15)) * 0x2C1B3C6D) % 2**32
    offset_count = 2**spec.log2_entries - cells
    scale = np.float32(offset_count) * np.float32(2.0**-24)
    return int(np.float32(hash_value >> 8) * scale) + x


def _slow_encode(table, points, spec):
    """Encode points in loops over points, levels and corners."""
    features = np.zeros((len(points), spec.levels, spec.features))
    for n, point in enumerate(points):
        for level, cells in enumerate(spec.resolutions):
            rows = np.asarray(level_rows(table, spec)[level])
            scaled = point * cells
            corner = np.minimum(scaled.astype(int), cells - 1)
            t = scaled - corner
            for shift in np.ndindex(2, 2, 2):
                weight = np.prod(np.where(shift, t, 1 - t))
                vertex = [int(c) for c in corner + shift]
                features[n, level] += weight * rows[_slow_row(spec, level, *vertex)]
    return features.reshape(len(points), -1)


def _relative(first, second):
    return float(jnp.linalg.norm(first - second) / jnp.linalg.norm(second))


def test_resolutions_grow_geometrically_between_both_ends():
    assert SMALL.resolutions == (2, 4, 8, 16)
    paper = HashGridSpec(levels=16, features=2, log2_entries=19, coarsest=32, finest=4096)
    assert paper.resolutions[0] == 32
    assert paper.resolutions[-1] == 4096
    ratios = np.diff(np.log(paper.resolutions))
    np.testing.assert_allclose(ratios, np.log(128) / 15, atol=0.03)
    assert HashGridSpec(levels=1, coarsest=8, finest=8).resolutions == (8,)


def test_levels_that_fit_are_dense_and_the_others_have_full_tables():
    assert SMALL.is_dense == (True, True, False, False)
    assert SMALL.entries == (27, 125, 256, 256)
    assert init_tables(jax.random.key(0), SMALL).shape == (664, 2)
    assert [len(rows) for rows in level_rows(_table(SMALL), SMALL)] == [27, 125, 256, 256]


@pytest.mark.parametrize(
    "sizes",
    [
        {"levels": 0},
        {"features": 0},
        {"coarsest": 8, "finest": 4},
        {"log2_entries": 8, "finest": 200},
    ],
)
def test_impossible_sizes_are_refused(sizes):
    with pytest.raises(ValueError, match=r"greater than or equal to 1|must be|takes more than"):
        HashGridSpec(**sizes)


def test_a_single_level_is_checked_by_its_own_cells():
    assert HashGridSpec(levels=1, log2_entries=12, coarsest=16, finest=4096).resolutions == (16,)
    with pytest.raises(ValueError, match="a grid line of 4096 cells"):
        HashGridSpec(levels=2, log2_entries=12, coarsest=16, finest=4096)


def test_a_constant_table_gives_a_constant_output():
    table = jnp.full((SMALL.total_entries, 2), 0.7)
    points = jnp.concatenate([_points(), _points(seed=2) * 4 - 2])
    np.testing.assert_allclose(encode(table, points, spec=SMALL), 0.7, atol=ROUNDING)


def test_dense_levels_return_the_rows_of_grid_vertices():
    table = _table(DENSE)
    cells = DENSE.resolutions[-1]
    z, y, x = np.meshgrid(*[np.arange(cells + 1)] * 3, indexing="ij")
    points = jnp.asarray(np.stack([x, y, z], -1).reshape(-1, 3) / cells, jnp.float32)
    features = encode(table, points, spec=DENSE)[:, -DENSE.features :]
    np.testing.assert_allclose(features, level_rows(table, DENSE)[-1], atol=ROUNDING)


def test_a_linear_function_is_reproduced_by_dense_levels():
    slopes = np.random.default_rng(0).standard_normal((3, DENSE.features))
    rows = []
    for cells in DENSE.resolutions:
        z, y, x = np.meshgrid(*[np.arange(cells + 1)] * 3, indexing="ij")
        rows.append(np.stack([x, y, z], -1).reshape(-1, 3) / cells @ slopes)
    points = _points()
    features = encode(jnp.asarray(np.concatenate(rows), jnp.float32), points, spec=DENSE)
    expected = np.tile(np.asarray(points) @ slopes, (1, DENSE.levels))
    np.testing.assert_allclose(features, expected, atol=5 * ROUNDING)


@pytest.mark.parametrize("spec", [SMALL, DENSE])
def test_values_equal_those_of_a_slow_reference(spec):
    with double_precision():
        table, points = _table(spec, dtype=jnp.float64), _points(dtype=jnp.float64)
        slow = _slow_encode(table, np.asarray(points), spec)
        np.testing.assert_allclose(encode(table, points, spec=spec), slow, atol=EXACT)
        np.testing.assert_allclose(
            jax.jit(_reference_encode, static_argnums=2)(table, points, spec), slow, atol=EXACT
        )


def test_the_field_is_continuous_across_cell_faces():
    table = _table(SMALL)
    edges = jnp.asarray([[k / 16, 0.3, 0.7] for k in range(1, 16)], jnp.float32)
    edges = jnp.concatenate([edges, edges[:, [1, 0, 2]], edges[:, [2, 1, 0]]])
    step = 1e-6
    jump = encode(table, edges + step, spec=SMALL) - encode(table, edges - step, spec=SMALL)
    assert float(jnp.max(jnp.abs(jump))) < 3e-3  # slopes reach 16 cells x a few units x 2 steps


def test_only_hashed_levels_collide_and_every_row_is_in_its_level():
    spec = HashGridSpec(levels=3, features=1, log2_entries=10, coarsest=8, finest=64)
    cells = spec.resolutions[-1]
    axis = (np.arange(cells) + 0.5) / cells
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    rows = np.stack(_locate(jnp.asarray(grid, jnp.float32), spec).rows)
    for level, (first, count) in enumerate(zip(spec.first_rows, spec.entries, strict=True)):
        local_rows = rows[:, :, level] - first
        assert local_rows.min() >= 0
        assert local_rows.max() + 1 < count
        usage = np.bincount(local_rows.ravel(), minlength=count)
        if spec.is_dense[level]:
            n = spec.resolutions[level]
            vertices = np.floor(grid * n).astype(int)
            expected = (vertices[:, 2] * (n + 1) + vertices[:, 1]) * (n + 1) + vertices[:, 0]
            np.testing.assert_array_equal(local_rows[0], expected)
        elif level == spec.levels - 1:
            # Only the ends of grid lines reach the ends of the table; the rest is used evenly.
            end = spec.resolutions[level]
            inner_usage = usage[end:-end]
            assert inner_usage.min() > 0
            assert inner_usage.max() < 3 * inner_usage.mean()


def _assert_equal_pullbacks(table, points, cotangent):
    ours = partial(hashgrid.encode, spec=SMALL, position_gradient=True)
    plain = partial(_reference_encode, spec=SMALL)
    gradients = [
        jax.jit(lambda t, p, c, f=f: jax.vjp(f, t, p)[1](c))(table, points, cotangent)
        for f in (ours, plain)
    ]
    for a, b in zip(*gradients, strict=True):
        assert _relative(a, b) < EXACT


def test_the_full_jacobian_of_a_tiny_grid_equals_that_of_autodiff():
    spec = HashGridSpec(levels=2, features=1, log2_entries=4, coarsest=1, finest=3)
    with double_precision():
        table, points = _table(spec, dtype=jnp.float64), _points(3, dtype=jnp.float64)
        ours = jax.jacrev(
            partial(hashgrid.encode, spec=spec, position_gradient=True), argnums=(0, 1)
        )
        plain = jax.jacrev(partial(_reference_encode, spec=spec), argnums=(0, 1))
        jacobians = (jax.jit(ours)(table, points), jax.jit(plain)(table, points))
        for a, b in zip(*jacobians, strict=True):
            np.testing.assert_allclose(a, b, atol=EXACT)


def test_gradients_over_several_chunks_equal_those_of_autodiff(monkeypatch):
    monkeypatch.setattr("geosplat_jax.hashgrid._BACKWARD_CHUNK", 16)
    with double_precision():
        table, points = _table(SMALL, dtype=jnp.float64), _points(53, dtype=jnp.float64)
        cotangent = jnp.asarray(np.random.default_rng(3).standard_normal((53, SMALL.width)))
        _assert_equal_pullbacks(table, points, cotangent)


def test_points_without_position_gradient_receive_zero():
    total = lambda p: jnp.sum(encode(_table(SMALL), p, spec=SMALL))  # noqa: E731
    gradient = jax.jit(jax.grad(total))(_points())
    np.testing.assert_array_equal(gradient, 0.0)


def test_points_outside_are_clamped_and_receive_no_gradient_along_that_axis():
    table = _table(SMALL)
    points = jnp.asarray([[1.5, 0.4, 0.6], [0.3, -2.0, 0.9], [0.2, 0.1, 1e9]], jnp.float32)
    clamped = jnp.clip(points, 0.0, 1.0)
    values = encode(table, points, spec=SMALL)
    np.testing.assert_array_equal(values, encode(table, clamped, spec=SMALL))
    gradient = jax.jit(
        jax.grad(lambda p: jnp.sum(encode(table, p, spec=SMALL, position_gradient=True) ** 2))
    )(points)
    is_outside = np.asarray(points != clamped)
    np.testing.assert_array_equal(np.asarray(gradient)[is_outside], 0.0)
    assert np.all(np.asarray(gradient)[~is_outside] != 0.0)


def test_the_border_is_the_last_vertex():
    table = _table(DENSE)
    corners = jnp.asarray([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    features = encode(table, corners, spec=DENSE).reshape(2, DENSE.levels, -1)
    for level, rows in enumerate(level_rows(table, DENSE)):
        np.testing.assert_allclose(features[:, level], rows[jnp.asarray([0, -1])], atol=ROUNDING)


def test_a_point_that_is_not_a_number_spoils_only_its_own_row():
    table = _table(SMALL)
    points = _points(4).at[1].set(jnp.nan).at[2].set(jnp.inf)
    features = encode(table, points, spec=SMALL)
    assert bool(jnp.all(jnp.isnan(features[1])))
    other_rows = jnp.asarray([0, 2, 3])
    assert bool(jnp.all(jnp.isfinite(features[other_rows])))


def test_rows_with_zero_cotangent_leave_no_trace():
    table, points = _table(SMALL), _points(20)

    @jax.jit
    def gradient(points):
        mask = (jnp.arange(points.shape[0]) < 20)[:, None]
        return jax.grad(
            lambda t: jnp.sum(jnp.where(mask, encode(t, points, spec=SMALL), 0.0) ** 2)
        )(table)

    padded = jnp.concatenate([points, jnp.full((13, 3), 0.123)])
    # Processors give equal bits; accelerators add what belongs to one entry in any order.
    np.testing.assert_allclose(gradient(points), gradient(padded), rtol=1e-6, atol=1e-6)


def test_no_points_give_no_rows_and_zero_gradients():
    table, points = _table(SMALL), jnp.zeros((0, 3))
    assert encode(table, points, spec=SMALL).shape == (0, SMALL.width)
    gradient = jax.grad(lambda t: jnp.sum(encode(t, points, spec=SMALL)))(table)
    np.testing.assert_array_equal(gradient, 0.0)


def test_jit_equals_eager_and_keeps_float32():
    table, points = _table(SMALL), _points()

    def value(table, points):
        return jnp.sum(hashgrid.encode(table, points, spec=SMALL, position_gradient=True) ** 2)

    eager = jax.value_and_grad(value, argnums=(0, 1))(table, points)
    compiled = jax.jit(jax.value_and_grad(value, argnums=(0, 1)))(table, points)
    for a, b in zip(jax.tree.leaves(eager), jax.tree.leaves(compiled), strict=True):
        assert a.dtype == b.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_tables_start_small():
    table = init_tables(jax.random.key(0), SMALL)
    assert table.dtype == jnp.float32
    assert 0.5e-4 < float(jnp.max(jnp.abs(table))) <= 1e-4


def test_an_mlp_is_affine_maps_with_rectified_layers_between():
    layers = init_mlp(jax.random.key(0), (4, 8, 3), bias=True)
    shifted = jax.tree.map(lambda leaf: leaf + 0.1, layers)
    x = np.random.default_rng(0).standard_normal((5, 4)).astype(np.float32)
    (w1, b1), (w2, b2) = ((np.asarray(layer.weights), np.asarray(layer.bias)) for layer in shifted)
    expected = np.maximum(x @ w1 + b1, 0.0) @ w2 + b2
    np.testing.assert_allclose(apply_mlp(shifted, jnp.asarray(x)), expected, atol=ROUNDING)


def test_mlp_weights_are_kaiming_uniform_and_biases_optional():
    layers = init_mlp(jax.random.key(0), (32, 64, 64), bias=False)
    assert len(jax.tree.leaves(layers)) == 2
    for layer in layers:
        bound = np.sqrt(6 / layer.weights.shape[0])
        assert 0.95 * bound < float(jnp.max(jnp.abs(layer.weights))) <= bound
        np.testing.assert_allclose(jnp.std(layer.weights), bound / np.sqrt(3), rtol=0.05)
    biased = init_mlp(jax.random.key(0), (4, 2), bias=True)
    np.testing.assert_array_equal(biased[0].bias, 0.0)
