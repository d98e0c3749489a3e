"""Hollows that no silhouette shows, carved from a visual hull by the colours of photographs.

The visual hull closes a bowl with a lid, and no gradient of a picture opens it: seen from one side
the lid has the colours of the bottom, from another side those of the wall. That disagreement is
what gives it away (photo-consistency). Four steps find what lies behind:

1. Points of the surface on whose colour the views disagree are carved, again and again (space
   carving, Kutulakos and Seitz 2000). Views are taken to agree with the median colour where
   anything in a window of 3 x 3 pixels does (the shuffle transform, Kutulakos 2000), so that
   texture, and a surface that is a cell out of place, are no disagreement.
2. This uses one half of the views. The other half judges: a hollow stays where it explains their
   colours much better than the lid did, and better than a mirror would. On metals and glossy
   surfaces views also disagree, but a dent does not explain what they reflect.
3. The hollows that stay are carved once more, with all views and less tolerance.
4. Then their surface moves inward while the views agree better on what lies a few cells deeper.

Small grids do: what is found on at most 48 cells along the longest side is interpolated. All of it
is host-side preparation and not differentiable.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from geosplat_jax.core.color import linear_to_srgb
from geosplat_jax.core.types import Grid

_LONGEST = 48  # cells along the longest side of the grid that is carved
_MOST_VIEWS = 64  # evenly chosen; time grows with them
_FEWEST_VIEWS = 8  # two halves of four
_FEWEST_SEEN = 4  # views that must see a point to say anything about it
_FEWEST_JUDGING = 3  # of either half
_FEWEST_POINTS = 10  # of a lid, and of what lies behind it
_FACING = 0.25  # least cosine between a point's normal and the direction to a view
_CLEAR = 2.0  # cells above a point at which its line of sight begins
_STRIDE = 0.7  # cells between looks along a line of sight
_WHOLE = 0.99  # coverage of a pixel that shows nothing but the object

_FIRST_PASS = (0.05, 0.6)
_LATER_PASSES = ((0.05, 0.6), (0.04, 0.7))
"""Difference in sRGB that is agreement, and the share of views that must agree."""

_WORST = 0.12  # larger differences count as this one
_CONFLICT = 0.05  # mean difference on a lid, at least
_EXPLAINED = 0.45  # of it may remain behind
_PLAINER = 0.75  # times what a mirror leaves may remain behind
_COMPARED = 0.03  # of the colours must be shown by both halves, to tell a mirror
_DIRECTIONS = 6  # bins of a reflected direction for each unit of x, y and z: about ten degrees
_DEPTHS = np.arange(0.0, 5.01, 0.5)  # cells inward that are compared
_BETTER = 0.7  # times the difference at the surface, at most, where it lies deeper
_SETTLED = 0.01  # mean difference of a surface that need not move
_POINTS_AT_ONCE = 2048
_EDGE = 0.5  # cells from a carved vertex to the new surface
_MOUTH = 4  # cells before the mouth of a hollow that are taken for a part of it
_SMOOTHING = 0.8  # cells; takes the steps of the carved vertices away
_THIN = 0.1  # cells; distance of a vertex to the surface, at least

_Field = Float[np.ndarray, "Z Y X"]
_Where = Bool[np.ndarray, "Z Y X"]


class Candidate(NamedTuple):
    """A part of the hull on whose surface views disagree, and how well what is behind explains it.

    Differences are means in sRGB, of one half of the views from what the other half shows.

    Attributes
    ----------
    region : vertices of the grid that is carved, as z, y and x.
    lid : difference on the surface of the hull.
    behind : difference on the surface behind the region.
    mirror : difference from what a mirror would show in place of the hull's surface; inf where the
        halves have hardly any direction of reflection in common.
    """

    region: _Where
    lid: float
    behind: float
    mirror: float

    @property
    def is_hollow(self) -> bool:
        """Whether what is behind explains the views far better than the lid and than a mirror."""
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
    world_to_camera : (V, 4, 4) rigid, OpenCV axes; intrinsics : (V, 3, 3) pixels.
    images : (V, H, W, 4) linear RGB and coverage, straight; an array, or what makes one view when
        indexed.
    sdf : (grid vertices,) signed distance to the hull in cells, x fastest, negative inside.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.

    Returns
    -------
    (grid vertices,) float32 in cells: ``sdf`` itself where there is no hollow, or fewer than 8
    views. Nothing that is outside the hull comes inside.
    """
    if len(images) < _FEWEST_VIEWS:
        return sdf
    fine, factor = _laid_out(sdf, grid)
    hull = _coarser(fine, factor)
    views = _Views.of(world_to_camera, intrinsics, images, valid, grid, factor)
    kept = [candidate.region for candidate in _candidates(hull, views) if candidate.is_hollow]
    if not kept:
        return sdf
    field, region = hull, np.any(kept, axis=0)
    for tolerance, share in _LATER_PASSES:
        field, region = _carved(field, views, region, tolerance, share)
    field = _advanced(field, views, region)
    return _opened(fine, hull, (hull < 0.0) & (field >= 0.0), factor).reshape(-1)


