"""Import of optional packages, which only some functions need; an extra installs each of them."""

import importlib
from types import ModuleType

from geosplat_jax.io.images import SceneError


def optional_package(
    module: str,
    purpose: str,
    *,
    extra: str,
    package: str | None = None,
    error: type[Exception] = SceneError,
) -> ModuleType:
    """Import an optional package; the error for a missing or broken one shows how to install it.

    Parameters
    ----------
    module : name of the module to import.
    purpose : what needs the package, the first words of the error message.
    extra : extra of ``geosplat_jax`` that installs the package.
    package : name of the package in the registry; None if it is that of the module.
    error : class of the error.

    Raises
    ------
    SceneError
        If the package is not installed or cannot be imported; another class if ``error`` names one.
    """
    needs = f"{purpose} needs the package {package or module}"
    install = f"`pip install 'geosplat_jax[{extra}]'`"
    try:
        return importlib.import_module(module)
    except ImportError as cause:
        top_level = module.partition(".")[0]
        if isinstance(cause, ModuleNotFoundError) and cause.name == top_level:
            raise error(f"{needs}; install it with {install}") from None
        raise error(
            f"{needs}, which is installed but cannot be imported ({cause}); install what it lacks, "
            f"or the package anew with {install}"
        ) from cause
