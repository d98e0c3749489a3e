"""Every layout loads as written, and every kind of bad input is named."""

import json
import os
import shutil
import sys
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageCms
from support import shared_path

from geosplat_jax.io.dataset import describe, load_dataset, load_recorded
from geosplat_jax.io.frames import read_transforms
from geosplat_jax.io.images import (
    ImageReadError,
    MissingFileError,
    SceneError,
    encode_srgb,
    read_image,
    read_linear,
    write_exr,
    write_hdr,
    write_png,
)
from geosplat_jax.io.lenses import AngleLens, PinholeLens
from geosplat_jax.io.quiet import without_decoder_lines

SIZE, ANGLE, RADIUS, DISTANCE = 24, 0.7, 0.8, 4.0
ALBEDO, RADIANCE = np.array([0.8, 0.2, 0.05]), np.array([0.5, 0.25, 0.1])
ROUGHNESS = 0.4
COUNTS = {"train": 8, "test": 3}
STEP = 1 / 255  # one step of eight bits

BOX = (np.full(3, -1.0), np.full(3, 1.0))


def poses(count, *, phase=0.0):
    """Blender camera-to-world matrices on a Fibonacci sphere, looking at the origin."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k + phase
    ring = np.sqrt(1.0 - z * z)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, 2] = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)
    for matrix in matrices:
        right = np.cross([0.0, 0.0, 1.0], matrix[:3, 2])
        matrix[:3, 0] = right / np.linalg.norm(right)
        matrix[:3, 1] = np.cross(matrix[:3, 2], matrix[:3, 0])
        matrix[:3, 3] = DISTANCE * matrix[:3, 2]
    return matrices


def sphere_view(pose):
    """Alpha (H, W, 1) and world normals (H, W, 3) of the sphere at the origin."""
    focal = 0.5 * SIZE / np.tan(0.5 * ANGLE)
    pixel = (np.arange(SIZE) + 0.5 - SIZE / 2) / focal
    x, y = np.meshgrid(pixel, -pixel)
    rays = np.stack([x, y, -np.ones_like(x)], -1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    closest_depth = -rays @ pose[:3, 3]
    discriminant = RADIUS**2 - DISTANCE**2 + closest_depth**2
    alpha = (discriminant > 0.0).astype(np.float32)[..., None]
    depth = closest_depth - np.sqrt(np.maximum(discriminant, 0.0))
    normals = (pose[:3, 3] + depth[..., None] * rays) / RADIUS
    return alpha, np.where(alpha > 0, normals, 0.0).astype(np.float32)


def constant(alpha, color):
    """Return RGBA of one colour; outside the mask it is white, so that a leak would be visible."""
    rgb = np.where(alpha > 0, np.asarray(color, np.float32), 1.0)
    return np.concatenate([rgb, alpha], -1).astype(np.float32)


def transforms(root, split, paths, matrices):
    frames = [
        {"file_path": path, "transform_matrix": matrix.tolist()}
        for path, matrix in zip(paths, matrices, strict=True)
    ]
    content = {"camera_angle_x": ANGLE, "frames": frames}
    (root / f"transforms_{split}.json").write_text(json.dumps(content))


def split_poses(split):
    return poses(COUNTS[split], phase=0.3 * (split == "test"))


def encoded(color):
    return encode_srgb(np.asarray(color, np.float32))


def write_blender(root, *, shiny=False):
    for split in COUNTS:
        matrices = split_poses(split)
        for i, pose in enumerate(matrices):
            alpha, normals = sphere_view(pose)
            rgba = constant(alpha, encoded(RADIANCE))
            image = rgba[..., :3] if shiny else rgba
            write_png(root / split / f"r_{i}.png", image)
            if shiny:
                write_png(root / split / f"r_{i}_alpha.png", alpha)
                write_png(root / split / f"r_{i}_normal.png", 0.5 * normals + 0.5)
        transforms(root, split, [f"./{split}/r_{i}" for i in range(len(matrices))], matrices)


def write_tensoir(root, *, with_transforms=True, with_scene=True):
    for split in COUNTS:
        matrices = split_poses(split)
        for i, pose in enumerate(matrices):
            folder = root / f"{split}_{i:03d}"
            alpha, normals = sphere_view(pose)
            for light, gain in (("noon", 1.0), ("night", 0.5)):
                if split == "test" or light == "noon":
                    image = constant(alpha, encoded(gain * RADIANCE))
                    write_png(folder / f"rgba_{light}.png", image)
            if split == "test":
                write_png(folder / "albedo.png", constant(alpha, ALBEDO))
                write_png(folder / "roughness.png", constant(alpha, [ROUGHNESS] * 3))
                write_png(folder / "normal.png", np.concatenate([0.5 * normals + 0.5, alpha], -1))
            camera = ",".join(str(number) for number in pose.reshape(-1))
            content = {"imw": SIZE, "imh": SIZE, "cam_angle_x": ANGLE, "cam_transform_mat": camera}
            (folder / "metadata.json").write_text(json.dumps(content))
        if with_transforms:
            paths = [f"./{split}_{i:03d}/rgba" for i in range(len(matrices))]
            transforms(root, split, paths, matrices)
    if with_scene:
        (root / "scene.json").write_text(json.dumps({"train_light": "noon"}))
    write_hdr(root.parent / "noon.hdr", np.ones((4, 8, 3), np.float32))
    write_hdr(root.parent / "night.hdr", np.ones((4, 8, 3), np.float32))


def write_synthetic4relight(root):
    for split in COUNTS:
        matrices = split_poses(split)
        for i, pose in enumerate(matrices):
            alpha, _ = sphere_view(pose)
            stem = f"{split}/{i:03d}"
            if split == "train":
                write_exr(root / f"{stem}_rgb.exr", constant(alpha, 4.0 * RADIANCE)[..., :3])
                write_png(root / f"{stem}_mask.png", alpha)
                continue
            write_png(root / f"{stem}_rgba.png", constant(alpha, encoded(RADIANCE)))
            write_png(root / f"{stem}_albedo.png", constant(alpha, encoded(ALBEDO)))
            write_png(root / f"{stem}_rough.png", constant(alpha, [ROUGHNESS, 0.0, 0.0]))
            for light, gain in (("envmap6", 0.5), ("envmap12", 0.25)):
                image = constant(alpha, encoded(gain * RADIANCE))[..., :3]
                write_png(root / "test_rli" / f"{light}_{i:03d}.png", image)
        transforms(root, split, [f"{split}/{i:03d}" for i in range(len(matrices))], matrices)
    for name in ("envmap3", "envmap6", "envmap12"):
        write_exr(root.parent / f"{name}.exr", np.ones((4, 8, 3), np.float32))


WRITERS = {
    "nerf_synthetic": write_blender,
    "shiny_blender": lambda root: write_blender(root, shiny=True),
    "tensoir": write_tensoir,
    "synthetic4relight": write_synthetic4relight,
}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """One pristine scene of each layout."""
    roots = {}
    for layout, write in WRITERS.items():
        root = tmp_path_factory.mktemp(layout) / "ball"
        root.mkdir()
        write(root)
        roots[layout] = root
    return roots


@pytest.fixture
def blender(scenes, tmp_path):
    """A copy of a NeRF-synthetic scene for tests that damage it."""
    return shutil.copytree(scenes["nerf_synthetic"], tmp_path / "ball")


@pytest.fixture
def tensoir(scenes, tmp_path):
    """A copy of a TensoIR scene for tests that damage it."""
    return shutil.copytree(scenes["tensoir"], tmp_path / "ball")


def load(root, **settings):
    """Load with given bounds, since tests of bad input do not need to find them."""
    return load_dataset(root, **{"bounds": BOX, **settings})


def paint(path, colors):
    """Replace the colours of a picture, (H, W, 3), and keep its alpha."""
    pixels = np.array(read_image(path))
    pixels[..., :3] = colors
    write_png(path, pixels)


def test_a_photograph_of_one_colour_among_others_is_named(blender):
    ramp = np.broadcast_to(np.linspace(0, 1, SIZE)[:, None, None], (SIZE, SIZE, 3))
    for path in sorted((blender / "train").glob("r_*.png")):
        paint(path, ramp)
    assert not any("even colour" in warning for warning in load(blender).warnings)
    paint(blender / "train" / "r_1.png", 0.5)
    warnings = load(blender).warnings
    assert any("one even colour in 1 views, r_1; such a" in warning for warning in warnings)


def test_an_object_far_from_the_origin_is_warned_of(blender):
    def moved(content, by):
        for frame in content["frames"]:
            frame["transform_matrix"][0][3] += by

    message = "times its size away from the origin"
    assert not any(message in text for text in load(blender).warnings)
    for name in ("transforms_train.json", "transforms_test.json"):
        edit(blender, lambda content: moved(content, 5e4), name=name)
    bounds = list(np.array(BOX) + [5e4, 0.0, 0.0])
    assert any(message in text for text in load(blender, bounds=bounds).warnings)


def test_cameras_on_one_side_only_are_warned_of(blender):
    path = blender / "transforms_train.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = content["frames"][0]["transform_matrix"]
    path.write_text(json.dumps(content))
    assert any("from one side, within 0.0 degrees" in warning for warning in load(blender).warnings)


@pytest.mark.parametrize("spoil", [lambda data: data[: len(data) // 2], lambda data: data[:40]])
def test_a_damaged_picture_is_one_line_and_the_decoder_is_silent(blender, spoil, capfd):
    path = blender / "train" / "r_1.png"
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(ImageReadError) as error_info:
        load(blender)
    assert str(path) in str(error_info.value)
    assert "\n" not in str(error_info.value)
    assert capfd.readouterr().err == ""


def test_a_process_without_a_stream_of_errors_reads_scenes(scenes, monkeypatch):
    """Services and ``pythonw`` have none."""
    monkeypatch.setattr(sys, "stderr", None)
    assert len(load(scenes["nerf_synthetic"]).train)


def test_only_the_lines_of_decoders_are_kept_away(capfd):
    with without_decoder_lines(), without_decoder_lines():
        os.write(2, b"libpng error: bad\nsomething else\n")
    os.write(2, b"libpng afterwards\n")
    assert capfd.readouterr().err == "something else\nlibpng afterwards\n"


def test_every_frame_has_its_own_angle_where_it_says_so(tmp_path):
    pose = np.eye(4).tolist()
    frames = [
        {"file_path": f"r_{k}", "transform_matrix": pose, **own_lens}
        for k, own_lens in enumerate(({}, {"camera_angle_x": 0.5}, {"camera_angle_x": 0.7}))
    ]
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    assert [lens.angle_x for _, _, lens in read_transforms(path)] == [0.6, 0.5, 0.7]


def edit(root, change, *, name="transforms_train.json"):
    content = json.loads((root / name).read_text())
    change(content)
    (root / name).write_text(json.dumps(content))


def color_on_mask(image):
    return image[image[..., -1] > 0.5][:, :3].mean(0)


@pytest.mark.parametrize("layout", list(WRITERS))
def test_every_layout_is_recognised_and_read_as_it_was_written(scenes, layout):
    dataset = load(scenes[layout])
    assert (dataset.layout, dataset.name, dataset.warnings) == (layout, "ball", ())
    for split, views in (("train", dataset.train), ("test", dataset.test)):
        expected = split_poses(split)
        assert len(views) == COUNTS[split]
        np.testing.assert_allclose(views.camera_to_world, expected, atol=1e-9)
        alpha = np.stack([sphere_view(pose)[0][..., 0] for pose in expected])
        np.testing.assert_array_equal(views.images[..., 3], alpha)
        gain = 4.0 if layout == "synthetic4relight" and split == "train" else 1.0
        np.testing.assert_allclose(color_on_mask(views.images), gain * RADIANCE, atol=3 * STEP)
        assert (views.images[views.images[..., 3] == 0.0] == 0.0).all()
        assert views.images.dtype == np.float32


def test_cameras_use_opencv_axes_and_the_formula_of_blender(scenes):
    views = load(scenes["nerf_synthetic"]).test
    camera = views.camera([2, 0])
    assert (camera.height, camera.width) == (SIZE, SIZE)
    focal = 0.5 * SIZE / np.tan(0.5 * ANGLE)
    np.testing.assert_allclose(camera.intrinsics[0, 0], [focal, 0.0, SIZE / 2], rtol=1e-6)
    np.testing.assert_allclose(camera.centers, views.camera_to_world[[2, 0], :3, 3], atol=1e-5)
    origin = np.asarray(camera.world_to_camera)[:, :3, 3]
    np.testing.assert_allclose(origin, [[0.0, 0.0, DISTANCE]] * 2, atol=1e-5)
    up = np.asarray(camera.world_to_camera)[:, :3, 2]
    assert (up[:, 1] < 0.0).all()  # up in the world is against y, which points down


@pytest.mark.parametrize("layout", ["tensoir", "shiny_blender"])
def test_normals_are_unit_and_in_world_axes(scenes, layout):
    normal = load(scenes[layout]).test.truth["normal"]
    for actual, pose in zip(normal, split_poses("test"), strict=True):
        alpha, expected = sphere_view(pose)
        np.testing.assert_allclose(actual, expected, atol=2.5 * STEP)
        np.testing.assert_allclose(np.linalg.norm(actual, axis=-1), alpha[..., 0], atol=1e-5)


@pytest.mark.parametrize("layout", ["tensoir", "synthetic4relight"])
def test_materials_are_linear_whatever_the_encoding(scenes, layout):
    truth = load(scenes[layout]).test.truth
    mask = load(scenes[layout]).test.masks
    expected = np.broadcast_to(ALBEDO, truth["albedo"][mask].shape)
    np.testing.assert_allclose(truth["albedo"][mask], expected, atol=STEP)
    np.testing.assert_allclose(truth["roughness"][mask], ROUGHNESS, atol=STEP)
    assert truth["roughness"].shape[-1] == 1
    assert (truth["albedo"][~mask] == 0.0).all()


@pytest.mark.parametrize(
    ("layout", "gains"),
    [("tensoir", {"night": 0.5}), ("synthetic4relight", {"envmap6": 0.5, "envmap12": 0.25})],
)
def test_relit_views_have_colour_and_alpha(scenes, layout, gains):
    test = load(scenes[layout]).test
    assert set(test.relight) == set(gains)
    for light, gain in gains.items():
        np.testing.assert_array_equal(test.relight[light][..., 3], test.images[..., 3])
        color = color_on_mask(test.relight[light])
        np.testing.assert_allclose(color, gain * RADIANCE, atol=2 * STEP)


@pytest.mark.parametrize("factor", [2, 4])
def test_relit_views_without_alpha_are_reduced_as_those_with_it(scenes, tmp_path, factor):
    """Their background, here white, must not be averaged into the rim."""
    root = shutil.copytree(scenes["synthetic4relight"], tmp_path / "ball")
    alphas = [read_image(path)[..., 3:] for path in sorted((root / "test").glob("*_rgba.png"))]
    relit_views = []
    for with_alpha in (True, False):
        for number, alpha in enumerate(alphas):
            path = root / "test_rli" / f"envmap6_{number:03d}.png"
            color = np.where(alpha > 0, read_image(path)[..., :3], 1.0)
            write_png(path, np.concatenate([color, alpha], -1) if with_alpha else color)
        relit_views.append(load(root, downscale=factor).test.relight["envmap6"])
    np.testing.assert_allclose(relit_views[1], relit_views[0], atol=1e-5)
    # An alpha of one everywhere separates nothing.
    for path in sorted((root / "test_rli").glob("envmap6_*.png")):
        color = read_image(path)
        write_png(path, np.concatenate([color, np.ones_like(color[..., :1])], -1))
    opaque = load(root, downscale=factor).test.relight["envmap6"]
    np.testing.assert_array_equal(opaque, relit_views[1])
    rim = (relit_views[0][..., 3] > 0) & (relit_views[0][..., 3] < 1)
    assert rim.any()


def test_environment_maps_and_lights_are_found(scenes, monkeypatch):
    tensoir = load(scenes["tensoir"])
    assert tensoir.train_light == "noon"
    assert {name: path.name for name, path in tensoir.lights.items()} == {
        "noon": "noon.hdr",
        "night": "night.hdr",
    }
    monkeypatch.chdir(scenes["tensoir"])
    assert list(load(".").lights) == ["noon", "night"]
    relight = load(scenes["synthetic4relight"])
    assert relight.train_light == "envmap3"
    assert list(relight.lights) == ["envmap3", "envmap6", "envmap12"]
    assert load(scenes["nerf_synthetic"]).train_light is None


def test_tensoir_needs_no_transforms_and_no_scene_file(scenes, tmp_path):
    root = tmp_path / "ball"
    root.mkdir()
    write_tensoir(root, with_transforms=False, with_scene=False)
    scanned_dataset, listed_dataset = load(root), load(scenes["tensoir"])
    np.testing.assert_allclose(
        scanned_dataset.train.camera_to_world, listed_dataset.train.camera_to_world
    )
    np.testing.assert_array_equal(scanned_dataset.test.images, listed_dataset.test.images)
    assert scanned_dataset.train.names == listed_dataset.train.names
    assert scanned_dataset.train_light == "noon"


def test_bounds_are_those_of_the_object(scenes):
    lo, hi = load_dataset(scenes["nerf_synthetic"]).bounds
    assert (lo < -RADIUS + 0.05).all()
    assert (hi > RADIUS - 0.05).all()
    assert ((hi - lo) < 3.2 * RADIUS).all()


def test_reduced_views_are_the_same_cameras(scenes):
    full_dataset, half_dataset = (load(scenes["tensoir"], downscale=factor) for factor in (1, 2))
    assert half_dataset.train.images.shape == (COUNTS["train"], SIZE // 2, SIZE // 2, 4)
    scale = np.array([[2.0], [2.0], [1.0]])
    np.testing.assert_allclose(half_dataset.train.intrinsics * scale, full_dataset.train.intrinsics)
    np.testing.assert_allclose(
        half_dataset.train.images[..., 3].mean(),
        full_dataset.train.images[..., 3].mean(),
        rtol=1e-6,
    )
    for key, values in half_dataset.test.truth.items():
        assert values.shape[:3] == half_dataset.test.images.shape[:3], key
    length = np.linalg.norm(half_dataset.test.truth["normal"], axis=-1)
    np.testing.assert_allclose(length[half_dataset.test.masks], 1.0, atol=1e-5)


@pytest.mark.parametrize("factor", [-1, 0, 10**6])
def test_factors_that_no_image_can_be_reduced_by_are_refused(blender, factor):
    with pytest.raises(SceneError, match=f"between 1 and the image size, got {factor} for"):
        load_dataset(blender, downscale=factor)


def test_a_size_that_does_not_divide_is_cut_and_said(scenes):
    dataset = load(scenes["nerf_synthetic"], downscale=5)
    assert dataset.train.images.shape[1:3] == (4, 4)
    assert dataset.train.intrinsics[0, 0, 2] == SIZE / 2 / 5
    assert any("cut to a multiple of the downscale factor 5" in w for w in dataset.warnings)


def test_limits_spread_over_the_views(scenes):
    dataset = load(scenes["nerf_synthetic"], train_views=3, test_views=1)
    assert dataset.train.names == ("r_0", "r_4", "r_7")
    assert dataset.test.names == ("r_0",)
    with pytest.raises(SceneError, match="train_views must be at least 1, got 0"):
        load(scenes["nerf_synthetic"], train_views=0)


def test_describe_tells_what_a_user_asks(scenes):
    text = describe(load(scenes["tensoir"]))
    for phrase in (
        "8 views of 24 x 24",
        "albedo, normal, roughness",
        "night.hdr",
        "bounds",
        "noon",
    ):
        assert phrase in text


def test_ground_truth_is_read_when_first_asked_for(tensoir):
    (tensoir / "test_001" / "albedo.png").write_text("no image")
    truth = load(tensoir).test.truth
    assert truth["normal"] is truth["normal"]
    with pytest.raises(ImageReadError, match="not a readable image"):
        truth["albedo"]


def test_ground_truth_of_some_views_only_is_left_out_and_said(tensoir):
    (tensoir / "test_001" / "albedo.png").unlink()
    dataset = load(tensoir)
    assert "albedo" not in dataset.test.truth
    assert any("'albedo' is left out: only 2 of 3" in warning for warning in dataset.warnings)


def test_a_folder_that_is_no_scene_says_what_was_expected(tmp_path):
    with pytest.raises(SceneError, match=r"no known layout; expected transforms_train\.json"):
        load_dataset(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(SceneError, match=r"transforms\.json has no key 'frames'"):
        load_dataset(tmp_path)
    with pytest.raises(MissingFileError, match="scene folder .* does not exist"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(SceneError, match="layout must be one of"):
        load_dataset(tmp_path, layout="bundler")


def test_a_missing_image_names_the_frame(blender):
    (blender / "train" / "r_3.png").unlink()
    with pytest.raises(MissingFileError, match=r"train/r_3 of transforms_train\.json has no file"):
        load(blender)


def test_an_unreadable_image_is_named(blender):
    (blender / "train" / "r_3.png").write_bytes(b"\x89PNG\r\n\x1a\n broken")
    with pytest.raises(ImageReadError, match=r"r_3\.png"):
        load(blender)


def test_a_capture_may_have_no_test_views(blender):
    (blender / "transforms_test.json").unlink()
    dataset = load(blender)
    assert len(dataset.test) == 0
    assert len(dataset.train) > 0
    assert dataset.test.images.shape[1:] == dataset.train.images.shape[1:]
    assert any("no test views" in warning for warning in dataset.warnings)
    assert "none" in describe(dataset)


def test_missing_training_views_are_named(blender):
    listing = (blender / "transforms_train.json").read_text().replace("r_0", "r_99")
    (blender / "transforms_train.json").write_text(listing)
    with pytest.raises(MissingFileError, match=r"r_99\.png or r_99\.jpg.* or r_99\.exr"):
        load(blender)


LENS = {"fl_x": 40.0, "fl_y": 30.0, "cx": 13.5, "cy": 10.25, "w": SIZE, "h": SIZE}
INTRINSICS = np.array([[40.0, 0.0, 13.5], [0.0, 30.0, 10.25], [0.0, 0.0, 1.0]])


def with_lens(root, lens, *, split="train"):
    """Replace the angle of view in a file by a lens."""

    def change(content):
        del content["camera_angle_x"]
        content.update(lens)

    edit(root, change, name=f"transforms_{split}.json")
    return root


@pytest.mark.parametrize("factor", [1, 2])
def test_a_lens_off_the_centre_reaches_the_cameras_exactly(blender, factor):
    views = load(with_lens(blender, LENS), downscale=factor).train
    expected = INTRINSICS / np.array([[factor], [factor], [1]])
    np.testing.assert_array_equal(views.intrinsics, np.stack([expected] * COUNTS["train"]))
    # Halves of these numbers are exact in float32, too.
    np.testing.assert_array_equal(views.camera([3]).intrinsics[0], expected)


@pytest.mark.parametrize("layout", ["tensoir", "synthetic4relight"])
def test_every_layout_with_transforms_takes_a_whole_lens(scenes, tmp_path, layout):
    root = shutil.copytree(scenes[layout], tmp_path / "ball")
    for split in COUNTS:
        with_lens(root, LENS, split=split)
    dataset = load(root)
    for views in (dataset.train, dataset.test):
        np.testing.assert_array_equal(views.intrinsics, np.stack([INTRINSICS] * len(views)))


@pytest.mark.parametrize("cx", [-10.0, 0, 3.0 * SIZE])
def test_a_principal_point_may_lie_outside_of_the_image(blender, cx):
    views = load(with_lens(blender, {**LENS, "cx": cx}), bounds=(-np.ones(3), np.ones(3))).train
    assert (views.intrinsics[:, 0, 2] == cx).all()


def test_a_frame_may_have_a_lens_of_its_own(blender):
    edit(with_lens(blender, LENS), lambda c: c["frames"][2].update(fl_x=50.0, cx=11.0))
    intrinsics = load(blender).train.intrinsics
    np.testing.assert_array_equal(intrinsics[2], [[50.0, 0, 11.0], [0, 30.0, 10.25], [0, 0, 1.0]])
    np.testing.assert_array_equal(intrinsics[[1, 3]], np.stack([INTRINSICS] * 2))


def test_a_lens_of_larger_images_is_scaled_to_those_on_disk(blender):
    lens = {"fl_x": 80.0, "fl_y": 90.0, "cx": 27.0, "cy": 30.75, "w": 2 * SIZE, "h": 3 * SIZE}
    intrinsics = load(with_lens(blender, lens)).train.intrinsics[0]
    np.testing.assert_array_equal(intrinsics, INTRINSICS)


@pytest.mark.parametrize(
    ("width", "height", "said"),
    [(24, 12, None), (12, 24, "stored on their side"), (24, 24, "were cropped")],
)
def test_images_of_another_shape_than_their_lens_are_noticed(tmp_path, width, height, said):
    """The lens has 48 x 24 pixels; images have half that size, or are turned or cropped as well."""
    lens = {"fl_x": 60.0, "w": 48, "h": 24}
    (tmp_path / "images").mkdir()
    frames = []
    for number, pose in enumerate(poses(4)):
        pixels = np.zeros((height, width, 4), np.float32)
        pixels[3:-3, 3:-3] = 1.0
        write_png(tmp_path / "images" / f"{number}.png", pixels)
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    warnings = load_dataset(tmp_path, bounds=((-0.5,) * 3, (0.5,) * 3)).warnings
    proportion_warnings = [warning for warning in warnings if "not in proportion" in warning]
    assert len(proportion_warnings) == 2 * (said is not None)
    assert all(said in warning for warning in proportion_warnings)


def test_what_a_lens_leaves_out_is_square_and_centred(blender):
    lens = {"fl_x": 40.0, "w": SIZE, "h": SIZE, "k1": 0.0, "p2": 0}
    intrinsics = load(with_lens(blender, lens)).train.intrinsics[0]
    middle = SIZE / 2
    np.testing.assert_array_equal(intrinsics, [[40.0, 0, middle], [0, 40.0, middle], [0, 0, 1.0]])


@pytest.mark.parametrize("size", [{"w": SIZE, "h": SIZE}, {}])
def test_a_vertical_angle_gives_the_vertical_focal_length(blender, size):
    with_lens(blender, {"camera_angle_x": 0.8, "camera_angle_y": 0.4, **size})
    intrinsics = load(blender).train.intrinsics[0]
    assert intrinsics[0, 0] == pytest.approx(0.5 * SIZE / np.tan(0.4))
    assert intrinsics[1, 1] == pytest.approx(0.5 * SIZE / np.tan(0.2))


@pytest.mark.parametrize("size", [{"w": SIZE, "h": SIZE}, {}])
def test_angles_may_be_given_in_degrees(blender, size):
    with_lens(blender, {"x_fov": 40.0, "y_fov": 20.0, **size})
    intrinsics = load(blender).train.intrinsics[0]
    expected_focals = 0.5 * SIZE / np.tan(np.radians([20.0, 10.0]))
    np.testing.assert_allclose(np.diag(intrinsics)[:2], expected_focals)


@pytest.mark.parametrize("angle", [0.0, 180.0, "40", None])
def test_impossible_angles_in_degrees_are_refused(blender, angle):
    with_lens(blender, {"x_fov": angle, "w": SIZE, "h": SIZE})
    with pytest.raises(SceneError, match=r"'x_fov' of frame 0 of .* must be in \(0, 180\) degrees"):
        load(blender)


def test_an_angle_in_two_units_is_refused(blender):
    edit(blender, lambda content: content.update(x_fov=40.0))
    with pytest.raises(SceneError, match="both 'x_fov' and 'camera_angle_x'; remove one"):
        load(blender)


def test_an_angle_gives_the_focal_length_that_a_lens_lacks(blender):
    edit(blender, lambda content: content.update(cx=9.0, w=SIZE, h=SIZE))
    focal = 0.5 * SIZE / np.tan(0.5 * ANGLE)
    intrinsics = load(blender).train.intrinsics[0]
    np.testing.assert_allclose(intrinsics, [[focal, 0, 9.0], [0, focal, SIZE / 2], [0, 0, 1.0]])


@pytest.mark.parametrize("error", [-0.009, 0.009])
def test_a_lens_that_spells_out_the_angle_is_taken_at_its_word(blender, error):
    focal = (1 + error) * 0.5 * SIZE / np.tan(0.5 * ANGLE)
    edit(blender, lambda content: content.update(LENS, fl_x=focal))
    assert load(blender).train.intrinsics[0, 0, 0] == focal


@pytest.mark.parametrize("error", [-0.011, 0.011])
def test_a_lens_that_contradicts_the_angle_is_refused(blender, error):
    focal = (1 + error) * 0.5 * SIZE / np.tan(0.5 * ANGLE)
    edit(blender, lambda content: content["frames"][1].update(LENS, fl_x=focal))
    with pytest.raises(SceneError, match="frame 1 of .* contradicts itself: with w = 24, fl_x is"):
        load(blender)


def test_a_distorted_lens_bends_truth_and_images_alike(scenes, tmp_path):
    root = shutil.copytree(scenes["shiny_blender"], tmp_path / "ball")
    for name in ("transforms_train.json", "transforms_test.json"):
        edit(root, lambda content: content.update(k1=0.5), name=name)
    pinhole_views, distorted_views = load(scenes["shiny_blender"]).test, load(root).test
    # The ball's rim is 7 pixels from the axis, at a focal length of 33. The lens shows it further
    # out, so it is nearer to the axis in the pinhole image.
    assert 0.8 < distorted_views.images[..., 3].sum() / pinhole_views.images[..., 3].sum() < 0.99
    assert distorted_views.valid is not None
    inside = distorted_views.images[..., 3] > 0.999
    normal = distorted_views.truth["normal"]
    np.testing.assert_allclose(np.linalg.norm(normal[inside], axis=-1), 1.0, atol=1e-5)
    assert (normal[distorted_views.images[..., 3] == 0] == 0).all()
    view_directions = distorted_views.camera_to_world[:, :3, 2]
    facing = np.einsum("vhwc,vc->vhw", normal, view_directions)
    assert (facing[inside] > 0).all()


def test_truth_of_another_size_is_named_and_not_its_image(scenes, tmp_path):
    root = shutil.copytree(scenes["shiny_blender"], tmp_path / "ball")
    path = root / "test" / "r_0_normal.png"
    write_png(path, read_image(path)[::2, ::2, :3])
    with pytest.raises(SceneError, match=r"r_0_normal\.png is \d+ x \d+ pixels, but its view is"):
        _ = load(root, downscale=2).test.truth["normal"]


def test_an_image_of_any_format_may_be_named_with_its_ending(blender):
    """In this layout names may lack their endings, and then only the usual endings are tried."""
    for path in sorted((blender / "train").glob("r_?.png")):
        write_png(path.with_suffix(".tga.png"), read_image(path))
        path.with_suffix(".tga.png").rename(path.with_suffix(".tga"))
        path.unlink()

    def name_them(content):
        for frame in content["frames"]:
            frame["file_path"] += ".tga"

    edit(blender, name_them)
    assert len(load(blender).train)


@pytest.mark.parametrize("key", list(LENS))
def test_every_number_of_a_lens_is_checked(blender, key):
    kind = "finite" if key in ("cx", "cy") else "positive"
    location = rf"frame 2 of .*transforms_train\.json must be a {kind}"
    with_lens(blender, LENS)
    wrong_values = [np.nan, np.inf, "wide", None, True, [1.0], 10**400]
    if kind == "positive":
        wrong_values += [0, -3.0]
    for value in [*wrong_values, SIZE + 0.5] if key in ("w", "h") else wrong_values:
        edit(blender, lambda content, v=value: content["frames"][2].update({key: v}))
        with pytest.raises(SceneError, match=f"'{key}' of {location}") as error_info:
            load(blender)
        assert "\n" not in str(error_info.value)


def test_a_lens_needs_the_size_of_its_image_and_a_focal_length(blender):
    angle = json.loads((blender / "transforms_train.json").read_text())["camera_angle_x"]
    with_lens(blender, {"fl_x": 40.0, "cx": 12.0})
    with pytest.raises(SceneError, match="lens of frame 0 of .* has fl_x, cx but no w and no h"):
        load(blender)
    edit(blender, lambda content: content.update(camera_angle_x=angle, w=SIZE))
    with pytest.raises(SceneError, match="lens of frame 0 of .* has fl_x, cx, w but no h"):
        load(blender)
    with_lens(blender, {"fl_y": 40.0, "h": SIZE})
    edit(blender, lambda content: content.pop("fl_x"))
    with pytest.raises(SceneError, match="has no key 'camera_angle_x'"):
        load(blender)


def test_an_angle_is_the_pinhole_lens_that_it_describes():
    angle = AngleLens(ANGLE)
    for width, height in ((SIZE, SIZE), (30, 20)):
        focal = 0.5 * width / np.tan(0.5 * ANGLE)
        pinhole = PinholeLens(focal, focal, width / 2, height / 2, width, height)
        for factor in (1, 3):
            size = (factor * width, factor * height)
            np.testing.assert_allclose(pinhole.intrinsics(*size), angle.intrinsics(*size))
    assert hash(angle) == hash(AngleLens(ANGLE))


def test_equal_views_have_one_fingerprint_and_others_another(scenes):
    views = load(scenes["nerf_synthetic"]).test
    text = views.fingerprint()
    assert load(scenes["nerf_synthetic"]).test.fingerprint() == text
    moved_poses = views.camera_to_world.copy()
    moved_poses[1, 0, 3] += 1e-9
    longer_lenses = views.intrinsics.copy()
    longer_lenses[2, 0, 0] += 1e-9
    variants = [
        replace(views, camera_to_world=moved_poses),
        replace(views, intrinsics=longer_lenses),
        replace(views, names=("r_0", "r_2", "r_1")),
        replace(views, images=views.images[:, :-1]),
        replace(views, images=views.images[:, :, :-1]),
        load(scenes["nerf_synthetic"]).train,
    ]
    assert len({text, *(variant.fingerprint() for variant in variants)}) == len(variants) + 1


def test_a_dataset_remembers_how_it_was_read(scenes):
    corners = ((-1, -1.5, -1), (1, 1, np.float64(2.0)))
    dataset = load_dataset(scenes["tensoir"], downscale=2, light="noon", bounds=corners)
    options = {"downscale": 2, "light": "noon", "bounds": [-1.0, -1.5, -1.0, 1.0, 1.0, 2.0]}
    assert dataset.options == options
    # The options pass through JSON, as in the record of a run.
    reread_dataset = load_recorded(scenes["tensoir"], json.loads(json.dumps(dict(dataset.options))))
    assert reread_dataset.options == options
    assert reread_dataset.train.fingerprint() == dataset.train.fingerprint()
    np.testing.assert_array_equal(reread_dataset.bounds, dataset.bounds)


def test_the_options_of_a_plain_reading_leave_everything_open(blender):
    dataset = load_dataset(blender)
    assert dataset.options == {"downscale": 1, "light": None, "bounds": None}
    for options in (dataset.options, {}):
        np.testing.assert_array_equal(load_recorded(blender, options).bounds, dataset.bounds)


def test_two_views_of_one_name_are_refused(blender):
    path = blender / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"].append(content["frames"][0])
    path.write_text(json.dumps(content))
    with pytest.raises(SceneError, match="1 image names occur more than once .* 'r_0'"):
        load(blender)


def test_images_of_another_size_are_named(blender):
    write_png(blender / "train" / "r_3.png", np.ones((SIZE, SIZE + 2, 4), np.float32))
    with pytest.raises(SceneError, match=r"r_3\.png is 26 x 24 pixels, but .*r_0\.png is 24 x 24"):
        load(blender)


def test_a_mask_of_another_size_is_named(scenes, tmp_path):
    root = shutil.copytree(scenes["synthetic4relight"], tmp_path / "ball")
    write_png(root / "train" / "002_mask.png", np.ones((3, 4, 1), np.float32))
    with pytest.raises(SceneError, match=r"mask .*002_mask\.png is 4 x 3 pixels"):
        load(root)


def test_truth_of_another_size_is_named(tensoir):
    write_png(tensoir / "test_001" / "albedo.png", np.ones((3, 4, 4), np.float32))
    truth = load(tensoir).test.truth
    with pytest.raises(SceneError, match=r"albedo\.png is 4 x 3 pixels"):
        truth["albedo"]


@pytest.mark.parametrize("channels", [2, 4])
def test_a_mask_may_be_the_alpha_of_a_cut_out(scenes, tmp_path, channels):
    """Its colours say nothing about the object's outline, and are ignored."""
    root = shutil.copytree(scenes["synthetic4relight"], tmp_path / "scene")
    for path in (root / "train").glob("*_mask.png"):
        mask = read_image(path)
        colors = np.full((*mask.shape[:2], channels - 1), 0.2, np.float32)
        write_png(path, np.concatenate([colors, mask[..., :1]], -1))
    expected = load(scenes["synthetic4relight"]).train
    np.testing.assert_array_equal(np.asarray(load(root).train.alphas), np.asarray(expected.alphas))


