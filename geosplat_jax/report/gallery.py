"""Pictures of an evaluation as single files, for the report.

::

    evaluation/000_00.png ...   each picture of each view that is shown
    evaluation/light.png        the recovered light, tone mapped; true_light.png where known
    evaluation/mesh.glb         the mesh with its materials
    evaluation/light_00.hdr ... the lights that the report shows the mesh under
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geosplat_jax.io.images import write_png
from geosplat_jax.report.pictures import tone_map_light

FOLDER = "evaluation"
"""Name of the folder of pictures, beside ``metrics.json``."""


def comparisons(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Pair the titles of true pictures with those of the reconstruction, in order.

    ``truth`` is paired with ``render``; ``true X`` with ``X, aligned`` if there is such a picture,
    or else with ``X``.
    """
    pairs = [("truth", "render")] if {"truth", "render"} <= set(titles) else []
    for title in titles:
        name = title.removeprefix("true ")
        partner = f"{name}, aligned" if f"{name}, aligned" in titles else name
        if name != title and partner in titles:
            pairs.append((title, partner))
    return pairs


def write_gallery(
    folder: Path,
    rows: Mapping[str, Mapping[str, np.ndarray]],
    *,
    lights: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    """Write every picture to a file of its own.

    Parameters
    ----------
    folder : receives the folder `FOLDER`; pictures of an earlier evaluation are replaced.
    rows : for each view, by name, its pictures (H, W, 3) by title; sRGB floats in [0, 1].
    lights : lat-long maps of linear radiance by title.

    Returns
    -------
    dict for ``metrics.json``, with paths below ``folder``: ``views``, a list of ``view`` (the name)
    and ``pictures`` (paths by title), and ``lights``, paths by title.
    """
    gallery_folder = folder / FOLDER
    gallery_folder.mkdir(exist_ok=True)
    for old_picture in gallery_folder.glob("*.png"):
        old_picture.unlink()
    views = []
    for number, (view, row) in enumerate(rows.items()):
        files = {}
        for column, (title, picture) in enumerate(row.items()):
            # Files are numbered: titles hold names of lights, which may be no valid file names.
            files[title] = f"{FOLDER}/{number:03d}_{column:02d}.png"
            write_png(folder / files[title], picture)
        views.append({"view": view, "pictures": files})
    light_files = {}
    for title, radiance in lights.items():
        light_files[title] = f"{FOLDER}/{title.replace(' ', '_')}.png"
        write_png(folder / light_files[title], tone_map_light(np.asarray(radiance)))
    return {"views": views, "lights": light_files}
