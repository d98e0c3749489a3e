"""Evaluation of a run on test views: named protocols, metrics, and sheets to look at.

Everything here runs on the host around `renderer.Renderer`.
"""

import json
import time
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.runtime import in_background, installed_versions, peak_memory_mb
from geosplat_jax.fit.train import Trained
from geosplat_jax.io.images import written_aside
from geosplat_jax.io.views import Views
from geosplat_jax.report import protocol_metrics, protocols
from geosplat_jax.report.assets import MODEL_TEXTURE, MaterialSampler, write_model
from geosplat_jax.report.light_metrics import light_metrics
from geosplat_jax.report.metrics import MASK_THRESHOLD, mask_iou, normal_mae_deg
from geosplat_jax.report.pace import OnProgress, counted
from geosplat_jax.report.protocols import ObjectRendition, Protocol, Rendition
from geosplat_jax.report.renderer import (
    DEFAULT_SAMPLES,
    RenderedView,
    Renderer,
    exposed_radiance,
    photograph_on_white,
    render_on_white,
)
from geosplat_jax.report.scales import error_map
from geosplat_jax.report.sheets import SheetContent
from geosplat_jax.report.trust import sightings

_MATERIALS = ("roughness", "metallic")


def _where_counted(view: RenderedView, valid: np.ndarray | None) -> RenderedView:
    """Set to zero what does not count in a render; ``valid`` is (H, W), or None for all pixels."""
    if valid is None:
        return view
    mask = valid[..., None]
    return replace(
        view,
        rgb=view.rgb * mask,
        linear=view.linear * mask,
        alpha=view.alpha * valid,
        aovs={name: values * mask for name, values in view.aovs.items()},
    )


def _compared(view: RenderedView, rendition: Rendition | ObjectRendition) -> np.ndarray:
    """Return the colours that a rendition compares: exposed radiance, or the tone-mapped image."""
    return view.linear if isinstance(rendition, ObjectRendition) else view.rgb


def _valid(views: Views, index: int) -> np.ndarray | None:
    return None if views.valid is None else views.valid[index]


def _all_valid(views: Views) -> np.ndarray | None:
    """Pixels of all views that count; None where all do."""
    return None if views.valid is None else np.asarray(views.valid)


def _view_metrics(
    view: RenderedView,
    image: np.ndarray,
    truth_normal: np.ndarray | None,
    valid: np.ndarray | None,
    protocol: Protocol,
) -> dict:
    """Compute the metrics of one view; ``image`` is (H, W, 4) linear with straight alpha.

    Metrics over the pixels of the mask are left out where the mask is empty.
    """
    mask = image[..., 3]
    metrics = protocol_metrics.new_view_metrics(view.rgb, view.alpha, image, valid)
    if protocol.new_views is not None:
        rendition = protocol.new_views
        metrics |= protocol_metrics.new_view_metrics(
            _compared(view, rendition), view.alpha, image, valid, rendition
        )
    metrics["mask.iou"] = float(mask_iou(view.alpha, mask))
    if truth_normal is not None:
        for name in ("masked", "full") if np.any(mask > MASK_THRESHOLD) else ("full",):
            metrics[f"normal.mae_{name}_deg"] = float(
                normal_mae_deg(
                    view.aovs["normal"],
                    truth_normal,
                    mask,
                    view.alpha,
                    full=name == "full",
                    valid=valid,
                )
            )
    return metrics


class _Rendered(NamedTuple):
    """What is stored of the renders of all test views.

    Attributes
    ----------
    metrics : metrics of every view.
    alpha : (V, H, W) coverage.
    maps : (V, H, W, c) by name, of the materials for which there is ground truth.
    shown : whole renders for the sheets, by index of the view.
    """

    metrics: list[dict[str, Any]]
    alpha: np.ndarray
    maps: dict[str, np.ndarray]
    shown: dict[int, RenderedView]


def _render_all(
    renderer: Renderer,
    views: Views,
    sheet_indices: np.ndarray,
    protocol: Protocol,
    on_progress: OnProgress | None,
) -> _Rendered:
    """Render every view once; only what is needed is stored, since there may be many views."""
    metrics, sheet_views, alpha = [], {}, []
    maps = {name: [] for name in ("albedo", *_MATERIALS) if name in views.truth}
    for index, name in counted([*enumerate(views.names)], "new views", on_progress):
        valid = _valid(views, index)
        view = _where_counted(renderer(views.camera(np.array([index]))), valid)
        normal = views.truth["normal"][index] if "normal" in views.truth else None
        view_metrics = _view_metrics(view, views.images[index], normal, valid, protocol)
        metrics.append({"view": name, **view_metrics})
        alpha.append(view.alpha)
        for key, images in maps.items():
            images.append(view.aovs[key])
        if index in sheet_indices:
            sheet_views[index] = view
    stacked_maps = {name: np.stack(images) for name, images in maps.items()}
    return _Rendered(metrics, np.stack(alpha), stacked_maps, sheet_views)


