"""Masks of an object from photographs that also show its surroundings (appendix F).

Splats are trained on the whole photographs. Those in a box around the object are kept, and the mask
is where they are opaque. Masks are written to ``SCENE/masks``, where the readers of captures look
for them, in the size of the photographs and with the distortion of their lenses.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_fill_holes, label, maximum_filter

from geosplat_jax.capture.box import (
    Cloud,
    Plane,
    inside_box,
    propose_box,
    require_something_inside,
)
from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.capture.start import CaptureError, require_trainable
from geosplat_jax.capture.training import (
    RECORD,
    Radiance,
    psnr_by_view,
    render_views,
    train_radiance,
)
from geosplat_jax.core.harmonics import CONSTANT
from geosplat_jax.core.types import Bounds
from geosplat_jax.fit.folder import locked_folder
from geosplat_jax.fit.listener import Progress
from geosplat_jax.io.agreement import agreement
from geosplat_jax.io.dataset import LAYOUTS, Dataset, recognise_layout
from geosplat_jax.io.distortion import Lookup, photograph_lookup, resample
from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.export import export_gaussians_ply
from geosplat_jax.io.frames import MASK_FOLDERS, Frame, beside_images, mask_file
from geosplat_jax.io.images import MissingFileError, image_size, write_png, written_aside
from geosplat_jax.io.layouts.colmap import read_points
from geosplat_jax.io.views import COVERED, Views, point_text
from geosplat_jax.report.pictures import overview_sheet
from geosplat_jax.report.renderer import to_picture

OPAQUE = 0.8
"""Alpha of the splats in the box above which a pixel is the object (appendix F)."""

_UNSURE = (0.2, OPAQUE)
"""Alpha between these belongs neither to the object nor to what is around it."""
_SPECK = 0.02
"""Share of the largest part of a mask, below which another part is a speck."""
_MOST_UNSURE = 0.1
_LEAST_AGREEMENT = 0.9
_MOST_CUT = 0.05
"""Limits of the figures in `Certainty`, beyond which there is a warning."""
_SHEET_VIEWS = 6
_SHEET_WIDTH = 200  # least width of a picture, pixels: three are about as wide as the notes below
_DIM = 0.12  # brightness outside of the mask in the sheet
_DISSENT = (0.9, 0.35, 0.1)  # colour that half-opaque pixels are marked with

_PIXELS = 270 * 480
"""Most pixels of a reduced photograph, see `choose_factor`."""

REPORT = "masks.json"
_BEGUN = "masks_begun.json"
"""File that lists the masks which a command is about to write; removed when all are written."""


@dataclass(frozen=True)
class Certainty:
    """How sure masks are.

    Attributes
    ----------
    coverage : mean share of an image that its mask covers.
    unsure : number of pixels with alpha from 0.2 to 0.8 that do not touch a mask, per pixel of
        masks.
    cut : share of the masks' rims that lies on the border of the image.
    agreement : mean share of the rays through a mask that meet the visual hull of the other masks.
    empty : names of views whose mask is empty.
    """

    coverage: float
    unsure: float
    cut: float
    agreement: float
    empty: tuple[str, ...]

    def warnings(self) -> list[str]:
        """Say what looks wrong, and what to do."""
        messages = []
        if self.unsure > _MOST_UNSURE:
            messages.append(
                "many pixels are half opaque; train longer (--force --steps), or give a tighter "
                "--box"
            )
        if self.agreement < _LEAST_AGREEMENT:
            messages.append("masks contradict each other; look at masks.png, and give a --box")
        if self.cut > _MOST_CUT:
            messages.append(
                f"{self.cut:.0%} of the masks' rims lie on the border of the image: the object, or "
                "something else in the box, is cut off there"
            )
        if self.empty:
            messages.append(f"{len(self.empty)} masks are empty, for example {self.empty[0]}")
        return messages


@dataclass(frozen=True)
class MaskReport:
    """Summary of the masks that were written, and how sure they are.

    Attributes
    ----------
    masks : number of files.
    folder : folder of the files.
    lo, hi : (3,) corners of the box in the world.
    proposed : whether the box was found by `propose_box`, not given.
    plane : ground that was left out: three numbers of its normal, then its height, see `box.Plane`.
        None where there is none.
    splats : number of splats in the box.
    splats_total : number of all splats.
    psnr : mean decibels of the splats on held-back views; None where there are none.
    certainty : how sure the masks are.
    """

    masks: int
    folder: str
    lo: tuple[float, float, float]
    hi: tuple[float, float, float]
    proposed: bool
    plane: tuple[float, float, float, float] | None
    splats: int
    splats_total: int
    psnr: float | None
    certainty: Certainty

    def lines(self) -> list[str]:
        """Describe the report for a reader."""
        corners = f"{point_text(self.lo)} to {point_text(self.hi)}"
        origin = "proposed" if self.proposed else "given"
        plane = ", without what it stands on or hangs from" if self.plane else ""
        psnr_text = "no views are held back"
        if self.psnr is not None:
            psnr_text = f"{self.psnr:.2f} dB on views that are held back"
        figures = self.certainty
        return [
            f"splats:     {self.splats_total}, {psnr_text}",
            f"box:        {corners} ({origin}{plane}), {self.splats} splats in it",
            f"masks:      {self.masks} in {self.folder}, {figures.coverage:.1%} of an image each",
            f"unsure:     {figures.unsure:.1%} half-opaque pixels off the rims, per mask pixel",
            f"agreement:  {figures.agreement:.1%} of the rays through a mask meet the others' hull",
            *(f"warning: {warning}" for warning in figures.warnings()),
        ]


def make_masks(
    dataset: Dataset,
    settings: RadianceSettings,
    folder: str | Path,
    *,
    box: Bounds | None = None,
    downscale: int = 1,
    resume: bool = False,
    force: bool = False,
    on_step: Callable[[Progress], None] | None = None,
) -> MaskReport:
    """Train splats on a capture, keep those in a box, and write masks into the scene's folder.

    Parameters
    ----------
    dataset : the capture, read with ``mask_files=False``.
    settings : settings of the training.
    folder : folder for splats, checkpoints, sheet and report.
    box : lo and hi in the world; by default `propose_box` finds one.
    downscale : factor that the dataset was read with.
    resume : continue a training, or take its splats where it is done.
    force : replace splats in ``folder``, and masks that this command did not write.
    on_step : called after every step of the training.

    Returns
    -------
    The report, which is also written to ``masks.json`` in ``folder``.

    Raises
    ------
    CaptureError : there are too few views, masks that are there already, no splats in the box, or
        nothing that the masks would cover.
    SceneError, RunError, TrainingError, Interrupted : see `train_radiance`.
    """
    folder = Path(folder)
    frames = _frames(dataset)
    require_trainable(dataset.train)
    _require_free(frames, folder, resume=resume, force=force)
    if box is not None and not (np.asarray(box[0]) < np.asarray(box[1])).all():
        raise CaptureError(f"the box must be lo (x, y, z) below hi (x, y, z), got {box}")
    radiance = train_radiance(
        dataset.train,
        settings,
        folder,
        points=read_points(dataset.root) if dataset.layout == "colmap" else None,
        resume=resume,
        replace_run=force,
        on_step=on_step,
    )
    with locked_folder(folder, own=folder / RECORD):
        return _write_masks(
            radiance, dataset, frames, folder, box=box, downscale=downscale, seed=settings.seed
        )


def _write_masks(
    radiance: Radiance,
    dataset: Dataset,
    frames: Sequence[Frame],
    folder: Path,
    *,
    box: Bounds | None,
    downscale: int,
    seed: int,
) -> MaskReport:
    """Write splats, masks, sheet and report, see `make_masks`."""
    files = [mask_file(dataset.root, frame.image) for frame in frames]
    write_splats(radiance, folder / "splats.ply")
    psnr = float(psnr_by_view(radiance, dataset.test).mean()) if len(dataset.test) else None
    views = _all_views(dataset)
    clipped, (lo, hi), plane = _clipped(radiance, dataset.train, box, seed)
    write_splats(clipped, folder / "object.ply")
    alpha = _alphas(clipped, views, (lo, hi))
    # A command that is stopped between the first mask and the report can be resumed.
    marker = folder / _BEGUN
    with written_aside(marker) as temporary_path:
        temporary_path.write_text(
            json.dumps([str(file.resolve()) for file in files]) + "\n", encoding="utf-8"
        )
    for frame, file, values in zip(frames, files, alpha, strict=True):
        write_png(file, photograph_mask(values, frame, downscale)[..., None].astype(np.float32))
    report = MaskReport(
        masks=len(files),
        folder=str(dataset.root / "masks"),
        lo=_numbers(lo),
        hi=_numbers(hi),
        proposed=box is None,
        plane=None if plane is None else (*_numbers(plane.normal), plane.height),
        splats=clipped.splats.capacity,
        splats_total=radiance.splats.capacity,
        psnr=psnr,
        certainty=certainty(views, alpha, (lo, hi)),
    )
    write_png(folder / "masks.png", mask_sheet(views, alpha, report.lines()))
    text = json.dumps(asdict(report), indent=2)
    with written_aside(folder / REPORT) as temporary_path:
        temporary_path.write_text(text + "\n", encoding="utf-8")
    marker.unlink()
    return report


def _alphas(clipped: Radiance, views: Views, box: Bounds) -> Float[np.ndarray, "V H W"]:
    """Render what becomes the masks of views.

    Raises
    ------
    CaptureError : it covers no pixel of any view.
    """
    _, alpha = render_views(clipped, views.camera())
    if views.valid is not None:
        alpha = alpha * views.valid
    alpha = tidied(alpha)
    if not (alpha > OPAQUE).any():
        lo, hi = map(_numbers, box)
        raise CaptureError(
            f"the splats in the box from {lo} to {hi} cover no pixel by more than {OPAQUE:g}, so "
            "masks would leave nothing; give another --box, or train longer (--force --steps)"
        )
    return alpha


def choose_factor(path: str | Path) -> int:
    """Return the factor that reduces photographs to at most 270 x 480 pixels each.

    Raises
    ------
    SceneError : see `io.dataset.load_dataset`.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        raise MissingFileError(f"scene folder {root} does not exist")
    listing = LAYOUTS[recognise_layout(root)].list_frames(root, light=None)
    sizes = [image_size(frame.image) for frame in (*listing.train, *listing.test)]
    height, width = max(sizes, key=lambda size: size[0] * size[1])
    factor = max(1, math.ceil(math.sqrt(height * width / _PIXELS)))
    return min(factor, height, width)


