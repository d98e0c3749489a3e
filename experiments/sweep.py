"""Sweep files: many settings to train on many scenes, read and checked before any training."""

import fnmatch
import functools
import math
import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geosplat_jax.fit.config import Config, all_settings, differences
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.io.start_mesh import digest_of
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, RELIGHT_KINDS

_FOLDER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_KINDS: dict[str, Callable[[Any], bool]] = {
    "a text": lambda x: isinstance(x, str),
    "a list of texts": lambda x: isinstance(x, list) and all(isinstance(y, str) for y in x),
    "a list of tables": lambda x: isinstance(x, list) and all(isinstance(y, dict) for y in x),
    "a table": lambda x: isinstance(x, dict),
    "a positive integer": lambda x: type(x) is int and x > 0,
    "a finite number": lambda x: type(x) in (int, float) and math.isfinite(x),
}
_SWEEP_KEYS = {
    **dict.fromkeys(("title", "about", "preset", "quality", "material_prior", "mesh"), "a text"),
    **dict.fromkeys(("scenes", "set", "figures"), "a list of texts"),
    **dict.fromkeys(("samples", "downscale"), "a positive integer"),
    "run": "a list of tables",
}
_RUN_KEYS = {
    **dict.fromkeys(("name", "title", "group"), "a text"),
    "set": "a list of texts",
    **dict.fromkeys(("evaluate", "scale"), "a table"),
    "downscale": "a positive integer",
    "x": "a finite number",
}
_EVALUATE_KEYS = {"protocol": "a text", "relight_indirect": "a text"}
_EVALUATE_KEYS["samples"] = "a positive integer"


class SweepError(ValueError):
    """A sweep cannot be run as it was asked for; the message says what to change."""


@dataclass(frozen=True)
class SweepRun:
    """One setting of a sweep; see `read_sweep`."""

    name: str
    title: str
    overrides: tuple[str, ...]
    evaluate: dict[str, Any]
    x: float | None
    group: str
    downscale: int


@dataclass(frozen=True)
class Sweep:
    """A parsed sweep file; see `read_sweep`."""

    file: str
    title: str
    about: str
    preset: str
    quality: str
    material_prior: str
    scenes: tuple[str, ...]
    overrides: tuple[str, ...]
    figures: tuple[str, ...]
    samples: int
    downscale: int
    runs: tuple[SweepRun, ...]
    mesh: str = ""

    def config(self, run: SweepRun) -> Config:
        """Return the settings of a run; a start mesh is given relative to a scene's folder."""
        overrides = (*self.overrides, *run.overrides)
        return _config(self.preset, self.quality, self.material_prior, self.mesh, overrides)

    def evaluation(self, run: SweepRun) -> dict[str, Any]:
        """Return all keyword arguments of a run's evaluation."""
        defaults = {"protocol": PROTOCOLS[0], "samples": self.samples, "relight_indirect": "traced"}
        return defaults | run.evaluate


def _anywhere(mesh: str) -> MeshSettings | None:
    """Return settings of the start mesh, relative to a scene's folder; None without a mesh."""
    return MeshSettings(path=mesh) if mesh else None


@functools.lru_cache(maxsize=1024)
def _config(
    preset: str, quality: str, material_prior: str, mesh: str, overrides: tuple[str, ...]
) -> Config:
    """Build settings. Cached: it takes 30 ms, and a sweep needs those of every run many times."""
    return make_config(
        preset,
        quality,
        material_prior=material_prior,
        mesh=_anywhere(mesh),
        overrides=overrides,
    )


def in_scene(config: Config, scene: Path) -> Config:
    """Return settings of a sweep with the path of the start mesh in a scene, if they have a mesh.

    Raises
    ------
    SweepError
        If the mesh file does not exist.
    """
    if not isinstance(config.geometry, MeshSettings):
        return config
    # A link to a file of another name is not followed, since reports know the name in the sweep.
    path = scene.resolve() / config.geometry.path
    try:
        return replace(
            config, geometry=replace(config.geometry, path=str(path), digest=digest_of(path))
        )
    except ValueError as error:
        raise SweepError(str(error)) from error