def _material_metrics(
    protocol: Protocol, rendered: _Rendered, views: Views
) -> tuple[dict[str, Any], np.ndarray]:
    """Compute metrics of the materials with ground truth; also return the scale of the albedo."""
    alpha, maps, mask = rendered.alpha, rendered.maps, np.asarray(views.alphas)
    metrics: dict[str, Any] = {}
    scale = np.ones(3)
    if "albedo" in maps:
        truth = views.truth["albedo"] * mask[..., None]
        scale = protocol_metrics.albedo_scale(protocol, maps["albedo"], alpha, truth, mask)
        metrics |= protocol_metrics.albedo_metrics(
            protocol, maps["albedo"], alpha, truth, mask, scale, _all_valid(views)
        )
        metrics |= {
            f"albedo.scale_{channel}": float(x) for channel, x in zip("rgb", scale, strict=True)
        }
        if scale.min() > 0.0:  # A channel whose truth is black has factor 0.
            metrics["albedo.scale_ratio"] = float(scale.max() / scale.min())
    true_maps = {name: views.truth[name][..., 0] * mask for name in _MATERIALS if name in maps}
    if true_maps:
        predicted_maps = {name: maps[name][..., 0] for name in true_maps}
        metrics |= protocol_metrics.material_metrics(
            predicted_maps, alpha, true_maps, mask, _all_valid(views)
        )
    return metrics, scale


def _relight_metrics(
    protocol: Protocol,
    renderer: Renderer,
    views: Views,
    lights: Mapping[str, EnvLight],
    albedo_scale: np.ndarray,
    indirect: str,
    sheet_indices: np.ndarray,
    on_progress: OnProgress | None,
) -> tuple[dict[str, float], list[dict[str, np.ndarray]]]:
    """Compute metrics under every light with true images and a map; also return rows of a sheet.

    To save memory, lights are processed one by one, and only what is compared is stored.
    """
    metrics: dict[str, float] = {}
    light_figures: dict[str, float] = {}
    rows: list[dict[str, np.ndarray]] = [{} for _ in sheet_indices]
    names = sorted(set(views.relight) & set(lights))
    relit_renderer = renderer
    for number, name in enumerate(names):
        if number:
            relit_renderer = relit_renderer.under(lights[name])
        else:
            relit_renderer = renderer.relit(
                lights[name], albedo_scale=albedo_scale, indirect=indirect
            )
        rgb = np.empty((*views.images.shape[:3], 3), np.float32)
        alpha = np.empty(views.images.shape[:3])
        sheet_pictures: dict[int, np.ndarray] = {}
        for index in counted(range(len(views)), f"under {name}", on_progress):
            view = relit_renderer(views.camera(np.array([index])))
            view = _where_counted(view, _valid(views, index))
            rgb[index], alpha[index] = _compared(view, protocol.relight), view.alpha
            if index in sheet_indices:
                sheet_pictures[index] = render_on_white(view.rgb, view.alpha)
        images = views.relight[name]  # read once, since every lookup reads all of them
        light_figures = protocol_metrics.relight_metrics(
            protocol, rgb, alpha, images, _all_valid(views)
        )
        metrics |= {f"relight.{name}.{key}": value for key, value in light_figures.items()}
        for row, index in zip(rows, sheet_indices, strict=True):
            truth, render = photograph_on_white(images[index]), sheet_pictures[index]
            row |= {f"true {name}": truth, name: render, f"error {name}": error_map(truth, render)}
    if names:
        for key in light_figures:
            values = [metrics[f"relight.{name}.{key}"] for name in names]
            metrics[f"relight.mean.{key}"] = float(np.mean(values))
    return metrics, rows if names else []


def _relight_programs(
    renderer: Renderer, views: Views, lights: Mapping[str, EnvLight], indirect: str
) -> Future[None]:
    """Compile the programs for relighting in the background, while views are rendered."""
    names = sorted(set(views.relight) & set(lights))

    def render_once() -> None:
        if names:
            renderer.relit(lights[names[0]], indirect=indirect).hurried()(views.camera([0]))

    return in_background(render_once)