def hollow_candidates(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    images: Any,
    sdf: Float[np.ndarray, " G"],
    grid: Grid,
    *,
    valid: Any = None,
) -> list[Candidate]:
    """Return what `carve_hollows` chooses from, for the same arguments; none for few views."""
    if len(images) < _FEWEST_VIEWS:
        return []
    fine, factor = _laid_out(sdf, grid)
    views = _Views.of(world_to_camera, intrinsics, images, valid, grid, factor)
    return _candidates(_coarser(fine, factor), views)


def _laid_out(sdf: Float[np.ndarray, " G"], grid: Grid) -> tuple[_Field, int]:
    """Lay values out as z, y and x, and say how many cells are taken as one."""
    fine = np.asarray(sdf, np.float32).reshape(grid.vertex_shape[::-1])
    return fine, -(-max(grid.shape) // _LONGEST)


def _candidates(hull: _Field, views: "_Views") -> list[Candidate]:
    """Carve with one half of the views, and let the other half judge every connected part."""
    fit, judge = views.every_second(0), views.every_second(1)
    field, _ = _carved(hull, fit, np.ones(hull.shape, bool), *_FIRST_PASS)
    parts, count = ndimage.label((hull < 0.0) & (field >= 0.0), np.ones((3, 3, 3)))
    if not count:
        return []
    before, after = _judged(hull, fit, judge), _judged(field, fit, judge)
    candidates = []
    for number in range(1, count + 1):
        region = parts == number
        lid, behind = before.of(before.inside, region), after.of(after.outside, region)
        if min(len(lid), len(behind)) >= _FEWEST_POINTS:
            mirror = _mirrored(hull, region, fit, judge)
            candidates.append(Candidate(region, float(lid.mean()), float(behind.mean()), mirror))
    return candidates


def _mirrored(hull: _Field, region: _Where, fit: "_Views", judge: "_Views") -> float:
    """Difference from a hull that mirrors its surroundings.

    The colour of a mirror depends on the direction of reflection alone: the mean over what one
    half of the views shows in a direction is compared with what the other half shows in it.
    """
    surface = _surface(hull)
    surface = surface.of(region[tuple(surface.inside.T)])
    asked, judging = (views.look(surface, hull < 0.0) for views in (fit, judge))
    asked_bin, judging_bin = (views.reflected(surface) for views in (fit, judge))
    weight = asked.seen.reshape(-1).astype(float)
    size = int(max(asked_bin.max(), judging_bin.max())) + 1
    row = asked_bin.reshape(-1)
    seen = np.bincount(row, weights=weight, minlength=size)
    total = [
        np.bincount(row, weights=weight * asked.color[..., channel].reshape(-1), minlength=size)
        for channel in range(3)
    ]
    mean = np.stack(total, axis=-1) / np.maximum(seen, 1.0)[:, None]
    compared = judging.seen & (seen[judging_bin] >= _FEWEST_JUDGING)
    if compared.sum() < _COMPARED * judging.seen.sum() or not compared.any():
        return np.inf
    difference = judge.difference(mean[judging_bin], judging)
    return float(np.minimum(difference, _WORST)[compared].mean())


class _Surface(NamedTuple):
    """Where the edges of the grid leave the solid.

    Attributes
    ----------
    inside : (N, 3) the edge's vertex in the solid, as z, y and x.
    outside : (N, 3) its other one.
    position : (N, 3) where it leaves, x, y and z in cells.
    normal : (N, 3) outward.
    """

    inside: Int[np.ndarray, "N 3"]
    outside: Int[np.ndarray, "N 3"]
    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]

    def of(self, chosen: Bool[np.ndarray, " N"]) -> "_Surface":
        """Return some of the points."""
        return _Surface(*(rows[chosen] for rows in self))


