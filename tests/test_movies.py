"""Films have the right frames, rate and colours; a failed write leaves the old file in place."""

import json
import os
import shutil
import stat
import subprocess
import sys
import types
import weakref

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from geosplat_jax.io.images import SceneError
from geosplat_jax.io.movies import MissingEncoderError, has_encoder, write_movie


def ramp_frames(count=5, height=40, width=60):
    """A smooth coloured ball that moves over white."""
    y, x = np.mgrid[:height, :width]
    frames = []
    for k in range(count):
        dx, dy = (x - 20 - 4 * k) / 14, (y - height / 2) / 14
        inside = dx**2 + dy**2 < 1
        shade = np.sqrt(np.clip(1 - dx**2 - dy**2, 0, None))
        color = np.stack([shade, 0.6 * shade, 0.3 + 0.5 * shade], -1)
        frames.append(np.where(inside[..., None], color, 1.0).astype(np.float32))
    return frames


def read_gif(path):
    """Frames as (F, H, W, 3) in [0, 1], their durations in ms, and the number of loops."""
    with Image.open(path) as film:
        frames, durations, loop = [], [], film.info.get("loop")
        for k in range(getattr(film, "n_frames", 1)):
            film.seek(k)
            frames.append(np.asarray(film.convert("RGB"), np.float32) / 255)
            durations.append(film.info.get("duration"))
    return np.stack(frames), durations, loop


def blurred(frames):
    """Means over blocks of four by four pixels, which dithering preserves."""
    count, height, width, _ = frames.shape
    return frames.reshape(count, height // 4, 4, width // 4, 4, 3).mean((2, 4))


def test_gif_keeps_frames_rate_and_colours_and_loops_for_ever(tmp_path):
    frames = ramp_frames()
    write_movie(tmp_path / "new" / "film.gif", frames, frames_per_second=25)
    decoded_frames, durations, loop = read_gif(tmp_path / "new" / "film.gif")
    assert decoded_frames.shape == (5, 40, 60, 3)
    assert durations == [40] * 5
    assert loop == 0
    assert np.abs(blurred(decoded_frames) - blurred(np.stack(frames))).max() < 0.03
    assert np.sqrt(np.mean((decoded_frames - np.stack(frames)) ** 2)) < 0.03
    np.testing.assert_array_equal(decoded_frames[:, :3], 1.0)
    assert os.listdir(tmp_path / "new") == ["film.gif"]


def test_gif_gradients_are_dithered_not_banded(tmp_path):
    # 3 x 4096 colours: far more than a palette holds.
    levels = np.linspace(0, 1, 64)
    red, green = np.meshgrid(levels, levels)
    frames = [np.stack([red, green, np.full_like(red, b)], -1) for b in (0.0, 0.5, 1.0)]
    write_movie(tmp_path / "film.gif", frames, frames_per_second=10)
    decoded_frames, _, _ = read_gif(tmp_path / "film.gif")
    inner = np.s_[:, 1:-1, 1:-1]
    errors = (blurred(decoded_frames) - blurred(np.stack(frames)))[inner]
    assert np.sqrt(np.mean(errors**2)) < 0.03
    raw_errors = decoded_frames - np.stack(frames)
    assert np.sqrt(np.mean(raw_errors**2)) > 1.5 * np.sqrt(np.mean(errors**2))


def test_gif_colours_that_fit_a_palette_are_exact_and_still_in_all_frames(tmp_path):
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 256, (40, 3)).astype(np.float32) / 255
    frames = [colors[rng.integers(0, 40, (20, 24))] for _ in range(4)]
    write_movie(tmp_path / "film.gif", frames, frames_per_second=10)
    decoded_frames, _, _ = read_gif(tmp_path / "film.gif")
    np.testing.assert_allclose(decoded_frames, np.stack(frames), atol=1e-6)


def test_frames_may_be_made_when_they_are_asked_for(tmp_path):
    """Only one frame exists as floats at a time, however long the film is."""
    frames, references = ramp_frames(5), []

    def made():
        for frame in frames:
            references.append(weakref.ref(frame_copy := frame.copy()))
            yield frame_copy
            del frame_copy
            assert sum(reference() is not None for reference in references) <= 1

    write_movie(tmp_path / "lazy.gif", made(), frames_per_second=10)
    write_movie(tmp_path / "film.gif", frames, frames_per_second=10)
    assert (tmp_path / "lazy.gif").read_bytes() == (tmp_path / "film.gif").read_bytes()


def test_palette_of_a_long_film_is_made_from_all_columns(tmp_path, monkeypatch):
    monkeypatch.setattr("geosplat_jax.io.movies._PALETTE_PIXELS", 400)
    colors = np.linspace(0, 1, 32).astype(np.float32)
    frames = [np.tile(colors[None, :, None], (32, 1, 3)) * [1.0, 1.0, k / 2] for k in range(3)]
    write_movie(tmp_path / "film.gif", frames, frames_per_second=10)
    decoded_frames, _, _ = read_gif(tmp_path / "film.gif")
    np.testing.assert_allclose(decoded_frames, np.rint(np.stack(frames) * 255) / 255, atol=0.01)


