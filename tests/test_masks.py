"""Masks of captures: the proposed box, the written files, and refused input."""

import shlex
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support import views_from
from test_captures import (
    BOX,
    CENTER,
    COUNT,
    RADIUS,
    opengl_poses,
    photograph,
    size_of,
    write_photographs,
    write_transforms,
)

from geosplat_jax import cli
from geosplat_jax.capture import masks as masks_module
from geosplat_jax.capture.box import Cloud, inside_box, propose_box
from geosplat_jax.capture.masks import OPAQUE, choose_factor, make_masks, photograph_mask
from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.capture.start import CaptureError
from geosplat_jax.capture.training import Radiance
from geosplat_jax.fit.folder import RunError
from geosplat_jax.fit.train import TrainingError
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.io.frames import Frame
from geosplat_jax.io.images import SceneError, read_image, write_png
from geosplat_jax.io.lenses import PinholeLens
from geosplat_jax.splats.radiance import RadianceSplats

SETTINGS = RadianceSettings(steps=1)


def on_ball(count, center=(0.0, 0.0, 0.0), radius=1.0, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return center + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_plane(count, height, reach=3.0, seed=1):
    place = np.random.default_rng(seed).uniform(-reach, reach, (count, 3))
    return place * [1.0, 1.0, 0.004] + [0.0, 0.0, height]


def cloud_of(*parts, opacity=0.9, size=0.02):
    positions = np.concatenate(parts)
    return Cloud(positions, np.full(len(positions), opacity), np.full(len(positions), size))


def ring(count=12, distance=5.0, scale=1.0):
    angle = 2 * np.pi * np.arange(count) / count
    eyes = np.stack([np.cos(angle), np.sin(angle), np.resize([0.4, 0.7], count)], -1)
    return views_from(scale * distance * eyes, size=40, field_of_view=0.9)


@pytest.mark.parametrize("scale", [1.0, 250.0])
def test_the_box_is_that_of_the_object_without_what_it_stands_on(scale):
    # The cameras do not look at the centre of the ball.
    middle = np.array([0.2, -0.15, 0.0])
    cloud = cloud_of(
        scale * on_ball(1500, middle, 0.6),
        scale * on_plane(2500, -0.63),
        scale * on_ball(3000, (0.0, 0.0, 0.0), 9.0),
        size=0.02 * scale,
    )
    proposal = propose_box(cloud, ring(scale=scale))
    assert proposal.plane is not None
    np.testing.assert_allclose(proposal.plane.normal, [0.0, 0.0, 1.0], atol=0.02)
    np.testing.assert_allclose(proposal.lo / scale, middle - 0.6, atol=0.12)
    np.testing.assert_allclose(proposal.hi / scale, middle + 0.6, atol=0.12)
    assert proposal.lo[2] / scale > -0.62
    assert 0.2 < proposal.share < 0.8


def test_a_thick_wall_that_no_axis_follows_is_cut_off():
    """Like a wall with a trophy on it: splats lie behind it, and all cameras are in front of it."""
    turn = np.linalg.qr(np.array([[1.0, 0.6, 0.3], [-0.5, 1.0, 0.2], [0.1, -0.4, 1.0]]))[0]
    turn = turn * np.sign(np.linalg.det(turn))
    rng = np.random.default_rng(5)
    wall = rng.uniform(-1.4, 1.4, (3000, 3)) * [1.0, 1.0, 0.02] - [0.0, 0.0, 0.45]
    behind = rng.uniform(-1.4, 1.4, (300, 3)) * [1.0, 1.0, 0.1] - [0.0, 0.0, 0.8]
    ball = on_ball(1500, radius=0.5)
    cloud = cloud_of(*(part @ turn.T for part in (ball, wall, behind)))
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4)), -1).reshape(-1, 2)
    eyes = 4.0 * np.c_[0.6 * grid, np.ones(16)] @ turn.T
    proposal = propose_box(cloud, views_from(eyes, size=40, field_of_view=0.7))
    plane = proposal.plane
    assert plane is not None
    assert plane.normal @ turn[:, 2] > 0.999
    is_above = plane.is_above(cloud.positions)
    assert is_above[1500:].mean() < 0.1
    assert is_above[:1500].mean() > 0.9
    assert np.abs(proposal.lo).max() < 0.75
    assert np.abs(proposal.hi).max() < 0.75


