"""Cameras of photographs by structure from motion, as a COLMAP model beside them.

pycolmap does the work (extra ``capture``). The same photographs and settings give the same model,
whatever the number of processor cores: photographs are numbered by name, random searches are
seeded, and mapping, whose sums depend on the order of threads, uses a single thread. Only
``sparse/0`` is written. Photographs are not changed; reading the scene undistorts them, together
with masks that were drawn on them.
"""

import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, groupby
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from geosplat_jax.io.alignment import align_world
from geosplat_jax.io.dataset import LAYOUTS
from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.frames import IMAGE_SUFFIXES, inside_scene, opengl_pose
from geosplat_jax.io.images import (
    LINEAR_FORMATS,
    MissingFileError,
    SceneError,
    image_orientation,
    image_size,
)
from geosplat_jax.io.layouts.colmap import image_folder

MODEL_FOLDER = "sparse/0"

_FEWEST = 5
_SMALLEST_SHARE = 0.5
"""Least share of the photographs that must get a camera for a model to be written."""
_GROUP = 8  # photographs whose features are computed between two reports of progress
_BLOCK = 16  # photographs that are matched with as many others at a time
_NEIGHBOURS = 10  # photographs before and after one in a sequence that it is matched with
_FEW_FEATURES = 300
_FEW_PARTNERS = 4.0
_UPRIGHT_DEGREES = {3: 180, 4: 180, 5: 90, 6: 90, 7: -90, 8: -90}
"""Angle from the y axis of the stored image to where up was, in degrees, by EXIF orientation."""


class PoseError(SceneError):
    """No cameras can be found; the message says why, and how to take better photographs."""


@dataclass(frozen=True)
class PoseSettings:
    """How cameras are found.

    Attributes
    ----------
    size : pixels of the longer side that photographs are reduced to for features.
    order : ``any`` matches every photograph with every other; ``sequence`` matches those whose
        names are close in alphabetical order, for frames of a movie.
    lens : ``one`` for all photographs, which must then be of one size, or one for ``each``.
    seed : seed of random searches.
    """

    size: int = 1600
    order: Literal["any", "sequence"] = "any"
    lens: Literal["one", "each"] = "one"
    seed: int = 0


@dataclass(frozen=True)
class PoseReport:
    """Result of a search for cameras.

    Attributes
    ----------
    model : folder that the model was written to.
    registered : number of photographs with a camera.
    missing : names of the other photographs.
    error : mean reprojection error of the points, pixels.
    points : number of points in space.
    seconds : time of each part: ``features``, ``matching`` and ``mapping``.
    """

    model: Path
    registered: int
    missing: tuple[str, ...]
    error: float
    points: int
    seconds: dict[str, float]


OnProgress = Callable[[str, int, int], None]
"""Called with the part of the work, how much of it is done, and how much there is."""


