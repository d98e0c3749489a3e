"""Undistorted photographs show what a pinhole camera would have seen.

The formulas of lenses are written here independently of the package.
"""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from geosplat_jax.io.distortion import (
    Brown,
    Fisheye,
    Lookup,
    largest_radius,
    photograph_lookup,
    pinhole_lookup,
    resample,
    resample_valid,
)

WIDTH, HEIGHT = 48, 40
LENS = np.array([[46.0, 0.0, 22.5], [0.0, 50.0, 21.0], [0.0, 0.0, 1.0]])
# Error of bilinear samples of colours whose phase turns by about a tenth of a radian per pixel.
TOLERANCE = 3e-3

MODELS = {
    "SIMPLE_RADIAL": (Brown((-0.25,)), (-0.25,)),
    "RADIAL": (Brown((0.15, -0.1)), (0.15, -0.1)),
    "OPENCV": (Brown((-0.2, 0.05), (0.03, -0.02)), (-0.2, 0.05, 0.03, -0.02)),
    "FULL_OPENCV": (
        Brown((-0.2, 0.05, 0.02), (0.03, -0.02), (0.1, -0.05, 0.02)),
        (-0.2, 0.05, 0.03, -0.02, 0.02, 0.1, -0.05, 0.02),
    ),
    "SIMPLE_RADIAL_FISHEYE": (Fisheye((0.1,)), (0.1,)),
    "RADIAL_FISHEYE": (Fisheye((0.1, -0.05)), (0.1, -0.05)),
    "OPENCV_FISHEYE": (Fisheye((0.1, -0.05, 0.02, -0.01)), (0.1, -0.05, 0.02, -0.01)),
}
"""Our model of each lens, and its parameters in the order of OpenCV and COLMAP."""


def shown(name, numbers, x, y):
    """Return where a lens shows (x, y, 1), by the formulas in the manual of OpenCV."""
    if name.endswith("FISHEYE"):
        k = [*numbers, 0.0, 0.0, 0.0, 0.0]
        r = (x**2 + y**2) ** 0.5
        t = np.arctan(r)
        td = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8)
        return (td / r * x, td / r * y) if r > 0 else (x, y)
    if name.endswith("RADIAL"):
        k1, k2 = (*numbers, 0.0)[:2]
        p1 = p2 = k3 = k4 = k5 = k6 = 0.0
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*numbers, 0.0, 0.0, 0.0, 0.0)[:8]
    r2 = x**2 + y**2
    gain = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * gain + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def unbent(name, numbers, u, v):
    """Return the point of the plane that a lens shows at (u, v), by Newton's method."""
    x, y = u, v
    step = 1e-6
    for _ in range(8):
        at = np.array(shown(name, numbers, x, y))
        along_x = (np.array(shown(name, numbers, x + step, y)) - at) / step
        along_y = (np.array(shown(name, numbers, x, y + step)) - at) / step
        change = np.linalg.solve(np.stack([along_x, along_y], -1), np.array([u, v]) - at)
        x, y = x + change[0], y + change[1]
    np.testing.assert_allclose(shown(name, numbers, x, y), (u, v), atol=1e-9)
    return x, y


def color(x, y):
    """Return colours that are smooth and different in every direction."""
    z = np.sqrt(1 + x * x + y * y)
    a, b = x / z, y / z
    waves = [np.sin(4 * a + b), np.cos(3 * b - a), np.sin(2 * a - 4 * b + 1)]
    return 0.5 + 0.4 * np.stack(waves, -1)


def pixel_plane():
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return (columns - LENS[0, 2]) / LENS[0, 0], (rows - LENS[1, 2]) / LENS[1, 1]


def photograph(name, numbers):
    """Return what the lens photographs of the colours at infinity, pixel by pixel."""
    u, v = pixel_plane()
    points = [unbent(name, numbers, *point) for point in zip(u.ravel(), v.ravel(), strict=True)]
    x, y = np.array(points).T
    return color(x, y).reshape(HEIGHT, WIDTH, 3).astype(np.float32)


@pytest.mark.parametrize("name", ["OPENCV", "RADIAL", "OPENCV_FISHEYE"])
def test_an_undistorted_photograph_is_that_of_a_pinhole(name):
    model, numbers = MODELS[name]
    lookup = pinhole_lookup(model, LENS, WIDTH, HEIGHT)
    actual = resample(photograph(name, numbers), lookup)
    expected = color(*pixel_plane())
    assert 0.8 < lookup.inside.mean() <= 1.0
    # Within half a pixel of the border, the last pixel stands for everything beyond its centre.
    is_inner = (np.abs(lookup.rows - HEIGHT / 2) < HEIGHT / 2 - 0.5) & (
        np.abs(lookup.columns - WIDTH / 2) < WIDTH / 2 - 0.5
    )
    assert np.abs(actual - expected)[is_inner].max() < TOLERANCE
    assert (actual[~lookup.inside] == 0.0).all()


@pytest.mark.parametrize("name", list(MODELS))
def test_a_lens_shows_points_where_its_formula_says(name):
    model, numbers = MODELS[name]
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))
    points[0] = 0.0
    actual = np.stack(model.distort(points[:, 0], points[:, 1]), -1)
    expected = [shown(name, numbers, *point) for point in points]
    np.testing.assert_allclose(actual, expected, atol=1e-12)