def _surface(field: _Field) -> _Surface:
    """Find the points at which the edges of the grid cross the surface."""
    solid = field < 0.0
    inside, outside = [], []
    for axis in range(3):
        lower = [slice(None)] * 3
        upper = [slice(None)] * 3
        lower[axis], upper[axis] = slice(0, -1), slice(1, None)
        below, above = solid[tuple(lower)], solid[tuple(upper)]
        step = np.eye(3, dtype=int)[axis]
        for leaves, first, second in ((below & ~above, 0, 1), (above & ~below, 1, 0)):
            corner = np.argwhere(leaves)
            inside.append(corner + first * step)
            outside.append(corner + second * step)
    start, end = np.concatenate(inside), np.concatenate(outside)
    low, high = field[tuple(start.T)], field[tuple(end.T)]
    share = np.clip(low / (low - high), 0.02, 0.98)
    slope = np.stack(np.gradient(ndimage.gaussian_filter(np.clip(field, -1.5, 1.5), 1.0)), -1)
    normal = slope[tuple(start.T)] + slope[tuple(end.T)]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return _Surface(
        start,
        end,
        (start + (end - start) * share[:, None])[:, ::-1].astype(np.float32),
        (normal / np.maximum(length, 1e-9))[:, ::-1].astype(np.float32),
    )


def _carved(
    field: _Field, views: "_Views", region: _Where, tolerance: float, share: float
) -> tuple[_Field, _Where]:
    """Carve from a region outward while fewer than a share of the views agree on a point.

    Returns
    -------
    field, region : the region has what was carved, too.
    """
    field, region = field.copy(), region.copy()
    for _ in range(2 * max(field.shape)):
        surface = _surface(field)
        surface = surface.of(ndimage.binary_dilation(region)[tuple(surface.inside.T)])
        sight = views.look(surface, field < 0.0)
        agrees = views.difference(sight.median(), sight) < tolerance
        disagreeing = 1.0 - sight.mean(agrees.astype(np.float64))
        wrong = _of_vertices(surface.inside, disagreeing, sight.counts, field.shape) > 1.0 - share
        if not wrong.any():
            break
        field = _without(field, wrong)
        region |= wrong
    return field, region


def _advanced(field: _Field, views: "_Views", region: _Where) -> _Field:
    """Move the surface of a region inward where views agree better on what lies deeper."""
    field, region = field.copy(), region.copy()
    for _ in range(2 * max(field.shape)):
        surface = _surface(field)
        surface = surface.of(ndimage.binary_dilation(region)[tuple(surface.inside.T)])
        seen = views.visible(surface, field < 0.0)
        differences = []
        for depth in _DEPTHS:
            sight = views.sample(surface.position - np.float32(depth) * surface.normal, seen)
            spread = np.abs(sight.color - sight.median()).max(-1)
            mean = sight.mean(np.minimum(spread, _WORST))
            differences.append(np.where(sight.counts, mean, np.inf))
        compared = np.stack(differences)
        best = compared.argmin(0)
        here = compared[0]
        counts = np.isfinite(here)
        lies_deeper = (_DEPTHS[best] >= 1.0) & (here > _SETTLED)
        lies_deeper &= compared.min(0) < _BETTER * np.where(counts, here, 0.0)
        share = _of_vertices(surface.inside, lies_deeper.astype(float), counts, field.shape)
        deeper = share > 0.5
        if not deeper.any():
            break
        field = _without(field, deeper)
        region |= deeper
    return field


