"""Scenes in memory: one type for all layouts, which are recognised automatically and checked."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from geosplat_jax.core.types import Bounds
from geosplat_jax.io.cameras import cameras_digest, read_cameras, with_cameras
from geosplat_jax.io.frames import Frame, Listing
from geosplat_jax.io.images import MissingFileError, SceneError, image_size, wide_color_profile
from geosplat_jax.io.layouts.blended_mvs import is_blended_mvs, list_blended_mvs
from geosplat_jax.io.layouts.colmap import is_colmap, list_colmap
from geosplat_jax.io.layouts.idr import is_idr, list_idr
from geosplat_jax.io.layouts.llff import is_llff, list_llff
from geosplat_jax.io.layouts.nerf_synthetic import (
    is_nerf_synthetic,
    is_shiny_blender,
    list_nerf_synthetic,
    list_shiny_blender,
)
from geosplat_jax.io.layouts.stanford_orb import is_stanford_orb, list_stanford_orb
from geosplat_jax.io.layouts.synthetic4relight import is_synthetic4relight, list_synthetic4relight
from geosplat_jax.io.layouts.tensoir import is_tensoir, list_tensoir
from geosplat_jax.io.layouts.transforms import is_transforms, list_transforms_capture
from geosplat_jax.io.loading import KEPT_BYTES, load_views, some_names
from geosplat_jax.io.views import COVERED, OPAQUE, Views, no_views, point_text
from geosplat_jax.surface.hull import hull_bounds, sight_bounds


class Layout(NamedTuple):
    """How to recognise a layout and how to list its frames."""

    recognise: Callable[[Path], bool]
    list_frames: Callable[..., Listing]


# Tried in this order when a layout is recognised: the most specific ones come first.
LAYOUTS: dict[str, Layout] = {
    "stanford_orb": Layout(is_stanford_orb, list_stanford_orb),
    "tensoir": Layout(is_tensoir, list_tensoir),
    "synthetic4relight": Layout(is_synthetic4relight, list_synthetic4relight),
    "shiny_blender": Layout(is_shiny_blender, list_shiny_blender),
    "nerf_synthetic": Layout(is_nerf_synthetic, list_nerf_synthetic),
    "transforms": Layout(is_transforms, list_transforms_capture),
    "colmap": Layout(is_colmap, list_colmap),
    "llff": Layout(is_llff, list_llff),
    "idr": Layout(is_idr, list_idr),
    "blended_mvs": Layout(is_blended_mvs, list_blended_mvs),
}


_PIXELS_OF_A_CELL = 2.0
READING: tuple[tuple[str, Any], ...] = (
    ("downscale", 1),
    ("light", None),
    ("layout", None),
    ("train_views", None),
    ("test_views", None),
    ("mask_files", True),
)
"""Options of `load_dataset` that a record keeps as they are, and their defaults."""

READING_OPTIONS = (*(name for name, _ in READING), "bounds", "cameras")
"""Names of all options that decide how a scene is read, see `load_recorded`."""

_FAR_SIZES = 1000.0
"""An object that lies farther from the origin than this many times its size causes a warning: at
that distance rounding may draw its points .04 pixels off, for a focal length of 800 pixels."""

_BOX_MARGIN = 1.0
"""Pixels by which a mask may exceed the outline of a given box."""
_REACH_PIXELS = 256
"""Pixels along a side of the masks that are compared with a given box; of larger ones every n-th
row and column is."""
_LARGEST_OUTSIDE = 0.02
"""Share of the masks' pixels that may lie outside of a given box without a warning."""

_NARROW_DEG = 20.0
"""Degrees. If the largest angle between two cameras, as seen from the object, is smaller, the
cameras see one side of the object only."""
_COARSE_PIXELS = 256
_COARSE_VIEWS = 16
_NEEDS_MASKS = (
    "training and evaluation need to tell the object from the background: write RGBA images, name "
    "a mask_path for each frame, or add masks/NAME.png, white on the object (docs/captures.md); "
    "for a capture, the command `geosplat-jax masks SCENE` makes them"
)