@pytest.mark.parametrize("name", list(MODELS))
def test_a_lens_is_that_of_colmap(name):
    pycolmap = pytest.importorskip("pycolmap")
    model, numbers = MODELS[name]
    focal = [50.0] if "SIMPLE" in name or name.startswith("RADIAL") else [46.0, 50.0]
    camera = pycolmap.Camera(
        model=name, width=WIDTH, height=HEIGHT, params=[*focal, 22.5, 21.0, *numbers]
    )
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (50, 2))
    expected = camera.img_from_cam(np.concatenate([points, np.ones((50, 1))], -1))
    actual = np.stack(model.distort(points[:, 0], points[:, 1]), -1)
    actual = actual * [focal[0], focal[-1]] + [22.5, 21.0]
    np.testing.assert_allclose(actual, expected, atol=1e-9)


def test_where_the_polynomial_turns_back_nothing_is_seen_twice():
    model = Brown((-0.6,))
    limit = largest_radius(model, 10.0)
    assert limit == pytest.approx((1 / (3 * 0.6)) ** 0.5, rel=1e-2)  # where 1 - 1.8 r^2 is zero
    assert largest_radius(Brown((0.1,)), 10.0) == 10.0
    wide_intrinsics = np.array([[12.0, 0.0, 24.0], [0.0, 12.0, 20.0], [0.0, 0.0, 1.0]])
    lookup = pinhole_lookup(model, wide_intrinsics, WIDTH, HEIGHT)
    x, y = np.meshgrid((np.arange(WIDTH) - 23.5) / 12, (np.arange(HEIGHT) - 19.5) / 12)
    # Points of the plane beyond the limit would fall on pixels of the photograph.
    is_beyond = np.hypot(x, y) > limit
    is_within = (lookup.rows > 0) & (lookup.rows < HEIGHT)
    is_within &= (lookup.columns > 0) & (lookup.columns < WIDTH)
    assert (is_beyond & is_within).sum() > 100
    assert not lookup.inside[is_beyond].any()
    assert lookup.inside[np.hypot(x, y) < 0.95 * limit].all()


def test_no_distortion_changes_nothing():
    pixels = np.random.default_rng(2).uniform(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    lookup = pinhole_lookup(Brown((0.0,)), LENS, WIDTH, HEIGHT)
    assert lookup.inside.all()
    np.testing.assert_allclose(resample(pixels, lookup), pixels, atol=1e-6)


@pytest.mark.parametrize("shape", [(23, 31), (1, 9), (40, 1)])
def test_samples_are_those_of_scipy(shape):
    rng = np.random.default_rng(4)
    pixels = rng.random((*shape, 3), np.float32)
    rows, columns = (rng.uniform(-1.0, n + 1.0, (37, 19)) for n in shape)
    lookup = Lookup(rows, columns, rng.random(rows.shape) > 0.2)
    coordinates = np.stack([rows, columns]) - 0.5
    expected = [
        map_coordinates(pixels[..., c], coordinates, order=1, mode="nearest") for c in range(3)
    ]
    expected = np.where(lookup.inside[..., None], np.stack(expected, -1), 0.0)
    np.testing.assert_allclose(resample(pixels, lookup), expected, atol=1e-6)


def test_colour_behind_the_mask_does_not_bleed_in():
    pixels = np.ones((HEIGHT, WIDTH, 4), np.float32)
    pixels[:, : WIDTH // 2] = [5.0, 5.0, 5.0, 0.0]
    pixels[:, WIDTH // 2 :, :3] = 0.25
    lookup = pinhole_lookup(Brown((-0.2,)), LENS, WIDTH, HEIGHT)
    resampled = resample(pixels, lookup)
    has_color = resampled[..., 3] > 1e-3
    assert ((resampled[..., 3] > 0.05) & (resampled[..., 3] < 0.95)).any()
    np.testing.assert_allclose(resampled[has_color][:, :3], 0.25, atol=1e-4)


def test_a_sample_next_to_a_pixel_that_does_not_count_does_not_count():
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[20, 30] = False
    model = Brown((-0.2,))
    lookup = pinhole_lookup(model, LENS, WIDTH, HEIGHT)
    counts = resample_valid(valid, lookup)
    is_near = (np.abs(lookup.rows - 20.5) < 0.9) & (np.abs(lookup.columns - 30.5) < 0.9)
    assert is_near.any()
    assert not counts[is_near].any()
    is_far = (np.abs(lookup.rows - 20.5) > 1.01) | (np.abs(lookup.columns - 30.5) > 1.01)
    np.testing.assert_array_equal(counts[is_far], lookup.inside[is_far])


@pytest.mark.parametrize("name", MODELS)
def test_pixels_of_a_photograph_are_found_in_the_pinhole_image(name):
    model, _ = MODELS[name]
    lookup = photograph_lookup(model, LENS, WIDTH, HEIGHT)
    x, y = (lookup.columns - LENS[0, 2]) / LENS[0, 0], (lookup.rows - LENS[1, 2]) / LENS[1, 1]
    u, v = model.distort(x, y)
    columns, rows = LENS[0, 0] * u + LENS[0, 2], LENS[1, 1] * v + LENS[1, 2]
    pixel_centers = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    assert lookup.inside.mean() > 0.5
    for actual, expected in zip((columns, rows), pixel_centers, strict=True):
        np.testing.assert_allclose(actual[lookup.inside], expected[lookup.inside], atol=0.02)


def test_without_distortion_photograph_and_pinhole_image_are_one():
    lookup = photograph_lookup(None, LENS, WIDTH, HEIGHT)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    np.testing.assert_allclose(lookup.columns, columns)
    np.testing.assert_allclose(lookup.rows, rows)
    assert lookup.inside.all()
