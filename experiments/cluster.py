"""Runs of a sweep as jobs of submitit, on Slurm or as processes on this machine.

Needs the extra ``cluster``. A job runs one command. If the cluster stops a job at its time limit,
the job is queued again, and continues from its last checkpoint.
"""

import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Any

_TIMEOUT_MIN = 24 * 60
"""Default time limit of a job, minutes."""

_PATIENCE = 60.0
"""Seconds in which a command can end after its job was cancelled."""


class Command:
    """A command as a job; if it fails, the error holds the last lines of its output."""

    def __init__(self, command: list[str]) -> None:
        self.command = command

    def __call__(self) -> None:
        """Run the command, and print its output.

        Raises
        ------
        RuntimeError
            If the command fails; the message holds the last lines of its output.
        """
        last_lines: deque[str] = deque(maxlen=60)
        with subprocess.Popen(
            self.command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as child:
            try:
                for line in child.stdout or ():
                    last_lines.append(line)
                    print(line, end="", flush=True)
            except BaseException:
                # A cancelled job ends its command as well, which then writes a checkpoint.
                child.terminate()
                try:
                    child.communicate(timeout=_PATIENCE)
                except subprocess.TimeoutExpired:
                    child.kill()
                raise
        if child.returncode:
            raise RuntimeError(
                f"the process ended with status {child.returncode}\n{''.join(last_lines)}"
            )

    def checkpoint(self) -> Any:
        """Tell submitit to queue the same command again, after a time limit or preemption."""
        import submitit

        return submitit.helpers.DelayedSubmission(Command(self.command))


def executor(folder: Path, kind: str, parameters: dict[str, Any]) -> Any:
    """Return the submitit executor that jobs are submitted to.

    Parameters
    ----------
    folder : folder for the files of submitit, which every node must see.
    kind : ``slurm`` or ``local``.
    parameters : parameters of submitit's `AutoExecutor`.

    Raises
    ------
    ImportError
        If submitit is not installed; the message says how to install it.
    """
    try:
        import submitit
    except ImportError:
        raise ImportError(
            "submitit is not installed; pip install 'geosplat_jax[cluster]'"
        ) from None
    import cloudpickle

    # Nodes cannot import this module, so that it is pickled with the job.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    auto_executor = submitit.AutoExecutor(folder=folder.resolve(), cluster=kind)
    auto_executor.update_parameters(
        **{"timeout_min": _TIMEOUT_MIN, "name": "geosplat", **parameters}
    )
    return auto_executor


def submit(executor: Any, command: list[str]) -> Any:
    """Submit a command; return submitit's job."""
    return executor.submit(Command(command))
