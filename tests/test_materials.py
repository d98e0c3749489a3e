"""Material fields: ranges, initial values, only the parameters a model uses, smoothness."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax import materials
from geosplat_jax.hashgrid import HashGridSpec
from geosplat_jax.materials import INITIAL_LOGITS, MaterialSpec, init_materials, to_unit_cube

GRID = HashGridSpec(levels=3, features=2, log2_entries=8, coarsest=2, finest=8)
CENTER = jnp.asarray([0.5, -1.0, 2.0])
HALF_EXTENT = jnp.asarray(1.5)

# One compilation costs less than a hundred eager operations.
materials_at = jax.jit(materials.materials_at, static_argnames=("spec", "position_gradient"))
inward_shift = jax.jit(materials.inward_shift, static_argnames="spec")
indirect_logits = jax.jit(materials.indirect_logits, static_argnames="spec")
smoothness = jax.jit(materials.smoothness, static_argnames="spec")

WHERE = {"center": CENTER, "half_extent": HALF_EXTENT}


def _spec(**settings):
    return MaterialSpec(grid=GRID, **settings)


def _lively(spec, seed=0):
    """A field whose attributes vary strongly."""
    params = init_materials(jax.random.key(seed), spec)
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda leaf: jnp.asarray(rng.standard_normal(leaf.shape), leaf.dtype), params
    )


def _points(count=60, seed=1):
    local = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return jnp.asarray(np.asarray(CENTER) + 1.5 * local, jnp.float32)


def _constant(params):
    """The same field with encodings that do not vary in space."""
    flat = {"albedo_table": jnp.ones_like(params.albedo_table)}
    if params.surface_table is not None:
        flat["surface_table"] = jnp.ones_like(params.surface_table)
    return type(params)(**{**vars(params), **flat})


@pytest.mark.parametrize("shared", [False, True])
def test_attributes_lie_in_their_ranges(shared):
    spec = _spec(shared=shared, bias=True)
    params = jax.tree.map(lambda leaf: 30 * leaf, _lively(spec))
    found = materials_at(params, 3 * _points(), spec=spec, **WHERE)
    for values, low in ((found.albedo, 0.0), (found.roughness, 0.1), (found.metallic, 0.0)):
        assert float(jnp.min(values)) >= low - 1e-7
        assert float(jnp.max(values)) <= 1.0 + 1e-7
        assert values.dtype == jnp.float32
    assert float(jnp.max(found.roughness)) - float(jnp.min(found.roughness)) > 0.5


@pytest.mark.parametrize("kind", sorted(INITIAL_LOGITS))
def test_a_new_field_starts_at_its_initial_guess(kind):
    roughness, metallic = INITIAL_LOGITS[kind]
    spec = _spec(initial_roughness_logit=roughness, initial_metallic_logit=metallic)
    found = materials_at(init_materials(jax.random.key(0), spec), _points(), spec=spec, **WHERE)
    # Tables start at 1e-4, and the heads pass that on with gains of order one.
    np.testing.assert_allclose(found.albedo, 0.5, atol=2e-3)
    np.testing.assert_allclose(found.roughness, 0.9 / (1 + np.exp(-roughness)) + 0.1, atol=2e-3)
    np.testing.assert_allclose(found.metallic, 1 / (1 + np.exp(-metallic)), atol=2e-3)


def test_a_field_holds_only_what_the_model_uses():
    def count(**settings):
        return len(jax.tree.leaves(init_materials(jax.random.key(0), _spec(**settings))))

    assert count() == 2 + 3 + 2 + 2  # two tables, then the weights of three heads
    assert count(shared=True) == 1 + 3 + 2 + 2
    assert count(has_shift=False) == 2 + 3 + 2
    assert count(indirect_outputs=6) == 2 + 3 + 2 + 2 + 3
    assert count(bias=True) == 2 + 2 * (3 + 2 + 2)
    plain = init_materials(jax.random.key(0), _spec(has_metallic=False, has_shift=False))
    assert plain.surface_head[-1].weights.shape[1] == 1
    assert plain.shift_head is None
    assert plain.indirect_head is None


def test_a_field_without_metallic_is_not_metallic():
    spec = _spec(has_metallic=False)
    found = materials_at(_lively(spec), _points(), spec=spec, **WHERE)
    np.testing.assert_array_equal(found.metallic, 0.0)


@pytest.mark.parametrize("shared", [False, True])
def test_every_parameter_receives_a_gradient(shared):
    spec = _spec(shared=shared, bias=True, indirect_outputs=6)
    params, points = _lively(spec), _points()

    def value(params):
        found = materials_at(params, points, spec=spec, **WHERE)
        parts = (found.albedo, found.roughness, found.metallic)
        total = sum((jnp.sum(part**2) for part in parts), start=jnp.zeros(()))
        total = total + jnp.sum(inward_shift(params, points, spec=spec, **WHERE) ** 2)
        return total + jnp.sum(indirect_logits(params, points, spec=spec, **WHERE) ** 2)

    for leaf in jax.tree.leaves(jax.jit(jax.grad(value))(params)):
        assert bool(jnp.all(jnp.isfinite(leaf)))
        assert float(jnp.max(jnp.abs(leaf))) > 0


def test_points_are_mapped_to_the_unit_cube_and_clamped():
    corners = jnp.stack([CENTER - 1.5, CENTER, CENTER + 1.5, CENTER + 9.0])
    expected = jnp.asarray([[0.0], [0.5], [1.0], [1.0]]) * jnp.ones((1, 3))
    np.testing.assert_allclose(to_unit_cube(corners, CENTER, HALF_EXTENT), expected, atol=1e-6)


def test_position_gradients_are_a_choice_and_agree_with_differences():
    step = 1e-6
    with double_precision():
        spec = _spec(bias=True)
        params = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), _lively(spec))
        where = {"center": CENTER.astype(jnp.float64), "half_extent": jnp.asarray(1.5, jnp.float64)}
        # Fractions in the middle of the finest cells; coarser resolutions divide eight.
        rng = np.random.default_rng(0)
        unit = (rng.integers(0, 8, (20, 3)) + rng.uniform(0.2, 0.8, (20, 3))) / 8
        points = where["center"][None, :] + 1.5 * jnp.asarray(2 * unit - 1)

        def value(points, position_gradient):
            found = materials_at(
                params, points, spec=spec, position_gradient=position_gradient, **where
            )
            return jnp.sum(found.albedo**2) + jnp.sum(jnp.sin(found.roughness + found.metallic))

        along = jnp.asarray(rng.standard_normal(points.shape))
        derivative = jnp.vdot(jax.jit(jax.grad(value), static_argnums=1)(points, True), along)
        change = value(points + step * along, True) - value(points - step * along, True)
        np.testing.assert_allclose(derivative, change / (2 * step), rtol=1e-6)
        np.testing.assert_array_equal(jax.grad(value)(points, False), 0.0)


def test_the_shift_is_a_share_that_carries_no_gradient_to_points():
    spec = _spec()
    params, points = _lively(spec), _points()
    shift = inward_shift(params, points, spec=spec, **WHERE)
    assert shift.shape == (60,)
    assert float(jnp.min(shift)) > 0
    assert float(jnp.max(shift)) < 1
    gradient = jax.grad(lambda p: jnp.sum(inward_shift(params, p, spec=spec, **WHERE)))(points)
    np.testing.assert_array_equal(gradient, 0.0)


def test_asking_for_an_absent_head_is_an_error():
    spec = _spec(has_shift=False)
    params = init_materials(jax.random.key(0), spec)
    with pytest.raises(ValueError, match="no shift head"):
        inward_shift(params, _points(), spec=spec, **WHERE)
    with pytest.raises(ValueError, match="no indirect head"):
        indirect_logits(params, _points(), spec=spec, **WHERE)


def test_smoothness_is_zero_for_a_constant_field_and_positive_otherwise():
    spec = _spec()
    params, points = _lively(spec), _points()
    mask, key = jnp.ones(60, bool), jax.random.key(2)
    measure = partial(smoothness, spec=spec, **WHERE)
    assert float(measure(_constant(params), points, mask, key)) < 1e-6  # weights sum to 1 rounded
    assert float(measure(params, points, mask, key)) > 1e-3


def test_smoothness_is_the_weighted_mean_of_absolute_changes():
    spec = _spec()
    params, points, key = _lively(spec), _points(), jax.random.key(2)
    moved = points + 0.05 * HALF_EXTENT * jax.random.normal(key, points.shape)
    here = materials_at(params, points, spec=spec, **WHERE)
    there = materials_at(params, moved, spec=spec, **WHERE)
    mask = np.arange(60) < 40
    expected = (
        2.0 * np.abs(here.albedo - there.albedo).sum(-1)
        + 0.5 * np.abs(here.roughness - there.roughness)
        + 3.0 * np.abs(here.metallic - there.metallic)
    )[mask].mean()
    weights = (2.0, 0.5, jnp.asarray(3.0))
    found = smoothness(
        params, points, jnp.asarray(mask), key, spec=spec, std=0.05, weights=weights, **WHERE
    )
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_smoothness_without_points_is_zero_with_zero_gradient():
    spec = _spec(has_metallic=False)
    params, points = _lively(spec), _points()
    nothing = jnp.zeros(60, bool)
    value, gradient = jax.value_and_grad(smoothness)(
        params, points, nothing, jax.random.key(0), spec=spec, **WHERE
    )
    assert float(value) == 0.0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0.0)


def test_jit_equals_eager():
    spec = _spec(shared=True)
    params, points = _lively(spec), _points()
    found = partial(materials.materials_at, spec=spec, **WHERE)
    for a, b in zip(
        jax.tree.leaves(found(params, points)),
        jax.tree.leaves(jax.jit(found)(params, points)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-5)
