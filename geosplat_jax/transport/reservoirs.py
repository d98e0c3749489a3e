"""Weighted reservoir sampling: samples of the light, chosen from candidates and reused.

A point draws several directions towards the light and keeps one with a probability in proportion to
its *target*, the brightness of the sky there times the cosine (resampled importance sampling,
Talbot et al. 2005). What it kept may be offered again to the point in the next step, and to its
neighbours on the surface (Bitterli et al. 2020). The environment is infinitely far away, so that a
direction means the same to all of them.

A reservoir is a direction, a weight whose mean is one over the density of that direction, and a
confidence, the number of directions it was chosen from. Several reservoirs are joined by the
balance heuristic over their confidences and targets (Lin et al. 2022)::

    m_j(w) = c_j p_j(w) / sum_k c_k p_k(w),    weight_j = m_j(w_j) p(w_j) W_j

with p the target of the point that chooses and p_k that of the point that reservoir k comes from,
W_j the weight of reservoir j and c_j its confidence. The m_j sum to 1 wherever a target is
positive. Joined reservoirs are therefore unbiased if the target of a point is positive exactly in
the directions that the point can have kept. `ReservoirSettings.visibility` says whether these are
the visible ones.

The reservoirs of a step are stored under the places of their points on the surface
(`RayIndex.places`), in a table of fixed size. A point takes the reservoirs under its own place if
they come from nearby and from a surface with a similar normal; otherwise it starts without any.
Where several points share a slot, it stores the reservoirs of the one in the last row, whatever
they hold, so that the choice favours no direction.

Reservoirs, their weights and the targets carry no gradient.
"""

from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from pydantic import Field

from geosplat_jax.core.color import luminance
from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.settings import Positive, PositiveCount, Share, settings
from geosplat_jax.core.types import EnvLight, SurfacePoints
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport.environment import lookup
from geosplat_jax.transport.light_sampling import LightSampler, sample_light
from geosplat_jax.transport.sampling import OPEN, cast, in_chunks, low_discrepancy

_DIMMEST = 1e-3
"""Least brightness of a direction in a target, as a share of the mean brightness: samples must be
possible also where the sky is black, since other surfaces may shine from there."""

_LANES = 8
"""Reservoirs that the store keeps per place; a point's row modulo this number picks its own."""

_NEIGHBORHOOD = 12
"""Most rows between a point and its neighbours, with the points sorted by their places."""

_SCATTER = np.int32(0x9E3779B1 - 2**32)
"""An odd number that spreads keys over the slots."""


@settings
class ReservoirSettings:
    """How the samples of the light are chosen; off by default."""

    candidates: Annotated[int, Field(ge=0, le=1024)] = 0
    """Candidate directions drawn for every sample of the light, of which one is kept; 0 turns
    reservoirs off: samples are plain, and none is reused."""
    reuse_steps: bool = False
    """Whether a point may reuse the sample that its place on the surface kept in the last step."""
    neighbors: Annotated[int, Field(ge=0, le=8)] = 0
    """Points nearby whose samples of the same step are offered as well."""
    visibility: Literal["ignored", "traced", "assumed"] = "ignored"
    """How the reuse of samples treats shadows. Ignored: not at all, which is unbiased and costs no
    rays. Traced: blocked samples are dropped, and rays test which points could have kept a sample,
    which is unbiased while the surface does not move. Assumed: blocked samples are dropped without
    such a test, which makes the edges of shadows darker."""
    confidence: Positive = 20.0
    """Most candidates that a sample from earlier steps may stand for, as a multiple of those of a
    single step."""
    slots: PositiveCount = 65_536
    """Entries of the table that carries samples from one step to the next."""
    smallest_cosine: Share = 0.5
    """Smallest cosine between the normals of two points that may share samples."""

    @property
    def drops_blocked(self) -> bool:
        """Whether blocked samples are left to other techniques."""
        return self.candidates > 0 and self.visibility != "ignored"