@pytest.mark.parametrize("rate", [7, 24, 30, 50])
def test_gif_lasts_as_long_as_it_should(tmp_path, rate):
    write_movie(tmp_path / "film.gif", ramp_frames(9, 20, 60), frames_per_second=rate)
    _, durations, _ = read_gif(tmp_path / "film.gif")
    assert len(durations) == 9
    assert abs(sum(durations) - 9000 / rate) <= 5
    assert max(durations) - min(durations) <= 10


def test_gif_of_equal_frames_and_of_one_frame_keep_their_time(tmp_path):
    frame = ramp_frames(1)[0]
    for count in (1, 3):
        write_movie(tmp_path / "film.gif", [frame] * count, frames_per_second=10)
        decoded_frames, durations, _ = read_gif(tmp_path / "film.gif")
        assert sum(durations) == 100 * count
        assert np.abs(decoded_frames - frame).max() < 0.2


def test_a_still_longer_than_gif_can_store_is_refused(tmp_path):
    path, still, other = tmp_path / "a.gif", np.zeros((4, 5, 3)), np.ones((4, 5, 3))
    write_movie(path, [other, *65 * [still], other, still], frames_per_second=0.1)
    with Image.open(path) as film:
        film.seek(1)
        assert film.info["duration"] == 650_000
    before = path.read_bytes()
    with pytest.raises(SceneError, match="one picture for more than 655 s"):
        write_movie(path, [other, *66 * [still], other], frames_per_second=0.1)
    assert path.read_bytes() == before


def test_upper_case_suffix_jax_arrays_and_values_outside_are_accepted(tmp_path):
    frames = [jnp.full((4, 4, 3), value) for value in (-0.5, 1.5)]
    write_movie(str(tmp_path / "film.GIF"), frames, frames_per_second=10)
    decoded_frames, _, _ = read_gif(tmp_path / "film.GIF")
    np.testing.assert_array_equal(decoded_frames[:, 0, 0, 0], [0.0, 1.0])


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "at least one frame"),
        ([np.zeros((4, 4, 3)), np.zeros((4, 5, 3))], "one size"),
        ([np.zeros((4, 4))], r"frame 0 must be \(H, W, 3\)"),
        ([np.zeros((4, 4, 3)), np.zeros((4, 4, 4))], r"frame 1 must be \(H, W, 3\)"),
        ([np.zeros((0, 4, 3))], "frame 0 must be"),
        ([np.zeros((4, 4, 3), np.uint8)], "divide bytes by 255"),
        ([np.zeros((4, 4, 3)), np.full((4, 4, 3), np.nan)], "frame 1 has 48 values"),
        ([np.full((4, 4, 3), np.inf)], "not finite"),
    ],
)
def test_unusable_frames_are_named_and_leave_the_old_film(tmp_path, frames, message):
    path = tmp_path / "film.gif"
    path.write_bytes(b"old")
    with pytest.raises(SceneError, match=message):
        write_movie(path, frames, frames_per_second=10)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["film.gif"]


@pytest.mark.parametrize("name", ["film", "film.avi", "film.png"])
def test_unknown_suffixes_are_refused(tmp_path, name):
    with pytest.raises(SceneError, match=r"must end in \.gif or \.mp4"):
        write_movie(tmp_path / name, ramp_frames(1), frames_per_second=10)


@pytest.mark.parametrize(
    ("name", "rate"),
    [("a.gif", 0), ("a.gif", -1), ("a.gif", 60), ("a.gif", np.nan), ("a.mp4", 0), ("a.mp4", 2000)],
)
def test_unusable_rates_are_refused(tmp_path, name, rate):
    with pytest.raises(SceneError, match="frames per second"):
        write_movie(tmp_path / name, ramp_frames(1), frames_per_second=rate)


