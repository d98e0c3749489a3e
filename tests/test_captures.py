"""Captures load as other programs wrote them, and every kind of damage is named."""

import json
import pickle
import shutil
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import shared_path, tiny_config

from geosplat_jax import cli
from geosplat_jax.fit.train import fit
from geosplat_jax.io.dataset import choose_downscale, describe, load_dataset, photograph_size
from geosplat_jax.io.images import MissingFileError, SceneError, read_image, write_exr, write_png
from geosplat_jax.io.layouts.colmap import list_colmap, read_points
from geosplat_jax.io.layouts.idr import _read_matrices
from geosplat_jax.io.views import ViewLight
from geosplat_jax.report.relight import load_view_light

COUNT = 10
CENTER, RADIUS, DISTANCE = np.array([3.0, -2.0, 1.0]), 0.8, 4.0
BOX = (CENTER - 1, CENTER + 1)
LENS = SimpleNamespace(fx=40.0, fy=36.0, cx=11.0, cy=12.5)
STEP = 1 / 255  # one step of eight bits


def size_of(number, *, several=True):
    """Height and width; one photograph is upright."""
    return (28, 20) if several and number == 3 else (20, 24)


def opengl_poses():
    """Cameras around the ball, none of them level: (COUNT, 4, 4) camera-to-world."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    for k, pose in enumerate(poses):
        z = 1 - 2 * (k + 0.5) / COUNT
        back = np.array([*(np.sqrt(1 - z * z) * np.array([np.cos(2.4 * k), np.sin(2.4 * k)])), z])
        right = np.cross(rng.normal(size=3), back)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
        pose[:3, 3] = CENTER + DISTANCE * back
    return poses


def opencv_extrinsics(pose):
    """R and t of x_camera = R x + t, y down and z forwards."""
    rotation = np.stack([pose[:3, 0], -pose[:3, 1], -pose[:3, 2]])
    return rotation, -rotation @ pose[:3, 3]


def photograph(pose, size):
    """Return an image (H, W, 3) of the ball, coloured by normals on grey, and a mask (H, W, 1)."""
    rotation, _ = opencv_extrinsics(pose)
    v, u = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5, indexing="ij")
    rays = np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones_like(u)], -1)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ rotation
    from_center = pose[:3, 3] - CENTER
    closest_depth = -rays @ from_center
    discriminant = RADIUS**2 - DISTANCE**2 + closest_depth**2
    is_hit = discriminant > 0
    depth = closest_depth - np.sqrt(np.where(is_hit, discriminant, 0.0))
    normals = (from_center + depth[..., None] * rays) / RADIUS
    rgb = np.where(is_hit[..., None], 0.5 + 0.5 * normals, 0.5)
    return rgb.astype(np.float32), is_hit[..., None].astype(np.float32)


def write_photographs(root, folder, *, masks="masks", several=True, rgba=False, start="view_"):
    """Write all photographs, and their masks where ``masks`` names a folder; return the names."""
    names = []
    for number, pose in enumerate(opengl_poses()):
        rgb, mask = photograph(pose, size_of(number, several=several))
        name = f"{start}{number:02d}"
        pixels = np.concatenate([rgb, mask], -1) if rgba else rgb
        write_png(root / folder / f"{name}.png", pixels)
        if masks:
            write_png(root / masks / f"{name}.png", mask)
        names.append(f"{name}.png")
    return names


def write_transforms(root, *, masks="masks", rgba=False, several=True, **more):
    names = write_photographs(root, "images", masks=None, rgba=rgba, several=several)
    frames = []
    # The frames are not in the order of their names.
    for number in [*range(5, COUNT), *range(5)]:
        pose, (height, width) = opengl_poses()[number], size_of(number, several=several)
        frame = {"file_path": f"./images/{names[number]}", "transform_matrix": pose.tolist()}
        frame |= {"w": width, "h": height, "cx": LENS.cx, "cy": LENS.cy}
        if masks:
            write_png(root / masks / f"m{number}.png", photograph(pose, (height, width))[1])
            frame["mask_path"] = f"{masks}/m{number}.png"
        frames.append(frame)
    content = {"fl_x": LENS.fx, "fl_y": LENS.fy, "camera_model": "OPENCV", "frames": frames}
    (root / "transforms.json").write_text(json.dumps({**content, "aabb_scale": 4, **more}))


def colmap_quaternion(rotation):
    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


def colmap_cameras():
    """Return number, model, size and parameters of the cameras.

    The upright photograph has a camera of its own.
    """
    parameters = (LENS.fx, LENS.fy, LENS.cx, LENS.cy)
    return [(1, 1, *size_of(0)[::-1], parameters), (7, 1, *size_of(3)[::-1], parameters)]


def colmap_images(names):
    """Return number, quaternion, translation, camera and name of every image, in reverse order."""
    images = []
    for number in reversed(range(COUNT)):
        rotation, translation = opencv_extrinsics(opengl_poses()[number])
        quaternion = colmap_quaternion(rotation)
        images.append(
            (100 + number, quaternion, translation, 7 if number == 3 else 1, names[number])
        )
    return images


def camera_bytes(cameras):
    chunks = [struct.pack("<Q", len(cameras))]
    for camera_id, model, width, height, parameters in cameras:
        chunks.append(struct.pack("<iiQQ", camera_id, model, width, height))
        chunks.append(struct.pack(f"<{len(parameters)}d", *parameters))
    return b"".join(chunks)


def image_bytes(images, *, points=2):
    chunks = [struct.pack("<Q", len(images))]
    for image_id, quaternion, translation, camera, name in images:
        chunks.append(struct.pack("<i7di", image_id, *quaternion, *translation, camera))
        chunks.append(name.encode() + b"\0" + struct.pack("<Q", points))
        chunks.append(struct.pack("<ddq", 1.5, 2.5, -1) * points)
    return b"".join(chunks)


def write_colmap(root, *, sparse="sparse/0"):
    names = write_photographs(root, "images")
    (root / sparse).mkdir(parents=True)
    (root / sparse / "cameras.bin").write_bytes(camera_bytes(colmap_cameras()))
    (root / sparse / "images.bin").write_bytes(image_bytes(colmap_images(names)))


def write_colmap_text(root):
    names = write_photographs(root, "images")
    folder = root / "sparse"
    folder.mkdir()
    lines = ["# Camera list", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, _, width, height, parameters in colmap_cameras():
        lines.append(f"{number} PINHOLE {width} {height} {' '.join(map(repr, parameters))}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for position, (number, quaternion, translation, camera, name) in enumerate(
        colmap_images(names)
    ):
        pose = " ".join(repr(float(x)) for x in (*quaternion, *translation))
        # Images without features have an empty second line.
        lines += [f"{number} {pose} {camera} {name}", "" if position % 2 else "1.5 2.5 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


SCALE = np.diag([2.0, 2.0, 2.0, 1.0]) + np.array([[0, 0, 0, c] for c in (5.0, 6.0, 7.0, 0.0)])


def write_idr(root):
    """Write a capture in whose world the object is larger and elsewhere; scale_mat undoes this."""
    write_photographs(root, "image", masks="mask", start="")
    arrays = {}
    for number, pose in enumerate(opengl_poses()):
        rotation, translation = opencv_extrinsics(pose)
        # In this layout, pixel centres lie at whole numbers.
        lens = np.array([[LENS.fx, 0, LENS.cx - 0.5], [0, LENS.fy, LENS.cy - 0.5], [0, 0, 1.0]])
        projection = np.eye(4)
        projection[:3] = -3.0 * lens @ np.concatenate([rotation, translation[:, None]], -1)
        arrays[f"world_mat_{number}"] = projection @ np.linalg.inv(SCALE)
        arrays[f"scale_mat_{number}"] = SCALE
    np.savez(root / "cameras_sphere.npz", **arrays)


def write_blended_mvs(root):
    write_photographs(root, "blended_images", start="000000")
    (root / "cams").mkdir()
    for number, pose in enumerate(opengl_poses()):
        rotation, translation = opencv_extrinsics(pose)
        rows = [*np.concatenate([rotation, translation[:, None]], -1).tolist(), [0, 0, 0, 1]]
        lines = ["extrinsic", *(" ".join(map(repr, row)) for row in rows), "", "intrinsic"]
        lines += [f"{LENS.fx} 0 {LENS.cx}", f"0 {LENS.fy} {LENS.cy}", "0 0 1", "", "2.5 0.01 128 5"]
        (root / "cams" / f"000000{number:02d}_cam.txt").write_text("\n".join(lines) + "\n")
        shutil.copy(
            root / "blended_images" / f"000000{number:02d}.png",
            root / "blended_images" / f"000000{number:02d}_masked.png",
        )


def light_of(pose):
    """Return a map (8, 16, 3) in a camera's axes that is bright where the world's +x is."""
    right, up, forward = pose[0, 0], pose[0, 1], -pose[0, 2]
    # u = .5 + atan2(x, -z) / 2 pi: forwards in the middle, +z at the left edge, y up.
    column = int((0.5 + np.arctan2(right, forward) / (2 * np.pi)) * 16) % 16
    row = min(int(np.arccos(np.clip(up, -1, 1)) / np.pi * 8), 7)
    radiance = np.full((8, 16, 3), 0.1, np.float32)
    radiance[row, column] = 20.0
    return radiance


def write_stanford_orb(root):
    """Write frames as NeRF-synthetic does, each with a lens of its own."""
    for split, view_numbers in (("train", range(2, COUNT)), ("test", range(2))):
        frames = []
        for view_number in view_numbers:
            pose, name = opengl_poses()[view_number], f"{view_number:04d}"
            rgb, mask = photograph(pose, size_of(view_number))
            write_png(root / split / f"{name}.png", rgb)
            write_png(root / f"{split}_mask" / f"{name}.png", mask)
            height, width = size_of(view_number)
            lens = {"fl_x": LENS.fx, "fl_y": LENS.fy, "cx": LENS.cx, "cy": LENS.cy}
            frame = {"file_path": f"./{split}/{name}", "transform_matrix": pose.tolist()}
            frames.append({**frame, **lens, "w": width, "h": height})
            if split == "test":
                lights = root.parent.parent / "ground_truth" / root.name / "env_map"
                write_exr(lights / f"{name}.exr", light_of(pose))
        (root / f"transforms_{split}.json").write_text(json.dumps({"frames": frames}))


WRITERS = {
    "transforms": write_transforms,
    "colmap": write_colmap,
    "colmap_text": write_colmap_text,
    "idr": write_idr,
    "blended_mvs": write_blended_mvs,
    "stanford_orb": write_stanford_orb,
}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """One pristine capture of each layout."""
    roots = {}
    for layout, write in WRITERS.items():
        root = tmp_path_factory.mktemp(layout) / "blender_LDR" / "ball"
        root.mkdir(parents=True)
        write(root)
        roots[layout] = root
    return roots


@pytest.fixture
def copied(scenes, tmp_path):
    """Copies of captures for tests that damage them."""
    return lambda layout: shutil.copytree(scenes[layout], tmp_path / "ball")


def load(root, **settings):
    """Load with given bounds, since most tests do not need to find them."""
    return load_dataset(root, **{"bounds": BOX, **settings})


def edit(root, change, *, name="transforms.json"):
    content = json.loads((root / name).read_text())
    change(content)
    (root / name).write_text(json.dumps(content))


def number_of(name):
    return int("".join(filter(str.isdigit, name))[-2:])


def refuses(root, message, kind=SceneError, **settings):
    with pytest.raises(kind, match=message) as error_info:
        load(root, **settings)
    assert "\n" not in str(error_info.value)


@pytest.mark.parametrize("layout", list(WRITERS))
def test_every_capture_is_recognised_and_read_as_it_was_written(scenes, layout):
    dataset = load(scenes[layout])
    assert dataset.layout == layout.removesuffix("_text")
    test_numbers = {0, 1} if layout == "stanford_orb" else {0, 8}
    for views, expected in (
        (dataset.test, test_numbers),
        (dataset.train, set(range(COUNT)) - test_numbers),
    ):
        numbers = [number_of(name) for name in views.names]
        assert sorted(numbers) == numbers
        assert set(numbers) == expected
        poses = opengl_poses()[numbers]
        np.testing.assert_allclose(views.camera_to_world, poses, atol=1e-6)
        lens = [[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]]
        np.testing.assert_allclose(views.intrinsics, [lens] * len(views), atol=1e-5)
        for index, number in enumerate(numbers):
            height, width = size_of(number)
            rgb, mask = photograph(opengl_poses()[number], (height, width))
            image = views.images[index, :height, :width]
            np.testing.assert_array_equal(image[..., 3:], mask)
            linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
            np.testing.assert_allclose(image[..., :3], mask * linear, atol=2 * STEP)
    assert "no split is given: 2 test views of 10, every 8th" in " ".join(dataset.notes) or (
        layout == "stanford_orb"
    )


def test_an_upright_photograph_lies_on_a_canvas_and_the_rest_does_not_count(scenes):
    dataset = load(scenes["colmap"])
    train, test = dataset.train, dataset.test
    assert train.images.shape == (8, 28, 24, 4)
    assert test.images.shape == (2, 20, 24, 4)
    assert test.valid is None
    for name, valid, image in zip(train.names, train.valid, train.images, strict=True):
        height, width = size_of(number_of(name))
        expected = np.zeros((28, 24))
        expected[:height, :width] = 1
        np.testing.assert_array_equal(valid, expected)
        assert (image[expected == 0] == 0).all()
    assert any("2 sizes are padded to 24 x 28" in warning for warning in dataset.warnings)
    share = photograph(opengl_poses()[3], size_of(3))[1].mean()
    assert train.coverage[train.names.index("view_03")] == pytest.approx(share)
    assert "pixels that count" in describe(dataset)


@pytest.mark.parametrize("layout", ["colmap", "idr"])
def test_bounds_are_those_of_the_ball_wherever_it_is(scenes, layout):
    lo, hi = load_dataset(scenes[layout]).bounds
    assert (lo < CENTER - RADIUS + 0.05).all()
    assert (hi > CENTER + RADIUS - 0.05).all()
    # The cones of eight views meet up to 1.7 radii from the middle, and a pixel is 0.1 wide.
    assert (np.sort(hi - lo) < [2.6 * RADIUS, 2.6 * RADIUS, 3.9 * RADIUS]).all()


def test_half_the_size_is_the_same_capture(scenes):
    full_views, half_views = (load(scenes["colmap"], downscale=factor).train for factor in (1, 2))
    np.testing.assert_allclose(
        half_views.intrinsics * np.array([[2], [2], [1]]), full_views.intrinsics
    )
    assert half_views.images.shape == (8, 14, 12, 4)
    assert np.asarray(half_views.valid).sum() == np.asarray(full_views.valid).sum() / 4


def test_images_are_reduced_to_half_a_cell(scenes):
    root = scenes["idr"]
    dataset = load_dataset(root)
    lo, hi = dataset.bounds
    middle = 0.5 * (lo + hi)
    distance = np.linalg.norm(dataset.train.camera_to_world[:, :3, 3] - middle, axis=1)
    pixel = np.median(distance / dataset.train.intrinsics[:, 0, 0])
    longest = (hi - lo).max()
    for cells in (1, 2, 3):
        factor = choose_downscale(root, cells).factor
        assert factor * pixel <= 0.5 * longest / cells < (factor + 1) * pixel
        assert factor > 1
        assert f"images are reduced by {factor}: a cell" in choose_downscale(root, cells).reason
    chosen = choose_downscale(root, 500)
    assert chosen.factor == 1
    assert "images stay in full size: a cell" in chosen.reason
    # A box of half the size has half as many cells of the same size.
    half = (middle - 0.25 * (hi - lo), middle + 0.25 * (hi - lo))
    assert choose_downscale(root, 1, bounds=half) == choose_downscale(root, 2)
    # It also takes the other options that tell how to read the scene.
    assert choose_downscale(root, 2, train_views=4, test_views=1) == choose_downscale(root, 2)
    for chosen in (choose_downscale, photograph_size):
        with pytest.raises(SceneError, match="layout must be one of"):
            chosen(root, *([2] if chosen is choose_downscale else []), layout="nope")


def test_bad_masks_among_the_views_that_choose_the_size_do_not_stop_it(
    scenes, tmp_path, monkeypatch
):
    root = shutil.copytree(scenes["stanford_orb"], tmp_path / "ball")
    monkeypatch.setattr("geosplat_jax.io.dataset._COARSE_VIEWS", 1)
    assert choose_downscale(root, 2) == choose_downscale(scenes["stanford_orb"], 2)
    monkeypatch.undo()
    mask = root / "test_mask" / "0000.png"
    write_png(mask, 0.0 * read_image(mask))
    assert any("is empty" in line for line in load_dataset(root).warnings)
    assert choose_downscale(root, 2) == choose_downscale(scenes["stanford_orb"], 2)


def test_the_size_of_every_photograph_is_known(scenes):
    views = load_dataset(scenes["transforms"]).train
    numbers = [int(name.removeprefix("view_")) for name in views.names]
    np.testing.assert_array_equal(views.sizes, [size_of(number) for number in numbers])
    assert len({tuple(size) for size in views.sizes}) > 1


def test_the_size_that_was_chosen_is_said(scenes, capsys):
    assert cli.main(["info", str(scenes["idr"]), "--downscale", "auto"]) == 0
    captured = capsys.readouterr()
    assert "images stay in full size" in captured.err
    assert cli.main(["info", str(scenes["idr"]), "--downscale", "2"]) == 0
    assert "reduced" not in capsys.readouterr().err


@pytest.mark.parametrize("masks", [None, "some"])
def test_without_masks_a_capture_is_shown_but_not_trained(tmp_path, masks):
    write_transforms(tmp_path, masks=None)
    if masks == "some":
        write_png(tmp_path / "masks" / "view_01.png", photograph(opengl_poses()[1], size_of(1))[1])
        return refuses(tmp_path, r"view_02\.png has no alpha channel and there is no mask file")
    dataset = load_dataset(tmp_path)
    lo, hi = dataset.bounds
    np.testing.assert_allclose((lo + hi) / 2, CENTER, atol=1e-6)
    assert 0.5 * RADIUS < (hi - lo)[0] / 2 < 0.9 * DISTANCE
    text = describe(dataset)
    assert "no masks" in text
    assert "the train and test views have no masks; training and evaluation need" in text
    with pytest.raises(SceneError, match=r"the train views of .* have no masks.*masks/NAME\.png"):
        fit(dataset, tiny_config(), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    return None


def test_masks_are_found_beside_the_images_by_either_name(tmp_path):
    write_transforms(tmp_path, masks=None)
    for number, pose in enumerate(opengl_poses()):
        name = f"view_{number:02d}.png" + (".png" if number % 2 else "")
        write_png(tmp_path / "masks" / name, photograph(pose, size_of(number))[1])
    views = load(tmp_path).train
    assert views.has_masks
    for name, image in zip(views.names, views.images, strict=True):
        height, width = size_of(number_of(name))
        expected = photograph(opengl_poses()[number_of(name)], (height, width))[1][..., 0]
        np.testing.assert_array_equal(image[:height, :width, 3], expected)


def test_images_with_alpha_need_no_masks_and_leave_those_that_are_there(tmp_path):
    write_transforms(tmp_path, masks=None, rgba=True)
    dataset = load(tmp_path)
    assert dataset.train.has_masks
    assert not any("mask" in warning for warning in dataset.warnings)
    write_png(tmp_path / "masks" / "view_04.png", np.zeros((20, 24, 1), np.float32))
    masked_dataset = load(tmp_path)
    np.testing.assert_array_equal(masked_dataset.train.images, dataset.train.images)
    message = (
        "train: 1 mask files are ignored because their images have an alpha channel, "
        "for example view_04.png"
    )
    assert message in masked_dataset.warnings


def test_an_alpha_that_is_one_in_all_photographs_cuts_nothing_out(tmp_path):
    """Screenshots and converters write such an alpha; one photograph may show only the object."""
    write_transforms(tmp_path, masks=None)
    for path in (tmp_path / "images").iterdir():
        write_png(path, np.concatenate([read_image(path), np.ones((*size(path), 1))], -1))
    dataset = load(tmp_path)
    assert not dataset.train.has_masks
    assert any("no masks" in warning for warning in dataset.warnings)
    write_transforms(tmp_path, masks=None, rgba=True)
    path = tmp_path / "images" / "view_04.png"
    write_png(path, np.concatenate([read_image(path)[..., :3], np.ones((*size(path), 1))], -1))
    assert load(tmp_path).train.has_masks


def test_an_opaque_alpha_stands_for_no_mask_file(tmp_path):
    write_transforms(tmp_path)
    for path in (tmp_path / "images").iterdir():
        write_png(path, np.concatenate([read_image(path), np.ones((*size(path), 1))], -1))
    assert load(tmp_path).train.has_masks
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    (frame,) = (x for x in content["frames"] if x["file_path"].endswith("view_04.png"))
    del frame["mask_path"]
    (tmp_path / "masks" / "view_04.png").unlink(missing_ok=True)
    path.write_text(json.dumps(content))
    refuses(tmp_path, r"view_04\.png has no alpha channel and there is no mask file")


@pytest.mark.parametrize("name", ["view_06", "view_08"])
def test_a_close_up_of_either_split_lies_outside_of_the_box(tmp_path, name):
    """Every eighth photograph is a test view; without masks the box must not depend on that."""
    write_transforms(tmp_path, masks=None)
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    (frame,) = (x for x in content["frames"] if name in x["file_path"])
    pose = np.array(frame["transform_matrix"])
    near = CENTER + 0.15 * (pose[:3, 3] - CENTER)
    pose[:3, 3] = near
    frame["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(content))
    dataset = load_dataset(tmp_path)
    assert (name in dataset.test.names) == (name == "view_08")
    lo, hi = dataset.bounds
    assert not ((near > lo) & (near < hi)).all()
    np.testing.assert_allclose((lo + hi) / 2, CENTER, atol=1e-6)


def size(path):
    return read_image(path).shape[:2]


def test_masks_of_dtu_belong_to_the_images_by_number(copied):
    root = copied("idr")
    expected = load(root).train
    for number, path in enumerate(sorted((root / "mask").iterdir())):
        path.rename(path.with_name(f"m{number:03d}.png"))
    actual = load(root).train
    assert actual.has_masks
    np.testing.assert_array_equal(actual.images, expected.images)
    # Without leading zeros, the tenth mask comes before the second in the order of names.
    for number, path in enumerate(sorted((root / "mask").iterdir())):
        path.rename(path.with_name(f"{number + 5}.png"))
    np.testing.assert_array_equal(load(root).train.images, expected.images)
    (root / "mask" / "8.png").unlink()
    refuses(root, "has 9 masks for 10 images")


def test_hidden_files_are_no_images(copied):
    root = copied("idr")
    (root / "image" / "._00.png").write_bytes(b"of a system that keeps its notes so")
    assert len(load(root).train) + len(load(root).test) == COUNT


def test_pixels_that_do_not_count_are_apart_from_the_mask(copied):
    root = copied("transforms")
    valid = np.ones((20, 24, 1), np.float32)
    valid[4:9, 6:11] = 0.0
    write_png(root / "valid" / "view_05.png", valid)
    # Masks with this name, as instant-ngp has them, mark the moving pixels, which do not count.
    moving = (1.0 - valid) * np.float32(
        [0.0, 0.0, 1.0]
    )  # black is what counts, whatever the colour
    write_png(root / "images" / "dynamic_mask_view_06.png", moving)
    for factor in (1, 2):
        views = load(root, downscale=factor).train
        for name in ("view_05", "view_06"):
            index = views.names.index(name)
            view_valid = views.valid[index][: 20 // factor, : 24 // factor]
            rows = valid[..., 0].reshape(20 // factor, factor, 24 // factor, factor)
            np.testing.assert_array_equal(view_valid, rows.min((1, 3)))
            assert (views.images[index][views.valid[index] == 0] == 0).all()
            assert (views.images[index][views.valid[index] == 1][:, 3] > 0).any()
    write_png(root / "valid" / "view_05.png", np.zeros((20, 24, 1), np.float32))
    refuses(root, "no pixel of the train view 'view_05' counts")
    write_png(root / "valid" / "view_05.png", valid[:7])
    refuses(root, r"view_05\.png is 24 x 7 pixels, but its image is 24 x 20")


def test_a_distorted_capture_becomes_a_pinhole_with_its_border_marked(tmp_path):
    write_transforms(tmp_path, several=False, k1=-0.0, p1=0.0)
    pinhole_views = load(tmp_path).train
    assert pinhole_views.valid is None
    edit(tmp_path, lambda content: content.update(k1=0.4))
    distorted_views = load(tmp_path).train
    np.testing.assert_array_equal(distorted_views.intrinsics, pinhole_views.intrinsics)
    # A corner of the pinhole image lies outside the photograph; the middle stays where it is.
    assert (distorted_views.valid[:, 0, 0] == 0).all()
    assert (distorted_views.valid[:, 12, 11] == 1).all()
    assert (np.asarray(distorted_views.images)[np.asarray(distorted_views.valid) == 0] == 0).all()
    np.testing.assert_allclose(
        distorted_views.images[:, 12, 11], pinhole_views.images[:, 12, 11], atol=0.02
    )


def test_the_split_of_nerfstudio_is_taken(copied):
    root = copied("transforms")
    names = [f"images/view_{number:02d}.png" for number in range(COUNT)]
    split = {"train_filenames": names[:6], "val_filenames": names[6:8], "test_filenames": names[9:]}
    edit(root, lambda content: content.update(split))
    dataset = load(root)
    assert dataset.train.names == tuple(f"view_{number:02d}" for number in range(6))
    assert dataset.test.names == ("view_09",)
    assert dataset.notes == ("3 views that the split of transforms.json leaves out are not used",)
    edit(root, lambda content: [content.pop("test_filenames"), content.pop("train_filenames")])
    dataset = load(root)
    assert dataset.test.names == ("view_06", "view_07")
    assert set(dataset.train.names) == {f"view_{number:02d}" for number in (0, 1, 2, 3, 4, 5, 8, 9)}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"train_filenames": ["images/view_77.png"]},
            "names 1 files that no frame has, for example 'images/v",
        ),
        ({"train_filenames": "images"}, "'train_filenames' of .* must be a list of names"),
        (
            {"train_filenames": ["images/view_00.png"], "test_filenames": ["./images/view_00.png"]},
            r"names 'images/view_00\.png' to train on and to test",
        ),
        ({"train_filenames": []}, "leaves no view to train on"),
        ({"applied_transform": [[1, 0, 0, 0]]}, "'applied_transform' of .* must be 3 x 4 finite"),
        ({"applied_transform": np.full((3, 4), np.nan).tolist()}, "must be 3 x 4 finite numbers"),
        ({"camera_model": "EQUIRECTANGULAR"}, "frame 0 of .* must be one of PINHOLE,.*EQUIRECT"),
        ({"camera_model": ["OPENCV"]}, "must be one of PINHOLE"),
        ({"latlong": True}, "frame 0 of .* has latlong, a projection that is not supported"),
        ({"equirectangular": True}, "frame 0 of .* has equirectangular, a projection that is not"),
        ({"orthographic": True}, "frame 0 of .* has orthographic, a projection that is not"),
        ({"ftheta_p0": 0.0}, "frame 0 of .* has ftheta_p0, a projection that is not supported"),
        ({"k1": np.nan}, "'k1' of frame 0 of .* must be a finite number below .* in size, got nan"),
        ({"k2": "0.1"}, "'k2' of frame 0 of .* must be a finite number"),
        ({"distortion_params": [0.1, 0.2]}, "'distortion_params' of frame 0 .* the 6 numbers k1"),
        ({"distortion_params": [0, 0, 0, 0, 0, np.inf]}, "'p2' of frame 0 of .* finite number"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 or p2, which a fisheye lens does not"),
    ],
)
def test_a_wrong_transforms_file_is_named(copied, values, message):
    root = copied("transforms")
    edit(root, lambda content: content.update(values))
    refuses(root, message)


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
@pytest.mark.parametrize("path", ["../outside.png", "/etc/hostname", "..\\outside.png"])
def test_paths_of_a_transforms_file_stay_in_the_scene(copied, key, path):
    root = copied("transforms")
    write_png(root.parent / "outside.png", np.ones((20, 24, 3), np.float32))
    edit(root, lambda content: content["frames"][2].update({key: path}))
    refuses(root, "leaves the scene folder")


def test_what_a_transforms_file_names_must_be_there(copied):
    root = copied("transforms")
    (root / "masks" / "m5.png").unlink()
    refuses(root, r"the mask of \./images/view_05\.png .* has no file m5\.png", MissingFileError)
    (root / "images" / "view_05.png").unlink()
    refuses(root, r"images/view_05\.png .* has no file view_05\.png", MissingFileError)
    edit(root, lambda content: content["frames"][0].update(mask_path=3))
    edit(root, lambda content: content["frames"][0].update(file_path="images/view_06.png"))
    refuses(root, "'mask_path' of .* must be a name")


def test_frames_that_were_sorted_out_for_their_blur_are_left_out(copied):
    root = copied("transforms")
    (root / "images" / "view_05.png").unlink()
    edit(root, lambda content: content["frames"][0].update(sharpness=20.5))
    dataset = load(root)
    names = dataset.train.names + dataset.test.names
    assert sorted(names) == [f"view_{number:02d}" for number in range(COUNT) if number != 5]
    assert dataset.notes[0].startswith("1 frames of transforms.json have no image")
    (root / "masks" / "m6.png").unlink()
    refuses(root, r"the mask of \./images/view_06\.png .* has no file m6\.png", MissingFileError)
    shutil.rmtree(root / "images")
    refuses(root, "has none of the images that transforms.json names", MissingFileError)


def write_llff(root, *, scale=1):
    """Write rows whose sizes and focal lengths are ``scale`` times those of the photographs."""
    names = write_photographs(root, "images")
    rows = []
    for number, pose in enumerate(opengl_poses()):
        right, up, backwards, position = pose[:3].T
        size = scale * np.array([*size_of(number), LENS.fx])
        matrix = np.stack([-up, right, backwards, position, size], axis=-1)
        rows.append([*matrix.ravel(), 2.0, 6.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return names


@pytest.mark.parametrize("scale", [1, 4])
def test_llff_has_a_row_for_every_photograph(tmp_path, scale):
    write_llff(tmp_path, scale=scale)
    dataset = load(tmp_path)
    assert dataset.layout == "llff"
    for views in (dataset.train, dataset.test):
        numbers = [number_of(name) for name in views.names]
        np.testing.assert_allclose(views.camera_to_world, opengl_poses()[numbers], atol=1e-6)
        for number, intrinsics in zip(numbers, views.intrinsics, strict=True):
            height, width = size_of(number)
            lens = [[LENS.fx, 0, width / 2], [0, LENS.fx, height / 2], [0, 0, 1]]
            np.testing.assert_allclose(intrinsics, lens, atol=1e-5)
        assert (views.images[..., 3].max((1, 2)) == 1).all()
    assert len(dataset.test) == 2


def test_masks_of_llff_may_have_names_of_their_own(tmp_path):
    write_llff(tmp_path)
    expected = load(tmp_path).train.images
    for number, path in enumerate(sorted((tmp_path / "masks").iterdir())):
        path.rename(path.with_name(f"{number:03d}.png"))
    np.testing.assert_array_equal(load(tmp_path).train.images, expected)


def test_a_wrong_table_of_llff_is_named(tmp_path):
    write_llff(tmp_path)
    file = tmp_path / "poses_bounds.npy"
    table = np.load(file)
    for wrong, message in (
        (table[:-1], r"17 numbers for each of the 10 images in .*images, got .* \(9, 17\)"),
        (table[:, :-1], r"got an array of shape \(10, 16\)"),
        (table * np.where(np.arange(17) == 14, -1, 1), "'f' of row 0 of .* must be a positive"),
        (table * np.where(np.arange(17) == 4, 1.001, 1), "'h' of row 0 .* whole number"),
        (table * np.where(np.arange(17) == 2, np.nan, 1), "row 0 of .* 17 finite numbers"),
        (table * np.where(np.arange(17) % 5 == 1, -1, 1), "row 0 of .* mirrors space"),
        (np.array([None]), "poses_bounds.npy is damaged"),
    ):
        np.save(file, wrong, allow_pickle=True)
        refuses(tmp_path, message)
    file.write_bytes(file.read_bytes()[:60])
    refuses(tmp_path, "poses_bounds.npy is damaged")


def test_distortion_params_and_keys_say_the_same(tmp_path):
    view_images = []
    keys = {"k1": -0.1, "k2": 0.02, "k3": 0.01, "k4": 0.005, "p1": 0.01, "p2": -0.02}
    for distortion in (keys, {"distortion_params": list(keys.values())}):
        write_transforms(tmp_path, **distortion)
        view_images.append(load(tmp_path).train.images)
    np.testing.assert_array_equal(*view_images)
    write_transforms(tmp_path, **keys, camera_model="PINHOLE")
    np.testing.assert_array_equal(load(tmp_path).train.images, view_images[0])
    write_transforms(tmp_path, is_fisheye=True)
    assert not np.array_equal(load(tmp_path).train.images, view_images[0])


def test_several_frames_of_one_file_are_refused(copied):
    root = copied("transforms")
    edit(root, lambda content: content["frames"].append(dict(content["frames"][0])))
    refuses(root, r"names 'images/view_05\.png' for two frames")


def test_a_binary_model_that_ends_early_is_refused_wherever_it_ends(copied):
    root = copied("colmap")
    for name in ("cameras.bin", "images.bin"):
        path = root / "sparse" / "0" / name
        whole_bytes = path.read_bytes()
        for size in range(0, len(whole_bytes), 7):
            path.write_bytes(whole_bytes[:size])
            with pytest.raises(SceneError, match=rf"{name} (is truncated|ends within a name)"):
                list_colmap(root)
        path.write_bytes(whole_bytes + b"\0\0\0")
        refuses(root, rf"{name} has 3 bytes more than its count says")
        for count in (0, 1, 2**63):
            path.write_bytes(struct.pack("<Q", count) + whole_bytes[8:])
            refuses(root, rf"{name} (has \d+ bytes more|is truncated)")
        path.write_bytes(whole_bytes)
    points = image_bytes(colmap_images([f"view_{k:02d}.png" for k in range(COUNT)]))
    false_points = points.replace(struct.pack("<Q", 2), struct.pack("<Q", 2**61), 1)
    path.write_bytes(false_points)
    refuses(root, r"images\.bin is truncated: \d+ more bytes are announced")


def spoiled_image(**changes):
    """Return the bytes of images, of which the first has the given changes."""
    images = colmap_images([f"view_{k:02d}.png" for k in range(COUNT)])
    fields = dict(
        zip(("number", "quaternion", "translation", "camera", "name"), images[0], strict=True)
    )
    return image_bytes([tuple({**fields, **changes}.values()), *images[1:]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quaternion": np.zeros(4)}, r"quaternion of image 'view_09\.png' .* of length 1, got 0"),
        ({"quaternion": np.full(4, np.nan)}, "quaternion of image .* of length 1, got nan"),
        ({"quaternion": np.full(4, np.inf)}, "quaternion of image .* of length 1, got inf"),
        ({"quaternion": 2 * np.eye(4)[0]}, "of length 1, got 2"),
        ({"translation": [0.0, np.nan, 1.0]}, "translation of image .* must be 3 finite numbers"),
        ({"camera": 5}, r"is of camera 5, which cameras\.bin lacks"),
        ({"name": "view_77.png"}, r"image 'view_77\.png' .* has no file view_77\.png"),
        ({"name": "../../outside.png"}, "leaves the scene folder"),
        ({"name": "/etc/hostname"}, "leaves the scene folder|has no file"),
        ({"number": 108}, r"images\.bin has the number 108 twice"),
        ({"name": "view_08.png"}, r"are both named 'view_08'; rename"),
    ],
)
def test_a_spoiled_image_of_a_model_is_named(copied, changes, message):
    root = copied("colmap")
    write_png(root.parent / "outside.png", np.ones((20, 24, 3), np.float32))
    (root / "sparse" / "0" / "images.bin").write_bytes(spoiled_image(**changes))
    refuses(root, message)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ((1, 77, 24, 20, (1.0,)), r"camera 1 of .*cameras\.bin has the unknown model 77"),
        ((1, -1, 24, 20, (1.0,)), "has the unknown model -1"),
        ((1, 7, 24, 20, (40.0,) * 5), "has the model FOV, which is not read; undistort"),
        ((1, 1, 24, 20, (np.nan, 36.0, 11.0, 12.5)), r"camera 1 .* \(PINHOLE\) must be 4 finite"),
        ((1, 1, 24, 20, (-40.0, 36.0, 11.0, 12.5)), "'fx' of camera 1 .* must be a positive"),
        ((1, 1, 0, 20, (40.0, 36.0, 11.0, 12.5)), "'w' of camera 1 .* must be a positive whole"),
        ((1, 1, 2**63, 20, (40.0, 36.0, 11.0, 12.5)), "'w' of camera 1 .* must be a positive"),
    ],
)
def test_a_spoiled_camera_of_a_model_is_named(copied, camera, message):
    root = copied("colmap")
    content = camera_bytes([camera, colmap_cameras()[1]])
    (root / "sparse" / "0" / "cameras.bin").write_bytes(content)
    refuses(root, message)


def test_half_a_model_and_an_empty_one_are_refused(copied):
    root = copied("colmap")
    (root / "sparse" / "0" / "images.bin").write_bytes(image_bytes([]))
    refuses(root, "has no registered image")
    (root / "sparse" / "0" / "cameras.bin").unlink()
    refuses(root, r"the COLMAP model has no file cameras\.bin", MissingFileError)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("cameras.txt", "1 PINHOLE", "1 PINHOLEX", "line 3 of .* has the unknown model 'PINHOLEX'"),
        ("cameras.txt", "1 PINHOLE 24", "1 PINHOLE x", "line 3 of .* must have whole numbers"),
        ("cameras.txt", " 12.5\n", "\n", r"of camera 1 .* \(PINHOLE\) must be 4 finite numbers"),
        ("cameras.txt", "1 PINHOLE 24 20", "1 PINHOLE #", "line 3 of .* must"),
        ("images.txt", " view_09.png", "", "line 2 of .* must be: number, quaternion"),
        ("images.txt", "109 ", "109 x", "line 2 of .* must have numbers|must be"),
        ("images.txt", "1.5 2.5 -1", "1.5 2.5", "line 3 of .* must hold points of three numbers"),
    ],
)
def test_a_spoiled_text_model_is_named(copied, name, old, new, message):
    root = copied("colmap_text")
    path = root / "sparse" / name
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    refuses(root, message)


@pytest.mark.parametrize("name", ["{}", "my {}", "my cat {}"])
def test_a_text_model_without_lines_of_points_is_refused(copied, name):
    """Every second image would be taken for points, since a line of points may have any length."""
    root = copied("colmap_text")
    path = root / "sparse" / "images.txt"
    header, *lines = path.read_text().splitlines()
    images = [line.rsplit(" ", 1) for line in lines[::2]]
    path.write_text("\n".join([header, *(f"{a} {name.format(b)}" for a, b in images)]) + "\n")
    refuses(root, r"line 3 of .*images\.txt")


def test_a_text_model_that_is_no_text_is_named(copied):
    root = copied("colmap_text")
    (root / "sparse" / "images.txt").write_bytes(b"\xff\xfe\x00")
    refuses(root, r"images\.txt is not a UTF-8 text file")


def test_models_beside_the_one_that_is_read_are_said(copied):
    root = copied("colmap")
    shutil.copytree(root / "sparse" / "0", root / "sparse" / "1")
    assert "of 2 models, sparse/0 is read" in load(root).notes


def test_a_distorted_colmap_camera_is_that_of_transforms(copied, tmp_path):
    """The same lens in both layouts, each of which writes its numbers in its own way."""
    root = copied("colmap")
    distortion = {"k1": -0.15, "k2": 0.03, "p1": 0.02, "p2": -0.01}
    cameras = [
        (camera_id, 4, width, height, (*parameters, *distortion.values()))
        for camera_id, _, width, height, parameters in colmap_cameras()
    ]
    (root / "sparse" / "0" / "cameras.bin").write_bytes(camera_bytes(cameras))
    other_root = tmp_path / "other"
    write_transforms(other_root, **distortion)
    actual, expected = load(root).train, load(other_root).train
    assert actual.names == expected.names
    np.testing.assert_allclose(actual.images, expected.images, atol=1e-5)
    np.testing.assert_array_equal(actual.valid, expected.valid)


def test_colmap_itself_writes_what_is_read(copied):
    pycolmap = pytest.importorskip("pycolmap")
    root = copied("colmap")
    shutil.rmtree(root / "sparse")
    model = pycolmap.Reconstruction()
    for number, _, width, height, numbers in colmap_cameras():
        camera = pycolmap.Camera(
            model="PINHOLE", width=width, height=height, params=list(numbers), camera_id=number
        )
        model.add_camera_with_trivial_rig(camera)
    for number, _, _, camera, name in colmap_images([f"view_{k:02d}.png" for k in range(COUNT)]):
        rotation, translation = opencv_extrinsics(opengl_poses()[number - 100])
        image = pycolmap.Image(name=name, camera_id=camera, image_id=number)
        image.points2D = [pycolmap.Point2D(np.array([1.5, 2.5])) for _ in range(number % 3)]
        world_pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        model.add_image_with_trivial_frame(image, world_pose)
    for position, color in POINTS:
        model.add_point3D(np.array(position), pycolmap.Track(), np.array(color, np.uint8))
    for kind, suffix in ((model.write_binary, "bin"), (model.write_text, "txt")):
        (root / "sparse" / "0").mkdir(parents=True)
        kind(str(root / "sparse" / "0"))
        assert (root / "sparse" / "0" / f"images.{suffix}").is_file()
        views = load(root).train
        numbers = [number_of(name) for name in views.names]
        assert numbers == [1, 2, 3, 4, 5, 6, 7, 9]
        np.testing.assert_allclose(views.camera_to_world, opengl_poses()[numbers], atol=1e-9)
        np.testing.assert_allclose(views.intrinsics[:, 0, 2], LENS.cx)
        points = read_points(root)
        order = np.argsort(points.positions[:, 0])
        np.testing.assert_allclose(points.positions[order], [position for position, _ in POINTS])
        np.testing.assert_allclose(points.colors[order], np.array([c for _, c in POINTS]) / 255)
        shutil.rmtree(root / "sparse")


POINTS = [((0.5, -1.0, 2.0), (255, 0, 51)), ((3.0, 4.0, -5.0), (0, 102, 255))]


def point_bytes(points=POINTS, *, count=None):
    chunks = [struct.pack("<Q", len(points) if count is None else count)]
    for point_id, (position, color) in enumerate(points):
        chunks.append(struct.pack("<Q3d3Bd", point_id, *position, *color, 0.7))
        chunks.append(struct.pack("<Q", point_id) + struct.pack("<ii", 1, 2) * point_id)
    return b"".join(chunks)


def test_points_of_a_model_are_read_in_both_kinds_of_files(tmp_path):
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    assert read_points(tmp_path) is None
    (folder / "images.bin").write_bytes(image_bytes([]))
    assert read_points(tmp_path) is None
    for name, content in (
        ("points3D.txt", b"# points\n7 0.5 -1 2 255 0 51 0.7\n9 3 4 -5 0 102 255 0.7 1 2 4 5\n"),
        ("points3D.bin", point_bytes()),
    ):
        (folder / name).write_bytes(content)
        points = read_points(tmp_path)
        np.testing.assert_array_equal(points.positions, [position for position, _ in POINTS])
        np.testing.assert_allclose(points.colors, np.array([c for _, c in POINTS]) / 255)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bin", point_bytes()[:-3], "points3D.bin is truncated"),
        ("bin", point_bytes(count=9), "points3D.bin is truncated"),
        ("bin", point_bytes(count=1), "bytes more than its count says"),
        ("bin", point_bytes([((0.0, np.nan, 1.0), (1, 2, 3))]), "points that are not finite"),
        ("txt", b"7 0.5 -1 2 255 0\n", "line 1 of .*points3D.txt must be: number, position"),
        ("txt", b"7 0.5 x 2 255 0 51 0.7\n", "line 1 of .*points3D.txt must have numbers"),
    ],
)
def test_damaged_points_are_refused(tmp_path, name, content, message):
    folder = tmp_path / "sparse"
    folder.mkdir()
    (folder / f"images.{name}").write_bytes(b"")
    (folder / f"points3D.{name}").write_bytes(content)
    with pytest.raises(SceneError, match=message):
        read_points(tmp_path)


def edit_matrices(root, change):
    path = root / "cameras_sphere.npz"
    arrays = dict(np.load(path))
    change(arrays)
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("world_mat_9"), "has 9 cameras, but .*image has 10 images"),
        (lambda a: a.pop("scale_mat_4"), "has no scale_mat_4"),
        (lambda a: a.update(world_mat_4=np.zeros((4, 4))), "world_mat_4 .* is singular"),
        (lambda a: a.update(world_mat_4=np.full((4, 4), np.nan)), "must be 4 x 4 finite numbers"),
        (lambda a: a.update(world_mat_4=np.eye(3)), "world_mat_4 of .* must be 4 x 4 finite"),
        (
            lambda a: a.update(scale_mat_4=np.eye(4) + 0.5 * np.eye(4, k=1)),
            r"world_mat_4 @ scale_mat_4 of .* has a skew of",
        ),
    ],
)
def test_wrong_projections_are_named(copied, change, message):
    root = copied("idr")
    edit_matrices(root, change)
    refuses(root, message)


def test_a_damaged_or_dangerous_archive_is_refused(copied):
    root = copied("idr")
    path = root / "cameras_sphere.npz"
    whole_bytes = path.read_bytes()
    for size in (0, 10, len(whole_bytes) // 2, len(whole_bytes) - 30):
        path.write_bytes(whole_bytes[:size])
        refuses(root, r"cameras_sphere\.npz is damaged")
    edit_source = {"world_mat_0": np.array([{"a": 1}], dtype=object)}
    np.savez(path, **edit_source, allow_pickle=True)
    refuses(root, r"cameras_sphere\.npz is damaged")
    path.write_bytes(pickle.dumps({"world_mat_0": 1}))
    refuses(root, r"cameras_sphere\.npz is damaged")
    with path.open("wb") as file:
        np.save(file, np.eye(4))
    refuses(root, r"cameras_sphere\.npz is damaged")


def test_no_flipped_byte_of_a_compressed_archive_is_a_traceback(copied):
    root = copied("idr")
    path = root / "cameras_sphere.npz"
    with np.load(path) as arrays:
        np.savez_compressed(path, **{name: arrays[name] for name in arrays.files[:2]})
    whole_bytes, refusal_count = path.read_bytes(), 0
    for offset in range(0, len(whole_bytes), 3):
        path.write_bytes(
            whole_bytes[:offset] + bytes([whole_bytes[offset] ^ 0x55]) + whole_bytes[offset + 1 :]
        )
        try:
            _read_matrices(path)
        except SceneError:
            refusal_count += 1
    assert refusal_count > 10


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("extrinsic", "extrinsics", "has no 'extrinsic'"),
        ("intrinsic\n40.0", "intrinsic\nx", r"intrinsic of .*02_cam\.txt must be numbers"),
        ("intrinsic\n40.0 0", "intrinsic\n40.0 1", "has a skew"),
        ("intrinsic\n40.0", "intrinsic\n-40.0", "'fx' of the camera .* must be a positive"),
        ("intrinsic\n40.0", "intrinsic\nnan", "must be 3 x 3 finite numbers"),
        ("0 0 0 1", "0 0 1 1", "must end in 0 0 0 1"),
        ("0 0 1\n\n2.5 0.01 128 5\n", "", "intrinsic of .* must be 9 numbers, got 6"),
    ],
)
def test_a_wrong_camera_file_is_named(copied, old, new, message):
    root = copied("blended_mvs")
    path = root / "cams" / "00000002_cam.txt"
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    refuses(root, message)


def test_a_missing_camera_file_and_missing_images_are_named(copied):
    root = copied("blended_mvs")
    (root / "cams" / "00000002_cam.txt").unlink()
    refuses(root, r"00000002\.png has no file 00000002_cam\.txt", MissingFileError)
    shutil.rmtree(root / "blended_images")
    refuses(root, "has no images in blended_images/ or images/", MissingFileError)


def test_the_light_of_a_test_view_shines_from_the_same_side_in_every_view(scenes):
    views = load(scenes["stanford_orb"]).test
    assert list(views.lights) == list(views.names)
    for light in views.lights.values():
        radiance = np.asarray(load_view_light(light).radiance)[..., 0]
        row, column = np.unravel_index(np.argmax(radiance), radiance.shape)
        # The world's +x is in the middle of the map, where four texels meet.
        assert row in (3, 4)
        assert column in (7, 8)
        assert radiance.max() > 4 * np.delete(np.delete(radiance, [3, 4], 0), [7, 8], 1).max()


def test_a_view_light_in_a_level_camera_is_the_map_of_a_world_with_y_up(tmp_path):
    """A camera that looks along +y of the z-up world: its right is x, its up is z."""
    azimuths = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rows = np.linspace(0.2, 1.0, 32)[:, None, None]  # no two sides are alike
    radiance = rows * (
        1 + 0.5 * np.stack([np.cos(azimuths), np.sin(azimuths), np.sin(2 * azimuths)], 1)
    )
    radiance = radiance.astype(np.float32)
    write_exr(tmp_path / "a.exr", radiance)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    loaded_radiance = np.asarray(load_view_light(ViewLight(tmp_path / "a.exr", pose)).radiance)
    # Forwards, +y, is in the middle of the camera's map, and at u = .5 - .25 of the world's.
    np.testing.assert_allclose(loaded_radiance, np.roll(radiance, -16, axis=1), atol=0.015)


def test_stanford_orb_needs_its_masks(copied):
    root = copied("stanford_orb")
    (root / "test_mask" / "0001.png").unlink()
    refuses(root, r"the mask of \./test/0001 .* has no file 0001\.png", MissingFileError)


def test_test_views_without_an_environment_map_are_said(scenes, tmp_path):
    root = tmp_path / "blender_LDR" / "ball"
    shutil.copytree(scenes["stanford_orb"].parents[1], tmp_path, dirs_exist_ok=True)
    next((tmp_path / "ground_truth" / "ball" / "env_map").glob("0001.exr")).unlink()
    dataset = load(root)
    assert list(dataset.test.lights) == ["0000"]
    assert "1 of 2 test views have no environment map" in dataset.notes


@pytest.mark.parametrize("layout", list(WRITERS))
def test_captures_have_one_light(scenes, layout):
    refuses(scenes[layout], "light='noon'", light="noon")


def test_a_single_photograph_is_kept_for_training(copied):
    root = copied("transforms")
    edit(root, lambda content: content.update(frames=content["frames"][:1]))
    dataset = load(root)
    assert (len(dataset.train), len(dataset.test)) == (1, 0)


@pytest.mark.parametrize(
    ("name", "chosen", "has_masks"),
    [("fox", "7 test views of 50", False), ("moldGoldCape", "15 test views of 119", True)],
)
def test_real_captures_load(name, chosen, has_masks):
    root = shared_path("real", name)
    dataset = load_dataset(root, downscale=2, train_views=12, test_views=2)
    assert dataset.layout == "transforms"
    assert chosen in dataset.notes[0]
    assert dataset.train.has_masks == has_masks
    # The fox was taken through a lens with distortion.
    assert (dataset.train.valid is None) == has_masks
    lo, hi = dataset.bounds
    assert 1.0 < (hi - lo).max() < 3.5
