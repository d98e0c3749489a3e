"""Windows of photographs: training looks at the part around the object, so borders cost nothing."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from geosplat_jax.io.views import Views

MARGIN = 16
"""Pixels around the object that a window keeps at least: splats that stand out are seen there."""

_RELATIVE_MARGIN = 0.1
"""The same as a share of the object's size in the image."""


def around_object(views: Views, *, largest: float) -> tuple[Views, float]:
    """Cut views to windows of one size around the object; principal points move along.

    Every window holds the pixels of its view with any alpha and a margin, as far as the photograph
    reaches. Truth and relit images are left behind: training never looks at them.

    Parameters
    ----------
    views : with masks; others are returned as they are.
    largest : share of the pixels up to which windows pay; 0 for whole photographs always.

    Returns
    -------
    views : cut, or whole.
    share : of the photographs' pixels that are left, in (0, 1]. A mean over a window is that over
        the photograph divided by this, where render and photograph are both empty outside. (SSIM
        leaves out a border of five pixels of either, so its mean falls a little more.)
    """
    if not views.has_masks or largest <= 0.0:
        return views, 1.0
    corners, size = _windows(views.images[..., 3] > 0.0)
    share = float(np.prod(size)) / (views.height * views.width)
    if share > largest:
        return views, 1.0
    height, width = (int(length) for length in size)

    def cut(images: np.ndarray) -> np.ndarray:
        found = np.empty((len(views), height, width, *images.shape[3:]), images.dtype)
        for index, (row, column) in enumerate(corners):
            found[index] = images[index, row : row + height, column : column + width]
        return found

    intrinsics = views.intrinsics.copy()
    intrinsics[:, 0, 2] -= corners[:, 1]
    intrinsics[:, 1, 2] -= corners[:, 0]
    windows = replace(
        views,
        images=cut(views.images),
        intrinsics=intrinsics,
        valid=None if views.valid is None else cut(views.valid),
        truth={},
        relight={},
    )
    return windows, share


def _windows(
    covered: Bool[np.ndarray, "V H W"],
) -> tuple[Int[np.ndarray, "V 2"], Int[np.ndarray, " 2"]]:
    """Return the upper left corner of every window, and the size of all: rows, columns."""
    corners = np.zeros((len(covered), 2), int)
    size = np.zeros(2, int)
    for axis in (0, 1):
        length = covered.shape[1 + axis]
        used = covered.any(axis=2 - axis)
        low = np.where(used.any(1), used.argmax(1), length // 2)
        high = np.where(used.any(1), length - used[:, ::-1].argmax(1), length // 2)
        widest = int((high - low).max(initial=0))
        margin = max(MARGIN, round(_RELATIVE_MARGIN * widest))
        size[axis] = min(length, widest + 2 * margin)
        middle = (low + high) // 2
        corners[:, axis] = np.clip(middle - size[axis] // 2, 0, length - size[axis])
    return corners, size
