"""TensorBoard event files: the scalars of every step and the previews, during training."""

import json
import shutil
from typing import Any

import numpy as np

from geosplat_jax.fit.folder import EVENTS, RunFolder
from geosplat_jax.fit.listener import Listener, Progress
from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.images import read_image

_SHOWN = ("loss", "psnr", "splats", "faces", "seconds", "peak_memory_mb")
_TERM = "term."


class EventLog(Listener):
    """Copies ``metrics.jsonl`` and the previews of a run into ``tensorboard/`` in its folder.

    When a run is resumed, the event files are written again from the first step, so that no step
    occurs twice.

    Parameters
    ----------
    folder : folder of the run, which need not exist yet.

    Raises
    ------
    SceneError
        If tensorboardX is not installed.
    """

    def __init__(self, folder: RunFolder) -> None:
        library = optional_package("tensorboardX", "--tensorboard", extra="tensorboard")
        self._kind, self._folder = library.SummaryWriter, folder
        self._writer: Any = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Reset the state, so that `note` writes new event files from the first step."""
        if self._writer is not None:
            self._writer.close()
        self._writer = None
        self._inode: int | None = None
        self._bytes_read = 0
        self._shown: set[str] = set()

    def on_step(self, progress: Progress) -> None:
        """Write what has been added since the last step."""
        del progress  # the files know more
        self.note()

    def note(self) -> None:
        """Write what was added since the last call, or everything if ``metrics.jsonl`` is new."""
        if not self._folder.metrics.exists():
            return
        inode = self._folder.metrics.stat().st_ino
        if self._inode not in (None, inode):
            self._begin_anew()
        self._inode = inode
        if self._writer is None:
            target = self._folder.path / EVENTS
            shutil.rmtree(target, ignore_errors=True)
            self._writer = self._kind(logdir=str(target))
        with self._folder.metrics.open("rb") as stream:
            stream.seek(self._bytes_read)
            new_bytes = stream.read()
        whole_lines = new_bytes[: new_bytes.rfind(b"\n") + 1]
        self._bytes_read += len(whole_lines)
        for text in whole_lines.splitlines():
            self._write_step(json.loads(text))
        for path in sorted(self._folder.previews.glob("step_*.png")):
            if path.name not in self._shown:
                self._shown.add(path.name)
                picture = np.round(255.0 * read_image(path)[..., :3]).astype(np.uint8)
                step = int(path.stem.removeprefix("step_"))
                self._writer.add_image("preview", picture, step, dataformats="HWC")

    def _write_step(self, line: dict[str, Any]) -> None:
        for name, value in line.items():
            if name in _SHOWN:
                self._writer.add_scalar(name, value, line["step"])
            elif name.startswith(_TERM):
                self._writer.add_scalar(f"terms/{name.removeprefix(_TERM)}", value, line["step"])

    def close(self) -> None:
        """Write what is left and close the files, if `note` has written any."""
        if self._writer is not None:
            self.note()
            self._writer.close()