@dataclass(frozen=True)
class Truth:
    """Ground truth that a run is compared with.

    Attributes
    ----------
    views : test views; metrics are computed for what their ``truth`` and ``relight`` hold.
    lights : environment maps by the names of ``views.relight``.
    train_light : true light of the training images, to compare the recovered one with, or None.
    train_views : training views, to count how many of them see each point of the surface, or None.
    """

    views: Views
    lights: Mapping[str, EnvLight] = field(default_factory=dict)
    train_light: EnvLight | None = None
    train_views: Views | None = None


@dataclass(frozen=True)
class EvaluateOptions:
    """How to measure, and what to show.

    Attributes
    ----------
    protocol : one of `protocols.PROTOCOLS`.
    samples : rays per splat in every image, see `Renderer`.
    relight_indirect : see `Renderer.relit`.
    sheet_views : number of views on the sheets, spread evenly.
    model_texture : texels along the edge of the model that the report shows; None for no model.
    """

    protocol: str = protocols.PROTOCOLS[0]
    samples: int = DEFAULT_SAMPLES
    relight_indirect: str = "traced"
    sheet_views: int = 5
    model_texture: int | None = MODEL_TEXTURE


class _Measured(NamedTuple):
    """Metrics of all views, and further data for the sheets.

    Attributes
    ----------
    views : metrics of every view.
    mean : by name, the mean of every metric over the views with an object, and metrics of all views
        together.
    rendered : see `_Rendered`.
    albedo_scale : (3,) factors that the albedo is aligned to the truth with.
    relit : pictures by title under each light, for every view that is shown.
    """

    views: list[dict[str, Any]]
    mean: dict[str, Any]
    rendered: _Rendered
    albedo_scale: np.ndarray
    relit: list[dict[str, np.ndarray]]


def _with_object(lines: list[dict[str, Any]], views: Views) -> list[dict[str, Any]]:
    """Return the lines of the views whose mask is not empty; all lines, if every mask is.

    Where neither mask nor render has an object, two equal backgrounds would count as 200 dB.
    """
    return [line for k, line in enumerate(lines) if views.mask(k).any()] or lines


def _measure(
    renderer: Renderer,
    truth: Truth,
    options: EvaluateOptions,
    radiance: np.ndarray,
    on_progress: OnProgress | None,
) -> _Measured:
    """Render every view, under the recovered light and under every other, and compare.

    ``radiance`` is the recovered light.
    """
    protocol, views = protocols.protocol(options.protocol), truth.views
    compiled = _relight_programs(renderer, views, truth.lights, options.relight_indirect)
    sheet_indices = np.unique(
        np.linspace(0, len(views) - 1, options.sheet_views).round().astype(int)
    )
    rendered = _render_all(renderer, views, sheet_indices, protocol, on_progress)
    lines = rendered.metrics
    compared = _with_object(lines, views)
    names = dict.fromkeys(key for line in compared for key in line if key != "view")
    mean = {key: float(np.mean([line[key] for line in compared if key in line])) for key in names}
    materials, scale = _material_metrics(protocol, rendered, views)
    compiled.result()
    relights, relit_rows = _relight_metrics(
        protocol,
        renderer,
        views,
        truth.lights,
        scale,
        options.relight_indirect,
        sheet_indices,
        on_progress,
    )
    mean |= materials | relights
    if truth.train_light is not None:
        light_figures = light_metrics(radiance, np.asarray(truth.train_light.radiance))
        mean |= {
            key: value for key, value in light_figures.items() if isinstance(value, int | float)
        }
    return _Measured(lines, mean, rendered, scale, relit_rows)


def _show(
    renderer: Renderer,
    truth: Truth,
    results: _Measured,
    folder: Path,
    protocol: str,
    radiance: np.ndarray,
) -> tuple[SheetContent, dict[str, Any]]:
    """Write the sheets and pictures; return what they show, and their paths for the metrics."""
    mesh, is_two_sided, seen = renderer.mesh(), renderer.is_two_sided, None
    if truth.train_views is not None:
        seen = sightings(*mesh, truth.train_views, is_two_sided=is_two_sided)
    lights = {"light": radiance}
    if truth.train_light is not None:
        lights = {"true light": np.asarray(truth.train_light.radiance)} | lights
    sheets = SheetContent(
        views=truth.views,
        psnr=[line["nvs.psnr"] for line in results.views],
        rendered=results.rendered.shown,
        mesh=mesh,
        is_two_sided=is_two_sided,
        seen=seen,
        albedo_scale=results.albedo_scale,
        relit=results.relit,
        relit_figures=[
            f"{key.removeprefix('relight.').removesuffix('.psnr')}: {value:.2f} dB, {protocol}"
            for key, value in results.mean.items()
            if key.startswith("relight.") and key.endswith(".psnr")
        ],
        lights=lights,
    )
    return sheets, sheets.write(folder)


