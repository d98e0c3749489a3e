"""Hollows that no silhouette shows, carved from a visual hull by the colours of photographs.

The visual hull closes a bowl with a lid, and no gradient of a picture opens it: seen from one side
the lid has the colours of the bottom, from another side those of the wall. That disagreement is
what gives it away (photo-consistency). Four steps find what lies behind:

1. Points of the surface on whose colour the views disagree are carved, again and again (space
   carving, Kutulakos and Seitz 2000). A view agrees with the median colour if that lies within, or
   close to, the range of its colours in a window of 3 x 3 pixels (after the shuffle transform,
   Kutulakos 2000), so that views agree in spite of texture or of a surface that is a cell off.
2. Step 1 uses one half of the views, and the other half judges: a hollow is kept if it explains the
   colours of the other half much better than the lid does, and better than a mirror would. On
   metals and glossy surfaces views also disagree, but a dent does not explain what they reflect.
3. The hollows that are kept are carved once more, with all views and less tolerance.
4. Their surface then moves inward as long as the views agree better on points a few cells deeper.

A small grid is enough: hollows are found on at most 48 cells along the longest side, and the result
is interpolated. All of it is host-side preparation and not differentiable.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import (
    binary_dilation,
    distance_transform_edt,
    gaussian_filter,
    label,
    map_coordinates,
)

from geosplat_jax.core.types import Grid
from geosplat_jax.surface.sightings import Field, Photographs, VertexMask, crossings

_LONGEST = 48  # cells along the longest side of the grid that is carved
_FEWEST_VIEWS = 8  # two halves of four
_FEWEST_JUDGING = 3  # least observations of a point in each half, and of a direction
_FEWEST_POINTS = 10  # least number of points on a lid, and on the surface behind it

_FIRST_PASS = (0.05, 0.6)
_LATER_PASSES = ((0.05, 0.6), (0.04, 0.7))
"""For every pass of carving, the difference in sRGB below which a view agrees, and the share of the
views that must agree on a point of the surface."""

_WORST = 0.12  # larger differences in sRGB are clipped to this
_CONFLICT = 0.05  # least mean difference on a lid that may hide a hollow
_EXPLAINED = 0.45  # largest part of the lid's difference that may remain behind it
_PLAINER = 0.75  # largest part of a mirror's difference that may remain behind the lid
_COMPARED = 0.03  # least part of the colours whose directions both halves show, to judge a mirror
_DEPTHS = np.arange(0.0, 5.01, 0.5)  # cells below the surface at which the views are compared
_BETTER = 0.7  # a deeper surface must lower the difference to less than this part of it
_SETTLED = 0.01  # mean difference up to which a surface is not moved
_EDGE = 0.5  # cells from a carved vertex to the new surface
_MOUTH = 4  # cells in front of the mouth of a hollow that are opened with it
_SMOOTHING = 0.8  # cells; Gaussian that smooths the staircase of carved vertices
_THIN = 0.1  # least distance of a vertex from the surface, in cells


class Candidate(NamedTuple):
    """A part of the hull that may be hollow, and how well the surface behind it explains the views.

    Differences are in sRGB: the colours of one half of the views are predicted from the other half,
    and their distances from the prediction are averaged.

    Attributes
    ----------
    region : mask of the carved vertices, indexed by z, y and x, on the coarse grid that is carved.
    lid : difference on the surface of the hull.
    behind : difference on the surface behind the region.
    mirror : difference from what a mirror would show in place of the hull's surface; inf where the
        halves have hardly any direction of reflection in common.
    """

    region: VertexMask
    lid: float
    behind: float
    mirror: float

    @property
    def is_hollow(self) -> bool:
        """Whether the surface behind explains the views far better than the lid and a mirror."""
        explains = self.lid > _CONFLICT and self.behind < _EXPLAINED * self.lid
        return explains and self.behind < _PLAINER * self.mirror


def carve_hollows(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    images: Any,
    sdf: Float[np.ndarray, " G"],
    grid: Grid,
    *,
    valid: Any = None,
) -> Float[np.ndarray, " G"]:
    """Carve the hollows of a visual hull in which photographs agree better than on its surface.

    Parameters
    ----------
    world_to_camera : (V, 4, 4) rigid, OpenCV axes.
    intrinsics : (V, 3, 3) pixels.
    images : (V, H, W, 4) linear RGB with straight alpha; an array, or an object that makes one view
        when it is indexed.
    sdf : (grid vertices,) signed distance to the hull in cells, x fastest, negative inside.
    grid : the grid of ``sdf``.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.

    Returns
    -------
    (grid vertices,) float32 signed values in cells, nowhere below ``sdf``; ``sdf`` itself if there
    is no hollow, or if there are fewer than 8 views.
    """
    if len(images) < _FEWEST_VIEWS:
        return sdf
    fine_field, factor = _laid_out(sdf, grid)
    hull = _coarser(fine_field, factor)
    views = Photographs.of(world_to_camera, intrinsics, images, valid, grid, factor)
    hollows = [candidate.region for candidate in _candidates(hull, views) if candidate.is_hollow]
    if not hollows:
        return sdf
    field, region = hull, np.any(hollows, axis=0)
    for tolerance, share in _LATER_PASSES:
        field, region = _carved(field, views, region, tolerance, share)
    field = _advanced(field, views, region)
    return _opened(fine_field, hull, (hull < 0.0) & (field >= 0.0), factor).reshape(-1)


def hollow_candidates(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    images: Any,
    sdf: Float[np.ndarray, " G"],
    grid: Grid,
    *,
    valid: Any = None,
) -> list[Candidate]:
    """Return the candidates of `carve_hollows` for the same arguments; none for under 8 views."""
    if len(images) < _FEWEST_VIEWS:
        return []
    fine_field, factor = _laid_out(sdf, grid)
    views = Photographs.of(world_to_camera, intrinsics, images, valid, grid, factor)
    return _candidates(_coarser(fine_field, factor), views)


def _laid_out(sdf: Float[np.ndarray, " G"], grid: Grid) -> tuple[Field, int]:
    """Arrange values by z, y and x, and choose how many cells are one coarse cell on each axis."""
    fine_field = np.asarray(sdf, np.float32).reshape(grid.vertex_shape[::-1])
    return fine_field, -(-max(grid.shape) // _LONGEST)


def _candidates(hull: Field, views: Photographs) -> list[Candidate]:
    """Carve with one half of the views, and let the other half judge every connected part."""
    fit_views, judge_views = views.every_second(0), views.every_second(1)
    field, _ = _carved(hull, fit_views, np.ones(hull.shape, bool), *_FIRST_PASS)
    label_result: Any = label((hull < 0.0) & (field >= 0.0), np.ones((3, 3, 3)))
    labels, count = label_result
    if not count:
        return []
    uncarved = _judged(hull, fit_views, judge_views)
    carved = _judged(field, fit_views, judge_views)
    candidates = []
    for number in range(1, count + 1):
        region = labels == number
        lid = uncarved.of(uncarved.inside, region)
        behind = carved.of(carved.outside, region)
        if min(len(lid), len(behind)) >= _FEWEST_POINTS:
            mirror = _mirrored(hull, region, fit_views, judge_views)
            candidates.append(Candidate(region, float(lid.mean()), float(behind.mean()), mirror))
    return candidates


def _mirrored(
    hull: Field, region: VertexMask, fit_views: Photographs, judge_views: Photographs
) -> float:
    """Difference from a hull that mirrors its surroundings.

    The colour of a mirror depends on the direction of reflection alone: the mean over what one
    half of the views shows in a direction is compared with what the other half shows in it.
    """
    surface = crossings(hull)
    surface = surface.of(region[tuple(surface.inside.T)])
    fit_sight, judge_sight = (views.look(surface, hull < 0.0) for views in (fit_views, judge_views))
    fit_bin, judge_bin = (views.reflected(surface) for views in (fit_views, judge_views))
    weight = fit_sight.seen.reshape(-1).astype(float)
    size = int(max(fit_bin.max(), judge_bin.max())) + 1
    row = fit_bin.reshape(-1)
    bin_counts = np.bincount(row, weights=weight, minlength=size)
    total = [
        np.bincount(row, weights=weight * fit_sight.color[..., channel].reshape(-1), minlength=size)
        for channel in range(3)
    ]
    mean = np.stack(total, axis=-1) / np.maximum(bin_counts, 1.0)[:, None]
    is_compared = judge_sight.seen & (bin_counts[judge_bin] >= _FEWEST_JUDGING)
    if is_compared.sum() < _COMPARED * judge_sight.seen.sum() or not is_compared.any():
        return np.inf
    difference = judge_sight.difference(mean[judge_bin])
    return float(np.minimum(difference, _WORST)[is_compared].mean())


def _carved(
    field: Field, views: Photographs, region: VertexMask, tolerance: float, share: float
) -> tuple[Field, VertexMask]:
    """Carve points of the surface in and around a region on which too few views agree, repeatedly.

    Parameters
    ----------
    tolerance, share : see `_FIRST_PASS`.

    Returns
    -------
    field : signed values after carving.
    region : the given region and all vertices that were carved.
    """
    field, region = field.copy(), region.copy()
    for _ in range(2 * max(field.shape)):
        surface = crossings(field)
        surface = surface.of(binary_dilation(region)[tuple(surface.inside.T)])
        sight = views.look(surface, field < 0.0)
        is_consistent = sight.difference(sight.median()) < tolerance
        disagreement = 1.0 - sight.mean(is_consistent.astype(np.float64))
        vertex_disagreement = _of_vertices(
            surface.inside, disagreement, sight.is_seen_enough, field.shape
        )
        carve_mask = vertex_disagreement > 1.0 - share
        if not carve_mask.any():
            break
        field = _without(field, carve_mask)
        region |= carve_mask
    return field, region


def _advanced(field: Field, views: Photographs, region: VertexMask) -> Field:
    """Move the surface of a region inward where views agree better on what lies deeper."""
    field, region = field.copy(), region.copy()
    for _ in range(2 * max(field.shape)):
        surface = crossings(field)
        surface = surface.of(binary_dilation(region)[tuple(surface.inside.T)])
        is_visible = views.visible(surface, field < 0.0)
        differences = []
        for depth in _DEPTHS:
            sight = views.sample(surface.position - np.float32(depth) * surface.normal, is_visible)
            spread = np.abs(sight.color - sight.median()).max(-1)
            mean = sight.mean(np.minimum(spread, _WORST))
            differences.append(np.where(sight.is_seen_enough, mean, np.inf))
        depth_differences = np.stack(differences)
        best_index = depth_differences.argmin(0)
        surface_difference = depth_differences[0]
        is_counted = np.isfinite(surface_difference)
        is_deeper = (_DEPTHS[best_index] >= 1.0) & (surface_difference > _SETTLED)
        is_deeper &= depth_differences.min(0) < _BETTER * np.where(
            is_counted, surface_difference, 0.0
        )
        share = _of_vertices(surface.inside, is_deeper.astype(float), is_counted, field.shape)
        carve_mask = share > 0.5
        if not carve_mask.any():
            break
        field = _without(field, carve_mask)
        region |= carve_mask
    return field


def _of_vertices(
    vertices: Int[np.ndarray, "N 3"],
    values: Float[np.ndarray, " N"],
    is_counted: Bool[np.ndarray, " N"],
    shape: tuple[int, ...],
) -> Field:
    """Average the values of every vertex over the rows that count; 0 for a vertex without any."""
    row = np.ravel_multi_index(tuple(vertices[is_counted].T), shape)
    size = int(np.prod(shape))
    total = np.bincount(row, weights=values[is_counted], minlength=size)
    return (total / np.maximum(np.bincount(row, minlength=size), 1)).reshape(shape)


def _without(field: Field, carve_mask: VertexMask) -> Field:
    """Put vertices outside, and the surface half a cell from them."""
    field = np.where(carve_mask, np.float32(_EDGE), field)
    is_neighbour = np.asarray(binary_dilation(carve_mask), bool) & (field < -_EDGE)
    return np.where(is_neighbour, np.float32(-_EDGE), field)


class _Judged(NamedTuple):
    """How well the colours of points in one half of the views predict those in the other half.

    Attributes
    ----------
    inside, outside : (N, 3) see `Crossings`.
    difference : (N,) mean difference in sRGB.
    """

    inside: Int[np.ndarray, "N 3"]
    outside: Int[np.ndarray, "N 3"]
    difference: Float[np.ndarray, " N"]

    def of(self, vertices: Int[np.ndarray, "N 3"], region: VertexMask) -> Float[np.ndarray, " M"]:
        """Differences of those points whose ``vertices`` lie in a region."""
        return self.difference[region[tuple(vertices.T)]]


def _judged(field: Field, fit_views: Photographs, judge_views: Photographs) -> _Judged:
    """Compare the median colour of some views with the colours of others."""
    surface, solid = crossings(field), field < 0.0
    fit_sight, judge_sight = fit_views.look(surface, solid), judge_views.look(surface, solid)
    is_counted = np.minimum(fit_sight.seen.sum(0), judge_sight.seen.sum(0)) >= _FEWEST_JUDGING
    difference = np.minimum(judge_sight.difference(fit_sight.median()), _WORST)
    return _Judged(
        surface.inside[is_counted],
        surface.outside[is_counted],
        judge_sight.mean(difference)[is_counted],
    )


def _coarser(field: Field, factor: int) -> Float[np.ndarray, "z y x"]:
    """Keep every ``factor``-th vertex along each axis, and the last one; values in coarse cells."""
    if factor == 1:
        return field
    rows = [
        np.minimum(np.arange(-(-(size - 1) // factor) + 1) * factor, size - 1)
        for size in field.shape
    ]
    return field[np.ix_(*rows)] / np.float32(factor)


def _opened(
    fine_field: Field,
    hull: Float[np.ndarray, "z y x"],
    hollows: Bool[np.ndarray, "z y x"],
    factor: int,
) -> Field:
    """Subtract the hollows from the hull: the larger of the two signed distances, in fine cells."""
    solid = (hull < 0.0) & ~hollows
    # Empty the cells in front of the mouths as well: a film of the old surface would stay there.
    # The mask keeps this from passing through walls.
    cavity = np.asarray(binary_dilation(hollows, iterations=_MOUTH, mask=~solid), bool)
    outside_depth, cavity_depth = (
        np.asarray(distance_transform_edt(side)) for side in (~cavity, cavity)
    )
    signed = cavity_depth - outside_depth
    blurred = gaussian_filter(signed - 0.5 * np.sign(signed), _SMOOTHING)
    # Solid vertices stay inside and hollow ones outside: smoothing would open walls that are as
    # thin as a cell.
    distance = np.where(
        solid, np.minimum(blurred, -_THIN), np.where(hollows, np.maximum(blurred, _THIN), blurred)
    )
    if factor > 1:
        coordinates = np.indices(fine_field.shape, np.float32) / factor
        distance = map_coordinates(distance, coordinates, order=1, mode="nearest") * factor
    return np.maximum(fine_field, distance).astype(np.float32)