def test_masks_that_are_numbers_or_colours_of_labels_are_noticed(scenes, tmp_path):
    """Masks of label 1 would be read as empty, and masks of colour 128 as half transparent."""
    root = shutil.copytree(scenes["synthetic4relight"], tmp_path / "scene")
    masks = {path: read_image(path) > 0.5 for path in (root / "train").glob("*_mask.png")}
    for path, mask in masks.items():
        write_png(path, mask * (128 / 255))
    assert any("255 on the object" in warning for warning in load(root).warnings)
    for path, mask in masks.items():
        write_png(path, mask * (1 / 255))
    with pytest.raises(SceneError, match="must be 255 on the object"):
        load(root)
    assert not any("opaque" in warning for warning in load(scenes["synthetic4relight"]).warnings)


@pytest.mark.parametrize(("name", "warns"), [("Display P3", True), ("sRGB IEC61966-2.1", False)])
def test_photographs_of_a_wide_colour_space_are_warned_of(blender, name, warns):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    built_in_name = "sRGB built-in".encode("utf-16-be")
    assert built_in_name in profile
    path = blender / "train" / "r_0.png"
    with Image.open(path) as image:
        renamed_profile = profile.replace(built_in_name, name[:13].ljust(13).encode("utf-16-be"))
        image.save(path, icc_profile=renamed_profile)
    profile_warnings = [warning for warning in load(blender).warnings if "read as sRGB" in warning]
    assert (len(profile_warnings) == 1) == warns
    assert all("Display P3" in warning for warning in profile_warnings)


