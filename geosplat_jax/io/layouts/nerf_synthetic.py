"""NeRF-synthetic and Shiny Blender: ``transforms_{train,test}.json`` and RGBA images.

Images are sRGB with straight alpha; the world is z-up. Shiny Blender adds, for each image, a
normal map in world axes (``r_0_normal.png``, n = 2v - 1) and a mask (``r_0_alpha.png``), which is
used where the image itself has no alpha. NeRF-synthetic has normal maps of another kind
(``r_0_normal_0001.png``): they depend on the camera and are not in world axes. These maps and its
validation split are not read.
"""

from pathlib import Path

from geosplat_jax.io.frames import (
    IMAGE_SUFFIXES,
    Frame,
    Listing,
    existing,
    image_stem,
    inside_scene,
    optional_files,
    read_transforms,
    require_no_light,
)


def is_nerf_synthetic(root: Path) -> bool:
    """Whether the folder holds ``transforms_train.json``."""
    return (root / "transforms_train.json").is_file()


def is_shiny_blender(root: Path) -> bool:
    """Whether the layout is that of NeRF-synthetic, with normal maps or masks beside the images."""
    maps = ("*_normal.png", "*_alpha.png")
    folders = [root / "train", root / "test"]
    return is_nerf_synthetic(root) and any(
        any(folder.glob(pattern)) for folder in folders for pattern in maps
    )


def list_nerf_synthetic(root: Path, *, light: str | None = None) -> Listing:
    """List the frames of a NeRF-synthetic scene.

    Raises
    ------
    SceneError : see `read_transforms`; a light is asked for, but the layout has a single one.
    """
    return _list(root, light, has_maps=False)


def list_shiny_blender(root: Path, *, light: str | None = None) -> Listing:
    """List the frames of a Shiny Blender scene, with normals as ground truth.

    Raises
    ------
    SceneError : see `read_transforms`; a light is asked for, but the layout has a single one.
    """
    return _list(root, light, has_maps=True)


def _list(root: Path, light: str | None, *, has_maps: bool) -> Listing:
    require_no_light(light)
    return Listing(
        train=_frames(root, "train", has_maps=has_maps),
        test=_frames(root, "test", has_maps=has_maps),
    )


def _frames(root: Path, split: str, *, has_maps: bool) -> tuple[Frame, ...]:
    where = root / f"transforms_{split}.json"
    if split == "test" and not where.exists():
        return ()
    frames = []
    for file_path, pose, lens in read_transforms(where):
        stem = image_stem(root, file_path, where)
        candidates = [stem.with_name(stem.name + suffix) for suffix in IMAGE_SUFFIXES]
        listed_path = inside_scene(root, file_path, where)
        image = existing(
            root,
            [listed_path] if listed_path != stem else [*candidates, listed_path],
            f"{file_path} of {where.name}",
        )
        maps = {}
        if has_maps:
            names = {"normal": "_normal.png", "mask": "_alpha.png"}
            maps = optional_files(
                root, {key: stem.with_name(stem.name + ending) for key, ending in names.items()}
            )
        mask = maps.pop("mask", None)
        frames.append(Frame(stem.name, pose, lens, image, mask=mask, truth=maps))
    return tuple(frames)