def test_a_larger_cluster_at_the_edge_is_not_the_object():
    wall = on_plane(1600, 0.0, reach=0.9)[:, [2, 0, 1]] + [-1.45, 0.0, 0.0]
    proposal = propose_box(cloud_of(on_ball(800, radius=0.4), wall), ring())
    np.testing.assert_allclose(proposal.lo, -0.4, atol=0.1)
    np.testing.assert_allclose(proposal.hi, 0.4, atol=0.1)


def test_what_some_photographs_cut_off_belongs_to_the_object_where_it_is_connected():
    """Such a part is a muzzle that sticks out towards the camera in close photographs."""
    rod = (
        on_ball(900, radius=0.12) * [1.0, 1.0, 0.0]
        + [0.0, 0.0, 1.0] * np.linspace(0.3, 1.25, 900)[:, None]
    )
    other_ball = on_ball(900, (0.0, 1.1, 1.0), radius=0.15)
    cloud = cloud_of(on_ball(1500, radius=0.5), rod, other_ball)
    eyes = [[np.cos(a) * d, np.sin(a) * d, 0.2] for a in np.arange(0, 6, 0.5) for d in (2.2, 4.5)]
    views = views_from(np.array(eyes), size=40, field_of_view=0.8)
    share = np.mean([_tip_is_seen(views, index, [0.0, 0.0, 1.25]) for index in range(len(views))])
    assert 0.4 < share < 0.8
    proposal = propose_box(cloud, views)
    assert proposal.hi[2] == pytest.approx(1.25, abs=0.12)
    assert proposal.hi[1] < 0.7


def _tip_is_seen(views, index, point):
    local = views.world_to_camera[index] @ [*point, 1.0]
    pixel = (views.intrinsics[index] @ local[:3])[:2] / local[2]
    return (pixel >= 0).all() and (pixel < 40).all()


@pytest.mark.parametrize("axes", [[2, 0, 1], [0, 1, 2]])
def test_a_board_through_the_object_is_no_ground(axes):
    # Equally many points lie on both sides of the plane, so nothing stands on it.
    board = on_plane(2000, 0.0, reach=0.7)[:, axes]
    cloud = cloud_of(on_ball(1500, radius=0.5), board)
    assert propose_box(cloud, ring()).plane is None


def test_faint_and_large_splats_do_not_make_a_box():
    ball = on_ball(500, radius=0.4)
    fog = np.random.default_rng(3).uniform(-1.4, 1.4, (2000, 3))
    sizes = np.r_[np.full(500, 0.02), np.full(2000, 5.0), np.full(2000, 0.02)]
    positions = np.concatenate([ball, on_ball(2000, radius=1.2), fog])
    for fog_opacity in (0.05, 0.12):
        opacities = np.r_[np.full(2500, 0.9), np.full(2000, fog_opacity)]
        proposal = propose_box(Cloud(positions, opacities, sizes), ring())
        assert np.abs([proposal.lo, proposal.hi]).max() < 0.6


def test_where_nothing_is_in_sight_there_is_no_box():
    single_view = ring(1)
    with pytest.raises(CaptureError, match="no opaque splat where the cameras look.*--box"):
        propose_box(cloud_of(on_ball(100, radius=40.0)), ring())
    with pytest.raises(CaptureError, match="what the cameras look at.*--box"):
        propose_box(cloud_of(on_ball(100)), single_view)


def test_corners_of_a_box_belong_to_it():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.01]])
    assert inside_box(corners, corners[0], corners[1]).tolist() == [True, True, False]