def test_images_without_alpha_and_mask_are_refused(blender):
    write_png(blender / "train" / "r_3.png", np.ones((SIZE, SIZE, 3), np.float32))
    with pytest.raises(SceneError, match=r"r_3\.png has no alpha channel and there is no mask"):
        load(blender)


def test_one_empty_mask_warns_and_only_empty_masks_stop(blender):
    empty = np.zeros((SIZE, SIZE, 4), np.float32)
    write_png(blender / "train" / "r_3.png", empty)
    assert any("mask of 1 views is empty, r_3" in warning for warning in load(blender).warnings)
    assert load_dataset(blender).bounds[1][0] > 0.5
    for i in range(COUNTS["train"]):
        write_png(blender / "train" / f"r_{i}.png", empty)
    with pytest.raises(SceneError, match="mask of every train view is empty"):
        load(blender)


def test_images_that_were_not_cut_out_warn(blender):
    for i in range(COUNTS["train"]):
        write_png(blender / "train" / f"r_{i}.png", np.ones((SIZE, SIZE, 4), np.float32))
    assert any("every mask is full" in warning for warning in load(blender).warnings)
    # Where their hull reaches the cameras, masks are to blame and not the poses.
    with pytest.raises(SceneError, match=r"every mask is full.*cut out"):
        load_dataset(blender, bounds=(np.full(3, -9.0), np.full(3, 9.0)))


