"""Whether silhouettes, poses and lenses of a scene agree with each other.

Every ray through a pixel of a mask meets the object, and the object lies in the visual hull of all
other views. So if rays through a view's mask miss the hull of the other views, the mask, pose or
lens of that view is wrong, or those of the others are. An error that all views share is not
noticed: a field of view that is wrong for every camera around a centred object only makes the
object larger or smaller.

Colours show more than silhouettes do: `hollow_line` reports hollows of the object that the hull
fills, and that a training carves into its first surface.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter

from geosplat_jax.core.types import Bounds
from geosplat_jax.io.views import Views, in_image, project
from geosplat_jax.surface.hollows import hollow_candidates
from geosplat_jax.surface.hull import fit_grid, hull_sdf

AGREES = 0.9
"""Least share of a mask's rays that meet the hull of the other views if everything is right. Some
rays miss it even then, because of the size of a voxel and of thin parts."""

_VOXELS = 40
"""Voxels along every side of the box."""
_RAYS = 400
"""Most pixels of a mask whose rays are tested."""
_STEPS = 2 * _VOXELS
"""Points that are tested along a ray."""
_DISSENT = 0.1
"""Share of the other views that may see a point of the hull outside their masks, so that a few
wrong views do not carve away the hull of all others."""

_CELLS = 32
"""Cells along the longest side of the grid in which hollows are looked for."""


def agreement(views: Views, bounds: Bounds) -> Float[np.ndarray, " V"]:
    """Find the share of every mask's pixels whose ray meets the visual hull of the other views.

    Parameters
    ----------
    views : views with masks.
    bounds : lo and hi of a world box around the object.

    Returns
    -------
    (V,) in [0, 1]; NaN for a view whose mask is empty.
    """
    lo, hi = (np.asarray(corner, np.float64) for corner in bounds)
    carved_voxels = np.stack([_left_out(views, view, lo, hi) for view in range(len(views))])
    carve_counts = carved_voxels.sum(0)
    dissent_limit = _DISSENT * (len(views) - 1)
    shares = np.full(len(views), np.nan)
    for view in range(len(views)):
        # The hull is enlarged by one voxel, because rays pass between the centres of voxels.
        hull = np.asarray(
            maximum_filter(carve_counts - carved_voxels[view] <= dissent_limit, size=3), bool
        )
        points = _points_on_rays(views, view, lo, hi)
        if len(points):
            voxel_indices = ((points - lo) / (hi - lo) * _VOXELS).astype(int)
            is_inside = ((voxel_indices >= 0) & (voxel_indices < _VOXELS)).all(-1)
            x, y, z = np.moveaxis(np.clip(voxel_indices, 0, _VOXELS - 1), -1, 0)
            shares[view] = (hull[x, y, z] & is_inside).any(1).mean()
    return shares


def agreement_lines(views: Views, bounds: Bounds) -> list[str]:
    """Say whether the views agree, and which do not."""
    if len(views) < 3:
        return ["agreement:  not checked, it takes three views"]
    shares = agreement(views, bounds)
    finite = shares[np.isfinite(shares)]
    if not len(finite):
        return ["agreement:  not checked, every mask is empty"]
    lines = [
        f"agreement:  {finite.mean():.1%} of the rays through masks meet the hull of the other "
        f"views (worst view {finite.min():.1%})"
    ]
    wrong = [k for k in np.argsort(shares) if shares[k] < AGREES]
    if wrong:
        examples = ", ".join(f"{views.names[k]} ({shares[k]:.0%})" for k in wrong[:5])
        more = ", ..." if len(wrong) > 5 else ""
        lines.append(
            f"warning: silhouettes, poses and lenses of {len(wrong)} of {len(views)} views do not "
            f"agree with the others: {examples}{more}; check their masks, their order and the axes "
            "and field of view of the cameras"
        )
    return lines


def hollow_line(views: Views, bounds: Bounds) -> str:
    """Say in a line of text how much of the visual hull is hollow, judged by colours."""
    cameras = views.world_to_camera, np.asarray(views.intrinsics, np.float64)
    try:
        grid = fit_grid(bounds, _CELLS)
        hull = hull_sdf(*cameras, views.alphas, grid, valid=views.valid)
    except ValueError as error:
        return f"hollows:    not looked for: {error}"
    candidates = hollow_candidates(*cameras, views.images, hull, grid, valid=views.valid)
    sizes = [int(candidate.region.sum()) for candidate in candidates if candidate.is_hollow]
    if not sizes:
        return "hollows:    none that the colours of the photographs show"
    share = sum(sizes) / max(int((hull < 0.0).sum()), 1)
    return (
        f"hollows:    {len(sizes)}, at least {share:.0%} of the visual hull: no mask shows them, "
        "the colours of the photographs do"
    )


def _left_out(views: Views, view: int, lo: np.ndarray, hi: np.ndarray) -> Bool[np.ndarray, "N N N"]:
    """Find the voxels that a view sees outside of its mask, in a pixel that counts."""
    axes = [a + (np.arange(_VOXELS) + 0.5) / _VOXELS * (b - a) for a, b in zip(lo, hi, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    pixels, _ = project(points, views.world_to_camera[view], views.intrinsics[view])
    is_seen = in_image(pixels, height=views.height, width=views.width)
    column, row = np.where(is_seen[:, None], pixels, 0).astype(int).T
    if views.valid is not None:
        is_seen &= np.asarray(views.valid[view])[row, column] > 0
    is_outside = is_seen & ~views.mask(view)[row, column]
    return is_outside.reshape(_VOXELS, _VOXELS, _VOXELS)


def _points_on_rays(
    views: Views, view: int, lo: np.ndarray, hi: np.ndarray
) -> Float[np.ndarray, "R S 3"]:
    """Place S world points along each of the rays through R pixels of a mask, around the box."""
    rows, columns = np.nonzero(views.mask(view))
    indices = np.unique(np.linspace(0, len(rows) - 1, _RAYS).astype(int)) if len(rows) else []
    pixels = np.stack([columns[indices] + 0.5, rows[indices] + 0.5, np.ones(len(indices))], -1)
    pose = views.world_to_camera[view]
    rays = pixels @ np.linalg.inv(views.intrinsics[view]).T @ pose[:3, :3]
    center = views.camera_to_world[view, :3, 3]
    # The points span the depths, along the camera's axis, of the ball around the box.
    middle, radius = 0.5 * (lo + hi), 0.5 * float(np.linalg.norm(hi - lo))
    depth = float(pose[2, :3] @ middle + pose[2, 3])
    steps = np.linspace(max(depth - radius, 0.0), max(depth + radius, 0.0), _STEPS)
    return center + steps[:, None] * rays[:, None, :]
