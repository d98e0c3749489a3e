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
from geosplat_jax.io.images import write_png
from geosplat_jax.io.meshes import render_mesh_normals
from geosplat_jax.io.views import Views
from geosplat_jax.report import protocols
from geosplat_jax.report.light_metrics import light_metrics
from geosplat_jax.report.metrics import MASK_THRESHOLD, mask_iou, normal_mae_deg
from geosplat_jax.report.pictures import normals_to_rgb, overview_sheet, shade_mesh_preview
from geosplat_jax.report.protocols import Protocol
from geosplat_jax.report.renderer import (
    DEFAULT_SAMPLES,
    RenderedView,
    Renderer,
    photograph_on_white,
    render_on_white,
    to_picture,
)

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
    renderer: Renderer, views: Views, chosen: np.ndarray, protocol: Protocol
) -> _Rendered:
    """Render every view once, and keep of it no more than is needed: views may be many."""
    metrics, shown, alpha = [], {}, []
    maps = {name: [] for name in ("albedo", *_MATERIALS) if name in views.truth}
    for index, name in enumerate(views.names):
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
    alpha, maps, mask = rendered.alpha, rendered.maps, views.images[..., 3]
    metrics: dict[str, Any] = {}
    scale = np.ones(3)
    if "albedo" in maps:
        truth = views.truth["albedo"] * mask[..., None]
        scale = protocols.albedo_scale(protocol, maps["albedo"], alpha, truth, mask)
        metrics |= protocols.albedo_metrics(
            protocol, maps["albedo"], alpha, truth, mask, scale, views.valid
        )
        metrics |= {f"albedo.scale_{c}": float(x) for c, x in zip("rgb", scale, strict=True)}
    known = {name: views.truth[name][..., 0] * mask for name in _MATERIALS if name in maps}
    if known:
        found = {name: maps[name][..., 0] for name in known}
        metrics |= protocols.material_metrics(found, alpha, known, mask, views.valid)
    return metrics, scale


def _relight_metrics(
    protocol: Protocol,
    renderer: Renderer,
    views: Views,
    lights: Mapping[str, EnvLight],
    albedo_scale: np.ndarray,
    indirect: str,
    chosen: np.ndarray,
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
        rgb, alpha = np.empty((*views.masks.shape, 3), np.float32), np.empty(views.masks.shape)
        for index in range(len(views)):
            view = relit(views.camera(np.array([index])))
            view = _where_counted(view, _valid(views, index))
            rgb[index], alpha[index] = view.rgb, view.alpha
        images = views.relight[name]
        found = protocols.relight_metrics(protocol, rgb, alpha, images, views.valid)
        metrics |= {f"relight.{name}.{key}": value for key, value in found.items()}
        for row, index in zip(rows, chosen, strict=True):
            row[name] = render_on_white(rgb[index], alpha[index])
            row[f"true {name}"] = photograph_on_white(images[index])
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
) -> dict[str, Any]:
    """Render every test view, write metrics and sheets, return the metrics.

    Writes ``metrics.json``, ``overview.png`` and, where the scene has the truth of them,
    ``materials.png`` and ``relight.png``. New views are always compared in sRGB on white, as the
    mean over the images of the measure of each; normals once over the mask's pixels and once over
    all of them, with (0, 0, 1) behind the object. Pixels that do not count have no part in any of
    it, and are empty on the sheets. See `protocols` for the rest.

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
    """
    began = time.perf_counter()
    chosen_protocol = protocols.protocol(protocol)
    renderer = Renderer.of(trained, samples=samples)
    compiled = _relight_programs(renderer, views, lights or {}, relight_indirect)
    chosen = np.unique(np.linspace(0, len(views) - 1, sheet_views).round().astype(int))
    rendered = _render_all(renderer, views, chosen, chosen_protocol)
    lines = rendered.metrics
    names = dict.fromkeys(key for line in lines for key in line if key != "view")
    mean = {key: float(np.mean([line[key] for line in lines if key in line])) for key in names}
    materials, scale = _material_metrics(chosen_protocol, rendered, views)
    compiled.result()
    relights, relit = _relight_metrics(
        chosen_protocol, renderer, views, lights or {}, scale, relight_indirect, chosen
    )
    no_map = sorted(set(views.relight) - set(lights or {}))
    notes = [protocols.lpips_note(chosen_protocol)]
    notes += [f"{name}: images but no environment map, so no relit metrics" for name in no_map]
    mean |= materials | relights
    radiance = np.asarray(trained.params.light.radiance)
    if train_light is not None:
        found = light_metrics(radiance, np.asarray(train_light.radiance))
        mean |= {key: value for key, value in found.items() if isinstance(value, int | float)}
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
        **meta,
    }
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    write_png(folder / "overview.png", _overview(renderer, radiance, views, rendered.shown))
    if materials:
        write_png(folder / "materials.png", _materials_sheet(views, rendered.shown, scale))
    if relit:
        write_png(folder / "relight.png", overview_sheet(relit))
    return metrics


def _materials_sheet(
    views: Views, shown: Mapping[int, RenderedView], scale: np.ndarray
) -> np.ndarray:
    """Compose a sheet of attributes beside the truth, the albedo in its scale."""
    rows = []
    for index, view in shown.items():
        mask, row = views.images[index][..., 3:], {}
        for name in ("albedo", "roughness", "metallic", "normal"):
            if name not in views.truth:
                continue
            true, found = views.truth[name][index], view.aovs[name]
            if name == "albedo":
                pair = to_picture(found * scale), to_picture(true * mask)
            elif name == "normal":
                pair = normals_to_rgb(found, view.alpha), normals_to_rgb(true, mask[..., 0])
            else:
                pair = tuple(np.clip(np.repeat(x, 3, axis=-1), 0, 1) for x in (found, true * mask))
            row[name], row[f"true {name}"] = pair
        rows.append(row)
    return overview_sheet(rows)


def _overview(
    renderer: Renderer,
    radiance: np.ndarray,
    views: Views,
    shown: Mapping[int, RenderedView],
) -> np.ndarray:
    """Compose the sheet: a row a view, and the light."""
    vertices, faces, normals = renderer.mesh()
    rows = []
    for index, view in shown.items():
        row = {
            "truth": photograph_on_white(views.images[index]),
            "render": render_on_white(view.rgb, view.alpha),
            "normal": normals_to_rgb(view.aovs["normal"], view.alpha),
            "albedo": to_picture(view.aovs["albedo"]),
            "roughness": np.repeat(view.aovs["roughness"], 3, axis=-1),
            "metallic": np.repeat(view.aovs["metallic"], 3, axis=-1),
        }
        camera = views.camera(np.array([index]))
        mesh_normals, mesh_alpha = render_mesh_normals(vertices, faces, normals, camera)
        row["mesh"] = shade_mesh_preview(mesh_normals, mesh_alpha)
        rows.append(row)
    return overview_sheet(rows, light=radiance)


def preview_image(trained: Trained, views: Views) -> np.ndarray:
    """Put truth, render and normals of the first view side by side, (H, 3 W, 3) sRGB."""
    view = Renderer.of(trained, samples=64)(views.camera(np.array([0])))
    parts = [
        photograph_on_white(views.images[0]),
        render_on_white(view.rgb, view.alpha),
        normals_to_rgb(view.aovs["normal"], view.alpha),
    ]
    return np.concatenate(parts, axis=1)
