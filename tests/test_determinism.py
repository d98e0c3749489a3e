"""Same input, same numbers: across processes, capacities and compilation.

`test_train.py` has the two laws of a run: the same seed gives the same parameters, and resuming
equals the uninterrupted run, both bit for bit.
"""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset, sphere_views, tiny_config

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Batch
from geosplat_jax.fit.stages import initial_params, make_context
from geosplat_jax.fit.train import fit, load_run
from geosplat_jax.geometry import sphere_sdf
from geosplat_jax.losses import LossWeights, loss
from geosplat_jax.render import render
from geosplat_jax.surface.hull import fit_grid

CONFIG = tiny_config()
AMPLE = Capacities(1024, 1024, 1024, 16384, 16384, 4096)
DOUBLE = Capacities(2048, 2048, 2048, 32768, 32768, 8192)
# Longer buffers and other fusions sum the same numbers in another order.
GRADIENT_TOLERANCE = 1e-5
# Materials at their start are nearly constant: their gradients are sums that nearly cancel.
EAGER_TOLERANCE = 2e-4

STATIC = {"model": CONFIG.model, "objective": CONFIG.objective}
evaluate = partial(jax.jit, static_argnames=("model", "objective", "capacities"))(
    jax.value_and_grad(loss, has_aux=True)
)
draw = partial(jax.jit, static_argnames=("model", "capacities"))(render)


@pytest.fixture(scope="module")
def setting():
    """A ball with dents: on a perfect one, equal distances put L_dev exactly on its kink."""
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), CONFIG.geometry.resolution)
    rng = np.random.default_rng(0)
    sdf = sphere_sdf(grid, radius=0.4)
    sdf = sdf + jnp.asarray(rng.uniform(-0.2, 0.2, sdf.shape), jnp.float32)
    params = initial_params(sdf, grid, CONFIG, jax.random.key(0))
    views = sphere_views(2)
    batch = Batch(views.camera([0]), jnp.asarray(views.images[:1]), jax.random.key(1))
    return params, make_context(grid, CONFIG.model), batch


def _assert_close(first, second, tolerance):
    paths = jax.tree_util.tree_flatten_with_path(first)[0]
    for (path, a), b in zip(paths, jax.tree.leaves(second), strict=True):
        error = float(safe_norm((a - b).reshape(-1)))
        assert error <= tolerance * float(safe_norm(a.reshape(-1))), path


def test_capacities_do_not_change_a_single_bit_of_the_image(setting):
    params, context, batch = setting
    outputs = [
        draw(params, batch.camera, context, model=CONFIG.model, capacities=c)
        for c in (AMPLE, DOUBLE)
    ]
    np.testing.assert_array_equal(outputs[0].rgb, outputs[1].rgb)
    np.testing.assert_array_equal(outputs[0].alpha, outputs[1].alpha)
    assert float(jnp.max(outputs[0].alpha)) > 0.9


def test_capacities_change_neither_loss_nor_gradients(setting):
    params, context, batch = setting
    (first, first_gradient), (second, second_gradient) = (
        evaluate(params, batch, context, LossWeights(), capacities=c, **STATIC)
        for c in (AMPLE, DOUBLE)
    )
    assert float(first[0]) == float(second[0])
    _assert_close(first_gradient, second_gradient, GRADIENT_TOLERANCE)


def test_repeating_a_gradient_repeats_its_bits(setting):
    params, context, batch = setting
    first, second = (
        evaluate(params, batch, context, LossWeights(), capacities=AMPLE, **STATIC)
        for _ in range(2)
    )
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_key_of_the_batch_is_all_the_randomness(setting):
    params, context, batch = setting
    other = replace(batch, key=jax.random.key(2))
    first, second = (
        evaluate(params, b, context, LossWeights(), capacities=AMPLE, **STATIC)[0]
        for b in (batch, other)
    )
    assert float(first[0]) != float(second[0])
    # The background and the smoothness samples are random, the surface is not.
    assert float(first[1].terms["deviation"]) == float(second[1].terms["deviation"])
    assert float(first[1].terms["mask"]) == float(second[1].terms["mask"])


@pytest.mark.slow
def test_compiled_equals_eager(setting):
    params, context, batch = setting
    static = {"capacities": AMPLE, **STATIC}
    (compiled, report), gradient = evaluate(params, batch, context, LossWeights(), **static)
    (eager, eager_report), eager_gradient = jax.value_and_grad(loss, has_aux=True)(
        params, batch, context, LossWeights(), **static
    )
    assert float(eager) == pytest.approx(float(compiled), rel=1e-6)
    for name, value in report.terms.items():
        # The smoothness of a nearly constant field is a difference of equals: three digits.
        assert float(eager_report.terms[name]) == pytest.approx(float(value), rel=1e-3, abs=1e-9)
    _assert_close(gradient, eager_gradient, EAGER_TOLERANCE)


_OTHER_PROCESS = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import jax
jax.config.update("jax_numpy_dtype_promotion", "strict")
from support import sphere_dataset, tiny_config
from geosplat_jax.fit.train import fit
fit(sphere_dataset(), tiny_config(), Path(sys.argv[2]))
"""


@pytest.mark.slow
def test_another_process_trains_the_same_bits(tmp_path):
    """Compiled anew, with other addresses and another hash seed."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    fit(sphere_dataset(), CONFIG, here)
    tests = str(Path(__file__).parent)
    subprocess.run([sys.executable, "-c", _OTHER_PROCESS, tests, str(there)], check=True)
    first, second = (load_run(folder)[1] for folder in (here, there))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)
