"""``report.html``: the results of one run, or of several, in one self-contained file.

The page is made from the files of training and evaluation; nothing is computed anew. Everything is
embedded, also the scripts in ``web/``, and a policy in the page forbids the browser any access to
the network. The template engine escapes texts, so that no name of a scene, a view or a light is
taken for markup.
"""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from geosplat_jax.core.settings import first_line
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.io.checkpoints import latest_checkpoint, read_step
from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import written_aside
from geosplat_jax.report.facts import (
    Figure,
    changed_from_preset,
    command,
    curves,
    figure,
    protocol_text,
    rung_row,
    stage_times,
)
from geosplat_jax.report.gallery import comparisons
from geosplat_jax.report.scales import ERROR, ROUGHNESS, SEEN

REPORT = "report.html"
"""Name of the page in the folder of a run."""

LARGEST_PAGE = 15_000_000
"""Bytes of a page at most; what does not fit is left out, and the page says so."""

_WEB = Path(__file__).parent / "web"
_LONGEST_SIDE = 640
_QUALITY = 90
# Share of a run's bytes that pictures may take; the model may take the rest.
_PICTURES_SHARE = 0.5
# Bytes that are reserved for the texts, tables and curves of a run.
_TEXT_BYTES = 250_000

_HEADLINES = ("nvs.psnr", "nvs.ssim", "normal.mae_masked_deg", "albedo.psnr", "relight.mean.psnr")


@dataclass
class _Allowance:
    """Number of bytes that may still be embedded, and names of what did not fit."""

    left: int
    refused: list[str] = field(default_factory=list)

    def embed(self, data: bytes, kind: str, what: str) -> str | None:
        """Return data as a URL, or None where there is no room for it."""
        size = 4 * math.ceil(len(data) / 3) + 64
        if size > self.left:
            self.refused.append(what)
            return None
        self.left -= size
        return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _picture_bytes(path: Path) -> bytes:
    """Read a picture and compress it for the page, with at most 640 pixels a side."""
    with Image.open(path) as image:
        image.load()
        picture = image.convert("RGB")
    picture.thumbnail((_LONGEST_SIDE, _LONGEST_SIDE), Image.Resampling.LANCZOS)
    sink = io.BytesIO()
    picture.save(sink, "WEBP", quality=_QUALITY, method=4)
    return sink.getvalue()


def _below(folder: Path, name: Any) -> Path | None:
    """Return a file by its name in the metrics; None for anything outside of the folder."""
    if not isinstance(name, str):
        return None
    path = (folder / name).resolve()
    return path if path.is_relative_to(folder.resolve()) and path.is_file() else None


@dataclass(frozen=True)
class RunResults:
    """A run, or the state at the end of one of its stages, whose results a report shows.

    Attributes
    ----------
    folder : folder of the run.
    results : folder of ``metrics.json``: that of the run, or that of the end of a stage.
    """

    folder: RunFolder
    results: Path

    @classmethod
    def of(cls, folder: RunFolder, *, stage: str | None = None) -> "RunResults":
        """Return the run as it is now, or at the end of a stage."""
        return cls(folder, folder.path if stage is None else folder.end_of(stage))

    def trained_steps(self) -> int:
        """Return the step of the last checkpoint; 0 for the end of a stage, which never changes."""
        if self.results != self.folder.path:
            return 0
        path = latest_checkpoint(self.folder.checkpoints)
        return 0 if path is None else read_step(path)

    def metrics(self) -> dict[str, Any]:
        """Read the metrics of the evaluation; an empty dict if there was none.

        Raises
        ------
        RunError
            If the file is damaged.
        """
        path = self.results / "metrics.json"
        if not path.exists():
            return {}
        try:
            content = parse_json(path.read_bytes())
        except ValueError as error:
            raise RunError(f"{path} is damaged: {error}; evaluate the run again") from None
        if not isinstance(content, dict) or not isinstance(content.get("mean"), dict):
            raise RunError(f"{path} is damaged: it has no figures; evaluate the run again")
        return content


def _views(gallery: Mapping[str, Any], run: RunResults, allowance: _Allowance) -> list[dict]:
    """Embed the pictures of each view: pairs to compare, and others."""
    views = []
    for entry in gallery.get("views", []):
        paths = {title: _below(run.results, name) for title, name in entry["pictures"].items()}
        urls = {
            title: allowance.embed(_picture_bytes(path), "image/webp", f"{entry['view']}: {title}")
            for title, path in paths.items()
            if path is not None
        }
        urls = {title: url for title, url in urls.items() if url is not None}
        pairs = comparisons(list(urls))
        paired_titles = {title for pair in pairs for title in pair}
        views.append(
            {
                "name": entry["view"],
                "pairs": [
                    {
                        "true": true_title,
                        "found": found_title,
                        "urls": (urls[true_title], urls[found_title]),
                    }
                    for true_title, found_title in pairs
                ],
                "others": {title: url for title, url in urls.items() if title not in paired_titles},
            }
        )
    return [view for view in views if view["pairs"] or view["others"]]


def _model(gallery: Mapping[str, Any], run: RunResults, allowance: _Allowance) -> dict | None:
    """Embed the mesh and the lights that it is shown under; None without a mesh that fits."""
    model = gallery.get("model") or {}
    path = _below(run.results, model.get("mesh"))
    if path is None:
        return None
    url = allowance.embed(path.read_bytes(), "model/gltf-binary", "the mesh to turn")
    if url is None:
        return None
    lights = []
    for title, name in model.get("lights", {}).items():
        light = _below(run.results, name)
        if light is not None:
            data = allowance.embed(light.read_bytes(), "application/octet-stream", f"light {title}")
            if data is not None:
                # The viewer tells the format by the end of the address.
                lights.append({"name": title, "url": f"{data}#.hdr"})
    return {
        "mesh": url,
        "lights": lights,
        "faces": model.get("faces"),
        "orbit": model.get("orbit"),
    }


