from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.capacity import Capacities, fits, overflowed
from geosplat_jax.splats.projection import Footprints, project
from geosplat_jax.splats.rasterize import (
    MAX_ALPHA,
    _reference_composite,
    composite,
    find_visible,
    gather_visible,
    rasterize,
)
from geosplat_jax.splats.tiles import MIN_ALPHA, _sort_hits, _stable_argsort

ORACLES = Path(__file__).parents[2] / "shared" / "oracles"
# float64 after a few hundred products, including the rounding of the oracle itself.
ORACLE_TOLERANCE = 1e-11
# The compositor is compared with dense autodiff, both in float64.
REFERENCE_TOLERANCE = 1e-11
AMPLE = Capacities(visible=512, hits=8192, chunks=2048)


@pytest.fixture
def x64():
    enable = getattr(jax, "enable_x64", None)
    if enable is None:
        from jax.experimental import enable_x64 as enable
    with enable(True):
        yield


def camera(dtype, height, width):
    world_to_camera = np.eye(4)
    world_to_camera[2, 3] = 3.0
    size = max(height, width)
    intrinsics = np.array([[1.2 * size, 0, width / 2], [0, 1.2 * size, height / 2], [0, 0, 1]])
    return {
        "world_to_camera": jnp.asarray(world_to_camera, dtype),
        "intrinsics": jnp.asarray(intrinsics, dtype),
        "height": height,
        "width": width,
    }


def scene(seed, count, dtype, *, opacity=(0.0, 1.0), channels=3, extent=1.2):
    """Means, quats, scales, opacities, features: from needles to blobs, some out of view."""
    rng = np.random.default_rng(seed)
    arrays = (
        rng.uniform(-extent, extent, (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-5, -1, (count, 3))),
        rng.uniform(*opacity, count),
        rng.uniform(size=(count, channels)),
    )
    return tuple(jnp.asarray(a, dtype) for a in arrays)


STATIC = ("height", "width", "capacities", "tile_size")
# Compiled once per shape; eager dispatch would compile every small operation on its own.
compiled_rasterize = jax.jit(rasterize, static_argnames=STATIC)


def draw(inputs, settings, *, capacities=AMPLE, tile_size=4, eligible=None):
    if eligible is None:
        eligible = jnp.ones(inputs[0].shape[0], bool)
    return compiled_rasterize(
        *inputs, eligible, capacities=capacities, tile_size=tile_size, **settings
    )


@partial(jax.jit, static_argnames=STATIC)
def loss_and_gradient(inputs, eligible, **settings):
    """Return `scalar`, (image, alpha, usage) and the gradient; most tests share one compilation."""

    def loss(inputs):
        image, alpha, usage = rasterize(*inputs, eligible, **settings)
        return scalar(image, alpha), (image, alpha, usage)

    (value, images), gradient = jax.value_and_grad(loss, has_aux=True)(inputs)
    return value, images, gradient


def differentiate(inputs, *, eligible=None, capacities=AMPLE):
    """Differentiate 40 float32 splats of 3 channels in a 12 x 12 image."""
    if eligible is None:
        eligible = jnp.ones(40, bool)
    settings = camera(jnp.float32, 12, 12)
    return loss_and_gradient(inputs, eligible, capacities=capacities, tile_size=4, **settings)


def padded(*rows):
    """Pad the rows to 40 with copies of the first one; also return the mask of the given rows."""
    count = rows[0].shape[0]
    padded_rows = tuple(jnp.concatenate([x, jnp.repeat(x[:1], 40 - count, axis=0)]) for x in rows)
    return padded_rows, jnp.arange(40) < count


def dense(inputs, settings):
    """Sort everything in front of the camera by depth, and composite it in every pixel."""
    depths = jax.lax.stop_gradient(project(*inputs[:3], **settings).depths)
    order = jnp.argsort(depths, stable=True)
    means, quats, scales, opacities, features = (x[order] for x in inputs)
    footprints = project(means, quats, scales, **settings)
    opacities = jnp.where(footprints.is_in_front, opacities, 0.0)
    shape = {k: settings[k] for k in ("height", "width")}
    return _reference_composite(footprints, opacities, features, **shape)