def _frames(dataset: Dataset) -> list[Frame]:
    """Return the frames of all views, those of the training first.

    Raises
    ------
    CaptureError : the images are cut out already, or the scene has masks in other places, so that
        new ones might not be read.
    """
    listing = LAYOUTS[dataset.layout].list_frames(dataset.root, light=None)
    if not listing.is_capture:
        raise CaptureError(
            f"{dataset.root} is of the layout {dataset.layout}, whose images are cut out; masks "
            "are made for captures (docs/captures.md)"
        )
    frames_by_name = {frame.name: frame for frame in (*listing.train, *listing.test)}
    frames = [frames_by_name[name] for name in (*dataset.train.names, *dataset.test.names)]
    for frame in frames:
        mask_path = beside_images(dataset.root, frame.image, MASK_FOLDERS)
        if frame.mask is not None and frame.mask != mask_path:
            raise CaptureError(
                f"the scene gives {frame.image.name} the mask {frame.mask}, which does not lie "
                "where a new one would; move such masks away, or remove mask_path from "
                "transforms.json"
            )
    return frames


def _require_free(frames: Sequence[Frame], folder: Path, *, resume: bool, force: bool) -> None:
    """Refuse to replace masks that this command did not write, before hours of training."""
    masks = [frame.mask for frame in frames if frame.mask is not None]
    marker = folder / _BEGUN
    recorded_masks = set(parse_json(marker.read_bytes())) if marker.exists() else set()
    is_of_stopped_run = (
        bool(recorded_masks) and {str(mask.resolve()) for mask in masks} <= recorded_masks
    )
    is_ours = resume and ((folder / REPORT).exists() or is_of_stopped_run)
    if masks and not (is_ours or force):
        raise CaptureError(
            f"{len(masks)} of {len(frames)} views have a mask already, for example {masks[0]}; "
            "replace them with --force, or move them away"
        )