def _of_vertices(
    vertices: Int[np.ndarray, "N 3"],
    values: Float[np.ndarray, " N"],
    counts: Bool[np.ndarray, " N"],
    shape: tuple[int, ...],
) -> _Field:
    """Mean of what counts of the values of every vertex, 0 where nothing does."""
    row = np.ravel_multi_index(tuple(vertices[counts].T), shape)
    size = int(np.prod(shape))
    total = np.bincount(row, weights=values[counts], minlength=size)
    return (total / np.maximum(np.bincount(row, minlength=size), 1)).reshape(shape)


def _without(field: _Field, carved: _Where) -> _Field:
    """Put vertices outside, and the surface half a cell from them."""
    field = np.where(carved, np.float32(_EDGE), field)
    beside = ndimage.binary_dilation(carved) & (field < -_EDGE)
    return np.where(beside, np.float32(-_EDGE), field)


class _Judged(NamedTuple):
    """What one half of the views says about points of whose colour the other half is asked.

    Attributes
    ----------
    inside, outside : (N, 3) see `_Surface`.
    difference : (N,) mean difference in sRGB.
    """

    inside: Int[np.ndarray, "N 3"]
    outside: Int[np.ndarray, "N 3"]
    difference: Float[np.ndarray, " N"]

    def of(self, vertices: Int[np.ndarray, "N 3"], region: _Where) -> Float[np.ndarray, " M"]:
        """Differences of those points whose ``vertices`` lie in a region."""
        return self.difference[region[tuple(vertices.T)]]


def _judged(field: _Field, fit: "_Views", judge: "_Views") -> _Judged:
    """Compare the median colour of some views with the colours of others."""
    surface, solid = _surface(field), field < 0.0
    asked, judging = fit.look(surface, solid), judge.look(surface, solid)
    counts = np.minimum(asked.seen.sum(0), judging.seen.sum(0)) >= _FEWEST_JUDGING
    difference = np.minimum(judge.difference(asked.median(), judging), _WORST)
    return _Judged(
        surface.inside[counts], surface.outside[counts], judging.mean(difference)[counts]
    )


class _Sight(NamedTuple):
    """What V views show at N points, in sRGB.

    Attributes
    ----------
    color : (V, N, 3).
    low, high : (V, N, 3) least and largest in the window around it.
    seen : (V, N) whether the view shows the point.
    """

    color: Float[np.ndarray, "V N 3"]
    low: Float[np.ndarray, "V N 3"]
    high: Float[np.ndarray, "V N 3"]
    seen: Bool[np.ndarray, "V N"]

    @property
    def counts(self) -> Bool[np.ndarray, " N"]:
        """Whether enough views see a point."""
        return self.seen.sum(0) >= _FEWEST_SEEN

    def median(self) -> Float[np.ndarray, "N 3"]:
        """Median colour over the views that see a point, the lower one of two; else 0."""
        ordered = np.sort(np.where(self.seen[..., None], self.color, np.inf), axis=0)
        count = self.seen.sum(0)
        middle = np.maximum(count - 1, 0) // 2
        chosen = np.take_along_axis(ordered, middle[None, :, None], 0)[0]
        return np.where(count[:, None] > 0, chosen, 0.0)

    def mean(self, values: Float[np.ndarray, "V N"]) -> Float[np.ndarray, " N"]:
        """Mean over the views that see a point, 0 where none does."""
        return (values * self.seen).sum(0) / np.maximum(self.seen.sum(0), 1)