def scalar(image, alpha, seed=0):
    """A random linear functional of image and alpha."""
    rng = np.random.default_rng(seed)
    weight = jnp.asarray(rng.normal(size=(*alpha.shape, image.shape[-1] + 1)), image.dtype)
    return jnp.sum(weight[..., :-1] * image) + jnp.sum(weight[..., -1] * alpha)


def assert_close_gradients(got, expected, *, relative, cosine):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a, np.float64).ravel(), np.asarray(b, np.float64).ravel()
        scale = np.linalg.norm(b)
        assert np.linalg.norm(a - b) <= relative * scale + 1e-300
        if scale > 0:
            assert a @ b >= (1 - cosine) * np.linalg.norm(a) * scale


def all_finite(tree):
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("name", ["large", "opaque_small", "soft"])
def test_image_and_gradients_match_the_oracle(name, x64):
    path = ORACLES / f"splat_{name}.npz"
    if not path.exists():
        pytest.skip("the shared oracles are not here")
    data = {k: jnp.asarray(v) for k, v in np.load(path).items()}
    keys = ("means", "quats", "scales", "opacities", "colors")
    settings = {
        "world_to_camera": data["viewmat"],
        "intrinsics": data["K"],
        "height": int(data["height"]),
        "width": int(data["width"]),
    }
    capacities = Capacities(visible=2048, hits=16384, chunks=4096)

    def loss(inputs):
        image, alpha, usage = draw(inputs, settings, capacities=capacities)
        value = jnp.sum(image * data["cotangent_image"])
        return value + jnp.sum(alpha * data["cotangent_alpha"]), (image, alpha, usage)

    inputs = tuple(data[k] for k in keys)
    gradient, (image, alpha, usage) = jax.jit(jax.grad(loss, has_aux=True))(inputs)
    assert overflowed(usage, capacities) == []
    np.testing.assert_allclose(image, data["image"], atol=ORACLE_TOLERANCE)
    np.testing.assert_allclose(alpha, data["alpha"], atol=ORACLE_TOLERANCE)
    expected = tuple(data[f"grad_{k}"] for k in keys)
    assert_close_gradients(gradient, expected, relative=ORACLE_TOLERANCE, cosine=1e-12)


@pytest.mark.parametrize(
    ("height", "width", "tile_size", "channels"),
    [(13, 9, 5, 7), pytest.param(1, 1, 4, 3, marks=pytest.mark.slow)],
)
def test_equals_dense_compositing(height, width, tile_size, channels, x64):
    settings = camera(jnp.float64, height, width)
    inputs = scene(1, 120, jnp.float64, channels=channels)
    inputs = (*inputs[:4], inputs[4].at[:, -1].set(1.0))

    def loss(render, inputs):
        image, alpha, *usage = render(inputs)
        return scalar(image, alpha), (image, alpha, usage)

    tiled = partial(draw, settings=settings, tile_size=tile_size)
    results = [
        jax.jit(jax.value_and_grad(partial(loss, render), has_aux=True))(inputs)
        for render in (tiled, partial(dense, settings=settings))
    ]
    (_, (image, alpha, [tile_usage])), gradients = results[0]
    (_, (expected_image, expected_alpha, _)), expected = results[1]
    assert overflowed(tile_usage, AMPLE) == []
    np.testing.assert_allclose(image, expected_image, atol=REFERENCE_TOLERANCE)
    np.testing.assert_allclose(alpha, expected_alpha, atol=REFERENCE_TOLERANCE)
    assert_close_gradients(gradients, expected, relative=1e-10, cosine=1e-12)
    # Alpha is the composite of a constant feature.
    np.testing.assert_allclose(image[..., -1], alpha, atol=1e-13)
    assert float(alpha.min()) >= 0.0
    assert float(alpha.max()) <= 1.0