def _all_views(dataset: Dataset) -> Views:
    """Return the views of both splits as one, those of the training first."""
    train, test = dataset.train, dataset.test
    if not len(test):
        return train
    height, width = max(train.height, test.height), max(train.width, test.width)

    def grown(pixels: Any, padding: float = 0.0) -> np.ndarray:
        values = np.asarray(pixels)
        widths = [(0, 0), (0, height - values.shape[1]), (0, width - values.shape[2])]
        return np.pad(
            values, [*widths, *[(0, 0)] * (values.ndim - 3)], constant_values=np.float32(padding)
        )

    def valid_of(views: Views) -> np.ndarray:
        marks = views.valid
        return grown(np.ones(views.images.shape[:3], np.float32) if marks is None else marks)

    valid = np.concatenate([valid_of(train), valid_of(test)])
    return Views(
        names=train.names + test.names,
        camera_to_world=np.concatenate([train.camera_to_world, test.camera_to_world]),
        intrinsics=np.concatenate([train.intrinsics, test.intrinsics]),
        images=np.concatenate([grown(train.images), grown(test.images)]),
        valid=None if (valid == 1.0).all() else valid,
        has_masks=False,
    )


def _clipped(
    radiance: Radiance, views: Views, box: Bounds | None, seed: int
) -> tuple[Radiance, Bounds, Plane | None]:
    """Keep the splats whose means lie in the box; with a proposed box, only those above its ground.

    Raises
    ------
    CaptureError : there is no splat in the box.
    """
    splats = radiance.splats
    cloud = Cloud(
        np.asarray(splats.means, np.float64),
        np.asarray(splats.opacities, np.float64),
        np.asarray(splats.scales, np.float64).max(1),
    )
    plane = None
    if box is None:
        proposal = propose_box(cloud, views, seed=seed)
        corners, plane = (proposal.lo, proposal.hi), proposal.plane
    else:
        corners = (np.asarray(box[0], np.float64), np.asarray(box[1], np.float64))
    is_inside = inside_box(cloud.positions, *corners)
    if plane is not None:
        is_inside &= plane.is_above(cloud.positions)
    require_something_inside(is_inside, cloud, corners)
    return radiance.of(is_inside), corners, plane