@dataclass(frozen=True)
class _Views:
    """Photographs of about a pixel a cell, with cameras in units of cells from the grid's origin.

    Attributes
    ----------
    pinholes : (V, 3, 4) from cells to the camera's axes.
    centers : (V, 3) of the cameras, cells.
    intrinsics : (V, 3, 3) pixels.
    color, low, high : (V, H, W, 3) sRGB; the latter two over windows of 3 x 3 pixels.
    shows : (V, H, W) pixels that show the object alone, and count.
    """

    pinholes: Float[np.ndarray, "V 3 4"]
    centers: Float[np.ndarray, "V 3"]
    intrinsics: Float[np.ndarray, "V 3 3"]
    color: Float[np.ndarray, "V H W 3"]
    low: Float[np.ndarray, "V H W 3"]
    high: Float[np.ndarray, "V H W 3"]
    shows: Bool[np.ndarray, "V H W"]

    @classmethod
    def of(
        cls,
        world_to_camera: Float[np.ndarray, "V 4 4"],
        intrinsics: Float[np.ndarray, "V 3 3"],
        images: Any,
        valid: Any,
        grid: Grid,
        factor: int,
    ) -> "_Views":
        """Choose views, reduce them and put their cameras into a grid of larger cells."""
        origin, cell = np.asarray(grid.origin, np.float64), factor * float(grid.cell_size)
        number = min(len(images), _MOST_VIEWS)
        chosen = np.unique(np.linspace(0, len(images) - 1, number).round().astype(int))
        poses = np.asarray(world_to_camera, np.float64)[chosen]
        rotation, shift = poses[:, :3, :3], poses[:, :3, 3] + poses[:, :3, :3] @ origin
        centers = -np.einsum("vji,vj->vi", rotation, shift) / cell
        lens = np.asarray(intrinsics, np.float64)[chosen]
        middle = 0.5 * np.asarray(grid.shape) / factor
        away = np.median(np.linalg.norm(centers - middle, axis=1))
        pixels = max(1, round(float(np.median(lens[:, 0, 0]) / away)))
        pictures = [_small(images[k], None if valid is None else valid[k], pixels) for k in chosen]
        color, shows = (np.stack(part) for part in zip(*pictures, strict=True))
        color = _encoded(color, shows)
        hidden = ~shows[..., None]
        window = (1, 3, 3, 1)
        return cls(
            np.concatenate([rotation, shift[..., None] / cell], -1).astype(np.float32),
            centers.astype(np.float32),
            (lens / np.array([[pixels], [pixels], [1.0]])).astype(np.float32),
            np.stack([_filled(c, s) for c, s in zip(color, shows, strict=True)]),
            ndimage.minimum_filter(np.where(hidden, np.float32(np.inf), color), window),
            ndimage.maximum_filter(np.where(hidden, np.float32(-np.inf), color), window),
            shows,
        )

    def every_second(self, first: int) -> "_Views":
        """Return one half of the views."""
        arrays = {name: getattr(self, name)[first::2] for name in self.__dataclass_fields__}
        return replace(self, **arrays)

    def look(self, surface: _Surface, solid: _Where) -> _Sight:
        """Return what the views that see the points of a surface show there."""
        return self.sample(surface.position, self.visible(surface, solid))

    def visible(self, surface: _Surface, solid: _Where) -> Bool[np.ndarray, "V N"]:
        """Tell which views see the points of a surface past the solid, a cell of doubt around it.

        They must look at its front, and at where it may begin to be clear of its own doubt.
        """
        steps = int(np.ceil(np.linalg.norm(solid.shape) / _STRIDE))
        doubtful = jnp.asarray(ndimage.binary_dilation(solid))
        return _in_parts(
            lambda *points: _visible(doubtful, self.centers, *points, steps=steps),
            surface.position,
            surface.normal,
        )[0]

    def sample(self, points: Float[np.ndarray, "N 3"], visible: Bool[np.ndarray, "V N"]) -> _Sight:
        """Look points up in the images of all views, of which some see them."""
        arrays = (self.pinholes, self.intrinsics, self.color, self.low, self.high, self.shows)
        color, low, high, shown = _in_parts(lambda part: _sample(*arrays, part), points)
        return _Sight(color, low, high, shown & visible)

    def reflected(self, surface: _Surface) -> Int[np.ndarray, "V N"]:
        """Return a number for the direction from which a mirror would show something to a view."""
        towards = self.centers[:, None] - surface.position[None]
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        normal = surface.normal[None]
        mirrored = 2.0 * (towards * normal).sum(-1, keepdims=True) * normal - towards
        place = np.floor(mirrored * _DIRECTIONS + 0.5).astype(int) + _DIRECTIONS + 1
        return (place * (2 * _DIRECTIONS + 3) ** np.arange(3)).sum(-1)

    def difference(
        self, color: Float[np.ndarray, "... N 3"], sight: _Sight
    ) -> Float[np.ndarray, "V N"]:
        """How far a colour lies from all in the window, largest over the channels.

        ``color`` : (N, 3) for all views, or (V, N, 3).
        """
        beyond = np.maximum(sight.low - color, color - sight.high)
        return np.where(sight.seen, np.maximum(beyond, 0.0).max(-1), 0.0)