def a_ball_before_a_wall(opacity=0.999):
    """Splats of the ball of `test_captures`, and of a far larger ball around everything."""
    count, outer_count = 1200, 600
    positions = np.concatenate(
        [on_ball(count, CENTER, RADIUS - 0.11), on_ball(outer_count, CENTER, 9)]
    )
    sizes = np.repeat([0.05, 0.7], [count, outer_count])[:, None] * np.ones(3)
    logits = np.full(count + outer_count, np.log(opacity / (1 - opacity)))
    return Radiance(
        RadianceSplats(
            means=jnp.asarray(positions, jnp.float32),
            log_scales=jnp.asarray(np.log(sizes), jnp.float32),
            quats=jnp.ones((count + outer_count, 4), jnp.float32),
            opacity_logits=jnp.asarray(logits, jnp.float32),
            base=jnp.zeros((count + outer_count, 3), jnp.float32),
            rest=jnp.zeros((count + outer_count, 15, 3), jnp.float32),
        ),
        near=0.1,
        degree=0,
    )


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """A capture without masks; known splats stand in for the training of splats."""
    root = tmp_path / "scene"
    write_transforms(root, masks=None)

    def train_radiance(views, settings, folder, **options):
        (folder / masks_module.RECORD).write_text("{}")
        return a_ball_before_a_wall()

    monkeypatch.setattr(masks_module, "train_radiance", train_radiance)
    monkeypatch.setattr(masks_module, "psnr_by_view", lambda *a: np.array([20.0, 22.0]))
    (tmp_path / "run").mkdir()
    return root, tmp_path / "run"


def read(root, **options):
    return load_dataset(root, mask_files=False, **options)


def truths():
    """True masks by the names of the views."""
    return {
        f"view_{k:02d}": photograph(pose, size_of(k))[1][..., 0] > 0.5
        for k, pose in enumerate(opengl_poses())
    }


def test_masks_are_those_of_the_object_and_are_read_by_training(capture):
    root, run = capture
    report = make_masks(read(root), SETTINGS, run, box=BOX)
    dataset = load_dataset(root)
    masks_by_name = {
        name: mask
        for views in (dataset.train, dataset.test)
        for name, mask in zip(views.names, views.masks, strict=True)
    }
    assert dataset.train.has_masks
    assert len(masks_by_name) == COUNT == report.masks
    overlaps = []
    for name, truth in truths().items():
        mask = masks_by_name[name][: truth.shape[0], : truth.shape[1]]
        overlaps.append((mask & truth).sum() / (mask | truth).sum())
        assert read_image(root / "masks" / f"{name}.png").shape[:2] == truth.shape
    # The ball is seventeen pixels wide, so its rim is a fifth of its area.
    assert np.mean(overlaps) > 0.93
    assert np.min(overlaps) > 0.88
    assert report.splats == 1200
    assert report.splats_total == 1800
    assert not report.proposed
    assert report.certainty.agreement > 0.95
    assert report.certainty.unsure < 0.1
    assert report.certainty.empty == ()
    assert report.psnr == 21.0
    assert (run / "masks.png").exists()
    assert (run / "splats.ply").stat().st_size > (run / "object.ply").stat().st_size


def test_without_a_box_the_object_is_found(capture):
    root, run = capture
    report = make_masks(read(root), SETTINGS, run)
    assert report.proposed
    np.testing.assert_allclose(report.lo, CENTER - RADIUS, atol=0.2)
    np.testing.assert_allclose(report.hi, CENTER + RADIUS, atol=0.2)


