"""The viewer without a browser: which picture is due, what it shows, when a run is read again."""

import shutil
import socket
import sys
from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.types import Box, EnvLight
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.train import Trained, TrainingError
from geosplat_jax.io.images import SceneError, write_hdr
from geosplat_jax.report.renderer import RenderedView, Renderer
from geosplat_jax.viewer import painter as painting
from geosplat_jax.viewer.looks import AS_TRAINED, LEVELS, MODES, Ladder, Level, Look
from geosplat_jax.viewer.painter import Painter, Viewer
from geosplat_jax.viewer.server import ViewerError, require_free_port, viser_library
from geosplat_jax.viewer.source import CheckpointWatch, light_files, load_lights, same_size

LOOK = Look((0.0, -3.0, 0.0), (0.5**0.5, -(0.5**0.5), 0.0, 0.0), 0.5, 1.5)
"""A look from the front at the ball in the origin, with z up."""

QUICK, GOOD, BEST = LEVELS


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def drawn(ladder, clock, look, *, seconds, wait=0.0):
    """Levels at which a look is drawn until nothing is due; ``seconds`` : durations by level."""
    levels = []
    clock.now += wait
    while (level := ladder.next(look)) is not None:
        clock.now += seconds[level]
        ladder.note(level, seconds[level])
        levels.append(level)
    return levels


def moved(number):
    return replace(LOOK, turn=float(number))


def test_a_look_that_stays_is_drawn_ever_better_and_then_no_more(clock):
    ladder = Ladder(clock=clock)
    seconds = {QUICK: 0.1, GOOD: 0.1, BEST: 2.0}
    assert drawn(ladder, clock, LOOK, seconds=seconds) == [QUICK]
    assert drawn(ladder, clock, LOOK, seconds=seconds) == []  # the look has not rested long enough
    assert drawn(ladder, clock, LOOK, seconds=seconds, wait=0.5) == [GOOD, BEST]
    assert drawn(ladder, clock, LOOK, seconds=seconds, wait=9.0) == []


def test_what_moves_is_drawn_at_the_best_level_that_keeps_up(clock):
    ladder = Ladder(clock=clock)
    seconds = {QUICK: 0.05, GOOD: 0.2, BEST: 2.0}
    for index in range(2):  # the first picture of a level does not count as its pace
        drawn(ladder, clock, moved(index), seconds=seconds)
        drawn(ladder, clock, moved(index), seconds=seconds, wait=1.0)
    assert [ladder.next(moved(index)) for index in range(2, 5)] == [GOOD] * 3
    ladder.note(GOOD, 1.0)  # the machine has become busy
    assert ladder.next(moved(9)) == QUICK


def test_a_compilation_does_not_count_as_a_pace(clock):
    ladder = Ladder(clock=clock)
    ladder.next(LOOK)
    ladder.note(QUICK, 60.0)
    ladder.next(moved(1))
    ladder.note(QUICK, 0.1)
    clock.now = 1.0
    ladder.next(moved(1))
    ladder.note(GOOD, 0.1)
    assert ladder.next(moved(2)) == QUICK  # the first time of GOOD does not count either
    ladder.forget()
    assert ladder.next(moved(2)) == QUICK


def test_the_camera_of_a_look_fills_the_window_whatever_its_shape():
    wide_camera, square_camera = (
        replace(LOOK, aspect=aspect).camera(GOOD) for aspect in (2.0, 1.0)
    )
    for camera in (wide_camera, square_camera):
        np.testing.assert_allclose(camera.centers[0], LOOK.position, atol=1e-6)
        # The origin is in the middle of the image; z points up, to smaller rows.
        center_pixel, upper_pixel = (
            np.asarray(camera.intrinsics[0] @ (camera.world_to_camera[0] @ jnp.array(p))[:3])
            for p in ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.5, 1.0])
        )
        np.testing.assert_allclose(center_pixel[:2] / center_pixel[2], [192, 128], atol=1e-3)
        assert upper_pixel[1] / upper_pixel[2] < 127
        half_angle = np.arctan(0.5 * GOOD.height / float(camera.intrinsics[0, 1, 1]))
        assert 2 * half_angle == pytest.approx(LOOK.field_of_view)
    assert float(
        square_camera.intrinsics[0, 0, 0] / wide_camera.intrinsics[0, 0, 0]
    ) == pytest.approx(2.0)


TINY_LEVELS = (Level(12, 8, 1), Level(24, 16, 2))


def make_trained(step=7):
    """The parts of a run that a viewer reads: its box, and a light that comes from y > 0."""
    radiance = np.full((8, 16, 3), 0.2, np.float32)
    radiance[:, :8] = 0.6
    box = Box(jnp.zeros(3), jnp.float32(0.6))
    params = SimpleNamespace(light=EnvLight(jnp.asarray(radiance)), log_exposure=0.0)
    fields = {"params": params, "pipeline": SimpleNamespace(surface=SimpleNamespace(box=box))}
    trained = object.__new__(Trained)
    for name, value in {**fields, "step": step}.items():
        object.__setattr__(trained, name, value)
    return trained