def find_poses(
    root: str | Path,
    settings: PoseSettings | None = None,
    *,
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> PoseReport:
    """Find the cameras of photographs and write them to ``sparse/0``.

    The world has z up and the object at its origin; see `alignment.align_world`.

    Parameters
    ----------
    root : folder with photographs, in ``images/`` or directly.
    settings : see `PoseSettings`; None for the default ones.
    force : replace an existing model.
    on_progress : see `OnProgress`.

    Raises
    ------
    MissingFileError : the folder does not exist.
    SceneError : pycolmap is missing, the folder has cameras already, or it has photographs that
        cannot be used.
    PoseError, AlignmentError : there are too few photographs, too few of them fit together, or all
        were taken from one place.
    """
    root, settings = Path(root).expanduser(), settings or PoseSettings()
    names = _photographs(root)
    _require_free(root, force)
    _require_sizes(root, names, settings)
    colmap = optional_package("pycolmap", "finding cameras", extra="capture")
    log_level = colmap.logging.minloglevel
    colmap.logging.minloglevel = colmap.logging.FATAL.value  # failures are reported by this module
    try:
        with tempfile.TemporaryDirectory(prefix="geosplat_poses_") as folder:
            search = _Search(
                colmap, image_folder(root), names, Path(folder), settings, on_progress or _silent
            )
            best_model = search.run()
            _align(colmap, best_model, image_folder(root))
            _write(best_model, root / MODEL_FOLDER)
    finally:
        colmap.logging.minloglevel = log_level
    registered_names = {image.name for image in best_model.images.values() if image.has_pose}
    return PoseReport(
        model=root / MODEL_FOLDER,
        registered=len(registered_names),
        missing=tuple(name for name in names if name not in registered_names),
        error=float(best_model.compute_mean_reprojection_error()),
        points=int(best_model.num_points3D()),
        seconds=search.seconds,
    )


def _silent(part: str, done: int, total: int) -> None:
    """Say nothing."""


def _photographs(root: Path) -> list[str]:
    """Names of the photographs, relative to their folder and sorted."""
    if not root.is_dir():
        raise MissingFileError(f"folder {root} does not exist")
    folder = image_folder(root)
    suffixes = set(IMAGE_SUFFIXES) - LINEAR_FORMATS
    # Without images/, folders below may hold anything, masks for one.
    candidates = folder.iterdir() if folder == root else folder.rglob("*")
    paths = [
        path
        for path in candidates
        if path.suffix.lower() in suffixes and path.is_file() and not path.name.startswith(".")
    ]
    names = sorted(path.relative_to(folder).as_posix() for path in paths)
    for name in names:
        inside_scene(root, (folder / name).relative_to(root).as_posix(), folder)
    if len(names) < _FEWEST:
        raise PoseError(
            f"{folder} has {len(names)} photographs ({', '.join(sorted(suffixes))}); finding "
            f"cameras takes at least {_FEWEST}, and a good reconstruction about 50"
        )
    bad_names = [name for name in names if name.startswith("#") or len(name.split()) != 1]
    if bad_names:
        # COLMAP reads pairs of names, divided by a space, and skips names that it does not know.
        raise SceneError(
            f"{len(bad_names)} photographs in {folder} have a space in their name or begin with #, "
            f"for example {bad_names[0]!r}, which COLMAP cannot match; rename them"
        )
    stems = Counter("_".join(Path(name).with_suffix("").parts) for name in names)
    stem, count = stems.most_common(1)[0]
    if count > 1:
        raise SceneError(f"{count} photographs in {folder} are named {stem!r}; rename them")
    return names


def _require_free(root: Path, force: bool) -> None:
    """Refuse a folder that has cameras, unless ``force`` is set and ours would be read instead."""
    layout_name = next((name for name, layout in LAYOUTS.items() if layout.recognise(root)), None)
    if layout_name is None:
        return
    order = list(LAYOUTS)
    if order.index(layout_name) < order.index("colmap"):
        raise SceneError(
            f"{root} is a scene with cameras already, of layout {layout_name}, which would be read "
            "instead of those found here; move its file of cameras away"
        )
    if not force:
        raise SceneError(
            f"{root} has cameras already, of layout {layout_name}; --force replaces them"
        )


def _require_sizes(root: Path, names: list[str], settings: PoseSettings) -> None:
    folder = image_folder(root)
    sizes = {name: image_size(folder / name) for name in names}
    first = sizes[names[0]]
    other = next((name for name in names if sizes[name] != first), None)
    if settings.lens == "one" and other is not None:
        height, width = sizes[other]
        raise SceneError(
            f"{other} is {width} x {height} pixels, but {names[0]} is {first[1]} x {first[0]}: "
            "they are not of one lens; pass --lens each, or leave some out"
        )


def _pairs(count: int, order: str) -> list[tuple[int, int]]:
    """Return pairs of photographs to match, by number."""
    pairs = list(combinations(range(count), 2))
    if order == "any":
        return pairs
    # Neighbours, and pairs at distances that are powers of two: these close loops in a movie that
    # shows the same again after a turn around the object.
    return [(i, j) for i, j in pairs if j - i <= _NEIGHBOURS or not (j - i) & (j - i - 1)]


def _in_blocks(pairs: list[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
    """Group pairs such that every group has few photographs."""

    def block(pair: tuple[int, int]) -> tuple[int, int]:
        return pair[0] // _BLOCK, pair[1] // _BLOCK

    for _, group in groupby(sorted(pairs, key=lambda pair: (*block(pair), *pair)), key=block):
        yield list(group)


class _Matches(NamedTuple):
    """Result of matching, from which advice for better photographs follows.

    Attributes
    ----------
    photographs : number of photographs.
    features : mean number of features per photograph.
    pairs : number of pairs of photographs that match.
    compared : number of pairs that were compared.
    """

    photographs: int
    features: float
    pairs: int
    compared: int

    def advice(self, count: int) -> str:
        """Say why no more than ``count`` photographs fit together, and how to take others."""
        said = f"only {count} of {self.photographs} photographs fit together"
        if self.features < _FEW_FEATURES:
            return (
                f"{said}: they show few details ({self.features:.0f} each); photograph sharply and "
                "in good light, with a patterned ground, or look closer with a larger --size"
            )
        if 2 * self.pairs / self.photographs < _FEW_PARTNERS:
            return (
                f"{said}: they overlap too little ({self.pairs} of {self.compared} pairs "
                "match); take more of them, with steps of about ten degrees around the object"
            )
        return (
            f"{said}, though {self.pairs} of {self.compared} pairs match; walk around the object "
            "instead of turning it or standing still, keep what is around it as it is, and pass "
            "--lens each if you zoomed"
        )


@dataclass
class _Search:
    """One search for cameras, in a folder of its own."""

    colmap: ModuleType
    images: Path
    names: list[str]
    work: Path
    settings: PoseSettings
    tell: OnProgress

    def run(self) -> Any:
        """Return the largest model; `PoseError` where it is too small."""
        self.database = self.work / "database.db"
        self.colmap.Database.open(self.database).close()
        self.seconds = {}
        for part, search in (("features", self._features), ("matching", self._match)):
            start_time = time.perf_counter()
            search()
            self.seconds[part] = time.perf_counter() - start_time
        start_time = time.perf_counter()
        models = self._map()
        self.seconds["mapping"] = time.perf_counter() - start_time
        best_model = max(models, key=lambda model: model.num_reg_images(), default=None)
        count = 0 if best_model is None else best_model.num_reg_images()
        if best_model is None or count < max(_FEWEST, _SMALLEST_SHARE * len(self.names)):
            raise PoseError(self._matches().advice(count))
        return best_model

    def _features(self) -> None:
        camera_modes = self.colmap.CameraMode
        is_single_lens = self.settings.lens == "one"
        mode = camera_modes.SINGLE if is_single_lens else camera_modes.PER_IMAGE
        reader = self.colmap.ImageReaderOptions()
        # A single photograph has too few points to determine more parameters.
        reader.camera_model = "OPENCV" if is_single_lens else "SIMPLE_RADIAL"
        # Photographs are numbered here: extraction would number them in the order of its threads.
        self.colmap.import_images(self.database, self.images, mode, self.names, reader)
        extraction = self.colmap.FeatureExtractionOptions()
        extraction.max_image_size = self.settings.size
        extraction.use_gpu = False
        for start in range(0, len(self.names), _GROUP):
            group = self.names[start : start + _GROUP]
            self.colmap.extract_features(
                self.database, self.images, group, mode, reader, extraction
            )
            self.tell("features", start + len(group), len(self.names))

    def _match(self) -> None:
        pairs = _pairs(len(self.names), self.settings.order)
        matching = self.colmap.FeatureMatchingOptions()
        matching.use_gpu = False
        geometry = self.colmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = self.settings.seed
        pairing = self.colmap.ImportedPairingOptions()
        pairing.match_list_path = self.work / "pairs.txt"
        matched_count = 0
        for group in _in_blocks(pairs):
            lines = [f"{self.names[i]} {self.names[j]}\n" for i, j in group]
            (self.work / "pairs.txt").write_text("".join(lines), encoding="utf-8")
            self.colmap.match_image_pairs(self.database, matching, pairing, geometry)
            matched_count += len(group)
            self.tell("matching", matched_count, len(pairs))

    def _map(self) -> list[Any]:
        options = self.colmap.IncrementalPipelineOptions()
        options.num_threads = 1
        options.min_model_size = _FEWEST
        for stage_options in (options, options.mapper, options.triangulation):
            stage_options.random_seed = self.settings.seed
        # The first two photographs are registered as a pair, without a callback.
        registered = 2

        def count() -> None:
            nonlocal registered
            registered = min(registered + 1, len(self.names))
            self.tell("mapping", registered, len(self.names))

        models = self.colmap.incremental_mapping(
            self.database, self.images, self.work / "models", options, next_image_callback=count
        )
        return list(models.values())

    def _matches(self) -> "_Matches":
        with self.colmap.Database.open(self.database) as database:
            return _Matches(
                photographs=len(self.names),
                features=database.num_keypoints() / len(self.names),
                pairs=database.num_verified_image_pairs(),
                compared=len(_pairs(len(self.names), self.settings.order)),
            )


def _upright(pose: Float[np.ndarray, "4 4"], orientation: int) -> Float[np.ndarray, "4 4"]:
    """Rotate a camera about its axis so that its y axis points up, by EXIF orientation."""
    upright_pose = pose.copy()
    angle = _UPRIGHT_DEGREES.get(orientation, 0)
    upright_pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", angle, degrees=True).as_matrix()
    return upright_pose


def _align(colmap: ModuleType, model: Any, images: Path) -> None:
    """Transform a model in place into the world of `align_world`."""
    poses = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            camera_from_world = image.cam_from_world()
            pose = opengl_pose(
                camera_from_world.rotation.matrix(), camera_from_world.translation, image.name
            )
            poses.append(_upright(pose, image_orientation(images / image.name)))
    points = np.stack([point.xyz for point in model.points3D.values()])
    world = align_world(np.stack(poses), points)
    model.transform(colmap.Sim3d(world.scale, colmap.Rotation3d(world.rotation), world.translation))


def _write(model: Any, folder: Path) -> None:
    """Write a model to a temporary folder, then replace an existing one by it; links are kept."""
    folder = folder.resolve()
    temporary_folder = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(temporary_folder, ignore_errors=True)
    temporary_folder.mkdir(parents=True)
    try:
        model.write(temporary_folder)
        if folder.exists():
            shutil.rmtree(folder)
        temporary_folder.rename(folder)
    finally:
        shutil.rmtree(temporary_folder, ignore_errors=True)
