"""Sheets of an evaluation: truth, reconstruction, errors, lights and colour scales."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geosplat_jax.fit.train import Trained
from geosplat_jax.io.images import write_png
from geosplat_jax.io.meshes import render_mesh_normals
from geosplat_jax.io.views import Views
from geosplat_jax.report.gallery import write_gallery
from geosplat_jax.report.pictures import normals_to_rgb, overview_sheet, shade_mesh_preview
from geosplat_jax.report.renderer import (
    RenderedView,
    Renderer,
    photograph_on_white,
    render_on_white,
    to_picture,
)
from geosplat_jax.report.scales import ERROR, METALLIC, ROUGHNESS, SEEN, error_map
from geosplat_jax.report.trust import Sightings

SHEETS = ("overview.png", "materials.png", "relight.png")
"""Sheets that an evaluation may write; the last two need ground truth of the scene."""


def _grey(values: np.ndarray) -> np.ndarray:
    return ROUGHNESS.picture(values[..., 0])


@dataclass(frozen=True)
class SheetContent:
    """Content of the sheets.

    Attributes
    ----------
    views : all test views.
    psnr : PSNR of every test view, dB.
    rendered : renders of the views that are shown, by index.
    mesh : vertices, faces and normals.
    is_two_sided : whether both sides of the mesh are surface.
    seen : by how many training views each vertex is seen; None where that was not counted.
    albedo_scale : (3,) factors that align the albedo with the truth.
    relit : for every view that is shown, pictures by title under each light; empty without lights.
    relit_figures : lines of text about the relit pictures.
    lights : (H, W, 3) linear radiance by title, the true light first where it is known.
    """

    views: Views
    psnr: Sequence[float]
    rendered: Mapping[int, RenderedView]
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray]
    is_two_sided: bool
    seen: Sightings | None
    albedo_scale: np.ndarray
    relit: list[dict[str, np.ndarray]]
    relit_figures: list[str]
    lights: Mapping[str, np.ndarray]

    def write(self, folder: Path) -> dict[str, Any]:
        """Write the sheets, and every picture as a file; return the result of `write_gallery`.

        All sheets of an earlier evaluation are removed first.
        """
        overview, materials = self.overview_rows(), self.material_rows()
        for name in SHEETS:
            (folder / name).unlink(missing_ok=True)
        write_png(folder / "overview.png", self._overview_sheet(overview))
        if materials[0]:
            write_png(folder / "materials.png", self._material_sheet(materials))
        if self.relit:
            names = [self.views.names[index] for index in self.rendered]
            sheet = overview_sheet(
                self.relit, row_labels=names, scales=[ERROR], notes=self.relit_figures
            )
            write_png(folder / "relight.png", sheet)
        relit_rows = self.relit or [{}] * len(overview)
        rows = {
            self.views.names[index]: {**overview_row, **material_row, **relit_row}
            for index, overview_row, material_row, relit_row in zip(
                self.rendered, overview, materials, relit_rows, strict=True
            )
        }
        return write_gallery(folder, rows, lights=self.lights)

    @property
    def _labels(self) -> list[str]:
        """Names of the views that are shown, each with its PSNR."""
        names = self.views.names
        return [f"{names[index]}\n{self.psnr[index]:.2f} dB" for index in self.rendered]

    def overview_rows(self) -> list[dict[str, np.ndarray]]:
        """Return pictures by title for each view, without those that need true materials."""
        rows = []
        for index, view in self.rendered.items():
            truth = photograph_on_white(self.views.images[index])
            render = render_on_white(view.rgb, view.alpha)
            row = {
                "truth": truth,
                "render": render,
                "error": error_map(truth, render),
                "normal": normals_to_rgb(view.aovs["normal"], view.alpha),
                "albedo": to_picture(view.aovs["albedo"]),
                "roughness": _grey(view.aovs["roughness"]),
                "metallic": _grey(view.aovs["metallic"]),
            }
            camera = self.views.camera(np.array([index]))
            mesh_normals = render_mesh_normals(*self.mesh, camera, is_two_sided=self.is_two_sided)
            row["mesh"] = shade_mesh_preview(*mesh_normals)
            if self.seen is not None:
                row["seen by"] = self.seen.picture(camera)
            rows.append(row)
        return rows

    def material_rows(self) -> list[dict[str, np.ndarray]]:
        """Return pictures of materials and normals beside their ground truth, where it exists."""
        rows = []
        for index, view in self.rendered.items():
            mask, row = self.views.images[index][..., 3:], {}
            for name in ("albedo", "roughness", "metallic", "normal"):
                if name not in self.views.truth:
                    continue
                true, predicted = self.views.truth[name][index], view.aovs[name]
                if name == "albedo":
                    row["true albedo"] = to_picture(true * mask)
                    row["albedo, aligned"] = to_picture(predicted * self.albedo_scale)
                    continue
                if name == "normal":
                    row["true normal"] = normals_to_rgb(true, mask[..., 0])
                    row["normal"] = normals_to_rgb(predicted, view.alpha)
                else:
                    row[f"true {name}"], row[name] = _grey(true * mask), _grey(predicted)
            rows.append(row)
        return rows

    def _overview_sheet(self, rows: list[dict[str, np.ndarray]]) -> np.ndarray:
        """Compose the overview sheet: a row for each view, and the lights below."""
        scales = [ERROR, ROUGHNESS, METALLIC]
        if self.seen is not None:
            scales.append(SEEN)
        notes = ["albedo: as reconstructed", "lights: each with its own exposure"]
        return overview_sheet(
            rows, row_labels=self._labels, lights=self.lights, scales=scales, notes=notes
        )

    def _material_sheet(self, rows: list[dict[str, np.ndarray]]) -> np.ndarray:
        """Compose the sheet of materials and normals beside their ground truth."""
        notes = []
        if "albedo" in self.views.truth:
            factors = zip("RGB", self.albedo_scale, strict=True)
            text = ", ".join(f"{channel} x {factor:.3f}" for channel, factor in factors)
            notes = [f"albedo, aligned: as reconstructed, times {text} (linear)"]
        material_scales = [scale for scale in (ROUGHNESS, METALLIC) if scale.name in rows[0]]
        return overview_sheet(rows, row_labels=self._labels, scales=material_scales, notes=notes)


def preview_image(trained: Trained, views: Views) -> np.ndarray:
    """Compose a labelled sheet of the first view: truth, render, error and normals, sRGB."""
    view = Renderer.of(trained, samples=64)(views.camera(np.array([0])))
    truth, render = photograph_on_white(views.images[0]), render_on_white(view.rgb, view.alpha)
    row = {
        "truth": truth,
        "render": render,
        "error": error_map(truth, render),
        "normal": normals_to_rgb(view.aovs["normal"], view.alpha),
    }
    title = f"step {trained.step}, {trained.stage.name}"
    return overview_sheet([row], title=title, row_labels=[views.names[0]], scales=[ERROR])