@pytest.mark.parametrize(("value", "message"), [(np.nan, "not finite"), (-1.0, "negative")])
def test_exr_pixels_that_are_no_light_are_located(scenes, tmp_path, value, message):
    root = shutil.copytree(scenes["synthetic4relight"], tmp_path / "ball")
    path = str(root / "train" / "002_rgb.exr")
    sink = oiio.ImageOutput.create(path)
    assert sink.open(path, oiio.ImageSpec(SIZE, SIZE, 3, oiio.FLOAT))
    assert sink.write_image(np.full((SIZE, SIZE, 3), value, np.float32))
    assert sink.close()
    with pytest.raises(SceneError, match=rf"002_rgb\.exr has .* {message}"):
        load(root)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda m: np.diag([1.0, 1.0, 0.0, 1.0]) @ m, "singular"),
        (lambda m: np.diag([2.0, 2.0, 2.0, 1.0]) @ m, r"not rigid: it stretches by \[2.0"),
        (lambda m: m @ (np.eye(4) + 0.5 * np.eye(4, k=1) * (np.arange(4) == 1)), "not rigid"),
        (lambda m: m @ np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrors space"),
        (lambda m: m.T, "transposed"),
        (lambda m: m * np.nan, "4 x 4 finite numbers"),
        (lambda m: m[:3], "4 x 4 finite numbers"),
        (lambda m: np.full((4, 4), "x"), "4 x 4 numbers"),
    ],
)
def test_poses_that_are_no_rigid_motion_are_named(blender, spoil, message):
    def change(content):
        frame = content["frames"][2]
        frame["transform_matrix"] = spoil(np.array(frame["transform_matrix"])).tolist()

    edit(blender, change)
    with pytest.raises(SceneError, match=f"pose of frame 2 of .*{message}"):
        load(blender)


