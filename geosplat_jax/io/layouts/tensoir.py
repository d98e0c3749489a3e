"""TensoIR: one folder per view, with one image per light and ground truth of the test views.

``{train,test}_NNN/`` hold ``metadata.json``, ``rgba_<light>.png`` (sRGB, straight alpha) and, for
test views, ``albedo.png`` (linear values), ``normal.png`` (n = 2v - 1, world, z-up) and, if they
exist, ``roughness.png`` and ``metallic.png``. Views are listed by ``transforms_*.json``; without
this file, every folder is a view. Environment maps lie in or beside the scene folder. A
``scene.json`` may name the training light.
"""

import re
from pathlib import Path

import numpy as np

from geosplat_jax.io.frames import (
    Frame,
    Listing,
    checked_pose,
    existing,
    find_lights,
    image_stem,
    optional_files,
    read_json,
    read_transforms,
    require,
)
from geosplat_jax.io.images import MissingFileError, SceneError
from geosplat_jax.io.lenses import AngleLens, Lens, checked_angle

USUAL_TRAIN_LIGHT = "sunset"

_VIEW_FOLDER = re.compile(r"(train|test|val)_\d+")


def is_tensoir(root: Path) -> bool:
    """Whether there are folders of views, such as ``train_000``."""
    return any(_VIEW_FOLDER.fullmatch(folder.name) for folder in _folders(root))


def list_tensoir(root: Path, *, light: str | None = None) -> Listing:
    """List the frames of a TensoIR scene.

    Parameters
    ----------
    light : light that the training images are taken under. By default the one that ``scene.json``
        names; without such a name ``sunset``, if it exists, or else the only light.

    Raises
    ------
    SceneError : see `read_transforms`; a view has no image under the light, or no light is given
        and there are several.
    """
    views = {split: _views(root, split) for split in ("train", "test")}
    train_light = light or _train_light(root, [folder for folder, _, _ in views["train"]])
    splits = {
        split: tuple(_frame(root, *view, train_light) for view in split_views)
        for split, split_views in views.items()
    }
    lights = {train_light: None}
    for frame in splits["test"]:
        lights.update(dict.fromkeys(frame.relight))
    return Listing(
        train=splits["train"],
        test=splits["test"],
        lights=find_lights(root, list(lights)),
        train_light=train_light,
        albedo_is_srgb=False,
    )


def _folders(root: Path) -> list[Path]:
    return sorted(folder for folder in root.iterdir() if folder.is_dir())


def _views(root: Path, split: str) -> list[tuple[Path, np.ndarray, Lens]]:
    """Folder, pose and lens of each view, from the transforms or from the metadata."""
    transforms = root / f"transforms_{split}.json"
    if transforms.is_file():
        return [
            (_view_folder(root, file_path, transforms), pose, lens)
            for file_path, pose, lens in read_transforms(transforms)
        ]
    folders = [folder for folder in _folders(root) if folder.name.startswith(f"{split}_")]
    if not folders and split == "train":
        raise SceneError(
            f"{root} has neither {transforms.name} nor folders {split}_000, {split}_001, ...; "
            "check the scene folder is complete"
        )
    # By number: names may lack leading zeros.
    folders.sort(key=lambda folder: int(re.sub(r"\D", "", folder.name) or 0))
    return [(folder, *_metadata_camera(root, folder)) for folder in folders]


def _view_folder(root: Path, file_path: str, where: Path) -> Path:
    """Return the folder of a view that is listed as ``./test_000/rgba`` or ``./test_000``."""
    stem = image_stem(root, file_path, where)
    return stem if stem.is_dir() else stem.parent


def _metadata_camera(root: Path, folder: Path) -> tuple[np.ndarray, Lens]:
    where = existing(root, [folder / "metadata.json"], folder.name)
    content = read_json(where)
    text = require(content, "cam_transform_mat", where)
    try:
        numbers = [float(number) for number in str(text).split(",")]
    except ValueError as error:
        raise SceneError(f"'cam_transform_mat' of {where} must be numbers, got {text!r}") from error
    if len(numbers) != 16:
        raise SceneError(f"'cam_transform_mat' of {where} must be 16 numbers, got {len(numbers)}")
    pose = checked_pose(np.reshape(numbers, (4, 4)), str(where))
    angle = checked_angle(require(content, "cam_angle_x", where), str(where))
    return pose, AngleLens(angle)


def _lights_of(folder: Path) -> list[str]:
    return sorted(path.stem.removeprefix("rgba_") for path in folder.glob("rgba_*.png"))


def _train_light(root: Path, folders: list[Path]) -> str:
    lights = _lights_of(folders[0])
    if not lights:
        raise MissingFileError(f"{folders[0]} has no image rgba_<light>.png; check it is complete")
    if (root / "scene.json").is_file():
        named_light = read_json(root / "scene.json").get("train_light")
        if named_light is not None:
            if named_light not in lights:
                raise SceneError(
                    f"{root / 'scene.json'} names the training light {named_light!r}, but "
                    f"{folders[0].name} has images under {lights}"
                )
            return named_light
    if USUAL_TRAIN_LIGHT in lights:
        return USUAL_TRAIN_LIGHT
    if len(lights) != 1:
        raise SceneError(
            f"{folders[0]} has images under the lights {lights}; choose one with --light"
        )
    return lights[0]


def _frame(root: Path, folder: Path, pose: np.ndarray, lens: Lens, light: str) -> Frame:
    lights = _lights_of(folder)
    if light not in lights:
        raise MissingFileError(
            f"{folder} has no image under the light {light!r} (rgba_{light}.png); it has {lights}"
        )
    image = existing(root, [folder / f"rgba_{light}.png"], folder.name)
    others = [name for name in lights if name != light]
    maps = ("albedo", "normal", "roughness", "metallic")
    return Frame(
        folder.name,
        pose,
        lens,
        image,
        truth=optional_files(root, {key: folder / f"{key}.png" for key in maps}),
        relight=optional_files(root, {name: folder / f"rgba_{name}.png" for name in others}),
    )
