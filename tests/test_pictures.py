"""Sheets show every picture unchanged and in its place; normals, clay and light in colour."""

import numpy as np
import pytest

from geosplat_jax.report import pictures
from geosplat_jax.report.scales import ERROR

SHEET = np.asarray(pictures._SHEET_COLOR, np.float32)
CELL = np.asarray(pictures._CELL_COLOR, np.float32)


def flat(value, height=40, width=60):
    return np.full((height, width, 3), value, np.float32)


def find(sheet, color):
    """Rows and columns of the bounding box of one exact colour."""
    rows, columns = np.nonzero(np.all(np.abs(sheet - np.float32(color)) < 1e-6, axis=-1))
    return rows.min(), rows.max() + 1, columns.min(), columns.max() + 1


def test_every_picture_appears_unchanged_in_its_row_and_column():
    colors = [[0.11, 0.22, 0.33], [0.44, 0.55, 0.66], [0.77, 0.88, 0.99], [0.31, 0.41, 0.51]]
    rows = [
        {"truth": flat(colors[0]), "render": flat(colors[1])},
        {"truth": flat(colors[2]), "render": flat(colors[3])},
    ]
    sheet = pictures.overview_sheet(rows)
    boxes = [find(sheet, color) for color in colors]
    assert [(b[1] - b[0], b[3] - b[2]) for b in boxes] == [(40, 60)] * 4
    assert boxes[0][0] == boxes[1][0] < boxes[2][0] == boxes[3][0]
    assert boxes[0][2] == boxes[2][2] < boxes[1][2] == boxes[3][2]
    assert boxes[1][2] - boxes[0][3] == pictures._GUTTER
    assert sheet.dtype == np.float32
    assert sheet.min() >= 0
    assert sheet.max() <= 1
    np.testing.assert_array_equal(sheet[0, 0], SHEET)


def test_columns_follow_first_appearance_and_missing_pictures_leave_empty_cells():
    rows = [{"a": flat(0.5)}, {"b": flat(0.9), "a": flat(0.5)}]
    sheet = pictures.overview_sheet(rows)
    a, b, empty = find(sheet, [0.5] * 3), find(sheet, [0.9] * 3), find(sheet, CELL)
    assert b[2] > a[3]
    assert (empty[2], empty[3]) == (b[2], b[3])
    assert empty[0] == a[0]


def test_grey_and_eight_bit_pictures_are_accepted():
    grey = np.full((40, 60), 0.25, np.float32)
    bytes_ = np.full((40, 60, 1), 51, np.uint8)
    sheet = pictures.overview_sheet([{"grey": grey, "bytes": bytes_}])
    assert find(sheet, [0.25] * 3)[3] < find(sheet, [0.2] * 3)[2]


def test_pictures_of_another_size_are_fitted_into_the_cell():
    sheet = pictures.overview_sheet([{"a": flat(0.5), "b": flat(0.9, 10, 30)}])
    b = find(sheet, [0.9] * 3)
    assert (b[1] - b[0], b[3] - b[2]) == (20, 60)


def test_large_pictures_are_reduced_in_proportion(monkeypatch):
    monkeypatch.setattr(pictures, "_LARGEST_CELL", 300)
    sheet = pictures.overview_sheet([{"a": flat(0.5, 400, 600), "b": flat(0.9, 800, 900)}])
    a, b = find(sheet, [0.5] * 3), find(sheet, [0.9] * 3)
    assert (a[1] - a[0], a[3] - a[2]) == (200, 300)
    # The second picture is fitted into a cell that has the size of the first.
    assert (b[1] - b[0], b[3] - b[2]) == (200, 225)


def test_titles_labels_notes_and_light_add_room_and_ink():
    rows = [{"truth": flat(0.5, 100, 100), "render": flat(0.7, 100, 100)}] * 3
    plain_sheet = pictures.overview_sheet(rows)
    light = np.ones((16, 32, 3), np.float32)
    full_sheet = pictures.overview_sheet(
        rows, lights={"light": light}, title="Spot", row_labels=["0", "1", "2"], notes=["PSNR 30"]
    )
    assert full_sheet.shape[0] >= plain_sheet.shape[0] + 100
    assert full_sheet.shape[1] > plain_sheet.shape[1]
    title = full_sheet[: pictures._TITLE_HEIGHT, :80]
    assert np.any(title > 0.5)
    np.testing.assert_array_equal(
        find(full_sheet, [0.7] * 3)[1] - find(full_sheet, [0.7] * 3)[0], 308
    )


