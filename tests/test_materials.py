"""Material fields: ranges, initial values, the parameters of each model, and smoothness."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax import materials
from geosplat_jax.core.types import Box
from geosplat_jax.hashgrid import HashGridSpec
from geosplat_jax.materials import MATERIAL_PRIORS, MaterialSpec, init_materials, to_unit_cube

RAW_TABLES = 2e-3  # tables start at 1e-4, and the heads pass that on with gains of order one
DIFFERENCES = 1e-6  # central differences in float64
ROUNDING = 1e-5  # float32, two layers

GRID = HashGridSpec(levels=3, features=2, log2_entries=8, coarsest=2, finest=8)
BOX = Box(jnp.asarray([0.5, -1.0, 2.0]), jnp.asarray(1.5))

# One compilation costs less than a hundred eager operations.
attributes_at = jax.jit(materials.attributes_at, static_argnames="spec")
smoothness = jax.jit(materials.smoothness, static_argnames="spec")


def spec_of(**settings):
    return MaterialSpec(grid=GRID, **settings)


def lively(spec, *, indirect_outputs=0, dtype=jnp.float32):
    """A field whose attributes vary strongly."""
    shapes = jax.eval_shape(
        lambda: init_materials(jax.random.key(0), spec, indirect_outputs=indirect_outputs)
    )
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.standard_normal(leaf.shape), dtype), shapes)


def points_in_the_box(count=60, seed=1):
    local = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return jnp.asarray(np.asarray(BOX.center) + 1.5 * local, jnp.float32)


@pytest.mark.parametrize("shared", [False, True])
def test_attributes_lie_in_their_ranges(shared):
    spec = spec_of(shared=shared, bias=True)
    field = jax.tree.map(lambda leaf: 30 * leaf, lively(spec))
    attributes = attributes_at(field, 3 * points_in_the_box(), BOX, spec=spec)
    material = attributes.materials
    for values, low in (
        (material.albedo, 0.0),
        (material.roughness, 0.1),
        (material.metallic, 0.0),
        (attributes.shift, 0.0),
    ):
        assert float(jnp.min(values)) >= low - 1e-7
        assert float(jnp.max(values)) <= 1.0 + 1e-7
        assert values.dtype == jnp.float32
    assert float(jnp.max(material.roughness)) - float(jnp.min(material.roughness)) > 0.5
    assert attributes.indirect is None


def test_a_new_field_starts_at_its_initial_guess():
    points = points_in_the_box()
    field = jax.jit(init_materials, static_argnames="spec")(jax.random.key(0), spec_of())
    for kind in ("diffuse", "specular"):
        roughness, metallic = MATERIAL_PRIORS[kind]
        spec = spec_of(initial_roughness_logit=roughness, initial_metallic_logit=metallic)
        attributes = attributes_at(field, points, BOX, spec=spec)
        material = attributes.materials
        np.testing.assert_allclose(material.albedo, 0.5, atol=RAW_TABLES)
        expected = 0.9 / (1 + np.exp(-roughness)) + 0.1
        np.testing.assert_allclose(material.roughness, expected, atol=RAW_TABLES)
        np.testing.assert_allclose(material.metallic, 1 / (1 + np.exp(-metallic)), atol=RAW_TABLES)
        np.testing.assert_allclose(attributes.shift, 0.5, atol=RAW_TABLES)
    shallow = attributes_at(field, points, BOX, spec=spec_of(initial_shift_logit=-1.1))
    np.testing.assert_allclose(shallow.shift, 1 / (1 + np.exp(1.1)), atol=RAW_TABLES)


def test_a_field_holds_only_what_the_model_uses():
    def field(indirect_outputs=0, **settings):
        return jax.eval_shape(
            lambda: init_materials(
                jax.random.key(0), spec_of(**settings), indirect_outputs=indirect_outputs
            )
        )

    def count(**settings):
        return len(jax.tree.leaves(field(**settings)))

    assert count() == 2 + 3 + 2 + 2  # two tables, then the weights of three heads
    assert count(shared=True) == 1 + 3 + 2 + 2
    assert count(has_shift=False) == 2 + 3 + 2
    assert count(indirect_outputs=6) == 2 + 3 + 2 + 2 + 3
    assert count(bias=True) == 2 + 2 * (3 + 2 + 2)
    plain = field(has_metallic=False, has_shift=False)
    assert plain.surface_head[-1].weights.shape[1] == 1
    assert plain.shift_head is None
    assert plain.indirect_head is None


def test_what_a_field_lacks_is_absent_and_metallic_is_zero():
    spec = spec_of(has_metallic=False, has_shift=False)
    attributes = attributes_at(lively(spec), points_in_the_box(), BOX, spec=spec)
    np.testing.assert_array_equal(attributes.materials.metallic, 0.0)
    assert attributes.shift is None
    assert attributes.indirect is None


@pytest.mark.parametrize("shared", [False, True])
def test_every_parameter_receives_a_gradient(shared):
    spec = spec_of(shared=shared, bias=True)
    field = lively(spec, indirect_outputs=6)

    @jax.jit
    @jax.grad
    def gradient(field, points):
        attributes = materials.attributes_at(field, points, BOX, spec=spec)
        assert attributes.indirect.shape == (60, 6)
        return sum(jnp.sum(part**2) for part in jax.tree.leaves(attributes))

    for leaf in jax.tree.leaves(gradient(field, points_in_the_box())):
        assert bool(jnp.all(jnp.isfinite(leaf)))
        assert float(jnp.max(jnp.abs(leaf))) > 0


def test_points_are_mapped_to_the_unit_cube_and_clamped():
    corners = BOX.center[None] + jnp.asarray([[-1.5], [0.0], [1.5], [9.0]])
    expected = jnp.asarray([[0.0], [0.5], [1.0], [1.0]]) * jnp.ones((1, 3))
    np.testing.assert_allclose(to_unit_cube(corners, BOX), expected, atol=1e-6)


def test_points_outside_the_box_have_the_attributes_of_its_border():
    spec = spec_of()
    field = lively(spec)
    outside = BOX.center[None] + 3 * (points_in_the_box() - BOX.center[None])
    border = jnp.clip(outside, BOX.center[None] - 1.5, BOX.center[None] + 1.5)
    actual, expected = (attributes_at(field, x, BOX, spec=spec) for x in (outside, border))
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=ROUNDING, atol=ROUNDING)


@pytest.mark.parametrize("shared", [False, True])
def test_attributes_pull_on_the_points_where_that_is_chosen_and_the_shift_never_does(shared):
    """The gradient of each output in the points agrees with central differences."""
    step = 1e-6
    with double_precision():
        spec = spec_of(shared=shared, bias=True, position_gradient=True)
        field = lively(spec, indirect_outputs=6, dtype=jnp.float64)
        box = jax.tree.map(lambda x: x.astype(jnp.float64), BOX)
        # Points keep off the borders of the finest cells, and of coarser ones, whose resolutions
        # divide 8.
        rng = np.random.default_rng(0)
        unit = (rng.integers(0, 8, (20, 3)) + rng.uniform(0.2, 0.8, (20, 3))) / 8
        points = box.center[None, :] + 1.5 * jnp.asarray(2 * unit - 1)
        direction = jnp.asarray(rng.standard_normal(points.shape))

        def values(points, spec):
            attributes = materials.attributes_at(field, points, box, spec=spec)
            return {
                "albedo": jnp.sum(attributes.materials.albedo**2),
                "roughness": jnp.sum(jnp.sin(attributes.materials.roughness)),
                "metallic": jnp.sum(jnp.sin(attributes.materials.metallic)),
                "shift": jnp.sum(attributes.shift**2),
                "indirect": jnp.sum(jnp.sin(attributes.indirect)),
            }

        @partial(jax.jit, static_argnames="spec")
        def values_and_gradients(points, spec):
            return values(points, spec), jax.jacrev(values)(points, spec)

        _, pulls = values_and_gradients(points, spec)
        ahead, _ = values_and_gradients(points + step * direction, spec)
        behind, _ = values_and_gradients(points - step * direction, spec)
        for name in ("albedo", "roughness", "metallic", "indirect"):
            derivative = float(jnp.vdot(pulls[name], direction))
            change = float(ahead[name] - behind[name]) / (2 * step)
            assert abs(derivative) > 1e-3
            np.testing.assert_allclose(derivative, change, rtol=DIFFERENCES)
        # The shift does vary in space.
        assert abs(float(ahead["shift"] - behind["shift"])) > 0.1 * step * float(ahead["shift"])
        np.testing.assert_array_equal(pulls["shift"], 0.0)
        # Without the position gradient nothing pulls on the points, and the values are the same.
        detached_spec = replace(spec, position_gradient=False)
        detached_values, pulls = values_and_gradients(points, detached_spec)
        ahead, _ = values_and_gradients(points, spec)
        for name, pull in pulls.items():
            np.testing.assert_array_equal(pull, 0.0)
            np.testing.assert_allclose(detached_values[name], ahead[name], rtol=1e-12)


def test_smoothness_is_zero_for_a_constant_field_and_positive_otherwise():
    spec = spec_of()
    field, points = lively(spec), points_in_the_box()
    flat = replace(
        field,
        albedo_table=jnp.ones_like(field.albedo_table),
        surface_table=jnp.ones_like(field.surface_table),
    )
    mask, key = jnp.ones(60, bool), jax.random.key(2)
    for change in smoothness(flat, points, mask, key, BOX, spec=spec):
        assert float(change) < 1e-6  # weights sum to 1 rounded
    for change in smoothness(field, points, mask, key, BOX, spec=spec):
        assert float(change) > 1e-4


def test_smoothness_is_the_mean_of_the_absolute_changes_of_each_attribute():
    """The mean is over the points in the mask; the change of the albedo is summed over channels."""
    spec = spec_of()
    field, points, key = lively(spec), points_in_the_box(), jax.random.key(2)
    moved_points = points + 0.05 * BOX.half_extent * jax.random.normal(key, points.shape)
    before, after = (
        attributes_at(field, x, BOX, spec=spec).materials for x in (points, moved_points)
    )
    mask = np.arange(60) < 40
    changes = smoothness(field, points, jnp.asarray(mask), key, BOX, spec=spec, std=0.05)
    for name in ("albedo", "roughness", "metallic"):
        change = np.abs(np.asarray(getattr(before, name)) - np.asarray(getattr(after, name)))
        expected = change.reshape(60, -1).sum(axis=1)[mask].mean()
        np.testing.assert_allclose(getattr(changes, name), expected, rtol=ROUNDING)


@pytest.mark.parametrize("power", [0.5, 1.0])
def test_relative_smoothness_does_not_reward_a_darker_albedo(monkeypatch, power):
    """Half the albedo changes by half as much, which is the same change relative to its mean."""
    spec = spec_of()
    field, points, key = lively(spec), points_in_the_box(), jax.random.key(2)
    mask = jnp.arange(60) < 40
    brightness = 1.0

    def changes(relative, factor):
        nonlocal brightness
        brightness = factor
        return materials.smoothness(
            field, points, mask, key, BOX, spec=spec, std=0.05, relative=relative
        )

    materials_at = materials.materials_at

    def scaled(*args, **settings):
        material = materials_at(*args, **settings)
        return replace(material, albedo=brightness * material.albedo)

    monkeypatch.setattr(materials, "materials_at", scaled)
    moved_points = points + 0.05 * BOX.half_extent * jax.random.normal(key, points.shape)
    before, after = (
        np.asarray(materials_at(field, x, BOX, spec=spec).albedo)[:40]
        for x in (points, moved_points)
    )
    for factor in (1.0, 0.5, 0.02):
        change = factor * np.abs(before - after).mean(axis=0)
        mean = 0.5 * factor * (before + after).mean(axis=0)
        terms = changes(power, factor)
        np.testing.assert_allclose(terms.albedo, np.sum(change / (2 * mean) ** power), rtol=1e-5)
        np.testing.assert_allclose(terms.roughness, changes(0.0, 1.0).roughness, rtol=ROUNDING)

    def pull(relative, factor):
        value, slope = jax.value_and_grad(lambda k: changes(relative, k).albedo)(factor)
        return float(factor * slope / value)  # d log(change) / d log(brightness)

    assert pull(0.0, 0.5) == pytest.approx(1.0, rel=1e-4)
    assert pull(power, 0.5) == pytest.approx(1.0 - power, abs=1e-4)


@pytest.mark.parametrize("relative", [0.0, 0.5, 1.0])
def test_smoothness_without_points_is_zero_with_zero_gradient(relative):
    spec = spec_of(has_metallic=False)
    field, points = lively(spec), points_in_the_box()

    @jax.jit
    @jax.value_and_grad
    def total(field):
        empty_mask, key = jnp.zeros(60, bool), jax.random.key(0)
        return sum(
            materials.smoothness(field, points, empty_mask, key, BOX, spec=spec, relative=relative)
        )

    value, gradient = total(field)
    assert float(value) == 0.0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0.0)


def test_jit_equals_eager():
    spec = spec_of(shared=True)
    field, points = lively(spec), points_in_the_box()
    eager = materials.materials_at(field, points, BOX, spec=spec)
    compiled = attributes_at(field, points, BOX, spec=spec).materials
    for a, b in zip(jax.tree.leaves(eager), jax.tree.leaves(compiled), strict=True):
        np.testing.assert_allclose(a, b, atol=ROUNDING)
