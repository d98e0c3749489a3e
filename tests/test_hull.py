"""The visual hull of a sphere is known: its distance, its box, and how masks may change it."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.surface.hull import (
    fit_grid,
    grid_points,
    hull_bounds,
    hull_distance,
    hull_sdf,
    sight_bounds,
)

pytestmark = pytest.mark.usefixtures("products_must_ask")

SHARED = Path(__file__).parents[2] / "shared"
VIEW_COUNT, SIZE, FOCAL, DISTANCE, RADIUS = 40, 64, 90.0, 4.0, 0.9


def cameras_around(center, *, scale=1.0, count=VIEW_COUNT):
    """OpenCV cameras on a Fibonacci sphere, looking at the centre."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z * z)
    backward = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)
    poses = np.zeros((count, 4, 4))
    for pose, axis in zip(poses, backward, strict=True):
        forward = -axis
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (np.asarray(center) + scale * DISTANCE * axis)
        pose[3, 3] = 1.0
    pinhole = np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
    return poses, np.tile(pinhole, (count, 1, 1))


def sphere_coverage(poses, intrinsics, center, radius, *, samples=4):
    """Antialiased masks of a sphere, from samples x samples rays a pixel."""
    steps = (np.arange(SIZE * samples) + 0.5) / samples
    masks = []
    for pose, pinhole in zip(poses, intrinsics, strict=True):
        c = pose[:3, :3] @ np.asarray(center) + pose[:3, 3]
        u, v = np.meshgrid(steps, steps)
        rays = np.stack(
            [
                (u - pinhole[0, 2]) / pinhole[0, 0],
                (v - pinhole[1, 2]) / pinhole[1, 1],
                np.ones_like(u),
            ],
            -1,
        )
        projections = rays @ c
        is_hit = projections**2 > (rays**2).sum(-1) * (c @ c - radius**2)
        masks.append(is_hit.reshape(SIZE, samples, SIZE, samples).mean((1, 3)))
    return np.stack(masks).astype(np.float32)


def is_in_hull(*views_and_points, **settings):
    return hull_distance(*views_and_points, **settings) < 0.0


@pytest.fixture(scope="module")
def sphere():
    poses, intrinsics = cameras_around(np.zeros(3))
    return poses, intrinsics, sphere_coverage(poses, intrinsics, np.zeros(3), RADIUS)


def test_hull_encloses_the_object_and_little_more(sphere):
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert is_in_hull(*sphere, 0.97 * RADIUS * directions, tolerance=0.0).all()
    assert not is_in_hull(*sphere, 1.12 * RADIUS * directions).any()


def test_distance_at_the_surface_is_accurate_to_a_fraction_of_a_pixel(sphere):
    # The silhouette of view v touches the sphere where the line of sight is tangent.
    poses, _, _ = sphere
    pixel = DISTANCE / FOCAL
    for pose in poses[::7]:
        backward = -pose[2, :3]
        perpendiculars = np.cross(backward, np.random.default_rng(1).normal(size=(50, 3)))
        perpendiculars /= np.linalg.norm(perpendiculars, axis=1, keepdims=True)
        sine = RADIUS / DISTANCE
        tangent_points = RADIUS * (sine * backward[None] + np.sqrt(1.0 - sine**2) * perpendiculars)
        distance = hull_distance(*sphere, tangent_points, tolerance=0.0)
        assert np.abs(distance).max() < 0.35 * pixel


def test_sdf_is_a_distance_in_cells_everywhere(sphere):
    grid = fit_grid((np.full(3, -1.2), np.full(3, 1.2)), 24)
    sdf = hull_sdf(*sphere, grid, tolerance=0.0)
    exact = (np.linalg.norm(grid_points(grid), axis=1) - RADIUS) / float(grid.cell_size)
    # The hull of forty views exceeds the sphere by up to half a cell.
    for reach, largest, mean in ((1.0, 0.6, 0.25), (3.0, 1.1, 0.3)):
        error = np.abs(sdf - exact)[np.abs(exact) < reach]
        assert error.max() < largest
        assert error.mean() < mean
    field = sdf.reshape(25, 25, 25)
    slopes = np.stack([np.abs(np.diff(field, axis=axis)).max() for axis in range(3)])
    assert slopes.max() < 2.0
    assert sdf.dtype == np.float32