def _in_parts(function: Any, *points: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, ...]:
    """Apply a function of (N, 3) arrays a fixed number at a time (one compilation)."""
    count = len(points[0])
    parts = []
    for start in range(0, max(count, 1), _POINTS_AT_ONCE):
        rows = [array[start : start + _POINTS_AT_ONCE] for array in points]
        room = ((0, _POINTS_AT_ONCE - len(rows[0])), (0, 0))
        results = function(*(jnp.asarray(np.pad(array, room)) for array in rows))
        parts.append([np.asarray(array)[:, : len(rows[0])] for array in results])
    return tuple(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))


@partial(jax.jit, static_argnames="steps")
def _visible(
    solid: Bool[Array, "Z Y X"],
    centers: Float[Array, "V 3"],
    points: Float[Array, "N 3"],
    normals: Float[Array, "N 3"],
    *,
    steps: int,
) -> tuple[Bool[Array, "V N"]]:
    """March from points to cameras, to where the grid ends."""
    last = jnp.asarray(solid.shape[::-1]) - 1
    flat = solid.reshape(-1)
    strides = jnp.asarray([1, solid.shape[2], solid.shape[1] * solid.shape[2]])
    start = points + _CLEAR * normals

    def seen_by(center):
        direction = center[None] - points
        direction /= jnp.linalg.norm(direction, axis=-1, keepdims=True)

        def look(step, blocked):
            place = jnp.round(start + direction * (step.astype(start.dtype) * _STRIDE)).astype(
                jnp.int32
            )
            is_inside = jnp.all((place >= 0) & (place <= last[None]), axis=-1)
            row = jnp.where(is_inside, (place * strides[None]).sum(-1), 0)
            return blocked | (is_inside & flat.at[row].get(mode="promise_in_bounds"))

        blocked = jax.lax.fori_loop(0, steps, look, jnp.zeros(points.shape[:1], bool))
        return ((direction * normals).sum(-1) > _FACING) & ~blocked

    return (jax.lax.map(seen_by, centers),)


@jax.jit
def _sample(
    pinholes: Float[Array, "V 3 4"],
    intrinsics: Float[Array, "V 3 3"],
    color: Float[Array, "V H W 3"],
    low: Float[Array, "V H W 3"],
    high: Float[Array, "V H W 3"],
    shows: Bool[Array, "V H W"],
    points: Float[Array, "N 3"],
) -> tuple[Array, ...]:
    """Look up colours between pixels, the window around the own one, and whether it shows them."""
    height, width = shows.shape[1:]

    def one(view):
        pinhole, lens, image, least, largest, counted = view
        x, y, z = jnp.moveaxis(points @ pinhole[:, :3].T + pinhole[None, :, 3], -1, 0)
        depth = jnp.maximum(z, 1e-6)
        u, v = lens[0, 0] * x / depth + lens[0, 2], lens[1, 1] * y / depth + lens[1, 2]
        is_inside = (z > 0.0) & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        own_column = jnp.clip(u.astype(jnp.int32), 0, width - 1)
        own_row = jnp.clip(v.astype(jnp.int32), 0, height - 1)
        column, row = jnp.clip(u - 0.5, 0.0, width - 1.0), jnp.clip(v - 0.5, 0.0, height - 1.0)
        left, top = column.astype(jnp.int32), row.astype(jnp.int32)
        right, bottom = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
        s = (column - left.astype(column.dtype))[:, None]
        t = (row - top.astype(row.dtype))[:, None]
        upper = (1.0 - s) * image[top, left] + s * image[top, right]
        lower = (1.0 - s) * image[bottom, left] + s * image[bottom, right]
        own = own_row, own_column
        return (
            (1.0 - t) * upper + t * lower,
            least[own],
            largest[own],
            is_inside & counted[own],
        )

    return jax.lax.map(one, (pinholes, intrinsics, color, low, high, shows))


