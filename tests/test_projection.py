from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.splats import projection
from geosplat_jax.splats.projection import LOW_PASS_VARIANCE

# Compiled once per shape; eager dispatch would compile every small operation on its own.
project = jax.jit(projection.project, static_argnames=("height", "width"))
ORACLES = Path(__file__).parents[2] / "shared" / "oracles"
# float64 on both sides, some hundred operations deep.
EXACT = 1e-12
# Central differences in float64 with a step of 1e-6 on values of order 1 to 100.
FINITE_DIFFERENCE = 1e-6


@pytest.fixture
def x64():
    enable = getattr(jax, "enable_x64", None)
    if enable is None:
        from jax.experimental import enable_x64 as enable
    with enable(True):
        yield


def camera(dtype, *, size=64):
    world_to_camera = np.eye(4)
    world_to_camera[2, 3] = 3.0
    intrinsics = np.array([[1.2 * size, 0, size / 2], [0, 1.3 * size, size / 2], [0, 0, 1]])
    return {
        "world_to_camera": jnp.asarray(world_to_camera, dtype),
        "intrinsics": jnp.asarray(intrinsics, dtype),
        "height": size,
        "width": size,
    }


def random_splats(seed, count, dtype):
    rng = np.random.default_rng(seed)
    return (
        jnp.asarray(rng.uniform(-1, 1, (count, 3)), dtype),
        jnp.asarray(rng.normal(size=(count, 4)), dtype),
        jnp.asarray(np.exp(rng.uniform(-4, -1, (count, 3))), dtype),
    )


def all_finite(tree):
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("name", ["large", "opaque_small", "soft"])
def test_matches_the_oracle(name, x64):
    path = ORACLES / f"splat_{name}.npz"
    if not path.exists():
        pytest.skip("the shared oracles are not here")
    data = np.load(path)
    footprints = project(
        *(jnp.asarray(data[key]) for key in ("means", "quats", "scales")),
        world_to_camera=jnp.asarray(data["viewmat"]),
        intrinsics=jnp.asarray(data["K"]),
        height=int(data["height"]),
        width=int(data["width"]),
    )
    np.testing.assert_allclose(footprints.means2d, data["means2d"], rtol=EXACT, atol=EXACT)
    np.testing.assert_allclose(footprints.conics, data["conics"], rtol=1e-11, atol=EXACT)
    np.testing.assert_allclose(footprints.depths, data["depths"], rtol=EXACT)
    # The oracle loses digits by cancellation in its determinant, which limits the agreement.
    np.testing.assert_allclose(footprints.compensation, data["compensations"], rtol=1e-9)


def test_covariance_is_the_linearised_image_of_the_splat(x64):
    means, quats, scales = random_splats(0, 20, jnp.float64)
    settings = camera(jnp.float64)

    def pixel(mean):
        point = settings["world_to_camera"][:3, :3] @ mean + settings["world_to_camera"][:3, 3]
        image = settings["intrinsics"] @ point
        return image[:2] / image[2]

    footprints = project(means, quats, scales, **settings)
    jacobian = jax.vmap(jax.jacfwd(pixel))(means)
    axes = jacobian @ quaternion_to_matrix(quats) * scales[:, None, :]
    expected = axes @ jnp.swapaxes(axes, 1, 2) + LOW_PASS_VARIANCE * jnp.eye(2)[None]
    xx, xy, yy = footprints.covariances2d.T
    np.testing.assert_allclose(xx, expected[:, 0, 0], rtol=1e-10)
    np.testing.assert_allclose(xy, expected[:, 0, 1], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(yy, expected[:, 1, 1], rtol=1e-10)
    np.testing.assert_allclose(footprints.means2d, jax.vmap(pixel)(means), rtol=1e-12)
    # A splat that is spread over a larger area is fainter by the ratio of the areas.
    sharp_covariances = expected - LOW_PASS_VARIANCE * jnp.eye(2)[None]
    area_ratios = jnp.linalg.det(sharp_covariances) / jnp.linalg.det(expected)
    np.testing.assert_allclose(footprints.compensation**2, area_ratios, rtol=1e-6, atol=1e-12)
    assert float(jnp.min(area_ratios)) < 0.9


def test_conic_inverts_the_covariance(x64):
    footprints = project(*random_splats(1, 50, jnp.float64), **camera(jnp.float64))
    a, b, c = footprints.covariances2d.T
    p, q, r = footprints.conics.T
    np.testing.assert_allclose(a * p + b * q, 1.0, rtol=1e-10)
    np.testing.assert_allclose(a * q + b * r, 0.0, atol=1e-10)
    np.testing.assert_allclose(b * q + c * r, 1.0, rtol=1e-10)


def test_flat_splats_keep_their_digits_in_float32():
    means, quats, scales = random_splats(2, 200, jnp.float32)
    flat_scales = scales * jnp.array([[1.0, 1.0, 1e-4]], jnp.float32)
    settings = camera(jnp.float32)
    footprints = project(means, quats, flat_scales, **settings)
    # The reference is the same in float64 NumPy, with the determinant as a cross product.
    rotation = np.asarray(quaternion_to_matrix(quats), np.float64)
    axes = rotation * np.asarray(flat_scales, np.float64)[:, None, :]
    points = np.asarray(means, np.float64) + np.array([0, 0, 3.0])
    focal = np.asarray(settings["intrinsics"], np.float64)[[0, 1], [0, 1]]
    slope = points[:, :2] / points[:, 2:]
    row = (focal / points[:, 2:])[..., None] * (axes[:, :2] - slope[..., None] * axes[:, 2:])
    determinants = np.sum(np.cross(row[:, 0], row[:, 1]) ** 2, -1)
    trace = np.sum(row**2, axis=(1, 2))
    expected = np.sqrt(
        determinants / (determinants + LOW_PASS_VARIANCE * trace + LOW_PASS_VARIANCE**2)
    )
    np.testing.assert_allclose(footprints.compensation, expected, rtol=1e-4, atol=1e-6)


def test_gradients_match_finite_differences_along_random_directions(x64):
    inputs = random_splats(3, 8, jnp.float64)
    rng = np.random.default_rng(4)
    weights = [rng.normal(size=s) for s in ((8, 2), (8, 3), (8,), (8,))]

    def value(inputs, settings):
        footprints = project(*inputs, **settings)
        leaves = [footprints.means2d, footprints.conics, footprints.depths, footprints.compensation]
        return sum(jnp.sum(w * leaf) for w, leaf in zip(weights, leaves, strict=True))

    static = {"height": 64, "width": 64}
    matrices = {k: v for k, v in camera(jnp.float64).items() if k not in static}

    def full(arguments):
        return value(arguments[0], arguments[1] | static)

    arguments = (inputs, matrices)
    gradient = jax.jit(jax.grad(full))(arguments)
    step = 1e-6
    for _ in range(3):
        direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arguments)
        forward = full(jax.tree.map(lambda x, d: x + step * d, arguments, direction))
        backward = full(jax.tree.map(lambda x, d: x - step * d, arguments, direction))
        products = jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, direction)
        expected = (forward - backward) / (2 * step)
        total = sum(jax.tree.leaves(products))
        np.testing.assert_allclose(total, expected, rtol=FINITE_DIFFERENCE)