def write_splats(radiance: Radiance, path: Path) -> None:
    """Write splats as the PLY of 3D Gaussian splatting, with all harmonics."""
    splats = radiance.splats
    export_gaussians_ply(
        path,
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        0.5 + CONSTANT * np.asarray(splats.base),
        np.zeros_like(splats.means),
        rest=splats.rest,
    )


def tidied(alpha: Float[np.ndarray, "V H W"]) -> Float[np.ndarray, "V H W"]:
    """Remove specks from masks, and fill holes in which the splats are half opaque.

    A speck is smaller than a fiftieth of the largest part of the mask; its alpha becomes 0. Pixels
    of a hole that a mask encloses get alpha 1 where their alpha is above 0.2; pixels with less are
    taken for a true hole.

    Parameters
    ----------
    alpha : (V, H, W) in [0, 1].

    Returns
    -------
    (V, H, W) changed copy.
    """
    alphas = np.array(alpha)
    for values in alphas:
        mask = values > OPAQUE
        labelling: Any = label(mask, structure=np.ones((3, 3), int))
        sizes = np.bincount(labelling[0].ravel())
        sizes[0] = sizes[1:].max(initial=0)
        is_speck = (sizes < _SPECK * sizes[0])[labelling[0]]
        values[is_speck] = 0.0
        holes = binary_fill_holes(mask & ~is_speck) & ~mask
        values[holes & (values > _UNSURE[0])] = 1.0
    return alphas


