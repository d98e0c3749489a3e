"""Pictures of an evaluation: composed into sheets, and one by one as files for the report.

::

    evaluation/000_00.png ...   each picture of each view that is shown
    evaluation/light.png        the light that was found, tone mapped; true_light.png where known
    evaluation/mesh.glb         the mesh with its materials; NAME.hdr the lights it is shown under
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geosplat_jax.io.images import write_png
from geosplat_jax.report.pictures import tone_map_light

FOLDER = "evaluation"
"""Name of the folder, in that of the run or of a stage's end."""


def comparisons(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Pair the titles of true pictures with those of what was found, in order.

    ``truth`` belongs to ``render``, ``true X`` to ``X, aligned`` where there is such a picture, and
    to ``X`` otherwise.
    """
    pairs = [("truth", "render")] if {"truth", "render"} <= set(titles) else []
    for title in titles:
        name = title.removeprefix("true ")
        found = f"{name}, aligned" if f"{name}, aligned" in titles else name
        if name != title and found in titles:
            pairs.append((title, found))
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
    rows : pictures by title, by the name of the view; display-referred floats in [0, 1].
    lights : lat-long maps of linear radiance by title.

    Returns
    -------
    dict, for ``metrics.json``: ``views`` (``view``, and ``pictures`` by title) and ``lights``, with
    paths below ``folder``.
    """
    own = folder / FOLDER
    own.mkdir(exist_ok=True)
    for old in own.glob("*.png"):
        old.unlink()
    views = []
    for number, (view, row) in enumerate(rows.items()):
        files = {}
        for column, (title, picture) in enumerate(row.items()):
            # Titles may hold the names of lights, which a file system need not like.
            files[title] = f"{FOLDER}/{number:03d}_{column:02d}.png"
            write_png(folder / files[title], picture)
        views.append({"view": view, "pictures": files})
    shown = {}
    for title, radiance in lights.items():
        shown[title] = f"{FOLDER}/{title.replace(' ', '_')}.png"
        write_png(folder / shown[title], tone_map_light(np.asarray(radiance)))
    return {"views": views, "lights": shown}