def test_sdf_numbers_vertices_with_x_fastest():
    center = np.array([0.5, -0.2, 0.3])
    poses, intrinsics = cameras_around(center)
    masks = sphere_coverage(poses, intrinsics, center, 0.4)
    grid = fit_grid((np.array([-0.5, -0.7, -0.2]), np.array([1.2, 0.6, 0.8])), 20)
    deepest = grid_points(grid)[np.argmin(hull_sdf(poses, intrinsics, masks, grid))]
    assert np.abs(deepest - center).max() < 2.0 * float(grid.cell_size)
    first, second = grid_points(grid)[:2]
    np.testing.assert_allclose(second - first, [float(grid.cell_size), 0.0, 0.0], atol=1e-7)


def test_sdf_is_closed_even_where_the_grid_cuts_the_object(sphere):
    grid = fit_grid((np.full(3, -0.5), np.full(3, 0.5)), 12)
    field = hull_sdf(*sphere, grid).reshape(13, 13, 13)
    border = np.ones_like(field, bool)
    border[1:-1, 1:-1, 1:-1] = False
    assert (field[border] > 0.0).all()
    assert (field < 0.0).any()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (7.0, -30.0, 11.0)])
def test_bounds_follow_the_object_wherever_and_however_large(scale, center):
    center = scale * np.asarray(center)
    poses, intrinsics = cameras_around(center, scale=scale)
    masks = sphere_coverage(poses, intrinsics, center, scale * RADIUS, samples=2)
    lo, hi = hull_bounds(poses, intrinsics, masks)
    assert (lo < center - scale * RADIUS).all()
    assert (hi > center + scale * RADIUS).all()
    assert ((hi - lo) < 2.5 * scale * RADIUS).all()


def test_bounds_find_an_object_far_smaller_than_the_first_search_cell():
    poses, intrinsics = cameras_around(np.zeros(3))
    center, radius = np.array([0.3, 0.5, -0.4]), 0.06
    masks = sphere_coverage(poses, intrinsics, center, radius)
    lo, hi = hull_bounds(poses, intrinsics, masks)
    assert (lo < center - radius).all()
    assert (hi > center + radius).all()
    assert ((hi - lo) < 4.0 * radius).all()