def _described(run: RunResults, name: str, room: int) -> dict[str, Any]:
    """Collect what the template shows of a run, in ``room`` bytes."""
    record, config = run.folder.record(), run.folder.config()
    lines, metrics = run.folder.metric_lines(), run.metrics()
    gallery, mean = metrics.get("gallery") or {}, metrics.get("mean", {})
    pictures = _Allowance(int(_PICTURES_SHARE * room))
    lights = {
        title: url
        for title, file in (gallery.get("lights") or {}).items()
        if (path := _below(run.results, file)) is not None
        and (url := pictures.embed(_picture_bytes(path), "image/webp", f"light: {title}"))
    }
    views = _views(gallery, run, pictures)
    models = _Allowance(room - int(_PICTURES_SHARE * room) + pictures.left)
    model = _model(gallery, run, models)
    psnr = {line["view"]: line["nvs.psnr"] for line in metrics.get("views", [])}
    command_text, is_whole = command(record, config)
    seen = metrics.get("seen")
    step, trained_step = metrics.get("step"), run.trained_steps()
    return {
        "name": name,
        "folder": str(run.results),
        "record": record,
        "config": config,
        "metrics": metrics,
        "older": step if step is not None and step < trained_step else None,
        "figures": [(figure(key), value) for key, value in mean.items()],
        "headlines": [
            (figure(key), metrics["mean"][key])
            for key in _HEADLINES
            if key in metrics.get("mean", ())
        ],
        "protocol": protocol_text(metrics["protocol"]) if "protocol" in metrics else None,
        "views": [{**view, "psnr": psnr.get(view["name"])} for view in views],
        "lights": lights,
        "model": model,
        "seen": seen,
        "seen_scale": SEEN.described() if seen else None,
        "times": stage_times(lines),
        "total_seconds": (run.folder.training() or {}).get("seconds_total"),
        "rungs": [rung_row(rung) for rung in record.get("model", {}).get("rungs", [])],
        "changed": changed_from_preset(config),
        "command": command_text,
        "command_is_whole": is_whole,
        "refused": pictures.refused + models.refused,
        "curves": curves(lines),
    }


def _figure_groups(
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, list[tuple[Figure, list[float | None]]]]:
    """Align the figures of all runs, by group, in the order of first appearance."""
    values = [{f.key: value for f, value in run["figures"]} for run in runs]
    figures_by_key = {f.key: f for run in runs for f, _ in run["figures"]}
    groups: dict[str, list[tuple[Figure, list[float | None]]]] = {}
    for key, f in figures_by_key.items():
        groups.setdefault(f.group, []).append((f, [run_values.get(key) for run_values in values]))
    return groups


def _names(runs: Sequence[RunResults]) -> list[str]:
    """Name each run by its folder, with as many parent folders as make the names distinct."""
    parts = [run.folder.path.resolve().parts for run in runs]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{part[-1]} ({number})" for number, part in enumerate(parts, 1)]


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_WEB),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = lambda value: "" if value is None else f"{value:,.4g}"
    environment.filters["figure"] = lambda value: "–" if value is None else f"{value:.4f}"
    return environment


def _web(name: str) -> Markup:
    """Read a script or style sheet of the package, which needs no escaping."""
    return Markup((_WEB / name).read_text(encoding="utf-8"))


def report_html(runs: Sequence[RunResults]) -> str:
    """Return the page as HTML.

    Raises
    ------
    RunError
        If a folder holds no run, or a file in it is damaged.
    ValueError
        If there is no run, or there are too many for one page.
    """
    if not runs:
        raise ValueError("a report needs a run, got none")
    scripts = {
        "viewer": _web("model-viewer.min.js"),
        "plot": _web("uPlot.min.js"),
        "own": _web("report.js"),
        "plot_style": _web("uPlot.min.css"),
        "style": _web("report.css"),
        "licences": (_WEB / "LICENSES.txt").read_text(encoding="utf-8"),
    }
    fixed_bytes = sum(len(text.encode()) for text in scripts.values())
    room = (LARGEST_PAGE - fixed_bytes) // len(runs) - _TEXT_BYTES
    if room < 0:
        raise ValueError(f"{len(runs)} runs do not fit into one report; compare fewer of them")
    descriptions = []
    for run, name in zip(runs, _names(runs), strict=True):
        try:
            descriptions.append(_described(run, name, room))
        except (AttributeError, KeyError, TypeError) as error:
            raise RunError(
                f"{run.results / 'metrics.json'} or a file beside it is damaged "
                f"({first_line(error)}); evaluate the run again"
            ) from None
    page = _environment().get_template("report.html.jinja")
    return page.render(
        runs=descriptions,
        figures=_figure_groups(descriptions),
        scripts=scripts,
        data={"runs": [{"name": run["name"], **run["curves"]} for run in descriptions]},
        error_scale=ERROR.described(),
        grey_scale=ROUGHNESS.described(),
    )


def write_report(path: Path, runs: Sequence[RunResults]) -> Path:
    """Write the page atomically and return its path; see `report_html`.

    Raises
    ------
    RunError, ValueError
        See `report_html`.
    """
    html = report_html(runs)
    with written_aside(path) as temporary_path:
        temporary_path.write_text(html, encoding="utf-8")
    return path