def test_columns_are_as_wide_as_their_names():
    rows = [{"roughness": flat(0.5, 8, 8), "true roughness": flat(0.7, 8, 8)}]
    top, bottom, left, right = find(pictures.overview_sheet(rows), [0.7] * 3)
    assert right - left >= pictures._text_width("true roughness")
    # Pixels stay square and are repeated whole.
    assert bottom - top == right - left
    assert (right - left) % 8 == 0


def test_scales_and_several_lights_stand_below_with_their_titles():
    rows = [{name: flat(0.5, 64, 100) for name in "abcd"}]
    lights = {"true light": flat(0.1, 8, 16), "light": flat(0.2, 8, 16)}
    plain_sheet = pictures.overview_sheet(rows)
    sheet = pictures.overview_sheet(rows, lights=lights, scales=[ERROR])
    # Each light is exposed by itself, so that both have the same grey here.
    strips = find(sheet, pictures.tone_map_light(lights["light"])[0, 0])
    assert strips[3] - strips[2] > 2 * 200
    bar = find(sheet, ERROR.colors[-1])
    assert bar[0] > strips[1] > plain_sheet.shape[0] - 2 * pictures._MARGIN
    ink = np.any(sheet[bar[0] : bar[1], bar[3] + 4 : bar[3] + 60] != SHEET, axis=-1)
    assert ink.any()


def test_unusable_input_is_named():
    with pytest.raises(ValueError, match="at least one picture"):
        pictures.overview_sheet([])
    with pytest.raises(ValueError, match="image 'mask'"):
        pictures.overview_sheet([{"mask": np.zeros((4, 4, 2), np.float32)}])
    with pytest.raises(ValueError, match="one a row"):
        pictures.overview_sheet([{"a": flat(0.5)}], row_labels=["x", "y"])


def test_normals_map_to_the_usual_colors_at_any_length():
    normals = np.zeros((1, 4, 3), np.float32)
    normals[0, 0], normals[0, 1], normals[0, 2] = [0, 0, 3], [-0.2, 0, 0], [0, 1e-3, 0]
    colors = pictures.normals_to_rgb(normals)
    expected = [[0.5, 0.5, 1], [0, 0.5, 0.5], [0.5, 1, 0.5]]
    np.testing.assert_allclose(colors[0, :3], expected, atol=1e-6)
    np.testing.assert_allclose(colors[0, 3], CELL, atol=1e-6)
    half_colors = pictures.normals_to_rgb(0.5 * normals, np.full((1, 4), 0.5, np.float32))
    np.testing.assert_allclose(half_colors[0, 0], (np.array([0.5, 0.5, 1]) + CELL) / 2, atol=1e-6)


def sphere_normals(size=64):
    x, y = (np.stack(np.meshgrid(np.arange(size), np.arange(size))) + 0.5) / size * 2 - 1
    is_inside = x**2 + y**2 < 1
    z = -np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normals = np.where(is_inside[..., None], np.stack([x, y, z], -1), 0).astype(np.float32)
    return normals, is_inside.astype(np.float32)


def test_clay_is_lit_from_the_upper_left_and_finite():
    clay = pictures.shade_mesh_preview(*sphere_normals())
    assert clay[20, 20].mean() > clay[32, 32].mean() - 0.1 > clay[50, 50].mean() - 0.1
    assert clay[20, 20].mean() > clay[50, 50].mean() + 0.1
    np.testing.assert_allclose(clay[0, 0], CELL, atol=1e-6)
    assert np.all((clay >= 0) & (clay <= 1))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
def test_light_display_does_not_depend_on_its_unit(scale):
    rng = np.random.default_rng(0)
    radiance = rng.lognormal(size=(8, 16, 3)).astype(np.float32)
    display = pictures.tone_map_light(radiance)
    np.testing.assert_allclose(
        pictures.tone_map_light(radiance * np.float32(scale)), display, atol=1e-4
    )
    assert 0.2 < display.mean() < 0.8


def test_light_display_survives_suns_and_darkness():
    radiance = np.full((8, 16, 3), 0.1, np.float32)
    radiance[2, 3] = 1e5
    display = pictures.tone_map_light(radiance)
    assert np.all(np.isfinite(display))
    assert display[2, 3].min() == pytest.approx(1.0)
    assert 0.3 < display[0, 0, 0] < 0.7
    assert not pictures.tone_map_light(np.zeros((4, 8, 3), np.float32)).any()