def test_one_wrong_mask_does_not_carve_the_object(sphere):
    poses, intrinsics, masks = sphere
    torn_masks = masks.copy()
    torn_masks[3, SIZE // 2 :] = 0.0
    points = np.random.default_rng(2).uniform(-0.4, 0.4, (500, 3))
    assert not is_in_hull(poses, intrinsics, torn_masks, points, tolerance=0.0).all()
    assert is_in_hull(poses, intrinsics, torn_masks, points, tolerance=1 / VIEW_COUNT).all()


def test_a_view_with_an_empty_mask_is_ignored(sphere):
    poses, intrinsics, masks = sphere
    blank_masks = masks.copy()
    blank_masks[5] = 0.0
    assert is_in_hull(poses, intrinsics, blank_masks, np.zeros((1, 3)), tolerance=0.0).all()
    with pytest.raises(ValueError, match="every mask is empty"):
        is_in_hull(poses, intrinsics, 0.0 * masks, np.zeros((1, 3)))


def test_a_view_says_nothing_about_what_it_does_not_see(sphere):
    poses, intrinsics, masks = sphere
    shifted, cropped = intrinsics.copy(), masks.copy()
    shifted[0, 0, 2] -= SIZE / 2  # the left half of the object leaves the image
    cropped[0] = np.pad(masks[0, :, SIZE // 2 :], ((0, 0), (0, SIZE // 2)))
    points = np.random.default_rng(3).uniform(-0.5, 0.5, (200, 3))
    assert is_in_hull(poses, shifted, cropped, points, tolerance=0.0).all()


def test_a_point_that_few_views_see_is_outside(sphere):
    far_points = np.array([[0.0, 0.0, 50.0], [30.0, 0.0, 0.0]])
    distance = hull_distance(*sphere, far_points)
    assert (distance > 0.0).all()
    poses, _, _ = sphere
    eye = -poses[0, :3, :3].T @ poses[0, :3, 3]
    assert not is_in_hull(*sphere, eye[None]).any()


def test_bool_masks_and_full_masks_are_masks_too(sphere):
    poses, intrinsics, masks = sphere
    assert is_in_hull(poses, intrinsics, masks > 0.5, np.zeros((1, 3))).all()
    assert is_in_hull(poses, intrinsics, np.ones_like(masks), np.zeros((1, 3))).all()


def through_jpeg(mask, *, quality):
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * mask).astype(np.uint8)).save(buffer, "JPEG", quality=quality)
    return np.asarray(Image.open(buffer)) / 255.0


def test_a_haze_of_compression_is_neither_object_nor_background(sphere):
    poses, pinholes, masks = sphere
    haze = np.random.default_rng(0).integers(0, 4, masks.shape) / 255.0
    points = grid_points(fit_grid((np.full(3, -1.2), np.full(3, 1.2)), 24))
    clean_distances = hull_distance(poses, pinholes, masks, points)
    assert clean_distances.min() < -0.6
    hazy_variants = [np.maximum(masks, haze), np.minimum(masks, 1.0 - haze), 0.985 * masks]
    hazy_variants.append(np.stack([through_jpeg(mask, quality=95) for mask in masks]))
    for hazy_masks in hazy_variants:
        distances = hull_distance(poses, pinholes, hazy_masks, points)
        # A pixel is .044 wide at the sphere.
        np.testing.assert_allclose(distances, clean_distances, atol=0.02)
        for corner, expected in zip(
            hull_bounds(poses, pinholes, hazy_masks),
            hull_bounds(poses, pinholes, masks),
            strict=True,
        ):
            np.testing.assert_allclose(corner, expected, atol=0.02)


def test_large_masks_are_reduced_without_moving_the_edge():
    poses, intrinsics = cameras_around(np.zeros(3), count=8)
    masks = sphere_coverage(poses, intrinsics, np.zeros(3), RADIUS)
    large = np.repeat(np.repeat(masks, 7, 1), 7, 2)[:, :-3]  # 445 x 448 pixels: the height is odd
    scaled = intrinsics * np.array([[7.0], [7.0], [1.0]])
    points = np.random.default_rng(4).uniform(-1.2, 1.2, (3000, 3))
    first, second = (
        hull_distance(poses, *views, points, tolerance=0.0)
        for views in ((intrinsics, masks), (scaled, large))
    )
    is_near = np.isfinite(first + second) & (np.abs(first) < 0.1)
    assert is_near.sum() > 50
    assert np.abs(first[is_near] - second[is_near]).max() < 1.5 * DISTANCE / FOCAL


def test_views_that_bound_nothing_are_refused(sphere):
    poses, intrinsics, masks = sphere
    with pytest.raises(ValueError, match="parallel or there is only one view"):
        hull_bounds(poses[:1], intrinsics[:1], masks[:1])
    small_masks = sphere_coverage(poses, intrinsics, np.zeros(3), 0.3)
    # Neighbouring views put the object on opposite sides.
    small_masks[::2] = np.roll(small_masks[::2], 22, axis=2)
    small_masks[1::2] = np.roll(small_masks[1::2], -22, axis=2)
    with pytest.raises(ValueError, match="no volume in common"):
        hull_bounds(poses, intrinsics, small_masks, tolerance=0.0)


def test_a_grid_beside_the_object_is_refused(sphere):
    grid = fit_grid((np.full(3, 1.3), np.full(3, 1.6)), 8)
    with pytest.raises(ValueError, match="holds no vertex of the grid"):
        hull_sdf(*sphere, grid)


def test_fitted_grid_is_cubic_tight_and_holds_its_margins():
    lo, hi = np.array([-0.3, 1.0, 2.0]), np.array([0.7, 1.4, 4.0])
    grid = fit_grid((lo, hi), 32, margin_cells=2)
    cell = float(grid.cell_size)
    assert max(grid.shape) == grid.shape[2] == 32
    low = np.asarray(grid.origin)
    high = low + cell * np.asarray(grid.shape)
    assert (lo - low > 1.99 * cell).all()
    assert (high - hi > 1.99 * cell).all()
    assert (lo - low < 2.51 * cell).all()


@pytest.mark.parametrize(
    ("bounds", "resolution", "message"),
    [
        (([0, 0, 0], [1, 1, 0]), 32, "lo < hi"),
        (([0, 0, 0], [1, 1, np.inf]), 32, "lo < hi"),
        (([0, 0, 0], [1, 1, 1]), 4, "exceed twice the margin"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(bounds, resolution, message):
    lo, hi = (np.asarray(corner, float) for corner in bounds)
    with pytest.raises(ValueError, match=message):
        fit_grid((lo, hi), resolution)


@pytest.mark.parametrize("name", ["spot", "knight"])
def test_hull_of_a_path_traced_scene_encloses_its_true_mesh(name):
    root = SHARED / "scenes" / name
    if not root.is_dir():
        pytest.skip("the shared scenes are not here")
    trimesh = pytest.importorskip("trimesh")
    box = (np.full(3, -1.5), np.full(3, 1.5))
    train = load_dataset(root, test_views=1, bounds=box).train
    vertices = np.asarray(trimesh.load(root / "mesh_gt.ply", process=False).vertices, float)
    extent = json.loads((root / "scene.json").read_text())["object_half_extent"]
    distance = hull_distance(
        train.world_to_camera, train.intrinsics, train.images[..., 3], vertices
    )
    assert distance.max() < 0.01 * extent


def test_pixels_that_do_not_count_carve_nothing(sphere):
    poses, intrinsics, masks = sphere
    # In every view a bar hides a part of the ball, also in the mask; the upper border is unknown.
    valid = np.ones(masks.shape, np.float32)
    valid[:, :, 34:40] = 0.0
    valid[:, :6] = 0.0
    visible_masks = (masks * valid).astype(np.float32)
    original_masks = visible_masks.copy()
    settings = {"tolerance": 0.0, "seen_fraction": 0.25}
    inside = np.random.default_rng(0).normal(size=(400, 3))
    inside *= 0.97 * RADIUS / np.linalg.norm(inside, axis=1, keepdims=True)
    outside = inside * (1.2 / 0.97)
    assert not is_in_hull(poses, intrinsics, visible_masks, inside, **settings).all()
    assert is_in_hull(poses, intrinsics, visible_masks, inside, valid=valid, **settings).all()
    assert (
        is_in_hull(poses, intrinsics, visible_masks, outside, valid=valid, **settings).mean() < 0.02
    )
    lo, hi = hull_bounds(poses, intrinsics, visible_masks, valid=valid)
    exact = hull_bounds(poses, intrinsics, masks)
    np.testing.assert_allclose((lo, hi), exact, atol=0.1)
    grid = fit_grid(exact, 16)
    sdf = hull_sdf(poses, intrinsics, visible_masks, grid, valid=valid)
    np.testing.assert_allclose(sdf, hull_sdf(poses, intrinsics, masks, grid), atol=1.0)
    # The masks that were given are not changed.
    np.testing.assert_array_equal(visible_masks, original_masks)


def test_where_all_pixels_count_the_hull_is_the_same(sphere):
    points = np.random.default_rng(3).uniform(-1.2, 1.2, (500, 3))
    actual = hull_distance(*sphere, points, valid=np.ones(sphere[2].shape, bool))
    # This is another program, which may round differently.
    np.testing.assert_allclose(actual, hull_distance(*sphere, points), atol=1e-6)


SIZES = np.full((VIEW_COUNT, 2), float(SIZE))


def test_photographs_of_several_sizes_show_what_each_of_them_shows():
    poses, intrinsics = cameras_around(np.zeros(3))
    sizes = SIZES.copy()
    sizes[::2, 0] /= 2
    sizes[1::2, 1] /= 2
    lo, hi = sight_bounds(poses, intrinsics, sizes=sizes)
    whole_lo, whole_hi = sight_bounds(poses, intrinsics, sizes=SIZES)
    np.testing.assert_allclose(hi - lo, (whole_hi - whole_lo) / 2)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_what_all_cameras_look_at_is_the_middle_of_the_bounds(scale):
    center = scale * np.array([5.0, -3.0, 2.0])
    poses, intrinsics = cameras_around(center, scale=scale)
    lo, hi = sight_bounds(poses, intrinsics, sizes=SIZES)
    np.testing.assert_allclose((lo + hi) / 2, center, atol=1e-9 * scale)
    # The corners of the cube are on the rim of what a camera shows.
    corner_distance = np.sqrt(3.0) * (hi - lo) / 2
    np.testing.assert_allclose(corner_distance, scale * DISTANCE * (SIZE / 2) / FOCAL, rtol=1e-9)
    wide_intrinsics = intrinsics * np.array([[0.05], [0.05], [1.0]])
    lo, hi = sight_bounds(poses, wide_intrinsics, sizes=SIZES)
    positions = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    assert not ((positions > lo) & (positions < hi)).all(1).any()


def test_cameras_that_look_nowhere_in_common_are_refused():
    poses, intrinsics = cameras_around(np.zeros(3))
    with pytest.raises(ValueError, match="parallel"):
        sight_bounds(poses[[0, 0]], intrinsics[:2], sizes=SIZES[:2])
    turned_poses = poses.copy()
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    turned_poses[:25] = turn @ poses[:25]
    with pytest.raises(ValueError, match="25 of 40 cameras look away"):
        sight_bounds(turned_poses, intrinsics, sizes=SIZES)
