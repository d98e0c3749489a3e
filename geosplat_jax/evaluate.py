"""Evaluation of a run on test views: named protocol, figures, and one sheet to look at.

Everything here runs on the host around the jitted `render.render`.
"""

import importlib.metadata
import json
import platform
import resource
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from geosplat_jax import capacity as capacity_module
from geosplat_jax.capacity import Capacities
from geosplat_jax.color import tone_map
from geosplat_jax.config import Config
from geosplat_jax.geometry import isosurface, vertex_normals
from geosplat_jax.io.images import encode_srgb, write_png
from geosplat_jax.io.meshes import render_mesh_normals
from geosplat_jax.io.sheets import normals_to_rgb, overview_sheet, shade_mesh_preview
from geosplat_jax.io.views import Views
from geosplat_jax.metrics import (
    mask_iou,
    normal_mae_deg,
    psnr,
    ssim,
)
from geosplat_jax.render import Context, Params, render
from geosplat_jax.scene import Camera, Mesh

_EVALUATION_AOVS = ("albedo", "roughness", "metallic", "normal")
_PACKAGES = ("jax", "jaxlib", "numpy", "optax", "geosplat_jax")

_render = partial(jax.jit, static_argnames=("model", "capacities", "sampling", "aov_names"))(render)
_isosurface = partial(jax.jit, static_argnames=("capacities", "training"))(isosurface)
_vertex_normals = jax.jit(vertex_normals)


@dataclass(frozen=True)
class RenderedView:
    """One rendered view on the host: premultiplied by alpha, float32.

    Attributes
    ----------
    rgb : (H, W, 3) linear, exposed and tone mapped.
    alpha : (H, W).
    aovs : albedo, roughness, metallic, normal; (H, W, c) each.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    aovs: dict[str, np.ndarray]


class Renderer:
    """Render views of fixed parameters one at a time, growing buffers as needed."""

    def __init__(
        self, config: Config, params: Params, context: Context, capacities: Capacities
    ) -> None:
        self._config = config
        self._params = params
        self._context = context
        self._capacities = capacities

    def __call__(self, camera: Camera) -> RenderedView:
        """Render the single view of ``camera``, with every AOV of the evaluation."""
        while True:
            output = _render(
                self._params,
                camera,
                self._context,
                model=self._config.model,
                capacities=self._capacities,
                aov_names=_EVALUATION_AOVS,
            )
            if not capacity_module.overflowed(output.usage, self._capacities):
                break
            self._capacities = capacity_module.grow(self._capacities, output.usage)
        rgb = tone_map(output.rgb[0], self._params.log_exposure)
        return RenderedView(
            np.asarray(rgb),
            np.asarray(output.alpha[0]),
            {name: np.asarray(image[0]) for name, image in output.aovs.items()},
        )

    def mesh(self, *, training: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Extract the surface: vertices (n, 3), faces (m, 3) and vertex normals (n, 3)."""
        while True:
            surface = _isosurface(
                self._params.geometry,
                self._context.grid,
                capacities=self._capacities,
                training=training,
            )
            if not capacity_module.overflowed(surface.usage, self._capacities):
                break
            self._capacities = capacity_module.grow(self._capacities, surface.usage)
        return trim_mesh(surface.mesh)