@dataclass(frozen=True)
class Dataset:
    """A scene: views for training and testing, and what is known about it.

    Attributes
    ----------
    name : name of the folder.
    layout : one of `LAYOUTS`.
    root : the folder.
    train, test : views.
    lights : files of environment maps, by light (lat-long in the z-up world, see `EnvLight`).
    train_light : name of the light of the training images; None where the layout names no lights.
    bounds : lo (3,) and hi (3,), corners of a world box around the object.
    warnings : problems that do not prevent a training.
    notes : choices that were made where the files leave them open.
    options : options that the scene was read with, for `load_recorded`.
    """

    name: str
    layout: str
    root: Path
    train: Views
    test: Views
    lights: Mapping[str, Path]
    train_light: str | None
    bounds: Bounds
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)

    def require_masks(self, split: str) -> None:
        """Refuse a split whose views have no masks; `SceneError`."""
        views = self.train if split == "train" else self.test
        if len(views) and not views.has_masks:
            raise SceneError(f"the {split} views of {self.root} have no masks, but {_NEEDS_MASKS}")

    @property
    def views_to_show(self) -> Views:
        """The test views, or the training views if there are no test views."""
        return self.test if self.test.names else self.train


def load_dataset(
    path: str | Path,
    *,
    layout: str | None = None,
    downscale: int = 1,
    light: str | None = None,
    bounds: Sequence[Sequence[float | int] | np.ndarray] | None = None,
    train_views: int | None = None,
    test_views: int | None = None,
    cameras: str | Path | None = None,
    mask_files: bool = True,
) -> Dataset:
    """Load a scene folder.

    Parameters
    ----------
    path : the scene folder.
    layout : one of `LAYOUTS`; recognised when not given.
    downscale : integer factor that images and intrinsics are reduced by.
    light : name of the training light, where the layout has several.
    bounds : lo and hi of a world box around the object; by default that of `object_bounds`.
    train_views, test_views : use at most this many views, spread evenly over the list.
    cameras : file of refined cameras. They replace the cameras of the scene in the splits that the
        file names, and the photographs are corrected as `cameras.with_cameras` describes.
    mask_files : False ignores mask files; the alpha of the images themselves is still used.

    Raises
    ------
    MissingFileError : the folder or a file in it does not exist.
    SceneError : something in the folder cannot be used; the message says what, why, and the cure.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        raise MissingFileError(f"scene folder {root} does not exist")
    arguments = {
        "layout": layout,
        "train_views": None if train_views is None else int(train_views),
        "test_views": None if test_views is None else int(test_views),
        "mask_files": mask_files,
    }
    layout = _layout_of(root, layout)
    listing = LAYOUTS[layout].list_frames(root, light=light)
    warnings: list[str] = []
    cameras = None if cameras is None else Path(cameras).expanduser()
    refined_splits = {} if cameras is None else read_cameras(cameras)
    splits: dict[str, Views] = {}
    for split, frames, limit in (
        ("train", listing.train, train_views),
        ("test", listing.test, test_views),
    ):
        split_frames = _spread(frames, limit, f"{split}_views")
        if not mask_files:
            split_frames = [replace(frame, mask=None) for frame in split_frames]
        if not split_frames and split == "test":
            warnings.append("there are no test views; nothing can be evaluated")
            splits[split] = no_views(splits["train"])
            continue
        splits[split] = _load_split(split, split_frames, listing, downscale, warnings)
        if split in refined_splits:
            splits[split] = with_cameras(splits[split], refined_splits[split], str(cameras))
    if unmasked_splits := [name for name, views in splits.items() if not views.has_masks]:
        warnings.append(f"the {' and '.join(unmasked_splits)} views have no masks; {_NEEDS_MASKS}")
    if bounds is None:
        box = object_bounds(splits["train"], others=splits["test"].camera_to_world[:, :3, 3])
    else:
        box = _checked_bounds(bounds)
        _check_reach(splits["train"], box, warnings)
    _check_box(splits, box, warnings)
    return Dataset(
        name=root.resolve().name,
        layout=layout,
        root=root,
        train=splits["train"],
        test=splits["test"],
        lights=listing.lights,
        train_light=listing.train_light,
        bounds=box,
        warnings=tuple(warnings),
        notes=listing.notes,
        options={
            "downscale": int(downscale),
            "light": light,
            "bounds": None if bounds is None else np.ravel(bounds).tolist(),
            **({} if cameras is None else _recorded(cameras)),
            **{
                name: arguments[name]
                for name, default in READING
                if arguments.get(name, default) != default
            },
        },
    )


def _load_split(
    split: str, frames: Sequence[Frame], listing: Listing, downscale: int, warnings: list[str]
) -> Views:
    """Load the views of a split, and append what is wrong with them to the warnings."""
    views, problems = load_views(
        frames, factor=downscale, listing=listing, most_bytes=KEPT_BYTES[split]
    )
    _check_pixels(views, split)
    _check_masks(views, split, warnings)
    warnings += [f"{split}: {problem}" for problem in problems]
    if (profile := wide_color_profile(frames[0].image)) is not None:
        warnings.append(
            f"{split}: {frames[0].image.name} has colours of the profile {profile!r}, which "
            "are read as sRGB and come out too dull; convert the photographs to sRGB"
        )
    return views


def _recorded(cameras: Path) -> dict[str, str]:
    """Return what a run records of its file of refined cameras: the path, and a digest."""
    return {
        "cameras": str(cameras.resolve()),
        "cameras_digest": cameras_digest(cameras),
    }


def load_recorded(path: str | Path, options: Mapping[str, Any]) -> Dataset:
    """Load a scene folder as a run read it, by the options in its record.

    Parameters
    ----------
    path : the scene folder.
    options : as in `Dataset.options`: keyword arguments of `load_dataset`, with ``bounds`` as six
        numbers (lo, then hi). Missing ones take their defaults; other keys are ignored.

    Raises
    ------
    SceneError
        As `load_dataset`, and if the file of refined cameras has changed since it was recorded.
    """
    bounds, cameras = options.get("bounds"), options.get("cameras")
    digest = options.get("cameras_digest")
    if cameras is not None and digest is not None and cameras_digest(cameras) != digest:
        raise SceneError(
            f"{cameras} has changed since the run read its cameras from it; train anew, or put "
            "the file back"
        )
    return load_dataset(
        path,
        bounds=None if bounds is None else (bounds[:3], bounds[3:]),
        cameras=cameras,
        **{name: options.get(name, default) for name, default in READING},
    )


def photograph_size(
    path: str | Path, *, layout: str | None = None, light: str | None = None
) -> tuple[int, int]:
    """Height and width in pixels of a scene's first training photograph, before any reduction.

    Raises
    ------
    SceneError : see `load_dataset`.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        raise MissingFileError(f"scene folder {root} does not exist")
    listing = LAYOUTS[_layout_of(root, layout)].list_frames(root, light=light)
    return image_size(listing.train[0].image)


