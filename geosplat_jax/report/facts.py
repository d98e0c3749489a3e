"""Facts about a run for the report, in words and numbers; reads its files, without JAX.

Names and units of figures, times of the stages, settings that differ from the preset, and the
command that repeats the training.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from geosplat_jax.core.settings import as_written
from geosplat_jax.fit.config import Config, changed_settings
from geosplat_jax.fit.presets import BETWEEN, PRESETS, QUALITIES, make_config
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.io.dataset import READING
from geosplat_jax.materials import MATERIAL_PRIORS
from geosplat_jax.report.protocols import NEW_VIEWS, ObjectRendition, Protocol, Rendition, protocol

_MEASURES = {
    "psnr": ("PSNR", "dB", "higher"),
    "psnr_h": ("PSNR-H", "dB", "higher"),
    "psnr_l": ("PSNR-L", "dB", "higher"),
    "ssim": ("SSIM", "", "higher"),
    "mse": ("mean squared error", "", "lower"),
    "iou": ("intersection over union", "", "higher"),
    "mae": ("mean angle", "degrees", "lower"),
    "scale": ("factor to the truth", "", ""),
    "scale_ratio": ("wrong colour: largest factor over the smallest", "", "lower"),
    "correlation": ("correlation of log luminance", "", "higher"),
    "direction_error": ("angle between mean directions", "degrees", "lower"),
    "yaw_error": ("turn about the vertical axis", "degrees", ""),
    "yaw_correlation": ("correlation after the best turn", "", "higher"),
    "is_mirrored": ("the map is mirrored: 1 for yes", "", "lower"),
    "mirrored_correlation": ("correlation of the mirrored map", "", ""),
}
"""Title, unit and better direction of a figure, by the end of its key."""

_REGIONS = {
    "masked": "object's pixels",
    "full": "all pixels",
    "r": "red",
    "g": "green",
    "b": "blue",
}

_GROUPS = {
    "nvs": "New views",
    "mask": "Silhouettes",
    "normal": "Normals",
    "albedo": "Albedo",
    "roughness": "Roughness",
    "metallic": "Metallic",
    "light": "Light",
}

_LONGEST_CURVE = 800
"""Points of a curve at most; of longer ones every n-th step is shown, and the page says so."""


@dataclass(frozen=True)
class Figure:
    """One line of the table of figures.

    Attributes
    ----------
    key : name in ``metrics.json``.
    group, label, unit : texts for the table.
    better : ``higher``, ``lower``, or empty where neither is better.
    """

    key: str
    group: str
    label: str
    unit: str
    better: str


def figure(key: str) -> Figure:
    """Describe a figure of ``metrics.json`` by its key; an unknown one keeps its key as label."""
    group, _, measure_key = key.partition(".")
    title = _GROUPS.get(group, group)
    if group == "relight":
        light, _, measure_key = measure_key.rpartition(".")
        title = "New lights, mean" if light == "mean" else f"New light: {light}"
    name, qualifiers = measure_key.removesuffix("_deg"), []
    while name not in _MEASURES and "_" in name:
        name, _, region = name.rpartition("_")
        qualifiers.append(_REGIONS.get(region, region))
    if name not in _MEASURES:
        return Figure(key, title, measure_key, "", "")
    label, unit, better = _MEASURES[name]
    return Figure(key, title, ", ".join([label, *qualifiers]), unit, better)


def _rendition(rendition: Rendition | ObjectRendition) -> str:
    """Say how pictures are compared."""
    if isinstance(rendition, ObjectRendition):
        scale = "each channel of each image scaled by least squares"
        return f"on the object alone, {scale if rendition.is_scaled else 'without a scale'}"
    encodings = {"linear": "in linear light", "srgb": "in sRGB", "gamma22": "after gamma 2.2"}
    grey = {0.0: "black", 1.0: "white"}.get(rendition.background, f"grey {rendition.background:g}")
    channels = ", by the mean PSNR of the channels" if rendition.is_by_channel else ""
    return f"{encodings[rendition.encoding]} on {grey}{channels}"


def protocol_text(name: str) -> str:
    """Say in sentences what a protocol compares, and how."""
    rules: Protocol = protocol(name)
    scale = {"least_squares": "least squares", "median": "the median of ratios"}
    benchmark = ""
    if rules.new_views is not None:
        names = [_MEASURES[figure.name][0] for figure in rules.new_views.figures]
        benchmark = f" (and, for {' and '.join(names)}, {_rendition(rules.new_views)})"
    return (
        f"Protocol {rules.name}. New views are compared {_rendition(NEW_VIEWS)}{benchmark}, albedo "
        f"{_rendition(rules.albedo)} after one factor for each channel by "
        f"{scale[rules.albedo_scale]}, relit images {_rendition(rules.relight)} with the albedo "
        "in that scale. Figures of other protocols are not comparable."
    )


def curves(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Extract the curves from the lines of ``metrics.jsonl``.

    Returns
    -------
    dict of lists ``step``, ``loss``, ``psnr`` (dB), ``splats`` and ``memory`` (MB), over every
    ``every``-th step and the last one; of ``every``; and of ``stages``, the name and first step of
    each.
    """
    stride = -(-len(lines) // _LONGEST_CURVE) if lines else 1
    rows = [line for n, line in enumerate(lines) if n % stride == 0 or n == len(lines) - 1]
    stages, last_stage = [], None
    for line in lines:
        if line["stage"] != last_stage:
            last_stage = line["stage"]
            stages.append({"name": last_stage, "step": line["step"]})
    columns = {"loss": "loss", "psnr": "psnr", "splats": "splats", "memory": "peak_memory_mb"}
    values = {name: [_finite(line.get(key)) for line in rows] for name, key in columns.items()}
    return {"step": [line["step"] for line in rows], **values, "stages": stages, "every": stride}


def rung_row(rung: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    """Format a rung of ``run.json``: part of the model, PSNR without and with it, gain, verdict."""
    comparison, gain = rung["found"], "-"
    smaller_psnr, larger_psnr = (
        "-" if psnr is None else f"{psnr:.2f} dB" for psnr in (rung["smaller"], rung["larger"])
    )
    if comparison is not None:
        gain = f"{comparison['gain']:+.2f} +- {comparison['standard_error']:.2f} dB"
        if comparison["spread"]:
            gain += f", seeds {comparison['spread']:.2f}"
        if comparison.get("seeds", 1) > 1:
            gain += f" (mean of {comparison['seeds']})"
    verdict = "kept" if rung["is_kept"] else "left out"
    if rung["note"]:
        separator = ": " if comparison is None else ", " if rung["is_kept"] else ", even "
        verdict += separator + rung["note"]
    return rung["title"], smaller_psnr, larger_psnr, gain, verdict


def _finite(value: Any) -> float | int | None:
    """Return a number that JSON can hold, or None."""
    return value if isinstance(value, int | float) and np.isfinite(value) else None


def stage_times(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Summarise each stage: number of steps, seconds, median step and longest step, in seconds.

    The longest step includes the compilation.
    """
    seconds: dict[str, list[float]] = {}
    for line in lines:
        seconds.setdefault(line["stage"], []).append(float(line["seconds"]))
    return [
        {
            "stage": stage,
            "steps": len(times),
            "seconds": sum(times),
            "median": float(np.median(times)),
            "longest": max(times),
        }
        for stage, times in seconds.items()
    ]


def _level_of(config: Config) -> str:
    """Return the quality level that settings are compared with: their own, if they have one."""
    return "standard" if config.quality == BETWEEN else config.quality


def _compared_with(config: Config) -> tuple[str, str, str | None]:
    """Return preset, quality level and material prior (or None) that settings are compared with.

    Labels are free texts in Python; in place of unknown ones stand the defaults.
    """
    level = _level_of(config)
    return (
        config.preset if config.preset in PRESETS else PRESETS[0],
        level if level in QUALITIES else "standard",
        config.material_prior if config.material_prior in MATERIAL_PRIORS else None,
    )


def _preset_of(config: Config, overrides: Sequence[str] = ()) -> Config:
    """Return the preset that ``config`` is compared with, with the labels of ``config``."""
    geometry, (name, level, prior) = config.geometry, _compared_with(config)
    preset = make_config(
        name,
        level,
        material_prior=prior,
        mesh=geometry.file if isinstance(geometry, MeshSettings) else None,
        overrides=tuple(overrides),
    )
    return replace(
        preset,
        preset=config.preset,
        quality=config.quality,
        material_prior=config.material_prior,
    )


def changed_from_preset(config: Config) -> dict[str, tuple[Any, Any]]:
    """Map each setting that differs from the preset to both values, that of the preset first."""
    return changed_settings(_preset_of(config), config)


_NAMED = ("downscale", "light")
"""Options of `READING` that the command has as well; the others exist in Python only."""


def command(record: Mapping[str, Any], config: Config) -> tuple[str, bool]:
    """Return the command that trains the run again, and whether it holds all settings.

    Parameters
    ----------
    record : content of ``run.json``.
    config : the settings in it.
    """
    words = ["geosplat-jax", "train", str(record["scene"]), "--output", "runs/again"]
    preset, level, prior = _compared_with(config)
    words += ["--preset", preset, "--quality", level]
    words += ["--material-prior", prior] if prior is not None else []
    if isinstance(config.geometry, MeshSettings):
        words += ["--mesh", config.geometry.path]
    reading = record["dataset"]
    if reading.get("downscale", 1) != 1:
        words += ["--downscale", str(reading["downscale"])]
    for name in ("light", "cameras"):
        if reading.get(name):
            words += [f"--{name}", str(reading[name])]
    if reading.get("bounds"):
        words += ["--bounds", *(f"{x:.9g}" for x in reading["bounds"])]
    overrides = [
        f"{path}={as_written(new)}" for path, (_, new) in changed_from_preset(config).items()
    ]
    try:
        is_whole = not changed_settings(_preset_of(config, overrides), config)
    except ValueError:
        is_whole = False
    is_whole &= all(reading.get(n, default) == default for n, default in READING if n not in _NAMED)
    if is_whole:
        words += [word for override in overrides for word in ("--set", override)]
    return _folded(words), is_whole


def _folded(words: Sequence[str]) -> str:
    """Quote words for a shell, with each option on its own line."""
    starts = [0, *(n for n, word in enumerate(words) if word.startswith("--")), len(words)]
    lines = [shlex.join(words[start:end]) for start, end in pairwise(starts)]
    return " \\\n    ".join(lines)
