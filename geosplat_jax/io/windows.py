"""Windows of photographs: training uses only the part around the object."""

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from geosplat_jax.io.photographs import Marks, Photographs
from geosplat_jax.io.views import Views

MARGIN = 16
"""Least margin of a window around the object, in pixels: it shows splats outside of the mask."""

_RELATIVE_MARGIN = 0.1
"""Least margin as a share of the object's size in the image."""


def around_object(views: Views, *, largest: float) -> tuple[Views, float]:
    """Crop views to windows of one size around the object; principal points move accordingly.

    Every window holds all pixels of its view whose alpha is not zero, and a margin, as far as the
    photograph reaches. Ground truth and relit images are dropped: training does not use them.

    Parameters
    ----------
    views : views with masks; others are returned as they are.
    largest : windows are used if they hold at most this share of the pixels; 0 for never.

    Returns
    -------
    views : cropped views, or those given.
    share : share of the pixels that the windows hold, among those that count, in (0, 1]. Where
        render and photograph are both empty outside the window, the mean of an error over the
        window is its mean over the photograph divided by this share. (SSIM leaves out a border of
        five pixels of either image, so that its mean falls a little more.)
    """
    chosen_windows = _chosen(views, largest)
    if chosen_windows is None:
        return views, 1.0
    corners, (height, width) = chosen_windows
    share = height * width / (views.height * views.width)

    intrinsics = views.intrinsics.copy()
    intrinsics[:, 0, 2] -= corners[:, 1]
    intrinsics[:, 1, 2] -= corners[:, 0]
    windows = replace(
        views,
        images=Photographs.of(views.images).windows(corners, height, width),
        intrinsics=intrinsics,
        valid=None
        if views.valid is None
        else Marks.of_array(views.valid).windows(corners, height, width),
        truth={},
        relight={},
    )
    if views.valid is not None:
        full_counts = views.valid_counts
        has_pixels = full_counts > 0
        share = (
            float(np.mean(windows.valid_counts[has_pixels] / full_counts[has_pixels]))
            if has_pixels.any()
            else 1.0
        )
    return windows, share


def window_size(views: Views, *, largest: float) -> tuple[int, int]:
    """Height and width in pixels of what `around_object` returns."""
    chosen_windows = _chosen(views, largest)
    return (views.height, views.width) if chosen_windows is None else chosen_windows[1]


def _chosen(views: Views, largest: float) -> tuple[Int[np.ndarray, "V 2"], tuple[int, int]] | None:
    """Return upper left corners, and height and width, of the windows to use; None for none."""
    if not views.has_masks or largest <= 0.0:
        return None
    corners, size = _windows(views)
    height, width = (int(length) for length in size)
    if height * width / (views.height * views.width) > largest:
        return None
    return corners, (height, width)


def _windows(views: Views) -> tuple[Int[np.ndarray, "V 2"], Int[np.ndarray, " 2"]]:
    """Return the upper left corner of every window, and the size of all: rows, columns."""
    corners = np.zeros((len(views), 2), int)
    size = np.zeros(2, int)
    used_rows = np.zeros((len(views), views.height), bool)
    used_columns = np.zeros((len(views), views.width), bool)
    for index, alpha in enumerate(views.alphas):
        is_covered = alpha > 0.0
        used_rows[index], used_columns[index] = is_covered.any(axis=1), is_covered.any(axis=0)
    for axis, is_used in enumerate((used_rows, used_columns)):
        length = is_used.shape[1]
        low = np.where(is_used.any(1), is_used.argmax(1), length // 2)
        high = np.where(is_used.any(1), length - is_used[:, ::-1].argmax(1), length // 2)
        widest = int((high - low).max(initial=0))
        margin = max(MARGIN, round(_RELATIVE_MARGIN * widest))
        size[axis] = min(length, widest + 2 * margin)
        middle = (low + high) // 2
        corners[:, axis] = np.clip(middle - size[axis] // 2, 0, length - size[axis])
    return corners, size
