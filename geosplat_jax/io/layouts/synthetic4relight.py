"""Synthetic4Relight: linear HDR for training, sRGB images and materials for testing.

Training images are ``<frame>_rgb.exr`` (linear) with ``<frame>_mask.png``; test frames have
``_rgba.png`` (sRGB, straight alpha), ``_albedo.png`` (sRGB) and ``_rough.png`` (linear, in channel
0). ``test_rli/envmap6_<stem>.png`` and ``envmap12_<stem>.png`` show the test views under two other
lights. ``envmap{3,6,12}.exr`` lie in or beside the scene folder; 3 is the training light.
"""

from pathlib import Path

from geosplat_jax.io.frames import (
    Frame,
    Listing,
    existing,
    find_lights,
    image_stem,
    optional_files,
    read_transforms,
)
from geosplat_jax.io.images import SceneError
from geosplat_jax.io.lenses import Lens

TRAIN_LIGHT = "envmap3"
TEST_LIGHTS = ("envmap6", "envmap12")

_ENDINGS = ("_rgb", "_rgba")


def is_synthetic4relight(root: Path) -> bool:
    """Whether there are transforms and HDR training images or relit test images."""
    has_images = any((root / "train").glob("*_rgb.exr")) or (root / "test_rli").is_dir()
    return (root / "transforms_train.json").is_file() and has_images


def list_synthetic4relight(root: Path, *, light: str | None = None) -> Listing:
    """List the frames of a Synthetic4Relight scene.

    Raises
    ------
    SceneError : see `read_transforms`; a light other than the training light is asked for.
    """
    if light not in (None, TRAIN_LIGHT):
        raise SceneError(f"training images show {TRAIN_LIGHT} only, got light={light!r}")
    return Listing(
        train=tuple(_train_frame(root, *entry) for entry in _listed(root, "train")),
        test=tuple(_test_frame(root, *entry) for entry in _listed(root, "test")),
        lights=find_lights(root, [TRAIN_LIGHT, *TEST_LIGHTS]),
        train_light=TRAIN_LIGHT,
    )


def _listed(root: Path, split: str):
    """Yield path stem, pose and lens of every frame; an ending ``_rgb`` or ``_rgba`` is removed."""
    where = root / f"transforms_{split}.json"
    if split == "test" and not where.exists():
        return
    for file_path, pose, lens in read_transforms(where):
        stem = image_stem(root, file_path, where)
        ending = next((candidate for candidate in _ENDINGS if stem.name.endswith(candidate)), "")
        yield stem.with_name(stem.name.removesuffix(ending)), pose, lens


def _beside(stem: Path, ending: str) -> Path:
    return stem.with_name(stem.name + ending)


def _train_frame(root: Path, stem: Path, pose, lens: Lens) -> Frame:
    image = existing(root, [_beside(stem, "_rgb.exr")], stem.name)
    mask = optional_files(root, {"mask": _beside(stem, "_mask.png")}).get("mask")
    return Frame(stem.name, pose, lens, image, mask=mask)


def _test_frame(root: Path, stem: Path, pose, lens: Lens) -> Frame:
    image = existing(root, [_beside(stem, "_rgba.png")], stem.name)
    mask = optional_files(root, {"mask": _beside(stem, "_mask.png")}).get("mask")
    truth_paths = {"albedo": _beside(stem, "_albedo.png"), "roughness": _beside(stem, "_rough.png")}
    relit_paths = {light: root / "test_rli" / f"{light}_{stem.name}.png" for light in TEST_LIGHTS}
    return Frame(
        stem.name,
        pose,
        lens,
        image,
        mask=mask,
        truth=optional_files(root, truth_paths),
        relight=optional_files(root, relit_paths),
    )