def _check_keys(
    values: dict[str, Any], kinds: dict[str, str], required: Iterable[str], where: str
) -> None:
    """Refuse unknown keys, values of the wrong kind, and missing keys."""
    for key, value in values.items():
        if key not in kinds:
            raise SweepError(f"{where}: unknown key {key!r}; expected one of {sorted(kinds)}")
        if not _KINDS[kinds[key]](value):
            raise SweepError(f"{where}: {key} must be {kinds[key]}, got {value!r}")
    for key in required:
        if key not in values:
            raise SweepError(f"{where}: {key!r} is missing")


def _check_names(names: Iterable[str], kind: str, where: str) -> None:
    """Refuse names that are no folder names, and names that differ in case only or not at all."""
    seen: dict[str, str] = {}
    for name in names:
        if not _FOLDER_NAME.fullmatch(name):
            raise SweepError(
                f"{where}: the {kind} {name!r} is no folder name; take letters, digits, '.', '-' "
                "and '_', a letter or digit first"
            )
        if name.lower() in seen:
            raise SweepError(f"{where}: the {kind} {name!r} appears twice")
        seen[name.lower()] = name


def _numbers(config: Config) -> dict[str, float]:
    """Return the settings that are numbers, by path."""
    return {path: value for path, value, *_ in all_settings(config) if _is_number(value)}


def has_numbers(config: Config, pattern: str) -> bool:
    """Whether the path of a numeric setting matches a pattern; ``*`` stands for any text."""
    return any(fnmatch.fnmatchcase(path, pattern) for path in _numbers(config))


def scaled(base: Config, factors: dict[str, Any], where: str) -> tuple[str, ...]:
    """Return overrides that multiply numeric settings by factors.

    Parameters
    ----------
    base : settings to multiply.
    factors : factor above 0 by pattern of paths, in which ``*`` stands for any text.
    where : place in the sweep file, for messages.

    Returns
    -------
    Overrides. Counts are rounded; a count of 0 stays 0, and others stay at least 1.

    Raises
    ------
    SweepError
        If a factor is not above 0, or no numeric setting matches a pattern.
    """
    overrides, numbers = [], _numbers(base)
    for pattern, factor in factors.items():
        if not _is_number(factor) or factor <= 0:
            raise SweepError(f"{where}, scale: {pattern} must be a factor above 0, got {factor!r}")
        paths = [path for path in numbers if fnmatch.fnmatchcase(path, pattern)]
        if not paths:
            raise SweepError(f"{where}, scale: no number is called {pattern}")
        for path in paths:
            number, value = numbers[path], numbers[path] * factor
            is_count = type(number) is int
            overrides.append(f"{path}={max(round(value), min(number, 1)) if is_count else value}")
    return tuple(overrides)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


def _read_run(values: dict[str, Any], where: str, base: Config, downscale: int) -> SweepRun:
    """Read one [[run]] table."""
    _check_keys(values, _RUN_KEYS, ("name",), where)
    where = f"{where} {values['name']!r}"
    evaluate = values.get("evaluate", {})
    _check_keys(evaluate, _EVALUATE_KEYS, (), f"{where}, evaluate")
    for key, choices in (("protocol", PROTOCOLS), ("relight_indirect", RELIGHT_KINDS)):
        if evaluate.get(key, choices[0]) not in choices:
            raise SweepError(
                f"{where}, evaluate: {key} must be one of {tuple(choices)}, got {evaluate[key]!r}"
            )
    if "group" in values and "x" not in values:
        raise SweepError(f"{where}: group names the curve of a run with x, and there is no x")
    return SweepRun(
        name=values["name"],
        title=values.get("title", values["name"]),
        overrides=(*scaled(base, values.get("scale", {}), where), *values.get("set", ())),
        evaluate=evaluate,
        downscale=values.get("downscale", downscale),
        x=float(values["x"]) if "x" in values else None,
        group=values.get("group", "x"),
    )