def trim_mesh(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drop padding: vertices, faces and vertex normals on the host."""
    normals = np.asarray(_vertex_normals(mesh))
    vertex_count, face_count = int(mesh.vertex_count), int(mesh.face_count)
    return (
        np.asarray(mesh.vertices)[:vertex_count],
        np.asarray(mesh.faces)[:face_count],
        normals[:vertex_count],
    )


def over_background(rgb: np.ndarray, alpha: np.ndarray, background: float) -> np.ndarray:
    """Lay premultiplied colour over a grey background."""
    return rgb + (1.0 - alpha[..., None]) * background


def _encode(linear: np.ndarray) -> np.ndarray:
    """Return sRGB in [0, 1] on the host."""
    return np.clip(encode_srgb(np.clip(linear, 0.0, 1.0)), 0.0, 1.0)


def _view_figures(view: RenderedView, image: np.ndarray, truth_normal: np.ndarray | None) -> dict:
    """Figures of one view; ``image`` is (H, W, 4) linear with straight alpha."""
    mask = image[..., 3]
    predicted = _encode(over_background(view.rgb, view.alpha, 1.0))
    wanted = _encode(over_background(image[..., :3] * mask[..., None], mask, 1.0))
    figures = {
        "nvs.psnr": float(psnr(predicted, wanted)),
        "nvs.ssim": float(ssim(predicted, wanted)),
        "mask.iou": float(mask_iou(view.alpha, mask)),
    }
    if truth_normal is not None:
        for name in ("masked", "full"):
            figures[f"normal.mae_{name}_deg"] = float(
                normal_mae_deg(
                    view.aovs["normal"], truth_normal, mask, view.alpha, full=name == "full"
                )
            )
    return figures


def evaluate_run(
    config: Config,
    params: Params,
    context: Context,
    capacities: Capacities,
    views: Views,
    folder: Path,
    *,
    meta: dict[str, Any],
    sheet_views: int = 5,
) -> dict[str, Any]:
    """Render every test view, write ``metrics.json`` and ``overview.png``, return the figures.

    Protocol ``geosplatting``: sRGB, white background, mean over the images of the measure of each
    whole image; normals once over the mask's pixels and once over all of them, with (0, 0, 1)
    behind the object.

    Parameters
    ----------
    config, params, context, capacities : see `train.load_run`.
    views : test views; figures need ``truth`` only where it exists.
    folder : receives the two files.
    meta : recorded with the figures (step, scene, training seconds).
    sheet_views : number of views on the sheet, spread evenly.
    """
    began = time.perf_counter()
    renderer = Renderer(config, params, context, capacities)
    rendered, per_view = [], []
    for index, name in enumerate(views.names):
        view = renderer(views.camera(np.array([index])))
        normal = views.truth["normal"][index] if "normal" in views.truth else None
        per_view.append({"view": name, **_view_figures(view, views.images[index], normal)})
        rendered.append(view)
    names = [key for key in per_view[0] if key != "view"]
    figures = {
        "protocol": "geosplatting",
        "mean": {key: float(np.mean([line[key] for line in per_view])) for key in names},
        "views": per_view,
        "seconds": round(time.perf_counter() - began, 2),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "versions": {
            "python": platform.python_version(),
            **{package: importlib.metadata.version(package) for package in _PACKAGES},
        },
        "seed": config.run.seed,
        "config": config.to_dict(),
        **meta,
    }
    (folder / "metrics.json").write_text(json.dumps(figures, indent=2) + "\n")
    chosen = np.unique(np.linspace(0, len(rendered) - 1, sheet_views).round().astype(int))
    sheet = _overview(renderer, params, views, rendered, chosen)
    write_png(folder / "overview.png", sheet)
    return figures


def _overview(
    renderer: Renderer,
    params: Params,
    views: Views,
    rendered: list[RenderedView],
    chosen: np.ndarray,
) -> np.ndarray:
    """Compose the sheet: a row a view, and the light."""
    vertices, faces, normals = renderer.mesh()
    rows = []
    for index in chosen:
        view, image = rendered[index], views.images[index]
        mask = image[..., 3]
        row = {
            "truth": _encode(over_background(image[..., :3] * mask[..., None], mask, 1.0)),
            "render": _encode(over_background(view.rgb, view.alpha, 1.0)),
            "normal": normals_to_rgb(view.aovs["normal"], view.alpha),
            "albedo": _encode(view.aovs["albedo"]),
            "roughness": np.repeat(view.aovs["roughness"], 3, axis=-1),
            "metallic": np.repeat(view.aovs["metallic"], 3, axis=-1),
        }
        camera = views.camera(np.array([index]))
        mesh_normals, mesh_alpha = render_mesh_normals(vertices, faces, normals, camera)
        row["mesh"] = shade_mesh_preview(mesh_normals, mesh_alpha)
        rows.append(row)
    radiance = np.asarray(params.light.radiance)
    return overview_sheet(rows, light=radiance)


def preview_image(
    config: Config, params: Params, context: Context, capacities: Capacities, views: Views
) -> np.ndarray:
    """Put truth, render and normals of the first view side by side, (H, 3 W, 3) sRGB."""
    view = Renderer(config, params, context, capacities)(views.camera(np.array([0])))
    image = views.images[0]
    mask = image[..., 3]
    parts = [
        _encode(over_background(image[..., :3] * mask[..., None], mask, 1.0)),
        _encode(over_background(view.rgb, view.alpha, 1.0)),
        normals_to_rgb(view.aovs["normal"], view.alpha),
    ]
    return np.concatenate(parts, axis=1)


def straight_rgba(view: RenderedView) -> np.ndarray:
    """Return sRGB with straight alpha, (H, W, 4); colour is zero where nothing was hit."""
    alpha = view.alpha[..., None]
    straight = np.where(alpha > 0, view.rgb / np.where(alpha > 0, alpha, 1.0), 0.0)
    return np.concatenate([_encode(straight), np.clip(alpha, 0.0, 1.0)], axis=-1)