def _write_model(
    trained: Trained,
    sampler: MaterialSampler,
    sheets: SheetContent,
    lights: Mapping[str, EnvLight],
    folder: Path,
    texture_size: int,
) -> dict[str, Any] | None:
    """Write the mesh with its materials, and lights to see it under; see `assets.write_model`."""
    maps = {name: np.asarray(light.radiance) for name, light in lights.items()}
    return write_model(
        folder,
        sheets.mesh,
        sampler,
        lights={"reconstructed light": exposed_radiance(trained.params)} | maps,
        eye=sheets.views.camera_to_world[0, :3, 3],
        texture_size=texture_size,
    )


def evaluate_run(
    trained: Trained,
    truth: Truth,
    folder: Path,
    options: EvaluateOptions = EvaluateOptions(),
    *,
    meta: Mapping[str, Any],
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Render every test view, write metrics and sheets, return the metrics.

    Writes ``metrics.json``, ``overview.png`` and, where the scene has the ground truth,
    ``materials.png`` and ``relight.png``; also every picture as a file (see `gallery`). New views
    are always compared in sRGB on white; their metrics are means over the images in which the mask
    is not empty. Normals are compared twice: over the pixels of the mask, and over all pixels, with
    (0, 0, 1) as normal of the background. Pixels that do not count are left out of all metrics, and
    are empty on the sheets. All other choices are those of the protocol, see `protocols`.

    Parameters
    ----------
    trained : see `train.load_trained`.
    truth : ground truth to compare with.
    folder : existing folder for the files.
    options : see `EvaluateOptions`.
    meta : entries that are recorded with the metrics, such as step, scene and training seconds.
    on_progress : see `poses.OnProgress`.

    Returns
    -------
    dict, the content of ``metrics.json``.
    """
    start_time = time.perf_counter()
    tell = on_progress or (lambda part, done, total: None)
    protocol = protocols.protocol(options.protocol)
    renderer = Renderer.of(trained, samples=options.samples)
    radiance = np.asarray(trained.params.light.radiance)
    results = _measure(renderer, truth, options, radiance, on_progress)
    unmapped_lights = sorted(set(truth.views.relight) - set(truth.lights))
    compared = {line["view"] for line in _with_object(results.views, truth.views)}
    empty_views = [name for name in truth.views.names if name not in compared]
    metrics = {
        "protocol": options.protocol,
        "notes": [
            protocols.lpips_note(protocol),
            *(
                f"{name}: images but no environment map, so no relit metrics"
                for name in unmapped_lights
            ),
            *(f"{name}: the mask is empty, so it has no part in means" for name in empty_views),
        ],
        "mean": results.mean,
        "views": results.views,
        "samples": options.samples,
        "samples_drawn": renderer.samples,
        "relight_indirect": options.relight_indirect,
        "versions": installed_versions(),
        "seed": trained.config.run.seed,
        "config": trained.config.to_dict(),
        **meta,
    }

    def written(**entries: Any) -> dict[str, Any]:
        """Write and return the metrics, with further entries, seconds and peak memory."""
        effort = {
            "seconds": round(time.perf_counter() - start_time, 2),
            "peak_memory_mb": peak_memory_mb(),
        }
        with written_aside(folder / "metrics.json") as temporary_path:
            text = json.dumps(metrics | effort | entries, indent=2)
            temporary_path.write_text(text + "\n", encoding="utf-8")
        return metrics | effort | entries

    written(gallery={}, seen=None)  # metrics are safe if the pictures fail, by lack of memory say
    tell("pictures and model", 0, 1)
    sheets, gallery = _show(renderer, truth, results, folder, options.protocol, radiance)
    if options.model_texture is not None:
        sampler = MaterialSampler(trained, renderer.asset())
        size = options.model_texture
        gallery["model"] = _write_model(trained, sampler, sheets, truth.lights, folder, size)
    tell("pictures and model", 1, 1)
    return written(gallery=gallery, seen=None if sheets.seen is None else sheets.seen.described())