class Downscale(NamedTuple):
    """Factor to reduce the images of a scene by, and the reason for it in a sentence."""

    factor: int
    reason: str


def choose_downscale(path: str | Path, cells: int, **options: Any) -> Downscale:
    """Choose how far photographs can be reduced without showing less detail than the grid holds.

    The result is the largest factor at which a pixel, at the distance of the object, is at most
    half as wide as a cell; 1 where the photographs are coarser than that already. To find the
    object, some of the views are read at low resolution.

    Parameters
    ----------
    path : the scene folder.
    cells : number of grid cells along the longest side of the object's box.
    options : options of `load_dataset`, except ``downscale``.

    Raises
    ------
    SceneError : see `load_dataset`.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        raise MissingFileError(f"scene folder {root} does not exist")
    layout = _layout_of(root, options.get("layout"))
    listing = LAYOUTS[layout].list_frames(root, light=options.get("light"))
    shortest = min(min(image_size(frame.image)) for frame in (*listing.train, *listing.test))
    coarse_factor = max(1, shortest // _COARSE_PIXELS)
    # Refined cameras belong to images of one size, and would change the factor little.
    excluded_names = ("cameras", "train_views", "test_views")
    reading_options = {name: value for name, value in options.items() if name not in excluded_names}
    read = partial(load_dataset, path, **reading_options, downscale=coarse_factor)
    try:
        dataset = read(train_views=_COARSE_VIEWS, test_views=1)
    except SceneError:
        dataset = read()  # a scene may have too many bad views among a few, but not among all
    lo, hi = dataset.bounds
    views = dataset.train
    distance = np.linalg.norm(views.camera_to_world[:, :3, 3] - 0.5 * (lo + hi), axis=1)
    pixel = float(np.median(distance / (coarse_factor * views.intrinsics[:, 0, 0])))
    cell = float((hi - lo).max()) / cells
    factor = int(np.clip(cell / (_PIXELS_OF_A_CELL * pixel), 1, shortest))
    size = "stay in full size" if factor == 1 else f"are reduced by {factor}"
    return Downscale(
        factor,
        f"images {size}: a cell of the grid then is {cell / (factor * pixel):.1f} pixels wide",
    )


def _layout_of(root: Path, layout: str | None) -> str:
    """Return the layout that was named, or else the one that is recognised."""
    if layout is None:
        return recognise_layout(root)
    if layout not in LAYOUTS:
        raise SceneError(f"layout must be one of {sorted(LAYOUTS)}, got {layout!r}")
    return layout


def recognise_layout(root: Path) -> str:
    """Return the layout of a scene folder, recognised by the files in it; one of `LAYOUTS`.

    Raises
    ------
    SceneError : none of the layouts fits.
    """
    for name, layout in LAYOUTS.items():
        if layout.recognise(root):
            return name
    raise SceneError(
        f"{root} has no known layout; expected transforms_train.json (NeRF-synthetic, Shiny "
        "Blender, Synthetic4Relight, Stanford-ORB), folders train_000, test_000, ... (TensoIR), "
        "transforms.json (nerfstudio, instant-ngp), sparse/0 (COLMAP), poses_bounds.npy (LLFF, "
        "nvdiffrec), cameras*.npz (IDR, NeuS) or cams/00000000_cam.txt (BlendedMVS); geosplat-jax "
        "poses finds the cameras of photographs"
    )


def object_bounds(
    views: Views, *, margin: float = 0.02, others: Float[np.ndarray, "N 3"] | None = None
) -> Bounds:
    """Find a box around the object, from the masks or else from the lines of sight.

    With masks it is the box of the visual hull, `hull.hull_bounds`; without masks it surrounds what
    the cameras look at, `hull.sight_bounds`.

    Parameters
    ----------
    views : the training views.
    margin : added on every side of the hull, as a share of its longest side.
    others : (N, 3) centres of further cameras, world. A box of the lines of sight leaves them
        outside; the hull of masks lies where the object is, whatever the cameras.

    Returns
    -------
    lo, hi : (3,) corners of the box, world.

    Raises
    ------
    SceneError : the masks and cameras do not bound a volume.
    """
    cameras = (views.world_to_camera, views.intrinsics)
    try:
        if not views.has_masks:
            return sight_bounds(*cameras, sizes=views.sizes, others=others)
        return hull_bounds(*cameras, views.alphas, valid=views.valid, margin=margin)
    except ValueError as error:
        raise SceneError(f"cannot find the object: {error}") from error


def describe(dataset: Dataset) -> str:
    """Summarise a dataset as lines of text."""
    lines = [f"{dataset.name}: {dataset.layout} scene in {dataset.root}"]
    for split, views in (("train", dataset.train), ("test", dataset.test)):
        if not len(views):
            lines.append(f"  {split + ':':<12}none")
            continue
        coverage, masks = views.coverage, "no masks"
        if views.has_masks:
            masks = (
                f"mask covers {coverage.mean():.1%} ({coverage.min():.1%} to {coverage.max():.1%})"
            )
        size = f"{views.width} x {views.height}"
        lines.append(f"  {split + ':':<12}{len(views)} views of {size}, {masks}")
        if views.valid is not None:
            share = views.valid_counts.mean() / (views.height * views.width)
            lines.append(f"  {'':<12}pixels that count: {share:.1%}")
        if views.lights:
            lines.append(f"  {'':<12}environment maps of {len(views.lights)} views")
        if views.truth:
            lines.append(f"  {'':<12}ground truth: {', '.join(views.truth)}")
        if views.relight:
            lines.append(f"  {'':<12}relit: {', '.join(views.relight)}")
    lines.append(f"  {'light:':<12}{dataset.train_light or 'unnamed'}")
    maps = ", ".join(f"{name} ({path.name})" for name, path in dataset.lights.items())
    lines.append(f"  {'maps:':<12}{maps or 'none found'}")
    lo, hi = dataset.bounds
    box = f"{point_text(lo)} to {point_text(hi)}, size {point_text(hi - lo)}"
    lines.append(f"  {'bounds:':<12}{box}")
    lines += [f"  note: {note}" for note in dataset.notes]
    lines += [f"  warning: {warning}" for warning in dataset.warnings]
    return "\n".join(lines)


def _check_pixels(views: Views, split: str) -> None:
    """Refuse a view of which no pixel counts."""
    if views.valid is None:
        return
    counts = views.valid_counts > 0.0
    if not counts.all():
        name = views.names[int(np.argmin(counts))]
        raise SceneError(
            f"no pixel of the {split} view {name!r} counts; check its file in valid/, or its lens"
        )


def _check_masks(views: Views, split: str, warnings: list[str]) -> None:
    if not views.has_masks:
        return
    has_object = views.coverage > 0.0
    if not has_object.any():
        raise SceneError(
            f"the mask of every {split} view is empty (no alpha above {COVERED}); check the alpha "
            "channel of the images, or the mask files, which must be 255 on the object"
        )
    if not views.has_opaque_pixel:
        warnings.append(
            f"{split}: no pixel of any view is opaque (alpha of {OPAQUE} or more); masks must be "
            "255 on the object, and not the colour of a label"
        )
    if not has_object.all():
        empty_names = [
            name for name, is_covered in zip(views.names, has_object, strict=True) if not is_covered
        ]
        warnings.append(
            f"{split}: the mask of {len(empty_names)} views is empty, {some_names(empty_names)}"
        )
    if (views.coverage == 1.0).all():
        warnings.append(f"{split}: every mask is full; the images may not be cut out at all")


def _check_box(splits: Mapping[str, Views], box: Bounds, warnings: list[str]) -> None:
    """Refuse cameras inside the box around the object.

    Add a warning if all cameras are on one side of the object, or if it lies far from the origin.
    """
    for views in splits.values():
        _check_cameras_outside(views, box)
    _check_sides(splits["train"], box, warnings)
    _check_origin(box, warnings)


def _check_sides(views: Views, bounds: Bounds, warnings: list[str]) -> None:
    """Warn of cameras that see the object from one side only."""
    directions = views.camera_to_world[:, :3, 3] - 0.5 * (bounds[0] + bounds[1])
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    widest = np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0)))
    if len(views) > 1 and widest < _NARROW_DEG:
        warnings.append(
            f"train: all {len(views)} cameras see the object from one side, within {widest:.1f} "
            "degrees; its shape away from them cannot be known. Check the poses, or photograph "
            "all around the object"
        )


def _check_reach(views: Views, bounds: Bounds, warnings: list[str]) -> None:
    """Warn of an object that reaches beyond the box that was given for it."""
    corners = np.stack(np.meshgrid(*np.transpose(bounds), indexing="ij"), axis=-1).reshape(-1, 3)
    total, outside = 0, 0
    stride = max(1, round(np.sqrt(views.height * views.width) / _REACH_PIXELS))
    for number in range(len(views) if views.has_masks else 0):
        pose = views.world_to_camera[number]
        local = (corners @ pose[:3, :3].T + pose[:3, 3]) @ views.intrinsics[number].T
        if (local[:, 2] <= 0).any():
            continue
        # Joggled, because the outline of a very flat box may have no area.
        outline = ConvexHull(local[:, :2] / local[:, 2:], qhull_options="QJ")
        row, column = np.nonzero(views.mask(number)[::stride, ::stride])
        points = stride * np.stack([column, row], axis=-1) + 0.5
        distance = points @ outline.equations[:, :2].T + outline.equations[:, 2]
        total += len(points)
        outside += int((distance.max(axis=1, initial=-np.inf) > _BOX_MARGIN).sum())
    if outside > _LARGEST_OUTSIDE * total:
        warnings.append(
            f"train: {outside / total:.0%} of the object's pixels lie outside the given bounds; "
            "the surface ends at the sides of that box and is open there. Give wider bounds, or "
            "none"
        )


def _check_origin(bounds: Bounds, warnings: list[str]) -> None:
    """Warn of an object so far from the origin that float32 cannot resolve its shape."""
    sizes = np.linalg.norm(0.5 * (bounds[0] + bounds[1])) / np.max(bounds[1] - bounds[0])
    if sizes > _FAR_SIZES:
        warnings.append(
            f"the object lies {sizes:,.0f} times its size away from the origin, where single "
            "precision blurs its shape; move the origin of the poses to the object"
        )


def _check_cameras_outside(views: Views, bounds: Bounds) -> None:
    lo, hi = bounds
    centers = views.camera_to_world[:, :3, 3]
    inside = ((centers > lo) & (centers < hi)).all(1)
    if inside.any():
        names = [name for name, is_in in zip(views.names, inside, strict=True) if is_in]
        if views.has_masks and (views.coverage == 1.0).all():
            raise SceneError(
                "every mask is full, so that the object seems to reach the cameras; check that the "
                "images are cut out: their alpha channel, or the mask files"
            )
        raise SceneError(
            f"{len(names)} cameras are inside the object's bounds, {some_names(names)} (the first "
            f"at {point_text(centers[inside][0])}, bounds {point_text(lo)} to {point_text(hi)}); "
            "check the scale of the poses, or give tighter bounds"
        )


def _checked_bounds(bounds) -> Bounds:
    try:
        corners = np.asarray(bounds, np.float64)
    except (TypeError, ValueError):
        corners = np.empty(0)
    is_box = corners.shape == (2, 3) and np.isfinite(corners).all()
    if not is_box or not (corners[0] < corners[1]).all():
        raise SceneError(f"bounds must be lo (x, y, z) below hi (x, y, z), got {bounds!r}")
    return corners[0], corners[1]


def _spread(frames: Sequence[Frame], limit: int | None, name: str) -> Sequence[Frame]:
    """At most ``limit`` frames, evenly over the list, since neighbours are often similar."""
    if limit is None or limit >= len(frames):
        return frames
    if limit < 1:
        raise SceneError(f"{name} must be at least 1, got {limit}")
    indices = np.round(np.linspace(0, len(frames) - 1, limit)).astype(int)
    return [frames[index] for index in indices]
