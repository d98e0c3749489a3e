"""Runs of a sweep as jobs of submitit: of Slurm, or of processes on this machine.

The extra ``cluster``. A job calls a command and ends with it. Where the cluster ends a job for its
time, it is put into the queue again and goes on from its last checkpoint.
"""

import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Any

_TIMEOUT_MIN = 24 * 60
"""Minutes that a job may take, where nobody says otherwise."""

_PATIENCE = 60.0
"""Seconds that a command has to end in once its job is cancelled."""


class Command:
    """A command as a job; what it says last is in the error where it fails."""

    def __init__(self, command: list[str]) -> None:
        self.command = command

    def __call__(self) -> None:
        """Run it.

        Raises
        ------
        RuntimeError
            With its last lines, where it ends badly.
        """
        tail: deque[str] = deque(maxlen=60)
        with subprocess.Popen(
            self.command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as child:
            try:
                for line in child.stdout or ():
                    tail.append(line)
                    print(line, end="", flush=True)
            except BaseException:
                # A job that is cancelled takes its command along, which writes a checkpoint.
                child.terminate()
                try:
                    child.communicate(timeout=_PATIENCE)
                except subprocess.TimeoutExpired:
                    child.kill()
                raise
        if child.returncode:
            raise RuntimeError(f"the process ended with status {child.returncode}\n{''.join(tail)}")

    def checkpoint(self) -> Any:
        """Tell submitit to call the same again, after a time limit or where others come first."""
        import submitit

        return submitit.helpers.DelayedSubmission(Command(self.command))


def executor(folder: Path, kind: str, parameters: dict[str, Any]) -> Any:
    """Return what jobs are submitted to.

    Parameters
    ----------
    folder : for its files, which every node must see.
    kind : ``slurm`` or ``local``.
    parameters : of submitit's `AutoExecutor`.

    Raises
    ------
    ImportError
        Without submitit, with how to install it.
    """
    try:
        import submitit
    except ImportError:
        raise ImportError(
            "submitit is not installed; pip install 'geosplat_jax[cluster]'"
        ) from None
    import cloudpickle

    # Nodes have no path to this module.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    found = submitit.AutoExecutor(folder=folder.resolve(), cluster=kind)
    found.update_parameters(**{"timeout_min": _TIMEOUT_MIN, "name": "geosplat", **parameters})
    return found


def submit(executor: Any, command: list[str]) -> Any:
    """Submit a command; return submitit's job."""
    return executor.submit(Command(command))
