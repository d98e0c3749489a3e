"""Hollows: the inside of a bowl, which no silhouette shows, and bodies that have none."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from support import look_at_poses

from geosplat_jax.fit.surfaces import FlexiCubesSettings
from geosplat_jax.io.agreement import hollow_line
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.views import Views
from geosplat_jax.surface.hollows import carve_hollows
from geosplat_jax.surface.hull import fit_grid, grid_points, hull_sdf

pytestmark = pytest.mark.usefixtures("products_must_ask")

OUTER, INNER = 1.0, 0.8
BOUNDS = (np.full(3, -1.05), np.array([1.05, 1.05, 0.1]))
COUNT, SIZE, DISTANCE = 24, 64, 4.0
FOCAL = 0.45 * SIZE * DISTANCE


def bowl(points):
    """Signed distance bound of half a ball, hollowed out from above."""
    radius = np.linalg.norm(points, axis=-1)
    return np.maximum(np.maximum(radius - OUTER, INNER - radius), points[..., 2])


def half_ball(points):
    """Signed distance bound of half a ball with a flat lid."""
    return np.maximum(np.linalg.norm(points, axis=-1) - OUTER, points[..., 2])


def painted(points, rays):
    """Return colours that change around the axis and do not depend on the viewer."""
    del rays
    angle = np.arctan2(points[..., 1], points[..., 0])
    waves = [np.cos(2 * angle), np.sin(2 * angle), np.cos(angle)]
    return 0.3 + 0.25 * np.stack(waves, axis=-1)


def reflected(points, rays):
    """Return the directions into which the polished lid and ball reflect rays."""
    ball = points / np.linalg.norm(points, axis=-1, keepdims=True)
    normal = np.where(points[..., 2:] > -0.02, [0.0, 0.0, 1.0], ball)
    return rays - 2 * (rays * normal).sum(-1, keepdims=True) * normal


def mirrored(points, rays):
    """Return the colours of a polished body in a colourful world."""
    x, y, z = np.moveaxis(reflected(points, rays), -1, 0)
    waves = [np.sin(5 * x + 3 * y), np.sin(4 * z - 3 * x), np.cos(6 * y + 2 * z)]
    return 0.4 + 0.3 * np.stack(waves, axis=-1)


def reflecting_softly(points, rays):
    """Return the colours of a polished body under a light that changes slowly."""
    return 0.5 + 0.3 * reflected(points, rays)


def photographed(distance, color, *, count=COUNT):
    """Render views of a body by sphere tracing."""
    poses = look_at_poses(count, distance=DISTANCE)
    steps = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    x, y = np.meshgrid(steps, -steps)
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    images = []
    for pose in poses:
        directions = rays @ pose[:3, :3].T
        ray_lengths = np.full((SIZE, SIZE, 1), DISTANCE - 1.5)
        for _ in range(60):
            points = pose[:3, 3] + ray_lengths * directions
            ray_lengths = ray_lengths + distance(points)[..., None]
        is_hit = distance(points)[..., None] < 0.01
        images.append(
            np.concatenate([np.where(is_hit, color(points, directions), 0.0), is_hit], -1)
        )
    lens = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1.0]])
    return Views(
        names=tuple(f"view_{k}" for k in range(count)),
        camera_to_world=poses,
        intrinsics=np.repeat(lens[None], count, axis=0),
        images=np.stack(images).astype(np.float32),
    )


def carved(views, *, resolution=24):
    """Return the grid, the hull, and the hull after hollows were carved from it."""
    grid = fit_grid(BOUNDS, resolution)
    cameras = views.world_to_camera, views.intrinsics
    hull = hull_sdf(*cameras, views.alphas, grid, valid=views.valid)
    return grid, hull, carve_hollows(*cameras, views.images, hull, grid, valid=views.valid)


def found(grid, hull, sdf):
    """Return the share of the hollow that was found, and the depth of the deepest cut in the wall.

    The depth is in cells.
    """
    cell = float(grid.cell_size)
    distance = bowl(grid_points(grid)) / cell
    is_hollow = (hull < 0) & (distance > 1.0)
    is_cut = (hull < 0) & (sdf >= 0) & (distance < 0)
    return (sdf[is_hollow] >= 0).mean(), -distance[is_cut].min(initial=0.0)


@pytest.fixture(scope="module")
def open_bowl():
    return photographed(bowl, painted)


def test_the_inside_of_a_bowl_is_found_and_its_wall_left(open_bowl):
    grid, hull, sdf = carved(open_bowl)
    assert ((hull < 0) & (bowl(grid_points(grid)) > 0)).sum() > 500
    share, cut_depth = found(grid, hull, sdf)
    assert share > 0.8
    assert cut_depth < 1.0
    # The outside of the wall is as it was; nothing is added.
    is_outer_wall = np.abs(hull) < 0.5
    is_outer_wall &= grid_points(grid)[:, 2] < -0.2
    np.testing.assert_array_equal(sdf[is_outer_wall], hull[is_outer_wall])
    assert (sdf >= hull).all()


def test_finer_grids_are_carved_by_what_a_coarse_one_shows(open_bowl):
    grid, hull, sdf = carved(open_bowl, resolution=60)
    share, cut_depth = found(grid, hull, sdf)
    assert share > 0.8
    assert cut_depth < 2.0
    assert (sdf >= hull).all()


def test_values_near_the_new_surface_are_distances_in_cells(open_bowl):
    grid, hull, sdf = carved(open_bowl)
    distance = bowl(grid_points(grid)) / float(grid.cell_size)
    is_near_axis = np.linalg.norm(grid_points(grid)[:, :2], axis=1) < 0.3
    is_opened = is_near_axis & (hull < -2.0) & (np.abs(distance) < 2.0)
    assert is_opened.sum() > 10
    assert np.abs(sdf - distance)[is_opened].mean() < 1.0


@pytest.fixture(scope="module")
def closed_body():
    return photographed(half_ball, painted)


@pytest.mark.parametrize("color", [mirrored, reflecting_softly])
def test_a_body_that_mirrors_stays_bit_for_bit(color):
    _, hull, sdf = carved(photographed(half_ball, color))
    np.testing.assert_array_equal(sdf, hull)


def exposed_at_random(views, spread):
    factors = np.random.default_rng(0).uniform(1 - spread, 1 + spread, (COUNT, 1, 1, 1))
    color = views.images[..., :3] * factors
    return replace(
        views, images=np.concatenate([color, views.images[..., 3:]], -1).astype(np.float32)
    )


def displaced(views, distance):
    poses = views.camera_to_world.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0.0, distance, (COUNT, 3))
    return replace(views, camera_to_world=poses)


def with_wide_masks(views, pixels):
    images = views.images.copy()
    for image, color in zip(images, np.random.default_rng(0).random((COUNT, 3)), strict=True):
        wide_mask = binary_dilation(image[..., 3] > 0.5, iterations=pixels)
        image[wide_mask & (image[..., 3] < 0.5)] = [*color, 1.0]
    return replace(views, images=images)


@pytest.mark.parametrize(
    ("disturb", "amount"),
    [(exposed_at_random, 0.0), (exposed_at_random, 0.3), (displaced, 0.15), (with_wide_masks, 3)],
)
def test_a_body_without_a_hollow_stays_bit_for_bit(closed_body, disturb, amount):
    _, hull, sdf = carved(disturb(closed_body, amount))
    np.testing.assert_array_equal(sdf, hull)


def test_noise_and_small_differences_of_exposure_hide_no_hollow(open_bowl):
    noise = np.random.default_rng(1).normal(0.0, 0.03, open_bowl.images.shape)
    noisy = open_bowl.images + np.where(open_bowl.images[..., 3:] > 0, noise, 0.0) * [1, 1, 1, 0]
    views = replace(open_bowl, images=np.maximum(noisy, 0.0).astype(np.float32))
    share, cut_depth = found(*carved(exposed_at_random(views, 0.1)))
    assert share > 0.8
    assert cut_depth < 1.0


def test_a_bowl_brighter_than_white_is_carved_alike(open_bowl):
    images = open_bowl.images * np.array([16.0, 16.0, 16.0, 1.0], np.float32)
    share, cut_depth = found(*carved(replace(open_bowl, images=images)))
    assert share > 0.8
    assert cut_depth < 1.0


def test_pixels_that_do_not_count_say_nothing(open_bowl):
    images, valid = open_bowl.images.copy(), np.ones(open_bowl.images.shape[:3], np.float32)
    valid[:, : SIZE // 2, : SIZE // 2] = 0.0
    images[:, : SIZE // 2, : SIZE // 2, :3] = np.random.default_rng(0).random(3)
    share, cut_depth = found(*carved(replace(open_bowl, images=images, valid=valid)))
    assert share > 0.6
    assert cut_depth < 1.0


def test_few_views_say_too_little():
    views = photographed(bowl, painted, count=7)
    _, hull, sdf = carved(views)
    assert sdf is hull


def test_a_run_begins_with_the_hollow_unless_it_is_told_not_to(open_bowl):
    dataset = Dataset(
        name="bowl",
        layout="memory",
        root=Path(),
        train=open_bowl,
        test=open_bowl,
        lights={},
        train_light=None,
        bounds=BOUNDS,
    )
    open_sdf, closed_sdf = (
        FlexiCubesSettings(resolution=20, hollows=hollows).start(dataset, jax.random.key(0))[1].sdf
        for hollows in (True, False)
    )
    assert ((open_sdf >= 0) & (closed_sdf < 0)).sum() > 200


def test_the_command_info_says_whether_there_is_a_hollow(open_bowl, closed_body):
    line = hollow_line(open_bowl, BOUNDS)
    share = int(re.fullmatch(r"hollows: +1, at least (\d+)% of the visual hull: .*", line)[1])
    assert 5 < share < 60
    assert hollow_line(closed_body, BOUNDS).startswith("hollows:    none")
    blank_views = replace(closed_body, images=0 * closed_body.images)
    assert hollow_line(blank_views, BOUNDS).startswith(
        "hollows:    not looked for: every mask is empty"
    )