def test_extreme_scales_and_depths_are_finite_in_float32():
    quats = jnp.array([[1.0, 0.0, 0.0, 0.0], [0.3, -0.2, 0.9, 0.1]], jnp.float32)

    @jax.jit
    @jax.value_and_grad
    def total(inputs):
        footprints = project(*inputs, **camera(jnp.float32, size=800))
        return (
            jnp.sum(footprints.means2d)
            + jnp.sum(footprints.conics)
            + jnp.sum(footprints.compensation)
        )

    for scale in (1e-8, 1e-4, 1.0, 1e4):
        scales = jnp.array([[scale, scale, scale], [scale, 1e-8, 1e4]], jnp.float32)
        for z in (0.0101, 1.0, 1e4):
            means = jnp.array([[0.0, 0.0, z - 3.0], [5.0 * z, -z, z - 3.0]], jnp.float32)
            assert all_finite(total((means, quats, scales))), (scale, z)


def test_zero_quaternion_is_the_identity_with_zero_gradient():
    means, _, scales = random_splats(5, 2, jnp.float32)
    quats = jnp.array([[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]], jnp.float32)
    footprints = project(means[:1], quats[:1], scales[:1], **camera(jnp.float32))
    expected = project(means[:1], quats[1:], scales[:1], **camera(jnp.float32))
    np.testing.assert_array_equal(footprints.conics, expected.conics)
    gradient = jax.grad(lambda q: project(means, q, scales, **camera(jnp.float32)).conics.sum())(
        quats
    )
    assert all_finite(gradient)
    np.testing.assert_array_equal(gradient[0], 0.0)


def test_zero_scales_have_zero_compensation_and_finite_gradients():
    means, quats, scales = random_splats(6, 3, jnp.float32)

    def compensation(scales):
        return jnp.sum(project(means, quats, scales, **camera(jnp.float32)).compensation)

    value, gradient = jax.value_and_grad(compensation)(0.0 * scales)
    assert float(value) == 0.0
    assert all_finite(gradient)


@pytest.mark.parametrize("depth", [-2.0, 0.0, 0.01, 0.0101])
def test_rows_at_or_behind_the_near_plane_are_finite_and_marked(depth):
    means = jnp.array([[0.1, 0.2, depth - 3.0]], jnp.float32)
    _, quats, scales = random_splats(7, 1, jnp.float32)

    def total(inputs):
        footprints = project(*inputs, **camera(jnp.float32))
        return sum(
            jnp.sum(leaf)
            for leaf in (footprints.means2d, footprints.conics, footprints.compensation)
        )

    footprints = project(means, quats, scales, **camera(jnp.float32))
    assert bool(footprints.is_in_front[0]) == (float(footprints.depths[0]) > 0.01)
    assert all_finite((footprints, jax.grad(total)((means, quats, scales))))


def test_float32_in_float32_out_and_jit_equals_eager():
    inputs = random_splats(8, 10, jnp.float32)
    settings = camera(jnp.float32)
    eager = projection.project(*inputs, **settings)
    compiled = project(*inputs, **settings)
    for a, b in zip(jax.tree.leaves(eager), jax.tree.leaves(compiled), strict=True):
        assert a.dtype in (jnp.float32, bool)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