def photograph_mask(
    alpha: Float[np.ndarray, "H W"], frame: Frame, downscale: int
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of a photograph in its own size and with the distortion of its lens.

    Parameters
    ----------
    alpha : (H, W) alpha of the undistorted image, reduced by ``downscale``; it may have padding at
        the ends of its axes.
    frame : the photograph and its lens.
    downscale : factor by which ``alpha`` is smaller than the photograph.

    Returns
    -------
    (h, w) True on the object.
    """
    height, width = image_size(frame.image)
    lookup = photograph_lookup(
        frame.lens.distortion, frame.lens.intrinsics(width, height), width, height
    )
    rows, columns = height // downscale, width // downscale
    reduced_lookup = Lookup(lookup.rows / downscale, lookup.columns / downscale, lookup.inside)
    mask = (alpha[:rows, :columns, None] > OPAQUE).astype(np.float32)
    return resample(mask, reduced_lookup)[..., 0] > COVERED


def _surrounded(pixels: Bool[np.ndarray, "V H W"]) -> Bool[np.ndarray, "V H W"]:
    """Find the pixels whose four neighbours are all set; there are none beyond the border."""
    padded = np.pad(pixels, ((0, 0), (1, 1), (1, 1)))
    return padded[:, :-2, 1:-1] & padded[:, 2:, 1:-1] & padded[:, 1:-1, :-2] & padded[:, 1:-1, 2:]


def certainty(views: Views, alpha: Float[np.ndarray, "V H W"], box: Bounds) -> Certainty:
    """Measure how sure masks are.

    Parameters
    ----------
    views : the photographs and their cameras.
    alpha : (V, H, W) alpha of the splats in the box; at least one mask must not be empty.
    box : lo and hi of the box.
    """
    masks = alpha > OPAQUE
    mask_area = int(masks.sum())
    # Photographs end where pixels do not count, too: at padding, and at the border of an
    # undistorted image.
    counts = np.ones(masks.shape, bool) if views.valid is None else np.asarray(views.valid) > 0
    border_count = int((masks & ~_surrounded(counts)).sum())
    rim = int((masks & ~_surrounded(masks)).sum())
    rgba = np.concatenate([views.images[..., :3], masks[..., None].astype(np.float32)], axis=-1)
    masked = replace(views, images=rgba, has_masks=True)
    shares = agreement(masked, box)
    is_empty = ~masks.any((1, 2))
    # A rim of one pixel is half opaque around any object, and so is not counted.
    dilated_masks = np.asarray(maximum_filter(masks, (1, 3, 3)), bool)
    return Certainty(
        coverage=float(masked.coverage.mean()),
        unsure=float(((alpha > _UNSURE[0]) & ~dilated_masks).sum() / mask_area),
        cut=border_count / max(rim, border_count, 1),
        agreement=float(shares[np.isfinite(shares)].mean()),
        empty=tuple(name for name, is_blank in zip(views.names, is_empty, strict=True) if is_blank),
    )


def _numbers(corner: np.ndarray) -> tuple[float, float, float]:
    x, y, z = map(float, corner)
    return x, y, z


def mask_sheet(
    views: Views, alpha: Float[np.ndarray, "V H W"], notes: Sequence[str]
) -> Float[np.ndarray, "rows columns 3"]:
    """Show some views: the capture, its mask, and the capture with the mask on it.

    Half-opaque pixels are orange in the mask.
    """
    view_indices = np.unique(np.linspace(0, len(views) - 1, _SHEET_VIEWS).astype(int))
    zoom = math.ceil(_SHEET_WIDTH / views.width)
    rows: list[dict[str, Any]] = []
    for view in view_indices:
        picture = to_picture(views.images[view, ..., :3])
        mask = (alpha[view] > OPAQUE)[..., None]
        is_unsure = (alpha[view] > _UNSURE[0])[..., None] & ~mask
        mask_picture = np.where(is_unsure, np.asarray(_DISSENT), mask.astype(np.float32))
        rows.append(
            {
                name: np.repeat(np.repeat(image, zoom, 0), zoom, 1)
                for name, image in (
                    ("capture", picture),
                    ("mask", mask_picture.astype(np.float32)),
                    ("masked", np.where(mask, picture, _DIM * picture)),
                )
            }
        )
    return overview_sheet(
        rows, title="masks", row_labels=[views.names[view] for view in view_indices], notes=notes
    )
