"""``python -m geosplat_jax``: the command without its installation."""

import sys

from geosplat_jax.cli import main

sys.exit(main())