def test_custom_vjp_equals_autodiff_for_every_input_of_the_compositor(x64):
    settings = camera(jnp.float64, 16, 16)
    shape = {"height": 16, "width": 16}
    means, quats, scales, opacities, features = scene(2, 60, jnp.float64)
    all_footprints = project(means, quats, scales, **settings)
    lists = jax.jit(find_visible, static_argnames=STATIC)(
        all_footprints, opacities, jnp.ones(60, bool), tile_size=4, capacities=AMPLE, **shape
    )
    rows = [gather_visible(lists.index, x) for x in (means, quats, scales, opacities, features)]
    footprints = project(*rows[:3], **settings)

    names = ("means2d", "conics", "compensation")

    def loss(render, arguments):
        *fields, opacities, features = arguments
        changed_footprints = replace(footprints, **dict(zip(names, fields, strict=True)))
        return scalar(*render(changed_footprints, opacities, features))

    def tiled(*a):
        return composite(*a, lists, tile_size=4, **shape)

    arguments = (*(getattr(footprints, name) for name in names), rows[3], rows[4])
    gradients = jax.jit(jax.grad(partial(loss, tiled)))(arguments)
    expected = jax.jit(jax.grad(partial(loss, partial(_reference_composite, **shape))))(arguments)
    assert_close_gradients(gradients, expected, relative=1e-10, cosine=1e-12)


def test_gradients_match_finite_differences_along_random_directions(x64):
    # The splats are soft and overlap, so that no pixel crosses a threshold within a step.
    settings = camera(jnp.float64, 10, 12)
    means, quats, _, _, features = scene(3, 6, jnp.float64, extent=0.4)
    rng = np.random.default_rng(5)
    scales = jnp.asarray(rng.uniform(1.0, 1.5, (6, 3)))
    inputs = (means, quats, scales, jnp.asarray(rng.uniform(0.3, 0.6, 6)), features)

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def loss(inputs, matrices):
        return scalar(*draw(inputs, settings | matrices)[:2])

    matrices = {k: settings[k] for k in ("world_to_camera", "intrinsics")}
    arguments = (inputs, matrices)
    _, gradient = loss(*arguments)
    step = 1e-6
    for _ in range(4):
        direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arguments)
        forward, _ = loss(*jax.tree.map(lambda x, d: x + step * d, arguments, direction))
        backward, _ = loss(*jax.tree.map(lambda x, d: x - step * d, arguments, direction))
        products = jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, direction)
        expected = (forward - backward) / (2 * step)
        np.testing.assert_allclose(sum(jax.tree.leaves(products)), expected, rtol=1e-6)


def test_float32_gradients_stay_close_behind_opaque_layers():
    # With twenty nearly opaque sheets, dividing by 1 - alpha or subtracting prefix sums would fail.
    count, settings = 20, camera(jnp.float32, 12, 12)
    rng = np.random.default_rng(6)
    means = np.stack([np.zeros(count), np.zeros(count), np.linspace(0, 1, count)], -1)
    arrays = (
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 3.0),
        np.full(count, 0.97),
        rng.uniform(size=(count, 3)),
    )
    inputs = tuple(jnp.asarray(a, jnp.float32) for a in arrays)
    padded_inputs, eligible = padded(*inputs)
    _, _, gradient = differentiate(padded_inputs, eligible=eligible)
    gradients = [x[:count] for x in gradient]
    expected = jax.jit(jax.grad(lambda x: scalar(*dense(x, settings))))(inputs)
    visible = np.abs(np.asarray(expected[4])) > 0
    assert visible.all()
    # The tolerance is relative for each row: the last sheet gets 1e-28 of the light, and its
    # gradient must still be right.
    np.testing.assert_allclose(gradients[4], expected[4], rtol=1e-3)
    assert_close_gradients(gradients[3], expected[3], relative=1e-4, cosine=1e-6)