def test_rounded_poses_become_exactly_rigid(blender):
    def change(content):
        for frame in content["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()

    edit(blender, change)
    rotation = load(blender).train.camera_to_world[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), identity, atol=1e-12)


def test_a_camera_inside_the_object_is_named(blender):
    def change(content):
        content["frames"][2]["transform_matrix"][0][3] = 0.0
        content["frames"][2]["transform_matrix"][1][3] = 0.1
        content["frames"][2]["transform_matrix"][2][3] = 0.0

    edit(blender, change)
    with pytest.raises(SceneError, match="1 cameras are inside the object's bounds, r_2"):
        load(blender)


def test_bounds_are_checked(blender):
    for bounds in (
        ((0, 0, 0), (1, 1, -1)),
        ((0, 0), (1, 1)),
        ((0, 0, 0), (1, 1, np.nan)),
        ((0, 0, 0),),
    ):
        with pytest.raises(SceneError, match="bounds must be lo"):
            load(blender, bounds=bounds)


def test_bounds_that_cut_the_object_are_told(blender):
    lo, hi = load_dataset(blender).bounds
    middle, half = 0.5 * (lo + hi), 0.5 * (hi - lo)

    def cuts(size):
        warnings = load(blender, bounds=(middle - size * half, middle + size * half)).warnings
        return [text for text in warnings if "outside the given bounds" in text]

    assert not cuts(1.0)
    (text,) = cuts(0.4)
    assert "open there" in text


