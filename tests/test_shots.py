"""Cameras to render from, out of views, files and circles, of any size; and the written files."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset

from geosplat_jax.cli import main
from geosplat_jax.fit.folder import RunError
from geosplat_jax.io.images import SceneError, encode_srgb, read_image, read_linear
from geosplat_jax.io.views import no_views
from geosplat_jax.report.renderer import RenderedView
from geosplat_jax.report.shots import (
    Cameras,
    Images,
    _stems,
    remove_later_frames,
    with_field_of_view,
)

DATASET = sphere_dataset()
CENTER = np.zeros(3)


def eyes(shots):
    poses = [np.asarray(shot.camera.world_to_camera[0], float) for shot in shots]
    return np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


def angle_of(camera):
    return 2 * np.degrees(np.arctan(0.5 * camera.width / float(camera.intrinsics[0, 0, 0])))


def write_cameras(folder, **keys):
    poses = DATASET.train.camera_to_world[:2]
    frames = [
        {"file_path": f"./path/{index}", "transform_matrix": pose.tolist()}
        for index, pose in enumerate(poses)
    ]
    path = folder / "path.json"
    path.write_text(json.dumps({**keys, "frames": frames}))
    return path


def test_the_views_of_a_split_are_its_cameras():
    shots = Cameras("train").shots(DATASET, CENTER)
    assert [shot.name for shot in shots] == list(DATASET.train.names)
    for view_index, shot in enumerate(shots):
        expected = DATASET.train.camera([view_index])
        np.testing.assert_array_equal(shot.camera.world_to_camera, expected.world_to_camera)
        np.testing.assert_array_equal(shot.camera.intrinsics, expected.intrinsics)


def test_size_and_angle_change_the_image_and_not_the_place():
    (first_shot, *_) = Cameras("train").shots(DATASET, CENTER)
    (resized_shot, *_) = Cameras("train", size=60, field_of_view=90.0).shots(DATASET, CENTER)
    assert max(resized_shot.camera.width, resized_shot.camera.height) == 60
    assert angle_of(resized_shot.camera) == pytest.approx(90.0, abs=1e-3)
    assert angle_of(first_shot.camera) != pytest.approx(90.0, abs=1)
    np.testing.assert_array_equal(
        resized_shot.camera.world_to_camera, first_shot.camera.world_to_camera
    )


def test_an_angle_keeps_the_shape_of_pixels_and_the_axis_of_the_lens():
    camera = DATASET.train.camera([0])
    intrinsics = jnp.asarray([[[40.0, 0, 11], [0, 50.0, 13], [0, 0, 1]]], jnp.float32)
    zoomed_camera = with_field_of_view(replace(camera, intrinsics=intrinsics), 60.0)
    zoomed_intrinsics = np.asarray(zoomed_camera.intrinsics[0])
    assert angle_of(zoomed_camera) == pytest.approx(60.0, abs=1e-3)
    assert zoomed_intrinsics[1, 1] / zoomed_intrinsics[0, 0] == pytest.approx(50 / 40)
    np.testing.assert_allclose(zoomed_intrinsics[:2, 2], [11, 13])


def test_a_shorter_turntable_removes_the_frames_of_a_longer_one(tmp_path):
    longer_shots = Cameras("train", turntable=3).shots(DATASET, np.zeros(3))
    frames = [f"{shot.name}{ending}" for shot in longer_shots for ending in (".png", "_rgba.png")]
    for name in [*frames, "turntable.gif", "turntable_notes.txt"]:
        (tmp_path / name).write_text("a picture")
    remove_later_frames(tmp_path, Cameras("train").shots(DATASET, np.zeros(3)))
    assert len(list(tmp_path.iterdir())) == 8
    remove_later_frames(tmp_path, Cameras("train", turntable=2).shots(DATASET, np.zeros(3)))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "turntable.gif",
        "turntable_0000.png",
        "turntable_0000_rgba.png",
        "turntable_0001.png",
        "turntable_0001_rgba.png",
        "turntable_notes.txt",
    ]


def test_a_turntable_is_a_circle_around_the_object_that_begins_at_the_first_camera():
    center = np.array([0.1, -0.2, 0.3])
    first_position = eyes(Cameras("train").shots(DATASET, center))[0]
    shots = Cameras("train", turntable=4).shots(DATASET, center)
    positions = eyes(shots)
    np.testing.assert_allclose(positions[0], first_position, atol=1e-5)
    radius = np.linalg.norm((positions - center)[:, :2], axis=1)
    np.testing.assert_allclose(radius, radius[0], atol=1e-5)
    np.testing.assert_allclose(positions[:, 2], first_position[2], atol=1e-5)
    midpoint = (positions[0] + positions[2])[:2] / 2
    np.testing.assert_allclose(midpoint, center[:2], atol=1e-5)


def test_cameras_of_a_file_have_its_poses_and_its_lens(tmp_path):
    path = write_cameras(tmp_path, camera_angle_x=0.8)
    shots = Cameras(file=path).shots(DATASET, CENTER)
    assert [shot.name for shot in shots] == ["path_0", "path_1"]
    np.testing.assert_allclose(
        eyes(shots), DATASET.train.camera_to_world[:2, :3, 3], rtol=1e-5, atol=1e-6
    )
    assert angle_of(shots[0].camera) == pytest.approx(np.degrees(0.8), abs=1e-3)
    assert shots[0].camera.width == DATASET.train.width
    path = write_cameras(tmp_path, camera_angle_x=0.8, w=50, h=20)
    (shot, _) = Cameras(file=path).shots(DATASET, CENTER)
    assert (shot.camera.width, shot.camera.height) == (50, 20)
    assert angle_of(shot.camera) == pytest.approx(np.degrees(0.8), abs=1e-3)
    path = write_cameras(tmp_path, fl_x=30.0, w=50, h=20)
    (shot, _) = Cameras(file=path).shots(DATASET, CENTER)
    assert (shot.camera.width, shot.camera.height) == (50, 20)
    assert float(shot.camera.intrinsics[0, 0, 0]) == pytest.approx(30.0)


def test_a_folder_of_cameras_is_refused(tmp_path):
    with pytest.raises(SceneError, match="is a folder; a file of JSON is expected"):
        Cameras(file=tmp_path).shots(DATASET, CENTER)


def test_a_bent_lens_is_refused(tmp_path):
    path = write_cameras(tmp_path, fl_x=30.0, w=50, h=20, k1=0.1)
    with pytest.raises(SceneError, match="without distortion"):
        Cameras(file=path).shots(DATASET, CENTER)


def test_a_scene_without_test_views_says_what_to_do():
    bare_dataset = replace(DATASET, test=no_views(DATASET.train))
    with pytest.raises(RunError, match="no test views; use --views train.*--cameras FILE"):
        Cameras("test").shots(bare_dataset, CENTER)
    assert len(Cameras(None).shots(bare_dataset, CENTER)) == len(bare_dataset.train)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "0"], "from 1 to 8192"),
        (["--size", "100000"], "from 1 to 8192"),
        (["--field-of-view", "180"], "below 180 degrees, got 180"),
        (["--field-of-view", "nan"], "below 180 degrees, got nan"),
        (["--turntable", "-3"], "a turntable has from 0 to 10000 pictures, got -3"),
        (["--turntable", "1000000000"], "a turntable has from 0 to 10000 pictures"),
        (["--samples", "0"], "--samples must be"),
    ],
)
def test_unusable_options_are_refused_before_the_run_is_opened(tmp_path, capsys, options, message):
    assert main(["render", str(tmp_path), *options]) == 2
    assert message in capsys.readouterr().err


def test_names_of_files_are_all_different():
    assert _stems(["a/b", "a_b", "a_b_2", "..", "/x/"]) == ["a_b", "a_b_2", "a_b_2_2", "view", "x"]
    assert _stems(["a", "a_rgba", "A", "b_normal", "b"]) == [
        "a",
        "a_rgba_2",
        "A_2",
        "b_normal",
        "b_2",
    ]


def rendered():
    rng = np.random.default_rng(0)
    alpha = np.array([[0.0, 0.25], [0.5, 1.0]], np.float32)
    straight_aovs = {
        "albedo": rng.uniform(0.1, 0.9, (2, 2, 3)),
        "roughness": rng.uniform(0.1, 0.9, (2, 2, 1)),
        "metallic": rng.uniform(0.1, 0.9, (2, 2, 1)),
        "normal": np.full((2, 2, 3), 3**-0.5),
        "depth": rng.uniform(2, 5, (2, 2, 1)),
    }
    rgb = rng.uniform(0.1, 4.0, (2, 2, 3))
    linear = (rgb * alpha[..., None]).astype(np.float32)
    blended_aovs = {
        name: (v * alpha[..., None]).astype(np.float32) for name, v in straight_aovs.items()
    }
    view = RenderedView(np.minimum(linear, 1.0), alpha, linear, blended_aovs)
    return view, rgb, straight_aovs


def test_floats_are_straight_linear_values_and_zero_beside_the_object(tmp_path):
    """This also holds for colours brighter than white."""
    view, rgb, straight_aovs = rendered()
    assert np.max(rgb[view.alpha > 0]) > 2.0
    names = ("albedo", "roughness", "metallic", "normal", "depth")
    paths = Images(names, exr=True).write(tmp_path, "v", view)
    assert {path.name for path in paths} == {path.name for path in tmp_path.iterdir()}
    is_covered = view.alpha[..., None] > 0
    for name in names:
        pixels = read_linear(tmp_path / f"v_{name}.exr")
        np.testing.assert_allclose(pixels, np.where(is_covered, straight_aovs[name], 0), rtol=1e-5)
    pixels = read_linear(tmp_path / "v_rgba.exr")
    np.testing.assert_allclose(pixels[..., 3], view.alpha)
    np.testing.assert_allclose(pixels[..., :3], np.where(is_covered, rgb, 0), rtol=1e-5)


def test_pictures_are_what_viewers_expect_and_depth_is_never_rounded(tmp_path):
    view, _, straight_aovs = rendered()
    Images(("albedo", "roughness", "normal", "depth")).write(tmp_path, "v", view)
    assert {path.name for path in tmp_path.iterdir()} == {
        *("v_rgba.png", "v_albedo.png", "v_roughness.png", "v_normal.png", "v_depth.exr"),
    }
    is_covered = view.alpha > 0
    albedo = read_image(tmp_path / "v_albedo.png")
    expected = encode_srgb(straight_aovs["albedo"].astype(np.float32))
    np.testing.assert_allclose(albedo[is_covered][:, :3], expected[is_covered], atol=1 / 255)
    roughness = read_image(tmp_path / "v_roughness.png")
    np.testing.assert_allclose(
        roughness[is_covered][:, 0], straight_aovs["roughness"][is_covered][:, 0], atol=1 / 255
    )
    np.testing.assert_allclose(roughness[..., -1], view.alpha, atol=1 / 255)
    normal = read_image(tmp_path / "v_normal.png")
    unit = 2 * normal[is_covered][:, :3] - 1
    np.testing.assert_allclose(unit, straight_aovs["normal"][is_covered], atol=1.01 / 255)
    np.testing.assert_allclose(normal[..., 3], view.alpha, atol=1 / 255)


def test_unknown_images_are_named():
    with pytest.raises(ValueError, match=r"\['shine'\]; expected some of"):
        Images(("albedo", "shine")).check()
