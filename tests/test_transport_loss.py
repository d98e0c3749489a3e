"""The loss of stage 2: finite, differentiable, and unchanged by buffers that overflow."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import (
    STAGE_2,
    double_precision,
    sphere_views,
    tiny_config,
)

from geosplat_jax.core.capacity import Capacities, fits, grow, overflowed
from geosplat_jax.core.types import Batch, EnvLight
from geosplat_jax.fit.stages import begin_stage_2, initial_params, make_context
from geosplat_jax.fit.step import initial_state, train_step
from geosplat_jax.geometry import sphere_sdf
from geosplat_jax.losses import LossWeights, loss
from geosplat_jax.render import (
    reconstruct,
    render,
)
from geosplat_jax.surface.hull import fit_grid
from geosplat_jax.transport.base import illuminate, shade_rows

AMPLE = Capacities(1024, 1024, 1024, 16384, 16384, 4096, 8192)
BIASED = ("model.material.bias=true",)
build = partial(jax.jit, static_argnames=("model", "capacities", "sampling"))(reconstruct)
prepare = partial(jax.jit, static_argnames=("transport",))(illuminate)
shine = partial(jax.jit, static_argnames=("transport", "baked_diffuse"))(shade_rows)
draw = partial(jax.jit, static_argnames=("model", "capacities", "sampling", "aov_names"))(render)


SMALL = (
    *STAGE_2,
    "geometry.resolution=8",
    "model.material.shared=false",
    "objective.smoothness_samples=16",
    "transport.loss.light=0.15",
)
TIGHT = Capacities(512, 512, 512, 6144, 8192, 2048, 4096)
evaluate = partial(jax.jit, static_argnames=("model", "objective", "capacities"))(
    jax.value_and_grad(loss, has_aux=True)
)


def sky(seed=0):
    """Return a map of random radiance with a few bright texels."""
    texels = np.random.default_rng(seed).uniform(0, 1, (8, 16, 3))
    return EnvLight(jnp.asarray(0.2 + 2 * texels**4, jnp.float32))


def problem(*overrides):
    """Settings of stage 2, parameters away from any symmetry, context and batch."""
    run_config = tiny_config(*SMALL, *overrides)
    config = run_config.stage(2)
    rng = np.random.default_rng(0)
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), config.geometry.resolution)
    sdf = np.asarray(sphere_sdf(grid, radius=0.4)) + rng.uniform(-0.15, 0.15, grid.vertex_count)
    sdf = np.where(np.abs(sdf) < 0.03, np.copysign(0.03, sdf), sdf)
    params = initial_params(jnp.asarray(sdf, jnp.float32), grid, run_config, jax.random.key(0))
    params = begin_stage_2(params, grid, run_config, jax.random.key(1))

    def varied(leaf):
        return leaf + jnp.asarray(rng.uniform(-0.5, 0.5, leaf.shape), leaf.dtype)

    params = replace(
        params,
        material=jax.tree.map(varied, params.material),
        light=sky(2),
        log_exposure=jnp.asarray(0.1),
    )
    views = sphere_views(2, size=14)
    batch = Batch(views.camera([0]), jnp.asarray(views.images[:1]), jax.random.key(1))
    return config, params, make_context(grid, config.model), batch


def evaluated(config, params, context, batch, capacities=TIGHT):
    return evaluate(
        params,
        batch,
        context,
        config.loss.at(0.0),
        model=config.model,
        objective=config.objective,
        capacities=capacities,
    )


@pytest.fixture(scope="module")
def second():
    return problem()


def groups_of(tree):
    return {
        "light": tree.light,
        "albedo": tree.material.albedo_head,
        "shine": tree.material.surface_head,
        "indirect": tree.material.indirect_head,
        "tables": (tree.material.albedo_table, tree.material.surface_table),
        "exposure": tree.log_exposure,
        "sdf": tree.geometry.sdf,
    }


def test_the_loss_of_stage_2_is_finite_and_pulls_on_everything(second):
    (total, report), gradient = evaluated(*second)
    assert np.isfinite(float(total))
    assert all(np.isfinite(float(term)) for term in report.terms.values())
    assert float(report.terms["light"]) > 0
    assert float(report.terms["indirect"]) > 0
    assert 0 < int(report.usage.cell_patches) <= TIGHT.cell_patches
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(gradient))
    for name, group in groups_of(gradient).items():
        for leaf in jax.tree.leaves(group):
            assert float(jnp.max(jnp.abs(leaf))) > 1e-7, name


def test_the_key_decides_every_sample(second):
    config, params, context, batch = second
    first, again = evaluated(*second), evaluated(*second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    other = evaluated(config, params, context, replace(batch, key=jax.random.key(5)))
    assert float(other[0][0]) != float(first[0][0])
    # Light has its own samples; the surface has none.
    assert float(other[0][1].terms["light"]) != float(first[0][1].terms["light"])
    assert float(other[0][1].terms["mask"]) == float(first[0][1].terms["mask"])


@pytest.mark.slow
def test_a_residual_of_its_own_has_its_own_samples(second):
    """The loss has the value of the second image; what has no samples keeps its gradient."""
    config, params, context, batch = second
    (total, report), gradient = evaluated(*second)
    shading = replace(config.model.transport, residual=1)
    apart = replace(config, model=replace(config.model, transport=shading))
    (other_total, other), other_gradient = evaluated(apart, params, context, batch)
    assert float(other.terms["l1"]) != float(report.terms["l1"])
    assert float(other_total) != float(total)
    # Eq. 18 and the mask are of the image that is differentiated.
    for name in ("light", "mask"):
        assert float(other.terms[name]) == pytest.approx(float(report.terms[name]), rel=1e-6)
    for name, group in groups_of(other_gradient).items():
        before = np.concatenate([np.ravel(x) for x in jax.tree.leaves(groups_of(gradient)[name])])
        after = np.concatenate([np.ravel(x) for x in jax.tree.leaves(group)])
        assert np.all(np.isfinite(after)), name
        assert np.any(before != after), name


@pytest.mark.slow
def test_a_residual_of_its_own_takes_the_bias_from_the_gradient(second):
    """Where the mean image is the photograph, nothing should pull on the brightness of the light.

    Residuals from the samples of the derivative pull it down, since less light makes less noise.
    """
    config, params, context, batch = second
    params = replace(params, light=EnvLight(0.3 * params.light.radiance))
    rendered = partial(draw, params, batch.camera, context, capacities=TIGHT)
    keys = jax.random.split(jax.random.key(9), 120)
    many = replace(config.model.transport, light=32, diffuse=32, specular=32)
    exact = replace(config.model, transport=many)
    images = [rendered(model=exact, sampling="face", key=key) for key in keys[:24]]
    alpha = images[0].alpha
    mean = jnp.mean(jnp.stack([image.rgb for image in images]), axis=0)
    mean = jnp.exp(params.log_exposure) * mean / jnp.maximum(alpha[..., None], 1e-6)
    assert float(jnp.max(mean)) < 1.0  # nothing is clipped
    photograph = jnp.concatenate([mean, alpha[..., None]], axis=-1)
    weights = LossWeights(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    weights = replace(weights, l1=1.0)

    def pulls(residual):
        transport = replace(config.model.transport, residual=residual)
        model = replace(config.model, transport=transport)
        found = []
        for key in keys:
            _, gradient = evaluate(
                params,
                replace(batch, image=photograph, key=key),
                context,
                weights,
                model=model,
                objective=replace(config.objective, background="black"),
                capacities=TIGHT,
            )
            found.append(float(jnp.sum(params.light.radiance * gradient.light.radiance)))
        return np.array(found)

    same, apart = pulls(0), pulls(1)
    errors = [pull.std() / np.sqrt(len(keys)) for pull in (same, apart)]
    assert same.mean() > 3 * errors[0]
    assert abs(apart.mean()) < 2.5 * errors[1]
    assert same.mean() - apart.mean() > 3 * np.hypot(*errors)


def test_vertices_cannot_be_shaded_by_monte_carlo(second):
    config, params, context, _ = second
    with pytest.raises(ValueError, match="Monte Carlo shading needs face sampling"):
        reconstruct(params, context, model=config.model, capacities=TIGHT, sampling="vertex")


DIFFERENCES = {
    # No light samples: neither light nor metallic, albedo or exposure moves a sample.
    "constant": ("light=0", "diffuse=2", "specular=2", "indirect=constant"),
    "traced": ("light=0", "diffuse=2", "specular=2", "indirect=traced"),
    # No samples of the lobe: roughness moves none.
    "harmonics": ("light=2", "diffuse=2", "specular=0", "indirect=harmonics"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", DIFFERENCES)
def test_the_gradient_of_the_whole_loss_agrees_with_differences(kind):
    """In float64 and for fixed samples, in all parameters that do not move them."""
    overrides = [f"transport.shading.{text}" for text in DIFFERENCES[kind]]
    with double_precision():
        config, params, context, batch = _in_double(problem(*overrides))
        rng = np.random.default_rng(1)
        (_, report), gradient = evaluated(config, params, context, batch)
        assert bool(fits(report.usage, TIGHT))
        value = partial(jax.jit, static_argnames=("model", "objective", "capacities"))(loss)

        def total(material, light, exposure):
            moved = replace(params, material=material, light=light, log_exposure=exposure)
            return value(
                moved,
                batch,
                context,
                config.loss.at(0.0),
                model=config.model,
                objective=config.objective,
                capacities=TIGHT,
            )[0]

        point = (params.material, params.light, params.log_exposure)
        slopes = (gradient.material, gradient.light, gradient.log_exposure)
        leaves, structure = jax.tree.flatten(point)
        paths = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_flatten_with_path(point)[0]]
        checked = 0
        for index, (path, leaf, slope) in enumerate(
            zip(paths, leaves, jax.tree.leaves(slopes), strict=True)
        ):
            direction = _free_direction(kind, path, rng.normal(size=leaf.shape))
            if direction is None:
                continue
            step = 1e-6

            def at(size, index=index, direction=direction):
                moved = list(leaves)
                moved[index] = moved[index] + size * direction
                return float(total(*jax.tree.unflatten(structure, moved)))

            found = (at(step) - at(-step)) / (2 * step)
            expected = float(jnp.sum(slope * direction))
            assert found == pytest.approx(expected, rel=1e-5, abs=2e-9), path
            checked += abs(expected) > 1e-5
        assert checked >= 5


def _in_double(parts):
    """Floats of parameters, context and batch as float64; the settings as they are."""
    config, *arrays = parts

    def convert(leaf):
        return jnp.asarray(leaf, jnp.float64) if leaf.dtype == jnp.float32 else leaf

    return config, *jax.tree.map(convert, tuple(arrays))


def _free_direction(kind, path, direction):
    """A direction of a leaf that moves no sample; None where there is none."""
    if "shift" in path or "surface_table" in path:
        return None  # moves the splats, or the roughness
    if "surface_head" in path:
        if kind != "harmonics":
            # Only the last layer tells roughness (column 0) from metallic (column 1).
            if direction.shape[-1] != 2:
                return None
            direction[..., 0] = 0.0
        return jnp.asarray(direction)
    if "radiance" in path and kind == "harmonics":
        return None  # moves the samples of the light
    return jnp.asarray(direction)


@pytest.mark.slow
def test_a_step_that_lacks_room_for_rays_changes_nothing_and_succeeds_with_it(second):
    config, params, context, batch = second

    def step(capacities):
        state = initial_state(jax.tree.map(jnp.copy, params), config.rates)
        return train_step(
            state,
            batch,
            context,
            config.loss.at(0.0),
            model=config.model,
            objective=config.objective,
            capacities=capacities,
            sampling="face",
            rates=config.rates,
            smallest_light=0.01,
        )

    state, report = step(replace(TIGHT, cell_patches=64))
    assert not bool(report.fits)
    assert int(state.step) == 0
    fresh = initial_state(params, config.rates)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_array_equal(a, b)
    needed = report.loss.usage
    assert overflowed(needed, replace(TIGHT, cell_patches=64)) == ["cell_patches"]
    state, report = step(grow(replace(TIGHT, cell_patches=64), needed))
    assert bool(report.fits)
    assert bool(report.finite)
    assert int(state.step) == 1
    assert np.any(state.params.log_exposure != params.log_exposure)
