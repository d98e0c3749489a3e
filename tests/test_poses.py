"""Cameras of photographs: what is refused before the search, and a search from end to end."""

import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from support import level_poses
from test_alignment import moved

from geosplat_jax import cli
from geosplat_jax.io.alignment import align_world
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.io.images import MissingFileError, SceneError, write_png
from geosplat_jax.io.poses import PoseError, _Matches, _pairs, _upright, _write, find_poses

HEIGHT, WIDTH, FOCAL = 150, 200, 190.0
# Error of cameras that follow from some thousand features, each found to a third of a pixel.
DISTANCE = 0.02
COUNT = 9


def photographs(root, count, *, size=(8, 8), folder="images"):
    for k in range(count):
        write_png(root / folder / f"{k:02d}.png", np.full((*size, 3), 0.5, np.float32))
    return root


def cameras():
    """Level cameras on a quarter of a ring, at two heights."""
    angle = np.linspace(-2.2, -0.9, COUNT)
    height = np.resize([0.9, 1.3], COUNT)
    return level_poses(np.stack([2 * np.cos(angle), 2 * np.sin(angle), height], -1), (0, 0, 0.2))


def photograph(pose, texture):
    """The ground and a wall, both with the texture, as a pinhole sees them."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, -y / FOCAL, -np.ones_like(x)], -1) @ pose[:3, :3].T
    origin = pose[:3, 3]
    ground_depth, wall_depth = -origin[2] / rays[..., 2], (0.8 - origin[1]) / rays[..., 1]
    depths = [np.where(depth > 0, depth, np.inf) for depth in (ground_depth, wall_depth)]
    depth = np.minimum(np.minimum(*depths), 50.0)
    points = origin + depth[..., None] * rays
    shift = np.where(depths[0] < depths[1], points[..., 1], 3.0 + points[..., 2])
    texel_positions = np.stack([40.0 * (points[..., 0] + 4.0), 40.0 * (shift + 3.0)])
    return map_coordinates(texture, texel_positions, order=1, mode="wrap")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    root = tmp_path_factory.mktemp("room")
    noise = np.random.default_rng(0).normal(size=(400, 400))
    texture = sum(gaussian_filter(noise, scale, mode="wrap") * scale for scale in (0.8, 2.0, 5.0))
    texture = np.clip(0.5 + 0.35 * texture, 0.0, 1.0).astype(np.float32)
    for k, pose in enumerate(cameras()):
        grey = photograph(pose, texture)
        write_png(root / "images" / f"{k:02d}.png", np.repeat(grey[..., None], 3, -1))
    return root


@pytest.fixture(scope="module")
def found_room(room):
    """The room with its cameras, the report on them, and the progress of the search."""
    pytest.importorskip("pycolmap")
    updates = []
    report = find_poses(room, on_progress=lambda *done: updates.append(done))
    return room, report, updates


def refuses(root, message, error=SceneError, **arguments):
    with pytest.raises(error, match=message):
        find_poses(root, **arguments)


def test_folders_without_enough_photographs_are_refused(tmp_path):
    refuses(tmp_path / "none", "does not exist", MissingFileError)
    refuses(photographs(tmp_path, 4), "has 4 photographs .*takes at least 5", PoseError)


def test_masks_are_no_photographs(tmp_path):
    photographs(photographs(tmp_path, 4, folder="."), 9, folder="masks")
    refuses(tmp_path, "has 4 photographs", PoseError)


def test_photographs_of_two_sizes_are_of_two_lenses(tmp_path):
    photographs(photographs(tmp_path, 6), 1, size=(8, 9))
    refuses(tmp_path, r"01\.png is 8 x 8 pixels, but 00\.png is 9 x 8.*--lens each")


def test_photographs_of_one_name_are_refused(tmp_path):
    photographs(tmp_path, 6)
    (tmp_path / "images" / "03.tif").write_bytes(b"")
    refuses(tmp_path, "2 photographs in .* are named '03'")


def test_names_that_colmap_cannot_match_are_refused(tmp_path):
    photographs(tmp_path, 6)
    (tmp_path / "images" / "03.png").rename(tmp_path / "images" / "03 2.png")
    refuses(tmp_path, "1 photographs in .* for example .03 2.png.*rename them")


def test_cameras_that_are_there_are_not_replaced(tmp_path):
    photographs(tmp_path, 6)
    model = tmp_path / "sparse" / "0" / "images.bin"
    model.parent.mkdir(parents=True)
    model.write_bytes(b"as it was")
    refuses(tmp_path, "has cameras already, of layout colmap; --force")
    (tmp_path / "transforms.json").write_text("{}")
    refuses(tmp_path, "of layout transforms, which would be read instead", force=True)
    assert model.read_bytes() == b"as it was"


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert cli.main(["poses", str(photographs(tmp_path, 6))]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "pip install 'geosplat_jax[capture]'" in lines[0]
    assert not (tmp_path / "sparse").exists()


def test_a_sequence_compares_neighbours_and_far_steps():
    assert len(_pairs(30, "any")) == 30 * 29 / 2
    steps = {j - i for i, j in _pairs(70, "sequence")}
    assert steps == {*range(1, 11), 16, 32, 64}


@pytest.mark.parametrize(
    ("features", "pairs", "message"),
    [(100.0, 300, "few details"), (2000.0, 12, "overlap too little"), (2000.0, 200, "--lens each")],
)
def test_advice_names_the_cause(features, pairs, message):
    advice = _Matches(photographs=25, features=features, pairs=pairs, compared=300).advice(3)
    assert message in advice
    assert "only 3 of 25 photographs" in advice
    assert "\n" not in advice


def test_photographs_stored_on_their_side_are_turned_up():
    pose = level_poses(np.array([[0.0, -1.0, 0.0]]))[0]
    # In orientation 6 the left column of the stored pixels is the top; in 8 the right one is.
    for orientation, axis, sign in ((1, 1, 1), (3, 1, -1), (6, 0, -1), (8, 0, 1)):
        stored_pose = _upright(pose, orientation)
        np.testing.assert_allclose(stored_pose[:3, 1], sign * pose[:3, axis], atol=1e-12)
        assert np.linalg.det(stored_pose[:3, :3]) == pytest.approx(1.0)


def test_photographs_of_a_room_give_its_cameras(found_room):
    room, report, updates = found_room
    assert (report.registered, report.missing) == (COUNT, ())
    assert report.error < 0.6
    assert [phase for phase, done_count, total in updates if done_count == total] == [
        *report.seconds
    ]
    dataset = load_dataset(room)
    assert dataset.layout == "colmap"
    views = dataset.train
    # Both sets of cameras are aligned to the same world, so that they can be compared directly.
    true_poses = moved(cameras(), align_world(cameras(), np.zeros((1, 3))))
    view_indices = [int(name) for name in views.names]
    np.testing.assert_allclose(views.camera_to_world, true_poses[view_indices], atol=DISTANCE)
    assert views.intrinsics[0, 0, 0] == pytest.approx(FOCAL, rel=DISTANCE)


def test_the_same_photographs_give_the_same_model(found_room, tmp_path):
    room, _, _ = found_room
    for path in (room / "images").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    expected_files = {path.name: path.read_bytes() for path in (room / "sparse" / "0").iterdir()}
    find_poses(tmp_path)
    files = {path.name: path.read_bytes() for path in (tmp_path / "sparse" / "0").iterdir()}
    assert files == expected_files
    assert len(load_dataset(tmp_path).train) == 7


def test_photographs_that_show_nothing_are_refused_with_advice(tmp_path):
    pytest.importorskip("pycolmap")
    refuses(photographs(tmp_path, 6, size=(40, 40)), "only 0 of 6 .*few details", PoseError)
    assert not (tmp_path / "sparse").exists()


class OneFile:
    """A model of COLMAP, as far as it is written."""

    def write(self, folder):
        (folder / "cameras.bin").write_bytes(b"new")


@pytest.mark.parametrize("has_target", [True, False])
def test_a_model_is_replaced_where_its_link_leads(tmp_path, has_target):
    target, link = tmp_path / "elsewhere" / "model", tmp_path / "sparse" / "0"
    link.parent.mkdir()
    link.symlink_to(target)
    if has_target:
        target.mkdir(parents=True)
        (target / "images.bin").write_bytes(b"old")
    _write(OneFile(), link)
    assert link.is_symlink()
    assert [path.name for path in target.iterdir()] == ["cameras.bin"]
    assert [path.name for path in target.parent.iterdir()] == ["model"]