def test_cameras_that_look_past_each_other_say_so(blender):
    def change(content):
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, :3] = matrix[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # look outwards
            frame["transform_matrix"] = matrix.tolist()

    edit(blender, change)
    with pytest.raises(SceneError, match="cannot find the object"):
        load_dataset(blender)


def test_json_that_is_not_json_is_named(blender):
    (blender / "transforms_train.json").write_text('{"frames": [')
    with pytest.raises(SceneError, match=r"transforms_train\.json is not JSON"):
        load(blender)
    (blender / "transforms_train.json").write_text("[1]")
    with pytest.raises(SceneError, match="must hold a JSON object, got list"):
        load(blender)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("frames"), "has no key 'frames'"),
        (lambda c: c.pop("camera_angle_x"), "has no key 'camera_angle_x'"),
        (lambda c: c["frames"][1].pop("file_path"), "frame 1 of .* has no key 'file_path'"),
        (lambda c: c["frames"][1].pop("transform_matrix"), "has no key 'transform_matrix'"),
        (lambda c: c["frames"].clear(), "has no frames"),
        (lambda c: c["frames"].insert(0, 3), "frame 0 of .* must be an object, got int"),
        (lambda c: c["frames"][0].update(file_path=7), "must be a name, got 7"),
        (lambda c: c.update(camera_angle_x=40), r"must be in \(0, pi\) radians, got 40"),
        (lambda c: c.update(camera_angle_x="wide"), "radians, got 'wide'"),
    ],
)
def test_missing_and_wrong_keys_are_named(blender, change, message):
    edit(blender, change)
    with pytest.raises(SceneError, match=message):
        load(blender)


