"""The ``geosplat-jax`` command."""

from geosplat_jax.cli.stopping import STOPPED, stops_soon
from geosplat_jax.core.allocator import retain_freed_memory


def main(argv: list[str] | None = None) -> int:
    """Run the command line, that of the process by default, and return its status.

    The status is 0 after success, 1 where gradcheck finds a wrong gradient, 2 after an error that a
    user can cure, which is printed in one line, and 130 where somebody stopped the command.
    """
    retain_freed_memory()
    try:
        with stops_soon(with_process=argv is None) as say_stopped:
            try:
                # Imports take seconds, in which somebody may have second thoughts.
                from geosplat_jax.cli.calling import call

                return call(argv)
            except KeyboardInterrupt:
                say_stopped()
                return STOPPED
    except KeyboardInterrupt:  # between the last line of a command and the end of the block
        return STOPPED
