"""Event files hold every step once, its terms and the previews, also after a resume."""

import json
import shutil
import struct
import sys

import numpy as np
import pytest

from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.io.images import SceneError, write_png
from geosplat_jax.report.events import EventLog

pytestmark = pytest.mark.filterwarnings("ignore")


def add_steps(folder, *steps):
    with folder.metrics.open("a") as file:
        for step in steps:
            line = {"step": step, "stage": "split_sum", "loss": 1.0 / (step + 1), "term.l1": 0.25}
            file.write(json.dumps({**line, "usage": {"hits": 3}}) + "\n")


def events(folder):
    """Return steps and values by tag, as in the files; the value of a picture is its size."""
    kind = pytest.importorskip("tensorboardX.proto.event_pb2").Event
    entries = {}
    (path,) = (folder.path / "tensorboard").glob("events.*")
    data = path.read_bytes()
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        event = kind.FromString(data[12 : 12 + length])
        data = data[16 + length :]
        for value in event.summary.value:
            content = value.simple_value
            if value.HasField("image"):
                content = (value.image.height, value.image.width)
            entries.setdefault(value.tag, []).append((event.step, content))
    return entries


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path)


def test_steps_and_previews_are_written_once_and_anew_after_a_resume(folder):
    pytest.importorskip("tensorboardX")
    log = EventLog(folder)
    log.note()
    assert not (folder.path / "tensorboard").exists()
    add_steps(folder, 0, 1)
    log.note()
    folder.previews.mkdir()
    write_png(folder.previews / "step_000002.png", np.full((4, 6, 3), 0.5))
    with folder.metrics.open("a") as file:
        file.write('{"step": 2, "lo')  # a line that is being written
    log.note()
    log.note()
    log.close()
    entries = events(folder)
    assert entries["loss"] == [(0, 1.0), (1, 0.5)]
    assert entries["terms/l1"] == [(0, 0.25), (1, 0.25)]
    assert entries["preview"] == [(2, (4, 6))]
    assert set(entries) == {"loss", "terms/l1", "preview"}
    folder.metrics.unlink()
    add_steps(folder, 0, 3)
    resumed_log = EventLog(folder)
    resumed_log.note()
    resumed_log.close()
    assert [step for step, _ in events(folder)["loss"]] == [0, 3]


def test_a_run_that_takes_the_place_of_another_is_written_whole(folder):
    """While a model is chosen, the run that will be replaced is still there."""
    pytest.importorskip("tensorboardX")
    add_steps(folder, 0, 1, 2)
    log = EventLog(folder)
    log.note()
    shutil.rmtree(folder.path / "tensorboard")
    folder.metrics.rename(folder.path / "old")
    log.note()
    add_steps(folder, 0, 1)
    log.note()
    log.close()
    assert [step for step, _ in events(folder)["loss"]] == [0, 1]


def test_a_missing_package_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(SceneError, match=r"pip install 'geosplat_jax\[tensorboard\]'"):
        EventLog(folder)