class Watch(CheckpointWatch):
    """Returns the checkpoints that a test provides, one after the other."""

    def __init__(self, *checkpoints):
        self.waiting = list(checkpoints)

    def newer(self):
        return self.waiting.pop(0) if self.waiting else None


class Recorder(Renderer):
    """Stand-in for a renderer: records the light and the number of samples of each picture.

    It shows a disc of one material at a distance of 2.6, which faces -y.
    """

    def __init__(self, log, light="found", count=None):
        self.log, self.light, self.count = log, light, count

    def with_aovs(self, *names):
        return self

    def with_samples(self, samples):
        return Recorder(self.log, self.light, samples)

    def relit(self, light):
        return self.under(light)

    def under(self, light):
        return Recorder(self.log, np.asarray(light.radiance), self.count)

    def __call__(self, camera):
        self.log.append((self.light, self.count))
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        radius = np.hypot(x - 0.5 * camera.width, y - 0.5 * camera.height)
        alpha = np.where(radius < 0.4 * camera.height, 0.9, 0.0).astype(np.float32)
        aov_values = {"albedo": [0.6] * 3, "roughness": [0.8], "metallic": [0.25]}
        aov_values |= {"normal": [0.0, -1.0, 0.0], "depth": [2.6]}
        aovs = {name: alpha[..., None] * np.float32(value) for name, value in aov_values.items()}
        grey = 0.5 * np.stack([alpha] * 3, -1)
        return RenderedView(grey, alpha, grey, aovs)


@pytest.fixture
def recorded(monkeypatch):
    log = []
    monkeypatch.setattr(painting, "Renderer", SimpleNamespace(of=lambda trained: Recorder(log)))
    sky = np.zeros((4, 8, 3), np.float32)
    sky[:, :4] = 1.0
    return Painter(make_trained(), {"sky": same_size(EnvLight(jnp.asarray(sky)))}), log