def test_padding_does_not_change_image_or_gradients():
    inputs = scene(7, 40, jnp.float32)
    larger_capacities = Capacities(visible=1024, hits=16384, chunks=4096)
    _, images, gradients = differentiate(inputs)
    _, other_images, other_gradients = differentiate(inputs, capacities=larger_capacities)
    for a, b in zip(images[:2], other_images[:2], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert_close_gradients(gradients, other_gradients, relative=1e-5, cosine=1e-9)


def test_ineligible_rows_are_inert_whatever_they_hold():
    inputs = scene(8, 40, jnp.float32)
    eligible = jnp.arange(40) < 25
    value, _, gradient = differentiate(
        tuple(x.at[25:].set(jnp.inf) for x in inputs), eligible=eligible
    )
    expected, _, expected_gradient = differentiate(inputs, eligible=eligible)
    np.testing.assert_array_equal(value, expected)
    for a, b in zip(gradient, expected_gradient, strict=True):
        np.testing.assert_array_equal(a, b)
        assert not bool(jnp.any(a[25:]))


def test_overflow_is_reported_with_true_counts():
    inputs, settings = scene(9, 200, jnp.float32, opacity=(0.5, 1.0)), camera(jnp.float32, 24, 24)
    footprints = project(*inputs[:3], **settings)
    find = partial(
        jax.jit(find_visible, static_argnames=STATIC),
        footprints,
        inputs[3],
        jnp.ones(200, bool),
        height=24,
        width=24,
        tile_size=4,
    )
    usage = find(capacities=AMPLE).usage
    assert bool(fits(usage, AMPLE))
    small_capacities = AMPLE.resized(hits=64)
    reported_usage = find(capacities=small_capacities).usage
    assert int(reported_usage["hits"]) == int(usage["hits"])
    assert overflowed(reported_usage, small_capacities) == ["hits"]
    small_capacities = AMPLE.resized(chunks=64)
    reported_usage = find(capacities=small_capacities).usage
    assert int(reported_usage["chunks"]) == int(usage["chunks"])
    assert overflowed(reported_usage, small_capacities) == ["chunks"]
    small_capacities = AMPLE.resized(visible=64)
    reported_usage = find(capacities=small_capacities).usage
    assert int(reported_usage["visible"]) == int(usage["visible"]) > 64
    assert "visible" in overflowed(reported_usage, small_capacities)


def test_an_astronomic_number_of_hits_saturates_instead_of_wrapping():
    count, size = 40_000, 512
    footprints = Footprints(
        means2d=jnp.full((count, 2), 256.0),
        covariances2d=jnp.tile(jnp.array([1e9, 0.0, 1e9]), (count, 1)),
        conics=jnp.tile(jnp.array([1e-9, 0.0, 1e-9]), (count, 1)),
        depths=jnp.ones(count),
        compensation=jnp.ones(count),
        is_in_front=jnp.ones(count, bool),
    )
    capacities = Capacities(visible=count, hits=1024, chunks=512)
    lists = jax.jit(find_visible, static_argnames=STATIC)(
        footprints,
        jnp.ones(count),
        jnp.ones(count, bool),
        height=size,
        width=size,
        tile_size=2,
        capacities=capacities,
    )
    assert int(lists.usage["hits"]) == 2**31 - 1


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_depth_order_is_exact_and_ties_keep_row_order(dtype, x64):
    rng = np.random.default_rng(10)
    # Neighbouring floats are repeated, which only an exact, stable sort orders correctly.
    next_depths = np.nextafter(np.full(50, 2.0, dtype), np.inf, dtype=dtype)
    depths = np.concatenate([next_depths, np.full(50, 2.0), rng.uniform(0.02, 1e6, 100)]).astype(
        dtype
    )
    depths = rng.permutation(depths)
    count = len(depths)
    footprints = Footprints(
        means2d=jnp.full((count, 2), 4.0, dtype),
        covariances2d=jnp.tile(jnp.array([1.0, 0.0, 1.0], dtype), (count, 1)),
        conics=jnp.tile(jnp.array([1.0, 0.0, 1.0], dtype), (count, 1)),
        depths=jnp.asarray(depths),
        compensation=jnp.ones(count, dtype),
        is_in_front=jnp.ones(count, bool),
    )
    lists = jax.jit(find_visible, static_argnames=STATIC)(
        footprints,
        jnp.ones(count, dtype),
        jnp.ones(count, bool),
        height=8,
        width=8,
        tile_size=4,
        capacities=AMPLE,
    )
    np.testing.assert_array_equal(lists.index[:count], np.argsort(depths, kind="stable"))
    assert bool(jnp.all(lists.index[count:] == count))


@pytest.mark.parametrize(
    ("bits", "count"), [(1, 1), (1, 0), (9, 7), (16, 200_001), (17, 70_000), (32, 140_000)]
)
def test_packed_argsort_is_stable(bits, count):
    rng = np.random.default_rng(11)
    keys = rng.integers(0, 2**bits, count, dtype=np.uint64).astype(np.uint32)
    order = jax.jit(_stable_argsort, static_argnums=1)(jnp.asarray(keys), bits)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("rank_count", [2**10, 2**20])
def test_hits_sort_alike_whether_or_not_tile_and_rank_fit_one_word(rank_count):
    rng = np.random.default_rng(12)
    tile_count = 40_000
    ranks = np.sort(rng.integers(0, rank_count, 3000)).astype(np.int32)
    # Pairs of a tile and a rank are unique.
    tiles = rng.permutation(tile_count)[:3000].astype(np.int32) // 7
    sorted_tiles, sorted_ranks = jax.jit(_sort_hits, static_argnums=(2, 3))(
        jnp.asarray(tiles), jnp.asarray(ranks), tile_count, rank_count
    )
    order = np.lexsort([ranks, tiles])
    np.testing.assert_array_equal(sorted_tiles, tiles[order])
    np.testing.assert_array_equal(sorted_ranks, ranks[order])


@pytest.mark.parametrize("shift", [(0.0, 0.0, -10.0), (1e4, 0.0, 0.0)])
def test_nothing_visible_gives_an_empty_image_and_zero_gradients(shift):
    inputs = scene(13, 40, jnp.float32)
    moved_inputs = (inputs[0] + jnp.array([shift], jnp.float32), *inputs[1:])
    _, (image, alpha, usage), gradient = differentiate(moved_inputs)
    assert int(usage["visible"]) == int(usage["hits"]) == int(usage["chunks"]) == 0
    for leaf in (image, alpha, *gradient):
        assert not bool(jnp.any(leaf))


def test_opacity_zero_is_culled_and_opacity_one_is_clamped():
    inputs, eligible = padded(
        jnp.zeros((2, 3)),
        jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (2, 1)),
        jnp.full((2, 3), 1e3),
        jnp.array([0.0, 1.0]),
        jnp.ones((2, 3)),
    )
    _, (image, alpha, usage), gradient = differentiate(inputs, eligible=eligible)
    assert int(usage["visible"]) == 1
    np.testing.assert_allclose(alpha, MAX_ALPHA, rtol=1e-6)
    np.testing.assert_allclose(image, MAX_ALPHA, rtol=1e-6)
    assert all_finite(gradient)
    assert not bool(jnp.any(gradient[3]))