def _check_settings(sweep: Sweep, where: str) -> None:
    """Build all settings, so that a bad override is found before any training.

    Runs with the same x in a group are repetitions, which may differ only in the seed.
    """
    for run in sweep.runs:
        try:
            config = sweep.config(run)
        except ValueError as error:
            raise SweepError(f"{where}, run {run.name!r}: {error}") from error
        if not config.active_stages:
            raise SweepError(f"{where}, run {run.name!r}: nothing to train: no stage has steps")
    points: dict[tuple[str, float], list[SweepRun]] = {}
    for run in sweep.runs:
        if run.x is not None:
            points.setdefault((run.group, run.x), []).append(run)
    _check_names({run.group: None for run in sweep.runs if run.x is not None}, "group", where)
    for (group, x), runs in points.items():
        first, *others = runs
        for other in others:
            changes = differences(sweep.config(first), sweep.config(other))
            if [line.split(":")[0] for line in changes] != ["run.seed"]:
                raise SweepError(
                    f"{where}: {first.name!r} and {other.name!r} are both at x = {x:g} of group "
                    f"{group!r}; repetitions differ in run.seed alone, these differ in "
                    f"{'; '.join(changes) or 'nothing'}"
                )


def read_sweep(
    path: Path,
    *,
    overrides: Iterable[str] = (),
    quality: str | None = None,
    mesh: str | None = None,
    downscale: int | None = None,
) -> Sweep:
    """Read and validate a sweep file.

    Parameters
    ----------
    path : TOML with ``title``, ``about``, ``preset``, ``quality``, ``material_prior``
        (see `presets.make_config`), ``scenes`` (folder names), ``set`` (overrides of every run),
        ``figures`` (names of ``metrics.json`` to tabulate), ``samples`` of the evaluation,
        ``downscale`` of the images, ``mesh`` (a file in every scene's folder to start from
        instead of the visual hull), and tables ``[[run]]`` with ``name``, ``title``, ``set``,
        ``scale`` (factors on settings by path, in which ``*`` stands for any text),
        ``downscale`` of the training images (all runs are evaluated on those of the sweep),
        ``evaluate`` (keyword arguments of `Run.evaluate`), ``x`` (position of the run on a
        curve) and ``group`` (name of the curve). The first run is the reference. Required are
        ``title``, ``scenes``, ``figures``, one run, and each run's ``name``.
    overrides : applied to every run after ``set`` of the file and before that of the run.
    quality, mesh, downscale : used instead of those in the file, unless None.

    Raises
    ------
    SweepError
        If the file cannot be read, or anything in it is unknown, of the wrong kind or not legal.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SweepError(f"cannot read the sweep {path}: {error}") from error
    where = path.name
    _check_keys(values, _SWEEP_KEYS, ("title", "scenes", "figures", "run"), where)
    for key in ("scenes", "figures", "run"):
        if not values[key]:
            raise SweepError(f"{where}: {key} must not be empty")
    if len(set(values["figures"])) < len(values["figures"]):
        raise SweepError(f"{where}: figures must not name one twice, got {values['figures']}")
    config_options = {
        "preset": values.get("preset", "default"),
        "quality": quality or values.get("quality", "standard"),
        "material_prior": values.get("material_prior"),
        "overrides": (*values.get("set", ()), *overrides),
    }
    mesh = values.get("mesh", "") if mesh is None else mesh
    try:
        base = make_config(**config_options, mesh=_anywhere(mesh))
    except ValueError as error:
        raise SweepError(f"{where}: {error}") from error
    downscale = values.get("downscale", 1) if downscale is None else downscale
    if downscale < 1:
        raise SweepError(f"{where}: downscale must be a positive integer, got {downscale}")
    tables = enumerate(values["run"], 1)
    sweep = Sweep(
        file=path.name,
        title=values["title"],
        about=values.get("about", "").strip(),
        **config_options | {"material_prior": base.material_prior},
        scenes=tuple(values["scenes"]),
        figures=tuple(values["figures"]),
        samples=values.get("samples", DEFAULT_SAMPLES),
        downscale=downscale,
        mesh=mesh,
        runs=tuple(
            _read_run(table, f"{where}, run {number}", base, downscale) for number, table in tables
        ),
    )
    _check_names(sweep.scenes, "scene", where)
    _check_names((run.name for run in sweep.runs), "run", where)
    _check_settings(sweep, where)
    return sweep