class Reservoirs(eqx.Module):
    """R reservoirs of each of N points; no gradients.

    Attributes
    ----------
    directions : (N, R, 3) unit.
    weights : (N, R) unbiased estimate of one over the density of the direction; 0 for no sample.
    confidences : (N,) number of candidates that each reservoir of a point stands for.
    """

    directions: Float[Array, "N R 3"]
    weights: Float[Array, "N R"]
    confidences: Float[Array, " N"]


class ReservoirStore(eqx.Module):
    """Reservoirs that a step leaves to the next, in T slots.

    Attributes
    ----------
    keys : (T,) number of place and lane; -1 for an empty slot.
    reservoirs : T rows of reservoirs.
    points : the T points that the reservoirs come from.
    """

    keys: Int[Array, " T"]
    reservoirs: Reservoirs
    points: SurfacePoints


def empty_store(spec: ReservoirSettings, count: int) -> ReservoirStore:
    """Return a store without content for ``count`` samples of the light per point."""
    slots = spec.slots
    vector = jnp.zeros((slots, 3))
    empty_keys = jnp.full((slots,), -1, jnp.int32)
    reservoirs = Reservoirs(
        jnp.zeros((slots, count, 3)), jnp.zeros((slots, count)), jnp.zeros((slots,))
    )
    points = SurfacePoints(vector, vector, vector, empty_keys, jnp.zeros((slots,), bool))
    # Copies, so that no two leaves share a buffer: a step consumes the buffers of its state.
    return jax.tree.map(jnp.array, ReservoirStore(empty_keys, reservoirs, points))


def _keys(points: SurfacePoints, index: RayIndex | None) -> Int[Array, " N"]:
    """Combine place and lane of every point into a number; -1 for a point without a place."""
    places = points.faces if index is None else index.places(points.positions, points.faces)
    lanes = jnp.arange(places.shape[0], dtype=jnp.int32) % _LANES
    return jnp.where(places < 0, -1, places * _LANES + lanes)


def _slots(keys: Int[Array, " N"], count: int) -> Int[Array, " N"]:
    """Spread keys over the slots."""
    hashes = keys * _SCATTER
    return ((hashes ^ (hashes >> 15)) & 0x7FFFFFFF) % count


