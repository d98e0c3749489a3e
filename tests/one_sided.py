"""One-sided differences in double precision, and what a gradient should be at a kink."""

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.types import Grid, Materials
from geosplat_jax.geometry import initial_geometry, sphere_sdf
from geosplat_jax.hashgrid import HashGridSpec

# One-sided differences err by curvature, which falls with their step, and by rounding.
STEP = 1e-7
TOLERANCE = 1e-5


def one_sided(function, x, step):
    """Derivative of a scalar function of a scalar towards the sign of ``step``."""
    return (float(function(x + step)) - float(function(x))) / step


def assert_smooth_at(function, points, *, step=STEP, tolerance=TOLERANCE):
    """The gradient equals both one-sided differences at every point."""
    function, slope = jax.jit(function), jax.jit(jax.grad(function))
    for x in map(jnp.asarray, points):
        for side in (-step, step):
            difference = one_sided(function, x, side)
            np.testing.assert_allclose(float(slope(x)), difference, rtol=tolerance, atol=tolerance)


def assert_kink(function, x, *, left, right, returned, step=STEP, tolerance=TOLERANCE):
    """At ``x`` the function is continuous, its one-sided slopes differ, and one value is returned.

    ``returned`` is ``"left"``, ``"right"``, ``"mean"``, a number, or ``"between"`` where rounding
    decides.
    """
    function, x = jax.jit(function), jnp.asarray(x)
    slopes = one_sided(function, x, -step), one_sided(function, x, step)
    np.testing.assert_allclose(slopes, (left, right), rtol=tolerance, atol=tolerance)
    assert abs(left - right) > 100 * tolerance
    if returned == "between":
        assert left <= float(jax.jit(jax.grad(function))(x)) <= right
        return
    expected = {"left": left, "right": right, "mean": 0.5 * (left + right)}.get(returned, returned)
    np.testing.assert_allclose(
        float(jax.jit(jax.grad(function))(x)), expected, rtol=1e-9, atol=1e-9
    )


GRID = HashGridSpec(levels=1, features=2, log2_entries=9, coarsest=4, finest=4)


def make_ball(shape=(5, 4, 4), radius=0.33):
    """A ball off the centre of a small box, whose SDF has no ties."""
    grid = Grid(jnp.asarray([-0.5, -0.4, -0.4]), jnp.asarray(0.2), shape)
    sdf = sphere_sdf(grid, radius=radius)
    tilt = 0.05 * np.sin(np.arange(grid.vertex_count))
    return grid, initial_geometry(grid, sdf + jnp.asarray(tilt))


def up():
    """Return the normal of all points below, as one row."""
    return jnp.array([[0.0, 0.0, 1.0]])


def direction_at(cosine):
    """Unit direction at this cosine from `up`, as one row."""
    return jnp.stack([jnp.sqrt(1 - cosine**2), 0 * cosine, cosine])[None]


def material(roughness=0.4, albedo=0.6):
    return Materials(
        jnp.full((1, 3), albedo), jnp.asarray(roughness).reshape(1), jnp.full((1,), 0.3)
    )
