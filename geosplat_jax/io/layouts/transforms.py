"""nerfstudio and instant-ngp: one ``transforms.json`` for all photographs.

Poses are camera-to-world with OpenGL axes. The lens is given once for all frames or in each frame
(`frames.list_transforms`). ``mask_path`` names the object's mask, white on the object; without it,
the mask is looked for in ``masks/`` (`frames.beside_images`). instant-ngp excludes pixels by a file
``dynamic_mask_NAME.png`` beside an image: pixels that are not black in it do not count. Blurred
photographs that were sorted out stay listed: where the first frame has a ``sharpness``, frames
without an image are left out.

nerfstudio gives the split by ``train_filenames``, ``val_filenames`` and ``test_filenames``. Test
views are those of ``test_filenames`` or, if there are none, of ``val_filenames``.
``applied_transform`` records how nerfstudio transformed the world before it wrote the poses; the
poses are used as they are written. ``aabb_scale``, ``near``, ``far`` and point clouds are not read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from geosplat_jax.io.frames import (
    IMAGE_SUFFIXES,
    Frame,
    ListedFrame,
    Listing,
    captured_frame,
    checked_numbers,
    existing,
    image_stem,
    inside_scene,
    list_transforms,
    optional_files,
    read_json,
    require_no_light,
    split_capture,
)
from geosplat_jax.io.images import MissingFileError, SceneError

FILE = "transforms.json"

_SPLITS = ("train_filenames", "val_filenames", "test_filenames")


def is_transforms(root: Path) -> bool:
    """Whether the folder holds ``transforms.json``."""
    return (root / FILE).is_file()


def list_transforms_capture(root: Path, *, light: str | None = None) -> Listing:
    """List the frames of a ``transforms.json``.

    Raises
    ------
    MissingFileError : a frame has no image or mask; see above for images that may be missing.
    SceneError : see `frames.list_transforms`; two frames have one name; the split names a file
        that no frame has, uses a view both for training and for testing, or leaves no view to
        train on; a light is asked for.
    """
    require_no_light(light)
    where = root / FILE
    content = read_json(where)
    if "applied_transform" in content:
        rows = content["applied_transform"]
        shape = (4, 4) if isinstance(rows, list) and len(rows) == 4 else (3, 4)
        checked_numbers(rows, shape, f"'applied_transform' of {where}")
    listed_frames = list_transforms(content, where)
    frames: dict[str, Frame] = {}
    missing_count = 0
    for listed_frame in listed_frames:
        name = _plain(listed_frame.file_path)
        if name in frames:
            raise SceneError(f"{where} names {name!r} for two frames; remove one")
        try:
            image = _image(root, listed_frame, where)
        except MissingFileError:
            if "sharpness" not in listed_frames[0].values:
                raise
            missing_count += 1
            continue
        frames[name] = _frame(root, listed_frame, image, where)
    if not frames:
        raise MissingFileError(f"{root} has none of the images that {where.name} names; add them")
    note = f"{missing_count} frames of {where.name} have no image and are left out"
    notes = (note,) if missing_count else ()
    splits = {key: _names(content, key, where, frames) for key in _SPLITS if key in content}
    if not splits:
        return split_capture(list(frames.values()), notes=notes)
    return _given_split(frames, splits, where, notes)


def _plain(path: str) -> str:
    """Normalise a path, so that ``./images/1.jpg`` and ``images/1.jpg`` compare equal."""
    return str(PurePosixPath(path.replace("\\", "/")))


def _image(root: Path, listed_frame: ListedFrame, where: Path) -> Path:
    """Return the photograph of a frame; `MissingFileError` if there is none."""
    listed_path = inside_scene(root, listed_frame.file_path, where)
    stem = image_stem(root, listed_frame.file_path, where)
    candidates = [listed_path]
    if listed_path == stem:  # no ending, or one that is not known
        candidates = [
            *(stem.with_name(stem.name + suffix) for suffix in IMAGE_SUFFIXES),
            listed_path,
        ]
    return existing(root, candidates, f"{listed_frame.file_path} of {where.name}")


def _frame(root: Path, listed_frame: ListedFrame, image: Path, where: Path) -> Frame:
    mask, name = None, listed_frame.values.get("mask_path")
    if name is not None:
        if not isinstance(name, str) or not name:
            raise SceneError(f"'mask_path' of {listed_frame.file_path} in {where} must be a name")
        path = inside_scene(root, name, where)
        mask = existing(root, [path], f"the mask of {listed_frame.file_path} of {where.name}")
    frame = captured_frame(root, image, listed_frame.pose, listed_frame.lens, mask=mask)
    ignored = {"ignored": image.with_name(f"dynamic_mask_{image.stem}.png")}
    return replace(frame, **optional_files(root, ignored))


def _names(
    content: Mapping[str, Any], key: str, where: Path, frames: Mapping[str, Frame]
) -> list[str]:
    """Return the normalised names of the frames in a split."""
    names = content[key]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{key!r} of {where} must be a list of names, got {names!r}")
    unknown = [name for name in names if _plain(name) not in frames]
    if unknown:
        raise SceneError(
            f"{key!r} of {where} names {len(unknown)} files that no frame has, for example "
            f"{unknown[0]!r}; remove them"
        )
    return [_plain(name) for name in names]


def _given_split(
    frames: Mapping[str, Frame],
    splits: Mapping[str, Sequence[str]],
    where: Path,
    notes: tuple[str, ...],
) -> Listing:
    train_key, validation_key, test_key = _SPLITS
    test = splits.get(test_key) or splits.get(validation_key) or []
    if train_key in splits:
        train = splits[train_key]
    else:
        others = {name for names in splits.values() for name in names}
        train = [name for name in frames if name not in others]
    shared_names = set(train) & set(test)
    if shared_names:
        raise SceneError(f"{where} names {min(shared_names)!r} to train on and to test; choose one")
    if not train:
        raise SceneError(f"the split of {where} leaves no view to train on")
    unused_count = len(frames) - len(set(train) | set(test))
    note = f"{unused_count} views that the split of {where.name} leaves out are not used"
    return Listing(
        train=tuple(frames[name] for name in train),
        test=tuple(frames[name] for name in test),
        is_capture=True,
        notes=(*notes, note) if unused_count else notes,
    )