def test_extreme_splats_give_finite_images_and_gradients():
    means = jnp.array(
        [[0, 0, 0], [0.1, 0, -2.985], [0.1, 0, -2.995], [50, 0, -2.9], [0, 0, 1e5]], jnp.float32
    )
    quats = jnp.array(
        [[1, 0, 0, 0], [0, 0, 0, 0], [0.5, 0.5, 0.5, 0.5], [1e-12, 0, 0, 0], [3, 1, 2, 9]],
        jnp.float32,
    )
    for s in (1e-8, 1e-3, 1.0, 1e4):
        rows = [[s, s, s], [s, 1e-8, 1e-8], [s, s, s], [s, s, 1e-8], [s, 1e4, 1e4]]
        inputs, eligible = padded(
            means, quats, jnp.array(rows, jnp.float32), jnp.ones(5), jnp.ones((5, 3))
        )
        value, images, gradient = differentiate(inputs, eligible=eligible)
        assert all_finite((value, images, gradient)), s


@pytest.mark.slow
def test_tile_size_does_not_change_the_image(x64):
    settings = camera(jnp.float64, 21, 18)
    inputs = scene(15, 90, jnp.float64)
    images = [draw(inputs, settings, tile_size=size)[0] for size in (2, 16)]
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], atol=1e-13)


def test_float32_stays_float32():
    _, (image, alpha, usage), gradient = differentiate(scene(16, 40, jnp.float32))
    assert {leaf.dtype for leaf in (image, alpha, *gradient)} == {jnp.dtype("float32")}
    assert {leaf.dtype for leaf in usage.values()} == {jnp.dtype("int32")}