def _small(
    rgba: Float[np.ndarray, "H W 4"], valid: Float[np.ndarray, "H W"] | None, factor: int
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Mean colour of the object in blocks of pixels, and which blocks show nothing else."""
    rgba = np.asarray(rgba, np.float32)
    coverage = rgba[..., 3] if valid is None else rgba[..., 3] * (np.asarray(valid) > 0.5)
    weighted = np.concatenate([rgba[..., :3] * coverage[..., None], coverage[..., None]], -1)
    height, width = (-(-size // factor) for size in rgba.shape[:2])
    room = ((0, height * factor - rgba.shape[0]), (0, width * factor - rgba.shape[1]), (0, 0))
    blocks = np.pad(weighted, room).reshape(height, factor, width, factor, 4).mean((1, 3))
    covered = blocks[..., 3]
    return blocks[..., :3] / np.maximum(covered, 1e-6)[..., None], covered >= _WHOLE


def _encoded(
    linear: Float[np.ndarray, "V H W 3"], shows: Bool[np.ndarray, "V H W"]
) -> Float[np.ndarray, "V H W 3"]:
    """Encode in sRGB, where equal steps look alike; radiance above white is exposed down first."""
    brightest = np.quantile(linear[shows], 0.99) if shows.any() else 1.0
    exposed = np.clip(linear / max(1.0, float(brightest)), 0.0, 1.0)
    return np.asarray(linear_to_srgb(jnp.asarray(exposed, jnp.float32)))


def _filled(
    color: Float[np.ndarray, "H W 3"], shows: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W 3"]:
    """Give pixels that do not show the object the colour of the nearest one that does."""
    if not shows.any():
        return color
    nearest = ndimage.distance_transform_edt(~shows, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    return color[tuple(nearest)]


def _coarser(field: _Field, factor: int) -> Float[np.ndarray, "z y x"]:
    """Take every so many-th vertex, in cells as large; the last ones may lie on the border."""
    if factor == 1:
        return field
    rows = [
        np.minimum(np.arange(-(-(size - 1) // factor) + 1) * factor, size - 1)
        for size in field.shape
    ]
    return field[np.ix_(*rows)] / np.float32(factor)


def _opened(
    fine: _Field,
    hull: Float[np.ndarray, "z y x"],
    hollows: Bool[np.ndarray, "z y x"],
    factor: int,
) -> _Field:
    """Take the hollows from the hull: the larger of both distances, in fine cells."""
    solid = (hull < 0.0) & ~hollows
    # With what is before their mouths, so that no film stays there; walls are not passed.
    empty = ndimage.binary_dilation(hollows, iterations=_MOUTH, mask=~solid)
    away, into = (np.asarray(ndimage.distance_transform_edt(side)) for side in (~empty, empty))
    signed = into - away
    smooth = ndimage.gaussian_filter(signed - 0.5 * np.sign(signed), _SMOOTHING)
    # Walls as thin as a cell stay walls.
    distance = np.where(
        solid, np.minimum(smooth, -_THIN), np.where(hollows, np.maximum(smooth, _THIN), smooth)
    )
    if factor > 1:
        places = np.indices(fine.shape, np.float32) / factor
        distance = ndimage.map_coordinates(distance, places, order=1, mode="nearest") * factor
    return np.maximum(fine, distance).astype(np.float32)
