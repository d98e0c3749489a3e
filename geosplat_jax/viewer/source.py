"""The run and the lights of a viewer: newer checkpoints as they appear, and environment maps."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.train import Trained, TrainingError, load_trained
from geosplat_jax.io.checkpoints import CheckpointError
from geosplat_jax.io.images import SceneError
from geosplat_jax.report.light_metrics import resize_light
from geosplat_jax.report.relight import load_light

LIGHT_ROWS = 128
"""Rows of all lights in a viewer: with one size, programs are compiled once."""

_LIGHT_SUFFIXES = (".hdr", ".exr")


class CheckpointWatch:
    """Reads the last checkpoint of a run whenever there is a newer one.

    Parameters
    ----------
    folder : folder of the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._seen: tuple[tuple[str, int], ...] | None = None

    def _listed(self) -> tuple[tuple[str, int], ...]:
        """Return the names of the checkpoints, and the times when they were written."""
        files = []
        for path in sorted(self._folder.checkpoints.glob("*.npz")):
            try:
                files.append((path.name, path.stat().st_mtime_ns))
            except FileNotFoundError:  # replaced by a newer one at this moment
                continue
        return tuple(files)

    def newer(self) -> Trained | None:
        """Return the parameters of the last checkpoint if they are new, otherwise None.

        None as well if reading fails because the folder is being written; the next call tries
        again.

        Raises
        ------
        TrainingError, RunError, CheckpointError, OSError
            If no checkpoint can be read, and none was read by an earlier call.
        """
        checkpoint_times = self._listed()
        if checkpoint_times == self._seen:
            return None
        try:
            trained = load_trained(self._folder)
        except (TrainingError, RunError, CheckpointError, OSError):
            if self._seen is None:
                raise
            return None
        self._seen = checkpoint_times
        return trained


def same_size(light: EnvLight) -> EnvLight:
    """Bring a light to the size of all lights in a viewer."""
    pixels = resize_light(np.asarray(light.radiance), LIGHT_ROWS, 2 * LIGHT_ROWS)
    return EnvLight(jnp.asarray(pixels, jnp.float32))


def light_files(paths: Iterable[Path]) -> list[Path]:
    """List environment maps: the given files, and the HDR and EXR files in the given folders.

    Raises
    ------
    SceneError
        If a folder has none.
    """
    files = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        light_maps = sorted(
            p
            for p in path.iterdir()
            if p.suffix.lower() in _LIGHT_SUFFIXES and not p.name.startswith(".")
        )
        if not light_maps:
            raise SceneError(f"{path} holds no environment map (.hdr or .exr)")
        files += light_maps
    return files


def load_lights(files: Iterable[Path], known: Mapping[str, Path]) -> dict[str, EnvLight]:
    """Read environment maps by name.

    Parameters
    ----------
    files : maps that are named after their files.
    known : further maps by name, such as those of a scene.

    Raises
    ------
    SceneError
        If two files have the same name, or a map cannot be read, see `load_light`.
    """
    paths: dict[str, Path] = {}
    for path in files:
        if path.stem in paths and path.resolve() != paths[path.stem].resolve():
            raise SceneError(f"{paths[path.stem]} and {path} have the same name; rename one")
        paths[path.stem] = path
    return {name: same_size(load_light(path)) for name, path in {**known, **paths}.items()}