@pytest.mark.slow
def test_jit_equals_eager():
    settings = camera(jnp.float32, 12, 12)
    inputs = scene(16, 40, jnp.float32)
    _, compiled, _ = differentiate(inputs)
    eager = rasterize(*inputs, jnp.ones(40, bool), capacities=AMPLE, tile_size=4, **settings)
    for a, b in zip(eager[:2], compiled[:2], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert int(eager[2]["hits"]) == int(compiled[2]["hits"])


@pytest.mark.slow
def test_vmap_and_scan_over_views_equal_the_loop():
    settings = camera(jnp.float32, 10, 10)
    matrices = settings.pop("world_to_camera")
    views = jnp.stack([matrices, matrices.at[0, 3].add(0.3), matrices.at[2, 3].add(1.0)])
    inputs = scene(17, 30, jnp.float32)

    def one(view):
        return draw(inputs, settings | {"world_to_camera": view})[0]

    expected = jnp.stack([one(view) for view in views])
    np.testing.assert_allclose(jax.lax.map(one, views), expected, atol=1e-5)
    np.testing.assert_allclose(jax.vmap(one)(views), expected, atol=1e-5)


def test_tiles_list_the_splats_that_their_pixels_may_see_and_hardly_any_other():
    """This matters for thin ellipses: the bounding box of a diagonal one meets every tile."""
    count, size, tile = 300, 96, 8
    rng = np.random.default_rng(5)
    major_radii, minor_radii = rng.uniform(2.0, 25.0, count), rng.uniform(0.3, 2.0, count)
    angle = rng.uniform(0, np.pi, count)
    axis = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    minor_axis = np.stack([-axis[:, 1], axis[:, 0]], axis=-1)
    squares = major_radii[:, None, None] ** 2 * axis[:, :, None] * axis[:, None, :]
    covariance = (
        squares + minor_radii[:, None, None] ** 2 * minor_axis[:, :, None] * minor_axis[:, None, :]
    )
    conic = np.linalg.inv(covariance)
    upper = (slice(None), [0, 0, 1], [0, 1, 1])
    means = rng.uniform(-10, size + 10, (count, 2))
    opacities = rng.uniform(0.01, 1.0, count)
    splats = Footprints(
        means2d=jnp.asarray(means, jnp.float32),
        covariances2d=jnp.asarray(covariance[upper], jnp.float32),
        conics=jnp.asarray(conic[upper], jnp.float32),
        depths=jnp.asarray(rng.uniform(1, 2, count), jnp.float32),
        compensation=jnp.ones(count),
        is_in_front=jnp.ones(count, bool),
    )
    capacities = Capacities(visible=512, hits=16384, chunks=4096)
    lists = find_visible(
        splats,
        jnp.asarray(opacities, jnp.float32),
        jnp.ones(count, bool),
        height=size,
        width=size,
        tile_size=tile,
        capacities=capacities,
    )
    assert not overflowed(lists.usage, capacities)
    index, ranks, tiles = (
        np.asarray(x) for x in (lists.index, lists.chunk_ranks, lists.chunk_tiles)
    )
    slot, chunk = np.nonzero(ranks < capacities["visible"])
    is_listed = np.zeros((count, (size // tile) ** 2), bool)
    is_listed[index[ranks[slot, chunk]], tiles[chunk]] = True

    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    offset = np.stack([x, y], axis=-1)[None] - means[:, None, None]
    sigma = 0.5 * np.einsum("nhwi,nij,nhwj->nhw", offset, conic, offset)
    is_seen = opacities[:, None, None] * np.exp(-sigma) >= MIN_ALPHA
    blocks = is_seen.reshape(count, size // tile, tile, size // tile, tile)
    is_needed = blocks.any(axis=(2, 4)).reshape(count, -1)
    assert not np.any(is_needed & ~is_listed)
    # A listed ellipse may pass between the centres of the pixels of a tile.
    assert is_listed.sum() < 1.1 * is_needed.sum()
    assert int(lists.usage["hits"]) > 1.3 * is_listed.sum()