def middle(picture):
    height, width = picture.rgb.shape[:2]
    return picture.rgb[height // 2, width // 2].astype(float) / 255


def test_every_mode_shows_what_it_says(recorded):
    painter, _ = recorded
    pictures = {mode: painter.paint(replace(LOOK, mode=mode), TINY_LEVELS[1]) for mode in MODES}
    for mode, picture in pictures.items():
        assert picture.rgb.shape == (16, 24, 3), mode
        assert picture.step == 7
        assert picture.depth[8, 12] == pytest.approx(2.6)
        assert picture.depth[0, 0] > 100
    # Nine tenths come from the sRGB value of .6, or from the numbers; the rest is the grey
    # background.
    np.testing.assert_allclose(middle(pictures["albedo"]), 0.9 * 0.797 + 0.02, atol=0.01)
    np.testing.assert_allclose(middle(pictures["roughness"]), 0.9 * 0.8 + 0.02, atol=0.01)
    np.testing.assert_allclose(middle(pictures["metallic"]), 0.9 * 0.25 + 0.02, atol=0.01)
    np.testing.assert_allclose(middle(pictures["normal"]), [0.46, 0.01, 0.46], atol=0.02)
    np.testing.assert_array_equal(pictures["render"].rgb[0, 0], 255)
    near_picture, far_picture = (
        painter.paint(replace(LOOK, mode="depth", position=(0.0, -y, 0.0)), TINY_LEVELS[1])
        for y in (2.6, 3.4)
    )
    # The scale follows the distance of the camera to the box: seen from further away, a depth of
    # 2.6 is at the front of the box.
    assert middle(far_picture).sum() > middle(near_picture).sum() + 0.3


def test_of_objects_that_are_too_far_for_a_browser_no_depth_is_sent(recorded, monkeypatch):
    painter, _ = recorded
    monkeypatch.setattr(painting, "_BEHIND_EVERYTHING", 2.7)
    assert painter.paint(LOOK, TINY_LEVELS[0]).depth.max() == np.float32(2.7)
    monkeypatch.setattr(painting, "_BEHIND_EVERYTHING", 2.5)
    assert painter.paint(LOOK, TINY_LEVELS[0]).depth is None


def test_lights_are_swapped_turned_and_scaled(recorded):
    painter, log = recorded
    looks = [
        LOOK,
        replace(LOOK, light="sky"),
        replace(LOOK, light="sky", turn=90.0, intensity=2.0),
        replace(LOOK, intensity=0.5),
    ]
    for look in looks:
        painter.paint(look, TINY_LEVELS[1])
    trained_light, sky, turned_light, dimmed_light = (light for light, _ in log)
    assert isinstance(trained_light, str)
    assert [samples for _, samples in log] == [2] * 4
    half_width = sky.shape[1] // 2
    assert sky[:, 4 : half_width - 4].min() > 0.99
    assert sky[:, half_width + 4 : -4].max() < 0.01
    # The light turns counter-clockwise seen from above; columns run the other way.
    np.testing.assert_allclose(
        turned_light, 2.0 * np.roll(sky, -half_width // 2, axis=1), atol=1e-3
    )
    assert dimmed_light.mean() == pytest.approx(0.2, abs=0.01)  # half of the trained light
    assert dimmed_light.shape == sky.shape


def test_a_camera_that_moves_keeps_the_light_it_has(recorded, monkeypatch):
    painter, _ = recorded
    calls = []
    monkeypatch.setattr(Recorder, "under", lambda self, light: calls.append(1) or self)
    for y in (-3.0, -3.5, -4.0):
        look = replace(LOOK, light="sky", position=(0.0, y, 0.0))
        painter.paint(look, TINY_LEVELS[0])
    first_count = len(calls)
    painter.paint(replace(look, turn=5.0), TINY_LEVELS[0])
    assert (first_count, len(calls)) == (2, 3)  # two for the first light, one for the turn


def test_a_newer_checkpoint_is_drawn_without_being_asked_for(monkeypatch, clock):
    monkeypatch.setattr(painting, "Renderer", SimpleNamespace(of=lambda trained: Recorder([])))
    newer_trained = make_trained(9)
    watch = Watch(make_trained())
    viewer = Viewer(watch, {}, levels=TINY_LEVELS, clock=clock)
    assert viewer.lights == (AS_TRAINED,)
    clock.now = 0.0
    assert viewer.draw(1, LOOK).level == TINY_LEVELS[0]
    clock.now = 9.0
    assert viewer.draw(1, LOOK).level == TINY_LEVELS[1]
    assert viewer.draw(1, LOOK) is None
    assert viewer.draw(2, LOOK).step == 7  # another client
    assert not viewer.refresh()
    watch.waiting.append(newer_trained)
    assert viewer.refresh()
    assert viewer.draw(1, LOOK).step == 9
    viewer.leave(1)
    assert viewer.draw(1, LOOK) is not None


def test_checkpoints_are_read_once_and_again_when_they_change(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()

    def load(run):
        steps = [int(path.stem) for path in run.checkpoints.iterdir()]
        if not steps:
            raise TrainingError("holds no checkpoint")
        return make_trained(max(steps))

    monkeypatch.setattr("geosplat_jax.viewer.source.load_trained", load)
    watch = CheckpointWatch(folder)
    with pytest.raises(TrainingError):
        watch.newer()
    (folder.checkpoints / "1.npz").write_bytes(b"1")
    assert watch.newer().step == 1
    assert watch.newer() is None
    (folder.checkpoints / "2.npz").write_bytes(b"2")
    assert watch.newer().step == 2
    shutil.rmtree(folder.checkpoints)  # the run is being replaced
    folder.checkpoints.mkdir()
    assert watch.newer() is None
    (folder.checkpoints / "1.npz").write_bytes(b"3")
    assert watch.newer().step == 1
    assert watch.newer() is None


def test_lights_come_from_files_and_folders(tmp_path):
    for name, value in (("b.hdr", 1.0), ("a.hdr", 0.5)):
        write_hdr(tmp_path / name, np.full((4, 8, 3), value, np.float32))
    (tmp_path / "notes.txt").write_text("no light")
    (tmp_path / "._a.hdr").write_text("what macOS writes beside a file")
    files = light_files([tmp_path])
    assert [path.name for path in files] == ["a.hdr", "b.hdr"]
    lights = load_lights(files, {"b": tmp_path / "a.hdr"})
    assert {light.radiance.shape for light in lights.values()} == {(128, 256, 3)}
    assert float(lights["b"].radiance.mean()) == pytest.approx(1.0, abs=0.01)
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    with pytest.raises(SceneError, match="holds no environment map"):
        light_files([other_folder])
    shutil.copy(tmp_path / "a.hdr", other_folder)
    with pytest.raises(SceneError, match="have the same name"):
        load_lights([*files, other_folder / "a.hdr"], {})


def test_a_viewer_that_cannot_start_says_why(monkeypatch):
    with socket.socket() as busy_socket:
        busy_socket.bind(("127.0.0.1", 0))
        busy_socket.listen()
        port = busy_socket.getsockname()[1]
        with pytest.raises(ViewerError, match=f"port {port} cannot be used .*--port"):
            require_free_port(port)
    with pytest.raises(ViewerError, match="from 1 to 65535, got 0"):
        require_free_port(0)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ViewerError, match=r"pip install 'geosplat_jax\[view\]'"):
        viser_library()