@pytest.mark.parametrize(
    "path", ["../outside", "train/../../outside", "/etc/hostname", "C:\\outside", "..\\outside"]
)
def test_paths_that_climb_out_of_the_scene_are_refused(blender, path):
    write_png(blender.parent / "outside.png", np.ones((SIZE, SIZE, 4), np.float32))
    edit(blender, lambda content: content["frames"][0].update(file_path=path))
    with pytest.raises(SceneError, match="leaves the scene folder"):
        load(blender)


def test_names_that_no_file_can_have_are_refused(blender):
    def change(content):
        content["frames"][0]["file_path"] = "train/\0r_0"

    edit(blender, change)
    with pytest.raises(SceneError, match=r"transforms_train\.json, is no name of a file"):
        load(blender)


def test_links_that_lead_out_of_the_scene_are_refused(blender):
    outside_path = blender.parent / "outside.png"
    write_png(outside_path, np.ones((SIZE, SIZE, 4), np.float32))
    (blender / "train" / "r_3.png").unlink()
    (blender / "train" / "r_3.png").symlink_to(outside_path)
    with pytest.raises(SceneError, match="leaves the scene folder"):
        load(blender)


def test_a_linked_scene_folder_is_fine(blender):
    link = blender.parent / "link"
    link.symlink_to(blender, target_is_directory=True)
    assert len(load(link).train) == COUNTS["train"]