def test_masks_that_are_there_are_replaced_only_where_that_is_said(capture, monkeypatch):
    root, run = capture
    write_photographs(root, "unused")

    def as_wide_as_splats_are_many(radiance, camera):
        alpha = np.zeros((COUNT, 28, 24), np.float32)
        alpha[:, :, : 24 * radiance.splats.capacity // 1200] = 0.9
        return np.zeros((COUNT, 28, 24, 3), np.float32), alpha

    monkeypatch.setattr(masks_module, "render_views", as_wide_as_splats_are_many)
    with pytest.raises(CaptureError, match=f"{COUNT} of {COUNT} views have a mask already"):
        make_masks(read(root), SETTINGS, run, box=BOX)
    make_masks(read(root), SETTINGS, run, box=BOX, force=True)
    assert read_image(root / "masks" / "view_04.png").mean() == 1.0
    smaller_box = (CENTER - 1, CENTER + np.array([1.0, 1.0, 0.0]))
    make_masks(read(root), SETTINGS, run, box=smaller_box, resume=True)
    assert 0.2 < read_image(root / "masks" / "view_04.png").mean() < 0.8


def test_a_command_that_was_stopped_while_it_wrote_masks_goes_on(capture, monkeypatch):
    root, run = capture
    write, written_paths = masks_module.write_png, []

    def stopped(path, pixels):
        if len(written_paths) == 2:
            raise KeyboardInterrupt
        written_paths.append(path)
        write(path, pixels)

    with monkeypatch.context() as patch:
        patch.setattr(masks_module, "write_png", stopped)
        with pytest.raises(KeyboardInterrupt):
            make_masks(read(root), SETTINGS, run, box=BOX)
    assert len(list((root / "masks").iterdir())) == 2
    with pytest.raises(CaptureError, match=f"2 of {COUNT} views have a mask already"):
        make_masks(read(root), SETTINGS, run, box=BOX)
    assert make_masks(read(root), SETTINGS, run, box=BOX, resume=True).masks == COUNT
    assert len(list((root / "masks").iterdir())) == COUNT
    assert not list(run.glob("*begun*"))


def test_only_one_process_writes_the_masks_of_a_folder(capture, monkeypatch):
    root, run = capture

    def written_by_two(radiance, views):
        with pytest.raises(RunError, match="another process is writing"):
            make_masks(read(root), SETTINGS, run, box=BOX, resume=True)
        return np.array([20.0])

    monkeypatch.setattr(masks_module, "psnr_by_view", written_by_two)
    assert make_masks(read(root), SETTINGS, run, box=BOX).masks == COUNT


def test_boxes_and_masks_that_leave_nothing_are_refused(capture, monkeypatch):
    root, run = capture
    with pytest.raises(CaptureError, match="holds no splat; most of them lie between"):
        make_masks(read(root), SETTINGS, run, box=(CENTER + 2, CENTER + 3))
    with pytest.raises(CaptureError, match="must be lo .* below hi"):
        make_masks(read(root), SETTINGS, run, box=(CENTER, CENTER))
    render = (np.zeros((COUNT, 28, 24, 3), np.float32), np.full((COUNT, 28, 24), 0.7, np.float32))
    monkeypatch.setattr(masks_module, "render_views", lambda *a: render)
    with pytest.raises(CaptureError, match="masks would leave nothing"):
        make_masks(read(root), SETTINGS, run, box=BOX)
    assert not (root / "masks").exists()


def test_scenes_whose_masks_would_not_be_read_are_refused(tmp_path):
    root = tmp_path / "named"
    write_transforms(root)
    with pytest.raises(CaptureError, match="remove mask_path from transforms.json"):
        make_masks(read(root), SETTINGS, tmp_path / "run", force=True)
    cut_root = tmp_path / "cut"
    write_transforms(cut_root, masks=None, rgba=True)
    with pytest.raises(CaptureError, match="cut out already"):
        make_masks(read(cut_root), SETTINGS, tmp_path / "run")


def test_too_few_photographs_are_refused(capture):
    root, run = capture
    with pytest.raises(CaptureError, match="there are 3 views to train on, at least 5"):
        make_masks(read(root, train_views=3), SETTINGS, run)


def test_a_mask_is_as_large_as_its_photograph(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((21, 31, 3), np.float32))
    lens = PinholeLens(fx=30.0, fy=30.0, cx=15.5, cy=10.5, width=31, height=21)
    frame = Frame("a", np.eye(4), lens, tmp_path / "a.png")
    alpha = np.zeros((12, 16), np.float32)
    alpha[2:6, 3:9] = 1.0
    # The photograph was cropped to 20 x 30 pixels and halved; alpha lies on a larger canvas.
    mask = photograph_mask(alpha, frame, 2)
    rows, columns = np.nonzero(mask)
    assert mask.shape == (21, 31)
    assert (rows.min(), rows.max()) == (4, 11)
    assert (columns.min(), columns.max()) == (6, 17)


def test_large_photographs_are_reduced(tmp_path):
    sizes = {"small": (20, 24), "large": (1000, 1100)}
    for name, (height, width) in sizes.items():
        root = tmp_path / name
        write_transforms(root, masks=None, several=False)
        for path in (root / "images").iterdir():
            write_png(path, np.zeros((height, width, 3), np.float32))
    assert choose_factor(tmp_path / "small") == 1
    assert choose_factor(tmp_path / "large") == 3
    with pytest.raises(SceneError, match="does not exist"):
        choose_factor(tmp_path / "nowhere")


def test_the_command_prints_how_sure_it_is(capture, capsys):
    root, run = capture
    box = [str(x) for x in np.concatenate(BOX)]
    command = ["masks", str(root), "--output", str(run), "--steps", "1"]
    assert cli.main([*command, "--box", *box]) == 0
    output = capsys.readouterr().out
    for part in ("dB on views that are held back", "agreement:", "half-opaque", "masks.png"):
        assert part in output
    again = shlex.join(["geosplat-jax", *command])
    assert f"next: geosplat-jax train {root}; if not: {again} --resume --box ..." in output
    assert cli.main([*command, "--resume", "--box", *box]) == 0
    capsys.readouterr()
    assert cli.main(command) == 2
    assert "have a mask already" in capsys.readouterr().err


def test_a_training_that_fails_says_so(capture, monkeypatch, capsys):
    root, run = capture

    def fail(*values, **named):
        raise TrainingError("step 3: a number is not finite")

    monkeypatch.setattr(masks_module, "train_radiance", fail)
    assert cli.main(["masks", str(root), "--output", str(run)]) == 2
    assert "not finite" in capsys.readouterr().err


def test_specks_go_and_half_opaque_holes_are_filled():
    alpha = np.zeros((2, 40, 40), np.float32)
    alpha[:, 5:35, 5:35] = 0.9
    alpha[0, 10:14, 10:14] = 0.4  # half opaque, enclosed
    alpha[0, 20:26, 20:26] = 0.1  # a real hole
    alpha[0, 30:35, 5:8] = 0.5  # half opaque, open to the outside
    alpha[0, 1:3, 1:3] = 0.95  # a speck: 4 pixels of about 850
    alpha[1, 1:4, 36:39] = 0.95
    alpha[1, 5:35, 5:35] = 0.0  # only nine pixels are left, so they are no speck
    original = alpha.copy()
    actual = masks_module.tidied(alpha)
    np.testing.assert_array_equal(alpha, original)
    expected = original.copy()
    expected[0, 10:14, 10:14] = 1.0
    expected[0, 1:3, 1:3] = 0.0
    np.testing.assert_array_equal(actual, expected)
    assert masks_module.tidied(np.zeros((1, 3, 3), np.float32)).max() == 0.0


def test_masks_are_cut_where_a_photograph_ends_within_its_canvas():
    views = replace(ring(6), has_masks=False)
    alpha = np.zeros((6, 40, 40), np.float32)
    alpha[:, 10:20, 20:30] = 0.9
    valid = np.zeros(alpha.shape, np.float32)
    box = (np.full(3, -1.5), np.full(3, 1.5))
    for columns, rows, length in ((31, 40, 0), (30, 40, 10), (30, 20, 19)):
        valid[:] = 0.0
        valid[:, :rows, :columns] = 1.0
        certainty = masks_module.certainty(replace(views, valid=valid), alpha, box)
        assert certainty.cut == pytest.approx(length / 36)


def test_half_opaque_pixels_and_cut_masks_raise_warnings():
    views = replace(ring(6), has_masks=False)
    alpha = np.zeros((6, 40, 40), np.float32)
    alpha[:, :, 18:22] = 0.9
    alpha[:, 5:35, 12:18] = 0.5
    alpha[5] = 0.0
    certainty = masks_module.certainty(views, alpha, (np.full(3, -1.5), np.full(3, 1.5)))
    # Of the six half opaque columns, the one next to the mask is not counted.
    assert certainty.unsure == pytest.approx(30 * 5 / (40 * 4))
    # The rim of the mask has 2 x 40 and 2 x 2 pixels, of which eight lie on the border of the
    # image.
    assert certainty.cut == pytest.approx(8 / 84)
    assert certainty.empty == (views.names[5],)
    assert certainty.coverage == pytest.approx(5 / 6 * 0.1)
    text = " ".join(certainty.warnings())
    for part in ("half opaque", "border of the image", "1 masks are empty"):
        assert part in text
    assert OPAQUE == 0.8
