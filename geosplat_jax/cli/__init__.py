"""The ``geosplat-jax`` command."""

import sys

from geosplat_jax.cli.stopping import STOPPED, stops_soon


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its status.

    Errors that a user can cure print one line and return 2, Ctrl-C and SIGTERM, where they can be
    noticed, 130.
    """
    try:
        with stops_soon():
            # Imports take seconds, in which somebody may have second thoughts.
            from geosplat_jax.cli.calling import call

            return call(argv)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return STOPPED