def test_the_choice_of_light_is_checked(tensoir):
    with pytest.raises(MissingFileError, match=r"no image under the light 'dawn'.*\['noon'\]"):
        load(tensoir, light="dawn")
    edit(tensoir, lambda content: content.update(train_light="dawn"), name="scene.json")
    with pytest.raises(SceneError, match="names the training light 'dawn'"):
        load(tensoir)
    assert load(tensoir, light="noon").train_light == "noon"


def test_an_open_choice_of_light_asks_for_one(tensoir):
    (tensoir / "scene.json").unlink()
    source = tensoir / "train_000" / "rgba_noon.png"
    shutil.copy(source, tensoir / "train_000" / "rgba_dusk.png")
    with pytest.raises(SceneError, match=r"under the lights \['dusk', 'noon'\]; choose one"):
        load(tensoir)


@pytest.mark.parametrize("layout", ["nerf_synthetic", "shiny_blender", "synthetic4relight"])
def test_layouts_with_one_light_refuse_a_choice(scenes, layout):
    with pytest.raises(SceneError, match="light='noon'"):
        load(scenes[layout], light="noon")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("cam_transform_mat"), "has no key 'cam_transform_mat'"),
        (lambda c: c.update(cam_transform_mat="1,2,x"), "must be numbers"),
        (lambda c: c.update(cam_transform_mat="1,2,3"), "must be 16 numbers, got 3"),
        (lambda c: c.pop("cam_angle_x"), "has no key 'cam_angle_x'"),
    ],
)
def test_metadata_of_tensoir_is_checked(tensoir, change, message):
    (tensoir / "transforms_train.json").unlink()
    edit(tensoir, change, name="train_001/metadata.json")
    with pytest.raises(SceneError, match=message):
        load(tensoir)


@pytest.mark.parametrize(
    ("name", "layout", "counts"),
    [
        ("scenes/spot", "tensoir", (64, 10)),
        ("scenes/flighthelmet", "tensoir", (64, 10)),
        ("real/lego", "nerf_synthetic", (87, 13)),
    ],
)
def test_real_scenes_load(name, layout, counts):
    dataset = load_dataset(shared_path(*name.split("/")), downscale=2)
    assert dataset.layout == layout
    assert (len(dataset.train), len(dataset.test)) == counts
    assert dataset.warnings == ()
    lo, hi = dataset.bounds
    assert (hi - lo).max() < 3.0


def test_truth_without_an_alpha_is_reduced_within_the_mask(scenes, tmp_path):
    """Background that was averaged into the rim would turn its normals."""
    root = shutil.copytree(scenes["shiny_blender"], tmp_path / "ball")
    normal = np.array([0.6, 0.0, 0.8], np.float32)
    for path in root.glob("test/*_normal.png"):
        is_covered = read_linear(path.with_name(path.name.replace("_normal", "_alpha"))) > 0
        normal_picture = np.where(is_covered, 0.5 + 0.5 * normal, 0.0).astype(np.float32)
        write_png(path, normal_picture)
    views = load(root, downscale=2).test
    normals = views.truth["normal"][views.images[..., 3] > 0]
    assert len(normals) > 20
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=0.01)
