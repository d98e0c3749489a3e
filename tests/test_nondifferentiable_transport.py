"""Points without a derivative: light transport, over fixed samples of the light.

The gradient that the code returns at these points is compared with one-sided differences on both
sides. The points are listed in `docs/gradients.md`.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_sided import STEP, assert_kink, material
from support import double_precision

from geosplat_jax.core.types import EnvLight, SurfacePoints
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.sampling import OPEN, SampleCounts, Samples, cast

RADIANCE = 2.0
COUNTS = SampleCounts(light=2, diffuse=0, specular=0)


@pytest.fixture(autouse=True)
def _double():
    with double_precision():
        yield


def leaning(tilt):
    """A direction in the yz plane; without tilt it is +z."""
    return jnp.stack([0.0 * tilt, jnp.sin(tilt), jnp.cos(tilt)])


def point(normal, outward):
    """One point at the origin."""
    return SurfacePoints(
        positions=jnp.zeros((1, 3)),
        normals=normal[None],
        outward=outward[None],
        faces=jnp.full((1,), -1, jnp.int32),
        mask=jnp.ones((1,), bool),
    )


def samples(*directions):
    """Unblocked samples of the light, with a density of .5."""
    count = len(directions)
    return Samples(
        directions=jnp.asarray(directions, jnp.float64)[None],
        weights=jnp.full((1, count), 2.0 / count),
        hits=jnp.full((1, count), OPEN, jnp.int32),
        light_density=jnp.full((1, count), 0.5),
    )


def sky(radiance=RADIANCE):
    return EnvLight(jnp.full((4, 8, 3), radiance))


def test_the_edge_of_a_face_jumps_and_carries_no_gradient():
    """The face tilts until it hides a direction that the shading normal still sees."""
    light_samples = samples([0.0, 0.8, -0.6], [0.0, 0.0, 1.0])
    edge = float(np.arctan2(0.6, 0.8))  # tilt at which the first sample lies in the face
    normal = leaning(jnp.asarray(1.2))

    @jax.jit
    @jax.value_and_grad
    def light(tilt):
        points = point(normal, leaning(tilt))
        hits = cast(points, jnp.moveaxis(light_samples.directions, 1, 0), None)
        return jnp.sum(gather(points, replace(light_samples, hits=hits.T), sky()).diffuse_light)

    below, on, above = (float(light(jnp.asarray(edge + s))[0]) for s in (-1e-9, 0.0, 1e-9))
    cosine = float(normal @ jnp.asarray([0.0, 0.8, -0.6]))
    assert cosine > 0.3
    # Each sample has a weight of 1, in each of three channels.
    assert above - below == pytest.approx(3 * RADIANCE * cosine / np.pi, rel=1e-9)
    assert on in (below, above)
    for tilt in (edge - 0.1, edge, edge + 0.1):
        assert float(light(jnp.asarray(tilt))[1]) == 0.0


def test_the_horizon_of_the_shading_normal_is_a_kink():
    light_samples = samples([0.0, 1.0, 0.0])

    def light(tilt):
        """Without tilt the sample lies in the horizon; with a positive tilt the normal faces it."""
        points = point(leaning(tilt), leaning(tilt))
        return jnp.sum(gather(points, light_samples, sky()).diffuse_light)

    slope = 3 * 2.0 * RADIANCE / np.pi
    assert_kink(light, 0.0, left=0.0, right=slope, returned="mean")


def test_the_flip_of_a_normal_jumps_in_the_specular_part_only():
    """A normal that faces away reflects the light from behind; its irradiance does not change."""
    light_samples = samples([0.0, 0.6, 0.8], [0.0, 0.6, -0.8])
    radiance = jnp.concatenate([jnp.full((2, 8, 3), 3.0), jnp.full((2, 8, 3), 1.0)])
    light, viewer = EnvLight(radiance), jnp.asarray([[0.0, 1.0, 0.0]])
    sampler = light_sampler(light)

    @jax.jit
    def shaded(tilt):
        points = point(leaning(tilt), leaning(tilt))
        gathered = gather(points, light_samples, light)
        key = jax.random.key(0)
        return reflect(
            key, points, material(), viewer, gathered, light, sampler, None, counts=COUNTS
        )

    def sums(tilt):
        shading = shaded(tilt)
        return jnp.stack([jnp.sum(shading.diffuse), jnp.sum(shading.specular)])

    below, above = (np.asarray(sums(jnp.asarray(t))) for t in (-1e-9, 1e-9))
    assert above[0] == pytest.approx(below[0], rel=1e-6)
    assert abs(above[1] - below[1]) > 0.1 * above[1]
    slope = jax.jit(jax.jacfwd(sums))
    for tilt in (-1e-2, 1e-2):
        for side in (-STEP, STEP):
            numeric_slope = np.asarray(sums(tilt + side) - sums(tilt)) / side
            np.testing.assert_allclose(slope(tilt), numeric_slope, rtol=1e-4, atol=1e-5)
