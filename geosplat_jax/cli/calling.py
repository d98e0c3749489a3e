"""Dispatch of a command line to its command, and reports of errors."""

import warnings

from jax.errors import JaxRuntimeError

from geosplat_jax.cli.arguments import command_line
from geosplat_jax.cli.commands import COMMANDS, GradientError, UsageError
from geosplat_jax.cli.display import say, show_warning
from geosplat_jax.cli.stopping import STOPPED
from geosplat_jax.core.settings import first_line
from geosplat_jax.fit.folder import RunError
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.train import Interrupted, TrainingError
from geosplat_jax.io.checkpoints import CheckpointError
from geosplat_jax.io.images import SceneError
from geosplat_jax.io.memory import is_out_of_memory

_CURABLE = (
    SceneError,
    UsageError,
    RunError,
    TrainingError,
    CheckpointError,
    OSError,
    ValueError,
)


def call(argv: list[str] | None) -> int:
    """Run the command line and return its status; see `cli.main`."""
    arguments = command_line().parse_args(argv)
    enable_compilation_cache()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
            COMMANDS[arguments.command](arguments)
    except Interrupted as stop:
        say(str(stop))
        return STOPPED
    except GradientError as error:
        say(str(error))
        return 1
    except _CURABLE as error:
        say(str(error), label="error: ", style="bold red")
        return 2
    except (MemoryError, JaxRuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        detail = first_line(error) or type(error).__name__
        say(f"memory ran out: {detail}", label="error: ", style="bold red")
        return 2
    return 0