def install_fake(folder, monkeypatch, body, *, encoder="libx264"):
    """Make a fake ffmpeg the only program on the PATH; ``body`` is its code.

    ``encoder`` : name of the encoder that it lists.
    """
    folder.mkdir()
    program = folder / "ffmpeg"
    listing = f"if '-encoders' in sys.argv:\n    sys.exit(print(' V....D {encoder} H.264'))\n"
    header = f"#!{sys.executable}\nimport json, sys\nfrom pathlib import Path\n"
    program.write_text(f"{header}{listing}{body}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(folder))


on_posix = pytest.mark.skipif(os.name != "posix", reason="the fake program is a script")

RECORD = """
received = sys.stdin.buffer.read()
target = Path(sys.argv[-1].removeprefix("file:"))
target.write_bytes(received)
Path(__file__).with_name("arguments.json").write_text(json.dumps(sys.argv[1:]))
"""


@on_posix
def test_encoder_receives_even_frames_and_h264_settings(tmp_path, monkeypatch):
    install_fake(tmp_path / "bin", monkeypatch, RECORD)
    frames = ramp_frames(3, 5, 7)
    assert has_encoder(".mp4")
    write_movie(tmp_path / "film.mp4", frames, frames_per_second=24)
    actual = np.frombuffer((tmp_path / "film.mp4").read_bytes(), np.uint8).reshape(3, 6, 8, 3)
    expected = np.rint(np.stack(frames) * 255).astype(np.uint8)
    np.testing.assert_array_equal(actual[:, :5, :7], expected)
    np.testing.assert_array_equal(actual[:, 5, :7], expected[:, 4])
    np.testing.assert_array_equal(actual[:, :, 7], actual[:, :, 6])
    arguments = json.loads((tmp_path / "bin" / "arguments.json").read_text())
    assert "-y" in arguments
    options = dict(zip(arguments, arguments[1:], strict=False))
    assert options["-s"] == "8x6"
    assert options["-framerate"] == "24"
    assert options["-c:v"] == "libx264"
    # The pixel formats of input and output are both given; the dictionary holds the output's.
    assert options["-pix_fmt"] == "yuv420p"
    assert arguments.index("rgb24") < arguments.index("-i") < arguments.index("yuv420p")
    assert sorted(os.listdir(tmp_path)) == ["bin", "film.mp4"]


@on_posix
@pytest.mark.parametrize(
    "body",
    [
        "sys.stdin.buffer.read()\nprint('Unknown encoder libx264', file=sys.stderr)\nsys.exit(3)",
        # This one stops before it has read anything, so writing to it fails.
        "print('Unknown encoder libx264', file=sys.stderr)\nsys.exit(3)",
    ],
)
def test_failure_of_the_encoder_is_told_and_the_old_film_stays(tmp_path, monkeypatch, body):
    install_fake(tmp_path / "bin", monkeypatch, body)
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")
    # These frames are larger than the buffer of any pipe.
    frames = [np.zeros((300, 400, 3), np.float32)] * 2
    with pytest.raises(OSError, match=r"status 3 \(Unknown encoder libx264\).*\.gif"):
        write_movie(path, frames, frames_per_second=24)
    assert path.read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == ["bin", "film.mp4"]


@on_posix
def test_encoder_that_writes_nothing_is_an_error(tmp_path, monkeypatch):
    install_fake(tmp_path / "bin", monkeypatch, "sys.stdin.buffer.read()")
    with pytest.raises(OSError, match="no message"):
        write_movie(tmp_path / "film.mp4", ramp_frames(2), frames_per_second=24)


def test_the_encoder_of_a_package_serves_where_none_is_on_the_path(tmp_path, monkeypatch):
    install_fake(tmp_path / "bin", monkeypatch, RECORD)
    package = types.SimpleNamespace(get_ffmpeg_exe=lambda: str(tmp_path / "bin" / "ffmpeg"))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", package)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert has_encoder(".mp4")
    write_movie(tmp_path / "film.mp4", ramp_frames(2, 4, 4), frames_per_second=24)
    assert (tmp_path / "film.mp4").stat().st_size == 2 * 4 * 4 * 3


@on_posix
def test_a_program_without_h264_is_none_and_hides_none(tmp_path, monkeypatch):
    install_fake(tmp_path / "bundled", monkeypatch, RECORD)
    install_fake(tmp_path / "bin", monkeypatch, RECORD, encoder="libopenh264")
    package = types.SimpleNamespace(get_ffmpeg_exe=lambda: str(tmp_path / "bundled" / "ffmpeg"))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert not has_encoder(".mp4")
    with pytest.raises(MissingEncoderError, match="with libx264"):
        write_movie(tmp_path / "film.mp4", ramp_frames(1), frames_per_second=24)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", package)
    assert has_encoder(".mp4")
    write_movie(tmp_path / "film.mp4", ramp_frames(2, 4, 4), frames_per_second=24)
    assert (tmp_path / "bundled" / "arguments.json").exists()
    assert not (tmp_path / "bin" / "arguments.json").exists()


def test_missing_encoder_names_the_cure(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert not has_encoder(".mp4")
    assert has_encoder(".gif")
    assert has_encoder(".GIF")
    assert not has_encoder(".avi")
    with pytest.raises(MissingEncoderError, match=r"install one.*write \.gif"):
        write_movie(tmp_path / "film.mp4", ramp_frames(1), frames_per_second=24)
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_mp4_decodes_to_the_frames(tmp_path):
    frames = ramp_frames(6, 41, 61)
    path = tmp_path / "film.mp4"
    try:
        write_movie(path, frames, frames_per_second=24)
    except OSError as error:
        if "Unknown encoder" not in str(error):
            raise
        pytest.skip(f"this ffmpeg has no H.264 encoder: {error}")
    raw_video = subprocess.run(
        ["ffmpeg", "-loglevel", "error", "-i", str(path)]
        + ["-vf", "scale=in_color_matrix=bt709,format=rgb24", "-f", "rawvideo", "pipe:1"],
        check=True,
        capture_output=True,
    ).stdout
    decoded_frames = np.frombuffer(raw_video, np.uint8).reshape(-1, 42, 62, 3) / 255
    assert decoded_frames.shape[0] == 6
    assert np.abs(decoded_frames[:, :41, :61] - np.stack(frames)).mean() < 0.015
    assert np.abs(decoded_frames[:, :3] - 1).max() < 0.03
