"""Stanford-ORB: photographs with masks, and an environment map for each test view.

``blender_LDR/SCENE`` or ``blender_HDR/SCENE`` hold ``transforms_{train,test}.json``, images
``{train,test}/NNNN.png`` or ``.exr`` and masks ``{train,test}_mask/NNNN.png``. Beside
``blender_LDR`` lies ``ground_truth/SCENE/env_map/NNNN.exr``, the light of each test view in the
frame of its camera; a folder ``env_map/`` in the scene folder itself takes precedence. Views of
other scenes (``transforms_novel.json``) are not read.
"""

from pathlib import Path

from geosplat_jax.io.frames import (
    Frame,
    Listing,
    existing,
    image_stem,
    read_transforms,
    require_no_light,
)

_SUFFIXES = (".png", ".exr")
_LIGHTS = "env_map"


def is_stanford_orb(root: Path) -> bool:
    """Whether the folder holds ``transforms_train.json`` and a folder ``train_mask``."""
    return (root / "transforms_train.json").is_file() and (root / "train_mask").is_dir()


def list_stanford_orb(root: Path, *, light: str | None = None) -> Listing:
    """List the frames of a scene of Stanford-ORB.

    Raises
    ------
    SceneError : see `read_transforms`; a light is asked for.
    """
    require_no_light(light)
    train, test = (_frames(root, split) for split in ("train", "test"))
    lit_count = sum(frame.light is not None for frame in test)
    notes = ()
    if 0 < lit_count < len(test):
        notes = (f"{len(test) - lit_count} of {len(test)} test views have no environment map",)
    return Listing(train=train, test=test, is_capture=True, notes=notes)


def _frames(root: Path, split: str) -> tuple[Frame, ...]:
    where = root / f"transforms_{split}.json"
    if split == "test" and not where.exists():
        return ()
    frames = []
    for file_path, pose, lens in read_transforms(where):
        stem = image_stem(root, file_path, where)
        candidates = [stem.with_name(stem.name + suffix) for suffix in _SUFFIXES]
        label = f"{file_path} of {where.name}"
        image = existing(root, candidates, label)
        masks = stem.parent.with_name(f"{stem.parent.name}_mask")
        mask = existing(root, [masks / f"{stem.name}.png"], f"the mask of {label}")
        light = _light(root, stem.name) if split == "test" else None
        frames.append(Frame(stem.name, pose, lens, image, mask=mask, light=light))
    return tuple(frames)


def _light(root: Path, name: str) -> Path | None:
    """Find the environment map of a test view, in the scene folder or in ``ground_truth``."""
    folders = [
        root / _LIGHTS,
        root.resolve().parent.parent / "ground_truth" / root.resolve().name / _LIGHTS,
    ]
    candidates = [folder / f"{name}.exr" for folder in folders]
    return next((path for path in candidates if path.is_file()), None)
