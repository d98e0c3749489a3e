"""Evaluation of a run on test views: named protocols, metrics, and sheets to look at.

Everything here runs on the host around `renderer.Renderer`.
"""

import importlib.metadata
import json
import platform
import time
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.runtime import in_background, peak_memory_mb
from geosplat_jax.fit.train import Trained
from geosplat_jax.io.views import Views
from geosplat_jax.report import protocols
from geosplat_jax.report.assets import MODEL_TEXTURE, MaterialSampler, write_model
from geosplat_jax.report.light_metrics import light_metrics
from geosplat_jax.report.metrics import MASK_THRESHOLD, mask_iou, normal_mae_deg
from geosplat_jax.report.pace import OnProgress, counted
from geosplat_jax.report.protocols import Protocol
from geosplat_jax.report.renderer import (
    DEFAULT_SAMPLES,
    RenderedView,
    Renderer,
    photograph_on_white,
    render_on_white,
)
from geosplat_jax.report.scales import error_map
from geosplat_jax.report.sheets import Shown
from geosplat_jax.report.trust import sightings

_PACKAGES = ("jax", "jaxlib", "numpy", "optax", "geosplat_jax")
_MATERIALS = ("roughness", "metallic")


def _where_counted(view: RenderedView, valid: np.ndarray | None) -> RenderedView:
    """Leave of a render what counts; ``valid`` is (H, W), or None for all of it."""
    if valid is None:
        return view
    counted = valid[..., None]
    return replace(
        view,
        rgb=view.rgb * counted,
        alpha=view.alpha * valid,
        aovs={name: values * counted for name, values in view.aovs.items()},
    )


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
    """Metrics of one view; ``image`` is (H, W, 4) linear with straight alpha.

    Metrics of the mask's pixels are left out where it has none.
    """
    mask = image[..., 3]
    metrics = protocols.new_view_metrics(view.rgb, view.alpha, image, valid)
    if protocol.new_views is not None:
        metrics |= protocols.new_view_metrics(
            view.rgb, view.alpha, image, valid, protocol.new_views
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
    """What is kept of all test views.

    Attributes
    ----------
    metrics : of every view.
    alpha : (V, H, W) coverage.
    maps : (V, H, W, c) by name, those of the materials that there is truth to compare with.
    shown : whole views, by index, for the sheets.
    """

    metrics: list[dict[str, Any]]
    alpha: np.ndarray
    maps: dict[str, np.ndarray]
    shown: dict[int, RenderedView]


def _render_all(
    renderer: Renderer,
    views: Views,
    chosen: np.ndarray,
    protocol: Protocol,
    on_progress: OnProgress | None,
) -> _Rendered:
    """Render every view once, and keep of it no more than is needed: views may be many."""
    metrics, shown, alpha = [], {}, []
    maps = {name: [] for name in ("albedo", *_MATERIALS) if name in views.truth}
    for index, name in counted([*enumerate(views.names)], "new views", on_progress):
        valid = _valid(views, index)
        view = _where_counted(renderer(views.camera(np.array([index]))), valid)
        normal = views.truth["normal"][index] if "normal" in views.truth else None
        found = _view_metrics(view, views.images[index], normal, valid, protocol)
        metrics.append({"view": name, **found})
        alpha.append(view.alpha)
        for key, kept in maps.items():
            kept.append(view.aovs[key])
        if index in chosen:
            shown[index] = view
    stacked = {name: np.stack(kept) for name, kept in maps.items()}
    return _Rendered(metrics, np.stack(alpha), stacked, shown)


def _material_metrics(
    protocol: Protocol, rendered: _Rendered, views: Views
) -> tuple[dict[str, Any], np.ndarray]:
    """Metrics of albedo, roughness and metallic where there is truth, and the albedo's scale."""
    alpha, maps, mask = rendered.alpha, rendered.maps, np.asarray(views.alphas)
    metrics: dict[str, Any] = {}
    scale = np.ones(3)
    if "albedo" in maps:
        truth = views.truth["albedo"] * mask[..., None]
        scale = protocols.albedo_scale(protocol, maps["albedo"], alpha, truth, mask)
        metrics |= protocols.albedo_metrics(
            protocol, maps["albedo"], alpha, truth, mask, scale, _all_valid(views)
        )
        metrics |= {f"albedo.scale_{c}": float(x) for c, x in zip("rgb", scale, strict=True)}
    known = {name: views.truth[name][..., 0] * mask for name in _MATERIALS if name in maps}
    if known:
        found = {name: maps[name][..., 0] for name in known}
        metrics |= protocols.material_metrics(found, alpha, known, mask, _all_valid(views))
    return metrics, scale


def _relight_metrics(
    protocol: Protocol,
    renderer: Renderer,
    views: Views,
    lights: Mapping[str, EnvLight],
    albedo_scale: np.ndarray,
    indirect: str,
    chosen: np.ndarray,
    on_progress: OnProgress | None,
) -> tuple[dict[str, float], list[dict[str, np.ndarray]]]:
    """Metrics of the views under every light that has true images and a map, and rows of a sheet.

    One light is in memory at a time, and of its renders only what is compared.
    """
    metrics: dict[str, float] = {}
    found: dict[str, float] = {}
    rows: list[dict[str, np.ndarray]] = [{} for _ in chosen]
    names = sorted(set(views.relight) & set(lights))
    relit = renderer
    for number, name in enumerate(names):
        if number:
            relit = relit.under(lights[name])
        else:
            relit = renderer.relit(lights[name], albedo_scale=albedo_scale, indirect=indirect)
        rgb = np.empty((*views.images.shape[:3], 3), np.float32)
        alpha = np.empty(views.images.shape[:3])
        for index in counted(range(len(views)), f"under {name}", on_progress):
            view = relit(views.camera(np.array([index])))
            view = _where_counted(view, _valid(views, index))
            rgb[index], alpha[index] = view.rgb, view.alpha
        images = views.relight[name]
        found = protocols.relight_metrics(protocol, rgb, alpha, images, _all_valid(views))
        metrics |= {f"relight.{name}.{key}": value for key, value in found.items()}
        for row, index in zip(rows, chosen, strict=True):
            truth = photograph_on_white(images[index])
            render = render_on_white(rgb[index], alpha[index])
            row |= {f"true {name}": truth, name: render, f"error {name}": error_map(truth, render)}
    if names:
        for key in found:
            values = [metrics[f"relight.{name}.{key}"] for name in names]
            metrics[f"relight.mean.{key}"] = float(np.mean(values))
    return metrics, rows if names else []


def _relight_programs(
    renderer: Renderer, views: Views, lights: Mapping[str, EnvLight], indirect: str
) -> Future[None]:
    """Compile what relights while the views are rendered under the light that was trained."""
    names = sorted(set(views.relight) & set(lights))

    def render_once() -> None:
        if names:
            renderer.relit(lights[names[0]], indirect=indirect).hurried()(views.camera([0]))

    return in_background(render_once)


def evaluate_run(
    trained: Trained,
    views: Views,
    folder: Path,
    *,
    meta: dict[str, Any],
    protocol: str = "geosplatting",
    lights: Mapping[str, EnvLight] | None = None,
    train_light: EnvLight | None = None,
    samples: int = DEFAULT_SAMPLES,
    relight_indirect: str = "traced",
    sheet_views: int = 5,
    train_views: Views | None = None,
    model_texture: int | None = MODEL_TEXTURE,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Render every test view, write metrics and sheets, return the metrics.

    Writes ``metrics.json``, ``overview.png`` and, where the scene has the truth of them,
    ``materials.png`` and ``relight.png``, and their pictures one by one (see `gallery`). New views
    are always compared in sRGB on white, as the mean over the images of the measure of each;
    normals once over the mask's pixels and once over all of them, with (0, 0, 1) behind the object.
    Pixels that do not count have no part in any of it, and are empty on the sheets. See `protocols`
    for the rest.

    Parameters
    ----------
    trained : see `train.load_trained`.
    views : test views; metrics need ``truth`` and ``relight`` only where they exist.
    folder : receives the files.
    meta : recorded with the metrics (step, scene, training seconds).
    protocol : one of `protocols.PROTOCOLS`.
    lights : environment maps by the names of ``views.relight``.
    train_light : true light of the training images, to compare the recovered one with.
    samples : rays a splat of the images.
    relight_indirect : see `Renderer.relit`.
    sheet_views : number of views on the sheets, spread evenly.
    train_views : those of the training, to count how many of them see each place.
    model_texture : texels along the edge of the model that the report shows; None for no model.
    on_progress : see `poses.OnProgress`.
    """
    began = time.perf_counter()
    chosen_protocol = protocols.protocol(protocol)
    renderer = Renderer.of(trained, samples=samples)
    compiled = _relight_programs(renderer, views, lights or {}, relight_indirect)
    chosen = np.unique(np.linspace(0, len(views) - 1, sheet_views).round().astype(int))
    rendered = _render_all(renderer, views, chosen, chosen_protocol, on_progress)
    lines = rendered.metrics
    names = dict.fromkeys(key for line in lines for key in line if key != "view")
    mean = {key: float(np.mean([line[key] for line in lines if key in line])) for key in names}
    materials, scale = _material_metrics(chosen_protocol, rendered, views)
    compiled.result()
    relights, relit = _relight_metrics(
        chosen_protocol,
        renderer,
        views,
        lights or {},
        scale,
        relight_indirect,
        chosen,
        on_progress,
    )
    no_map = sorted(set(views.relight) - set(lights or {}))
    notes = [protocols.lpips_note(chosen_protocol)]
    notes += [f"{name}: images but no environment map, so no relit metrics" for name in no_map]
    mean |= materials | relights
    radiance = np.asarray(trained.params.light.radiance)
    if train_light is not None:
        found = light_metrics(radiance, np.asarray(train_light.radiance))
        mean |= {key: value for key, value in found.items() if isinstance(value, int | float)}
    tell = on_progress or (lambda part, done, total: None)
    tell("pictures and model", 0, 1)
    mesh = renderer.mesh()
    seen = None if train_views is None else sightings(*mesh, train_views)
    by_title = {"true light": None if train_light is None else np.asarray(train_light.radiance)}
    by_title |= {"light": radiance}
    figures = [
        f"{key.removeprefix('relight.').removesuffix('.psnr')}: {value:.2f} dB, {protocol}"
        for key, value in relights.items()
        if key.endswith(".psnr")
    ]
    shown = Shown(
        views=views,
        psnr=[line["nvs.psnr"] for line in lines],
        rendered=rendered.shown,
        mesh=mesh,
        seen=seen,
        albedo_scale=scale,
        relit=relit,
        relit_figures=figures,
        lights={title: light for title, light in by_title.items() if light is not None},
    )
    gallery = shown.write(folder)
    if model_texture is not None:
        exposed = radiance * np.exp(float(trained.params.log_exposure))
        maps = {"light as found": exposed} | {
            name: np.asarray(light.radiance) for name, light in (lights or {}).items()
        }
        sampler = MaterialSampler(trained, renderer.asset())
        gallery["model"] = write_model(
            folder,
            mesh,
            sampler,
            lights=maps,
            eye=views.camera_to_world[0, :3, 3],
            texture_size=model_texture,
        )
    tell("pictures and model", 1, 1)
    metrics = {
        "protocol": protocol,
        "notes": notes,
        "mean": mean,
        "views": lines,
        "samples": samples,
        "samples_drawn": renderer.samples,
        "relight_indirect": relight_indirect,
        "seconds": round(time.perf_counter() - began, 2),
        "peak_memory_mb": peak_memory_mb(),
        "versions": {
            "python": platform.python_version(),
            **{package: importlib.metadata.version(package) for package in _PACKAGES},
        },
        "seed": trained.config.run.seed,
        "config": trained.config.to_dict(),
        "gallery": gallery,
        "seen": None if seen is None else seen.described(),
        **meta,
    }
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    return metrics
