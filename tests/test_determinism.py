"""Same input, same numbers: across processes, capacities and compilation.

Related laws are tested elsewhere. In `test_train.py`: the same seed gives the same parameters, and
resuming equals the uninterrupted run, both bit for bit. In `test_pipeline.py`: the key is the only
source of randomness.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import ball, sphere_dataset, sphere_views, tiny_config

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Batch
from geosplat_jax.fit.train import fit, load_trained
from geosplat_jax.pipeline import Pipeline

CONFIG = tiny_config("geometry.resolution=8")
SIZES = {"surface_cubes": 384, "dual_vertices": 384, "quads": 384}
AMPLE = Capacities(**SIZES, visible=5120, hits=7168, chunks=2048)
DOUBLE = Capacities(**{name: 2 * size for name, size in AMPLE.items()})
# The ends of buffers are not vectorised, which changes single numbers by a few roundings.
ROUNDING = 1e-6
# Longer buffers and other fusions sum the same numbers in another order.
GRADIENT_TOLERANCE = 1e-5
# Materials are nearly constant at the start, so their gradients are sums that nearly cancel.
EAGER_TOLERANCE = 2e-4

evaluate = jax.jit(
    lambda pipeline, params, batch: jax.value_and_grad(pipeline.loss, has_aux=True)(params, batch)
)
draw = jax.jit(Pipeline.render)


@pytest.fixture(scope="module")
def setting():
    """A ball with dents; on a perfect one, distances are equal and L_dev is exactly at its kink."""
    pipeline, params = ball(CONFIG)
    rng = np.random.default_rng(0)
    sdf = params.geometry.sdf
    sdf = sdf + jnp.asarray(rng.uniform(-0.2, 0.2, sdf.shape), jnp.float32)
    params = replace(params, geometry=replace(params.geometry, sdf=sdf))
    views = sphere_views(2, size=16)
    batch = Batch(views.camera([0]), jnp.asarray(views.images[:1]), jax.random.key(1))
    return replace(pipeline, capacities=AMPLE), params, batch


def _assert_close(first, second, tolerance):
    paths = jax.tree_util.tree_flatten_with_path(first)[0]
    for (path, a), b in zip(paths, jax.tree.leaves(second), strict=True):
        error = float(safe_norm((a - b).reshape(-1)))
        assert error <= tolerance * float(safe_norm(a.reshape(-1))), path


def test_capacities_change_a_pixel_by_a_rounding_at_most(setting):
    pipeline, params, batch = setting
    outputs = [draw(replace(pipeline, capacities=c), params, batch.camera) for c in (AMPLE, DOUBLE)]
    np.testing.assert_allclose(outputs[0].rgb, outputs[1].rgb, rtol=ROUNDING)
    np.testing.assert_allclose(outputs[0].alpha, outputs[1].alpha, rtol=ROUNDING)
    assert float(jnp.max(outputs[0].alpha)) > 0.9


@pytest.mark.slow
@pytest.mark.long
def test_capacities_change_neither_loss_nor_gradients(setting):
    pipeline, params, batch = setting
    (first, first_gradient), (second, second_gradient) = (
        evaluate(replace(pipeline, capacities=c), params, batch) for c in (AMPLE, DOUBLE)
    )
    assert float(first[0]) == pytest.approx(float(second[0]), rel=ROUNDING)
    _assert_close(first_gradient, second_gradient, GRADIENT_TOLERANCE)


@pytest.mark.slow
def test_compiled_equals_eager(setting):
    pipeline, params, batch = setting
    # The cast of a grey light is a difference of equal numbers, whose rounding has a gradient.
    yellow = params.light.radiance * jnp.asarray([1.2, 1.0, 0.7], jnp.float32)[None, None]
    params = replace(params, light=replace(params.light, radiance=yellow))
    (compiled, report), gradient = evaluate(pipeline, params, batch)
    eager_value = jax.value_and_grad(pipeline.loss, has_aux=True)
    (eager, eager_report), eager_gradient = eager_value(params, batch)
    assert float(eager) == pytest.approx(float(compiled), rel=1e-6)
    for name, value in report.terms.items():
        # The smoothness of a nearly constant field is a difference of nearly equal numbers, and
        # only exact to eight decimals.
        assert float(eager_report.terms[name]) == pytest.approx(float(value), rel=1e-3, abs=1e-8)
    _assert_close(gradient, eager_gradient, EAGER_TOLERANCE)


_OTHER_PROCESS = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import jax
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_enable_compilation_cache", False)
from support import sphere_dataset, tiny_config
from geosplat_jax.fit.train import fit
fit(sphere_dataset(), tiny_config(), Path(sys.argv[2]))
"""


@pytest.mark.slow
@pytest.mark.long
def test_another_process_trains_the_same_bits(tmp_path):
    """The other process compiles anew, with other addresses and another hash seed."""
    own_folder, other_folder = tmp_path / "here", tmp_path / "there"
    fit(sphere_dataset(), tiny_config(), own_folder)
    tests_folder = str(Path(__file__).parent)
    subprocess.run(
        [sys.executable, "-c", _OTHER_PROCESS, tests_folder, str(other_folder)], check=True
    )
    own_params, other_params = (
        load_trained(folder).params for folder in (own_folder, other_folder)
    )
    for a, b in zip(jax.tree.leaves(own_params), jax.tree.leaves(other_params), strict=True):
        np.testing.assert_array_equal(a, b)
