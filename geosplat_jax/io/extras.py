"""Packages that only some parts need: they come with an extra of the installation."""

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
    """Import a package, or say how to install it.

    Parameters
    ----------
    module : name to import. purpose : what needs it, the beginning of the message.
    extra : of the installation, that brings the package.
    package : its name where that is not the module's.
    error : to raise where it is not installed.

    Raises
    ------
    SceneError
        If it is not installed, or ``error``.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise error(
            f"{purpose} needs the package {package or module}; install it with "
            f"`pip install 'geosplat_jax[{extra}]'`"
        ) from None
