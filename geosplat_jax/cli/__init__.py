"""The ``geosplat-jax`` command."""

from geosplat_jax.cli.stopping import STOPPED, stops_soon
from geosplat_jax.core.allocator import retain_freed_memory


def main(argv: list[str] | None = None) -> int:
    """Run a command line, by default that of the process, and return its exit status.

    The status is 0 after success, 1 if gradcheck finds a wrong gradient, 2 after an error that the
    user can cure, which is printed in one line, and 130 if the command was stopped by Ctrl-C, or a
    training by SIGTERM.
    """
    retain_freed_memory()
    try:
        with stops_soon(with_process=argv is None) as say_stopped:
            try:
                # Imports take seconds, during which Ctrl-C must work already.
                from geosplat_jax.cli.calling import call

                return call(argv)
            except KeyboardInterrupt:
                say_stopped()
                return STOPPED
    except KeyboardInterrupt:  # between the last line of a command and the end of the block
        return STOPPED