def _brightness(light: EnvLight, directions: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Brightness of the sky in directions, never 0; that of a black sky is 1.

    Samples that no reservoir chooses would be missing where blocked directions send light back.
    """
    brightness = luminance(lookup(light.radiance, directions.reshape(-1, 3)))
    mean = jnp.mean(luminance(light.radiance))
    floor = jnp.where(mean > 0.0, _DIMMEST * mean, 1.0)
    return jnp.maximum(brightness, floor).reshape(directions.shape[:-1])


def _chosen(
    uniforms: Float[Array, "R n"], weights: Float[Array, "K R n"]
) -> tuple[Int[Array, "R n"], Float[Array, "R n"]]:
    """Choose one of K in proportion to its weight; also return the sum of the weights."""
    running_sum = jnp.cumsum(weights, axis=0)
    total = running_sum[-1]
    choice = jnp.sum((running_sum <= (uniforms * total)[None]).astype(jnp.int32), axis=0)
    return jnp.minimum(choice, weights.shape[0] - 1), total


def _take(values: Array, choice: Int[Array, "R n"]) -> Array:
    """Take the chosen one of K."""
    choice = choice.reshape(1, *choice.shape, *[1] * (values.ndim - choice.ndim - 1))
    return jnp.take_along_axis(values, choice, axis=0)[0]


def _cosine(normals: Float[Array, "n 3"], directions: Float[Array, "... n 3"]) -> Array:
    normals = jnp.expand_dims(normals, range(directions.ndim - normals.ndim))
    return jnp.maximum(jnp.sum(normals * directions, axis=-1), 0.0)


def _own(
    points: SurfacePoints,
    offsets: Float[Array, "n 2"],
    uniforms: Float[Array, "n R"],
    light: EnvLight,
    sampler: LightSampler,
    spec: ReservoirSettings,
) -> tuple[Array, Array]:
    """Choose from a step's own candidates: directions (R, n, 3) and weights (R, n)."""
    count, dtype = uniforms.shape[1], points.normals.dtype
    numbers = low_discrepancy(offsets, count * spec.candidates, dtype)
    directions, density = sample_light(sampler, numbers.reshape(-1, 2))
    # Every ``count``-th candidate belongs to the same reservoir: they spread over the whole sky.
    shape = (spec.candidates, count, points.normals.shape[0])
    directions, density = directions.reshape(*shape, 3), density.reshape(shape)
    target = _brightness(light, directions) * _cosine(points.normals, directions)
    choice, total = _chosen(uniforms.T, target / (spec.candidates * density))
    weight = safe_divide(total, _take(target, choice))
    return _take(directions, choice), weight


class _Source(eqx.Module):
    """R reservoirs that are offered to each of n points, and the points that they come from."""

    directions: Float[Array, "R n 3"]
    weights: Float[Array, "R n"]
    confidences: Float[Array, " n"]
    points: SurfacePoints


def _is_open(
    source: _Source, directions: Float[Array, "R n 3"], index: RayIndex | None
) -> Bool[Array, "R n"]:
    """Trace directions from the points that a source comes from; True for open ones."""
    return cast(source.points, directions, index) == OPEN


def _balance(terms: Float[Array, "K K R n"]) -> Float[Array, "K R n"]:
    """Shares m_j(w_j) of K samples by the balance heuristic.

    ``terms`` : c_k p_k(w_j) in row k and column j, what source k could have made of sample j.
    """
    source = jnp.arange(terms.shape[0])
    return safe_divide(terms[source, source], jnp.sum(terms, axis=0))


def _joined(
    sources: list[_Source],
    uniforms: Float[Array, "R n"],
    light: EnvLight,
    index: RayIndex | None,
    *,
    traces: bool,
) -> _Source:
    """Choose one of K reservoirs, of which the first is the points' own."""
    all_directions = jnp.stack([source.directions for source in sources])
    brightness = _brightness(light, all_directions)

    def targets_at(k: int) -> Float[Array, "K R n"]:
        """Targets at source k of the samples of all sources."""
        values = brightness * _cosine(sources[k].points.normals, all_directions)
        if not traces:
            return values
        # Its own samples were traced when they were chosen. One call traces all others.
        others = jnp.delete(all_directions, k, axis=0)
        is_open = _is_open(sources[k], others.reshape(-1, *others.shape[2:]), index)
        is_open = jnp.insert(is_open.reshape(others.shape[:-1]), k, True, axis=0)
        return jnp.where(is_open, values, 0.0)

    targets = jnp.stack([targets_at(k) for k in range(len(sources))])
    confidences = jnp.stack([source.confidences for source in sources])
    shares = _balance(confidences[:, None, None] * targets)
    weights = shares * targets[0] * jnp.stack([source.weights for source in sources])
    choice, total = _chosen(uniforms, weights)
    directions = _take(all_directions, choice)
    target_value = _take(brightness, choice) * _cosine(sources[0].points.normals, directions)
    return _Source(
        directions,
        safe_divide(total, target_value),
        jnp.sum(confidences, axis=0),
        sources[0].points,
    )


def _offered(
    reservoirs: Reservoirs,
    origin: SurfacePoints,
    points: SurfacePoints,
    is_present: Bool[Array, " N"],
    reach: Float[Array, ""],
    spec: ReservoirSettings,
) -> tuple[Reservoirs, SurfacePoints]:
    """Accept reservoirs of other points that are near and have a similar normal; empty the rest."""
    offset = origin.positions - points.positions
    is_near = jnp.sum(jnp.square(offset), axis=-1) <= jnp.square(reach)
    is_similar = jnp.sum(origin.normals * points.normals, axis=-1) >= spec.smallest_cosine
    is_good = is_present & is_near & is_similar & origin.mask & points.mask
    confidences = jnp.where(is_good, reservoirs.confidences, 0.0)
    weights = jnp.where(is_good[:, None], reservoirs.weights, 0.0)
    return Reservoirs(reservoirs.directions, weights, confidences), origin


def _source(reservoirs: Reservoirs, points: SurfacePoints) -> _Source:
    directions = jnp.moveaxis(reservoirs.directions, 1, 0)
    return _Source(directions, reservoirs.weights.T, reservoirs.confidences, points)


def _rows(values: Any, rows: Int[Array, " N"]) -> Any:
    return jax.tree.map(lambda x: x.at[rows].get(mode="clip"), values)


def _recalled(
    store: ReservoirStore,
    points: SurfacePoints,
    index: RayIndex | None,
    reach: Float[Array, ""],
    spec: ReservoirSettings,
) -> tuple[Reservoirs, SurfacePoints]:
    """Look up the reservoirs that are stored under the points' places."""
    keys = _keys(points, index)
    slot = _slots(keys, spec.slots)
    reservoirs, origin = _rows((store.reservoirs, store.points), slot)
    is_present = (keys >= 0) & (store.keys[slot] == keys)
    confidence_limit = spec.confidence * spec.candidates
    reservoirs = Reservoirs(
        reservoirs.directions,
        reservoirs.weights,
        jnp.minimum(reservoirs.confidences, confidence_limit),
    )
    return _offered(reservoirs, origin, points, is_present, reach, spec)


def _beside(
    key: Key[Array, ""], points: SurfacePoints, index: RayIndex | None, count: int
) -> list[Int[Array, " N"]]:
    """Draw ``count`` points near each point in the order of their places; -1 for none."""
    places = points.faces if index is None else index.places(points.positions, points.faces)
    size = places.shape[0]
    last = jnp.iinfo(jnp.int32).max
    order = jnp.argsort(jnp.where(points.mask & (places >= 0), places, last)).astype(jnp.int32)
    rank = jnp.zeros((size,), jnp.int32).at[order].set(jnp.arange(size, dtype=jnp.int32))
    step_key, sign_key = jax.random.split(key)
    # Row by row, so that a point draws the same numbers whatever the buffer's size.
    steps = jax.random.randint(step_key, (size, count), 1, _NEIGHBORHOOD + 1, jnp.int32).T
    signs = jax.random.bernoulli(sign_key, 0.5, (size, count)).T
    neighbor_ranks = rank[None] + jnp.where(signs, steps, -steps)
    is_inside = (neighbor_ranks >= 0) & (neighbor_ranks < size)
    rows = order.at[jnp.clip(neighbor_ranks, 0, size - 1)].get(mode="promise_in_bounds")
    return list(jnp.where(is_inside, rows, -1))


def resample(
    key: Key[Array, ""],
    points: SurfacePoints,
    light: EnvLight,
    sampler: LightSampler,
    index: RayIndex | None,
    store: ReservoirStore | None,
    *,
    spec: ReservoirSettings,
    count: int,
) -> Reservoirs:
    """Choose ``count`` directions towards the light for each of N points; no gradients.

    Parameters
    ----------
    key : random key of all numbers.
    points : N points.
    light, sampler, index : the environment, its tables, and the surface.
    store : reservoirs that the step before left; None for none.
    spec : static; with at least one candidate.
    count : static; R, samples of the light per point.

    Returns
    -------
    `Reservoirs`, R for each of the N points.
    """
    points, light, sampler = jax.lax.stop_gradient((points, light, sampler))
    size, traces = points.normals.shape[0], spec.visibility == "traced"
    candidate_key, own_key, previous_key, neighbor_key, joining_key = jax.random.split(key, 5)
    offsets = jax.random.uniform(candidate_key, (size, 2), jnp.float32)
    dtype = points.normals.dtype
    uniforms = [
        jax.random.uniform(k, (size, count), jnp.float32).astype(dtype)
        for k in (own_key, previous_key)
    ]
    reach = jnp.asarray(jnp.inf, dtype) if index is None else index.place_size.astype(dtype)
    previous_reservoirs = None
    if store is not None and spec.reuse_steps:
        previous_reservoirs = _recalled(jax.lax.stop_gradient(store), points, index, reach, spec)

    def one_chunk(inputs: tuple) -> Reservoirs:
        points, offsets, uniforms, previous_reservoirs = inputs
        directions, weights = _own(points, offsets, uniforms[0], light, sampler, spec)
        confidences = jnp.full(points.faces.shape, float(spec.candidates), dtype)
        source = _Source(directions, weights, confidences, points)
        if traces:
            is_open = _is_open(source, directions, index)
            source = _Source(directions, jnp.where(is_open, weights, 0.0), confidences, points)
        if previous_reservoirs is not None:
            sources = [source, _source(*previous_reservoirs)]
            source = _joined(sources, uniforms[1].T, light, index, traces=traces)
        return Reservoirs(
            jnp.moveaxis(source.directions, 0, 1), source.weights.T, source.confidences
        )

    def in_all(function: Any, arguments: Any, samples: int) -> Reservoirs:
        return in_chunks(function, arguments, points.mask, samples, has_gradient=False)

    reservoirs = in_all(
        one_chunk, (points, offsets, uniforms, previous_reservoirs), count * spec.candidates
    )
    if not spec.neighbors:
        return reservoirs
    numbers = jax.random.uniform(joining_key, (size, count), jnp.float32)
    neighbors = [
        _offered(_rows(reservoirs, rows), _rows(points, rows), points, rows >= 0, 2 * reach, spec)
        for rows in _beside(neighbor_key, points, index, spec.neighbors)
    ]

    def with_neighbors(inputs: tuple) -> Reservoirs:
        points, reservoirs, neighbors, numbers = inputs
        sources = [_source(reservoirs, points), *(_source(*neighbor) for neighbor in neighbors)]
        joined_source = _joined(sources, numbers.T, light, index, traces=traces)
        directions = jnp.moveaxis(joined_source.directions, 0, 1)
        return Reservoirs(directions, joined_source.weights.T, joined_source.confidences)

    arguments = (points, reservoirs, neighbors, numbers.astype(dtype))
    return in_all(with_neighbors, arguments, count * (spec.neighbors + 1) ** 2)


def store_reservoirs(
    store: ReservoirStore,
    points: SurfacePoints,
    reservoirs: Reservoirs,
    hits: Int[Array, "N R"],
    index: RayIndex | None,
    *,
    spec: ReservoirSettings,
) -> ReservoirStore:
    """Put the reservoirs of a step into the store; slots that no point of the mask claims stay.

    Parameters
    ----------
    store : that of the step before.
    points, reservoirs : N points and their reservoirs.
    hits : (N, R) where rays in the reservoirs' directions end, see `sampling.Samples`.
    index : the surface.
    spec : static; unless visibility is ignored, blocked samples are stored with a weight of 0.

    Returns
    -------
    The store for the next step.
    """
    points, reservoirs = jax.lax.stop_gradient((points, reservoirs))
    if spec.visibility != "ignored":
        weights = jnp.where(hits == OPEN, reservoirs.weights, 0.0)
        reservoirs = Reservoirs(reservoirs.directions, weights, reservoirs.confidences)
    keys = _keys(points, index)
    size = keys.shape[0]
    slot = jnp.where((keys >= 0) & points.mask, _slots(keys, spec.slots), spec.slots)
    row = jnp.full((spec.slots,), -1, jnp.int32)
    row = row.at[slot].max(jnp.arange(size, dtype=jnp.int32), mode="drop")
    new_store = _rows(ReservoirStore(keys, reservoirs, points), row)

    def chosen(new: Array, old: Array) -> Array:
        is_new = (row >= 0).reshape(-1, *[1] * (new.ndim - 1))
        return jnp.where(is_new, new, old).astype(old.dtype)

    return jax.tree.map(chosen, new_store, store)
