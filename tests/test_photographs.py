"""Photographs in memory hold the values of their files, take little of it, and look like arrays."""

import json
from dataclasses import replace

import numpy as np
import pytest

from geosplat_jax.io.cameras import RefinedCamera, RefinedSplit, with_cameras
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.io.images import SceneError, read_linear, write_exr, write_png
from geosplat_jax.io.loading import KEPT_BYTES
from geosplat_jax.io.photographs import Marks, Part, PartsInMemory, Photographs, pack_marks
from geosplat_jax.io.windows import around_object

HEIGHT, WIDTH, COUNT = 60, 80, 9


def pose(index: int) -> list[list[float]]:
    """A camera on a circle, looking at the origin (z up)."""
    angle = 2 * np.pi * index / COUNT
    back = np.array([np.cos(angle), np.sin(angle), 0.3])
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
    matrix[:3, 3] = 3.0 * back
    return matrix.tolist()


@pytest.fixture
def capture(tmp_path):
    """Photographs of noise with soft masks in separate files, of 8 bits by default."""

    def write(*, bits: int = 8, suffix: str = ".png", lens: dict | None = None):
        rng = np.random.default_rng(5)
        (tmp_path / "images").mkdir()
        (tmp_path / "masks").mkdir()
        frames = []
        for index in range(COUNT):
            name = f"images/{index:02}{suffix}"
            pixels = rng.random((HEIGHT, WIDTH, 3), np.float32)
            if suffix == ".exr":
                write_exr(tmp_path / name, 3.0 * pixels)
            else:
                write_png(tmp_path / name, pixels, bits=bits)
            mask = np.zeros((HEIGHT, WIDTH, 1), np.float32)
            mask[20:40, 28:52] = rng.random((20, 24, 1)) ** 0.1
            write_png(tmp_path / f"masks/{index:02}.png", mask)
            frames.append({"file_path": name, "transform_matrix": pose(index)})
        content = {"fl_x": 90.0, "w": WIDTH, "h": HEIGHT, "frames": frames, **(lens or {})}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return write


def read(folder, **options):
    """Read a capture with a given box, which saves the computation of the visual hull."""
    return load_dataset(folder, bounds=([-0.5] * 3, [0.5] * 3), **options)


def values_of_files(folder, name, suffix=".png"):
    """Values of a view, read directly from its files as floats."""
    rgb = read_linear(folder / "images" / f"{name}{suffix}")
    alpha = read_linear(folder / "masks" / f"{name}.png", is_srgb=False)[..., :1]
    return np.concatenate([np.where(alpha > 0, rgb, 0.0), alpha], -1)


@pytest.mark.parametrize(("bits", "suffix"), [(8, ".png"), (16, ".png"), (32, ".exr")])
def test_values_are_those_of_the_files_to_the_bit(capture, bits, suffix):
    folder = capture(bits=bits, suffix=suffix)
    train = read(folder).train
    assert isinstance(train.images, Photographs)
    for name, image in zip(train.names, train.images, strict=True):
        np.testing.assert_array_equal(image, values_of_files(folder, name, suffix))
    # Only pixels of the object are stored: three colours in the bit depth of the file, and alpha in
    # 8 bits.
    covered_count = len(train) * 20 * 24
    assert train.images.nbytes == covered_count * (3 * bits // 8 + 1)


def test_what_does_not_fit_is_read_again_and_its_alpha_is_not(capture, monkeypatch):
    folder = capture()
    expected_images = np.asarray(read(folder).train.images)
    monkeypatch.setitem(KEPT_BYTES, "train", 3 * 20 * 24 * 3)
    train = read(folder).train
    images = train.images
    assert images.read_again_count == len(train) - 3
    np.testing.assert_array_equal(images, expected_images)
    np.testing.assert_array_equal(images[[4, 1]], expected_images[[4, 1]])
    for file in (folder / "images").iterdir():
        file.unlink()
    np.testing.assert_array_equal(train.alphas, expected_images[..., 3])
    with pytest.raises(SceneError, match=r"images/.*\.png does not exist"):
        np.asarray(images)


def test_reduced_and_undistorted_photographs_are_read_again_alike(capture, monkeypatch):
    folder = capture(lens={"k1": 0.3})
    kept_views = read(folder, downscale=2).train
    assert kept_views.valid is not None
    monkeypatch.setitem(KEPT_BYTES, "train", 0)
    reread_views = read(folder, downscale=2).train
    assert (kept_views.images.read_again_count, reread_views.images.read_again_count) == (
        0,
        len(reread_views),
    )
    np.testing.assert_array_equal(kept_views.images, reread_views.images)
    np.testing.assert_array_equal(kept_views.valid, reread_views.valid)


def test_windows_and_exposures_are_parts_and_quotients_of_the_whole(capture):
    train = read(capture(lens={"k1": 0.3})).train
    windows, share = around_object(train, largest=0.9)
    assert share < 0.9
    offsets = (train.intrinsics - windows.intrinsics)[:, :2, 2].astype(int)
    for index, (column, row) in enumerate(offsets):
        rows, columns = slice(row, row + windows.height), slice(column, column + windows.width)
        np.testing.assert_array_equal(windows.images[index], train.images[index][rows, columns])
        np.testing.assert_array_equal(windows.valid[index], train.valid[index][rows, columns])
    assert windows.images.nbytes == train.images.nbytes
    camera = RefinedCamera(np.eye(4), train.intrinsics[0], 1.25, 0.0, 0.0, 1, True)
    split = RefinedSplit(WIDTH, HEIGHT, dict.fromkeys(train.names, camera))
    exposed_images = with_cameras(train, split, "file").images
    np.testing.assert_array_equal(
        exposed_images[2][..., :3], train.images[2][..., :3] / np.float32(1.25)
    )
    np.testing.assert_array_equal(exposed_images[2][..., 3], train.images[2][..., 3])


def photographs(rng, shape=(4, 7, 9)):
    """Photographs whose stored parts lie anywhere, one of them empty; and the same as an array."""
    array = np.zeros((*shape, 4), np.float32)
    array[0, 2:5, 3:9] = rng.random((3, 6, 4), np.float32) + 0.1
    array[1] = rng.random(shape[1:] + (4,), np.float32) + 0.1
    array[3, :1, :1] = 0.5
    parts = PartsInMemory(len(array), 10_000)
    for index, image in enumerate(array):
        parts.add(index, Part.of(image[..., :3], image[..., 3]))
    return parts.photographs(
        *shape[1:], read=lambda index: pytest.fail("read again"), threads=1
    ), array


KEYS = [0, -1, np.int64(2), slice(None), slice(1, 3), slice(0, 0), [2, 0], np.array([3, 3])]
KEYS += [np.array([True, False, True, True]), np.ones((4, 7, 9), bool)]
KEYS += [(..., 3), (slice(None), 2), (1, 4), (slice(0, 2), 1, 2), (np.array([0, 1]), 2, 3)]


@pytest.mark.parametrize("key", KEYS, ids=str)
def test_indexing_is_that_of_an_array(key):
    stack, array = photographs(np.random.default_rng(0))
    np.testing.assert_array_equal(stack[key], array[key])
    assert stack[key].dtype == np.float32


def test_windows_may_reach_beyond_a_part_or_miss_it():
    stack, array = photographs(np.random.default_rng(1))
    corners = np.array([[1, 2], [3, 4], [0, 0], [2, 3]])
    windows = stack.windows(corners, 3, 4)
    for index, (row, column) in enumerate(corners):
        expected = array[index, row : row + 3, column : column + 4]
        np.testing.assert_array_equal(windows[index], expected)
        np.testing.assert_array_equal(windows.alphas[index], expected[..., 3])
    nested_windows = windows.windows(np.ones((4, 2), int), 2, 2)
    np.testing.assert_array_equal(nested_windows, np.asarray(windows)[:, 1:3, 1:3])
    with pytest.raises(IndexError):
        stack[4]


def test_marks_take_a_bit_and_come_back():
    marks = np.random.default_rng(2).random((5, 6, 11)) > 0.4
    marks[3] = True
    packed = Marks.of([pack_marks(image) for image in marks], 6, 11)
    np.testing.assert_array_equal(packed, marks.astype(np.float32))
    assert packed.nbytes == 4 * 6 * 2
    windows = packed.windows(np.full((5, 2), 2), 3, 7)
    np.testing.assert_array_equal(windows, marks[:, 2:5, 2:9].astype(np.float32))
    assert Marks.of([None, None], 6, 11) is None


def test_an_array_of_images_is_looked_at_and_not_copied(capture):
    train = read(capture()).train
    array = np.asarray(train.images)
    windows, _ = around_object(replace(train, images=array), largest=0.9)
    expected_windows, _ = around_object(train, largest=0.9)
    np.testing.assert_array_equal(windows.images, expected_windows.images)
    assert Photographs.of(array).nbytes == array.nbytes
