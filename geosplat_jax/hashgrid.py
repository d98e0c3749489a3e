"""Multi-resolution hash encoding (Mueller et al. 2022) and the tiny MLP that reads it.

A point in the unit cube is looked up in several cubic grids of growing resolution; each gives the
trilinear interpolation of its vertices' feature rows, and the results are concatenated. Grids that
fit into the table are *dense* (one row per vertex); the others share rows by a spatial hash.

Layout. All levels live in one array, level after level: one gather and one scatter serve them all.
Along x, neighbouring vertices always own neighbouring rows: a level's row is ``x + offset(y, z)``,
with the offset of a grid line either its dense position or a hash of (y, z). The eight corners of
a cell are therefore four pairs of adjacent rows, which halves the hashing and the scattered rows.

Gradients. `encode` has a hand-written reverse mode, 3 times faster on a CPU than autodiff of
`_reference_encode`; forward mode and second derivatives are not available. Gradients of hash tables
are small and sparse; the authors multiply them by 16, which does not change the steps of Adam.
"""

import math
from functools import partial
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key
from pydantic import Field

from geosplat_jax.core.settings import PositiveCount, settings

_HASH_Y = np.uint32(2654435761)
_HASH_Z = np.uint32(805459861)
_HASH_FINAL = np.uint32(0x2C1B3C6D)

_INITIAL_SCALE = 1e-4
"""Half-width of the uniform distribution that tables start from."""

_BACKWARD_CHUNK = 8192
"""Points per step of the backward pass: enough to hide the cost of a step, but few enough that the
scattered rows (4 x 2 x features floats per point and level) stay in cache and off the heap."""


@settings
class HashGridSpec:
    """Static shape of an encoding; hashable, so that it can be a static jit argument.

    Level ``l`` has ``floor(coarsest * growth**l)`` cells along an axis, with ``growth`` such that
    the last level has ``finest``. A level is dense when its ``(cells + 1)**3`` vertices fit into
    ``2**log2_entries`` rows; otherwise it has exactly that many rows.

    Raises
    ------
    ValueError
        When ``finest < coarsest``, or a hashed level has so many cells that one grid line takes
        more than half of the table.
    """

    levels: Annotated[int, Field(ge=1, le=64)] = 8
    """Number of grids."""
    features: Annotated[int, Field(ge=1, le=64)] = 4
    """Numbers that a vertex of a grid holds."""
    log2_entries: Annotated[int, Field(ge=1, le=30)] = 15
    """Base-2 logarithm of the most rows that a level may have."""
    coarsest: PositiveCount = 16
    """Cells along an axis of the first level."""
    finest: PositiveCount = 512
    """Cells along an axis of the last level; no effect with a single level."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        if self.finest < self.coarsest:
            raise ValueError(f"finest must be at least coarsest: {self}")
        if not self.is_dense[-1] and 2 * self.resolutions[-1] > 2**self.log2_entries:
            raise ValueError(
                f"a grid line of {self.resolutions[-1]} cells takes more than half of "
                f"2**{self.log2_entries} rows; raise log2_entries or lower finest"
            )

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along an axis, per level."""
        steps = max(self.levels - 1, 1)
        growth = math.exp((math.log(self.finest) - math.log(self.coarsest)) / steps)
        # The epsilon keeps the last level at `finest` where the power rounds below it.
        return tuple(int(self.coarsest * growth**level + 1e-6) for level in range(self.levels))

    @property
    def is_dense(self) -> tuple[bool, ...]:
        """Whether each level is free of collisions."""
        return tuple((cells + 1) ** 3 <= 2**self.log2_entries for cells in self.resolutions)

    @property
    def entries(self) -> tuple[int, ...]:
        """Rows of the table, per level."""
        return tuple(
            (cells + 1) ** 3 if dense else 2**self.log2_entries
            for cells, dense in zip(self.resolutions, self.is_dense, strict=True)
        )

    @property
    def first_rows(self) -> tuple[int, ...]:
        """First row of each level in the common table."""
        return tuple(sum(self.entries[:level]) for level in range(self.levels))

    @property
    def total_entries(self) -> int:
        """Rows of the common table."""
        return sum(self.entries)

    @property
    def width(self) -> int:
        """Features of an encoded point, all levels together."""
        return self.levels * self.features


class _Cells(NamedTuple):
    """Where points lie in every level: row pairs along x of the four (y, z) edges of a cell."""

    rows: tuple[Int[Array, "N L"], ...]
    fractions: tuple[Float[Array, "N L"], ...]


def init_tables(key: Key[Array, ""], spec: HashGridSpec) -> Float[Array, "E F"]:
    """Draw feature rows of all levels, level after level, uniform in ±1e-4."""
    shape = (spec.total_entries, spec.features)
    return jax.random.uniform(key, shape, minval=-_INITIAL_SCALE, maxval=_INITIAL_SCALE)


def _hash_line(
    y: Int[Array, "N L"], z: Int[Array, "N L"], offset_count: Float[np.ndarray, "1 L"]
) -> Int[Array, "N L"]:
    """First row of the grid line (y, z) in a hashed level, below ``offset_count``.

    The upper 24 bits of the hash scale an interval; float32 holds them exactly and the product
    never rounds up to ``offset_count``. (An integer remainder would not vectorise.)
    """
    hashes = (y.astype(jnp.uint32) * _HASH_Y) ^ (z.astype(jnp.uint32) * _HASH_Z)
    hashes = (hashes ^ (hashes >> 15)) * _HASH_FINAL
    fraction = (hashes >> 8).astype(jnp.float32)
    return (fraction * (offset_count * np.float32(2.0**-24))).astype(jnp.int32)


def _locate(points: Float[Array, "N 3"], spec: HashGridSpec) -> _Cells:
    """Find every point's cell in every level, as table rows and fractions within the cell.

    Rows are in bounds for *any* input, NaN included; fractions of a NaN are NaN.
    """
    cells = np.asarray(spec.resolutions, np.int32)[None, :]
    first_rows = np.asarray(spec.first_rows, np.int32)[None, :]
    is_dense = np.asarray(spec.is_dense)[None, :]
    # A line occupies cells + 1 rows, so this many offsets keep it inside the level's table.
    offset_count = np.float32(2**spec.log2_entries) - cells.astype(np.float32)

    sizes = jnp.asarray(cells, points.dtype)
    corners, fractions = [], []
    for axis in range(3):  # three (N, L) arrays vectorise 4 times better than one (N, 3, L)
        scaled = jnp.clip(points[:, axis], 0.0, 1.0)[:, None] * sizes
        corner = jnp.clip(scaled.astype(jnp.int32), 0, cells - 1)
        corners.append(corner)
        fractions.append(scaled - corner.astype(points.dtype))
    x, y, z = corners

    rows = []
    for dz, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        dense_line = ((z + dz) * (cells + 1) + (y + dy)) * (cells + 1)
        line = jnp.where(is_dense, dense_line, _hash_line(y + dy, z + dz, offset_count))
        rows.append(first_rows + line + x)
    locations = _Cells(tuple(rows), tuple(fractions))
    # Without the barrier XLA repeats the hashing for every feature of every corner (x1.6 time).
    return jax.lax.optimization_barrier(locations)


def _line_weights(cells: _Cells) -> list[Float[Array, "N L"]]:
    """Bilinear weights in (y, z) of the four row pairs, in their order."""
    _, ty, tz = cells.fractions
    return [wz * wy for wz in (1 - tz, tz) for wy in (1 - ty, ty)]


def _take(table: Float[Array, "E ..."], rows: Int[Array, "N L"]) -> Float[Array, "N L ..."]:
    """Rows, or entries of a column, that are known to be in bounds."""
    return table.at[rows].get(mode="promise_in_bounds")


def _interpolate(table: Float[Array, "E F"], cells: _Cells) -> Float[Array, "N L F"]:
    """Trilinear interpolation of every level's rows."""
    tx = cells.fractions[0][..., None]
    weights = _line_weights(cells)
    features = jnp.zeros((), table.dtype)
    for rows, weight in zip(cells.rows, weights, strict=True):
        along_x = _take(table, rows) * (1 - tx) + _take(table, rows + 1) * tx
        features = features + weight[..., None] * along_x
    return features


def _reference_encode(
    table: Float[Array, "E F"], points: Float[Array, "N 3"], spec: HashGridSpec
) -> Float[Array, "N W"]:
    """Encode with plain operations that autodiff differentiates; the reference of `encode`."""
    is_inside = (points >= 0) & (points <= 1)
    clamped = jnp.where(is_inside, points, jnp.clip(jax.lax.stop_gradient(points), 0.0, 1.0))
    locations = _locate(jax.lax.stop_gradient(points), spec)
    cells = jnp.asarray(spec.resolutions, points.dtype)[None, :]
    fractions = []
    for axis in range(3):
        scaled = clamped[:, axis, None] * cells
        # The same fractions, but with a derivative: the corner of the cell is a constant.
        corner = jax.lax.stop_gradient(scaled) - locations.fractions[axis]
        fractions.append(scaled - corner)
    features = _interpolate(table, _Cells(locations.rows, tuple(fractions)))
    return features.reshape(points.shape[0], spec.width)


def _scatter_rows(
    gradient: Float[Array, "E F"], cells: _Cells, cotangent: Float[Array, "N L F"]
) -> Float[Array, "E F"]:
    """Add the cotangent, times its weight, to the rows of all corners."""
    tx = cells.fractions[0]
    updates = [
        jnp.stack([(w * (1 - tx))[..., None] * cotangent, (w * tx)[..., None] * cotangent], axis=-2)
        for w in _line_weights(cells)
    ]
    pair_shape = (2, gradient.shape[1])
    # One window of two adjacent rows per pair.
    numbers = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
    )
    return jax.lax.scatter_add(
        gradient,
        jnp.stack(cells.rows).reshape(-1, 1),
        jnp.stack(updates).reshape(-1, *pair_shape),
        numbers,
        mode="promise_in_bounds",
    )


def _point_gradient(
    table: Float[Array, "E F"],
    points: Float[Array, "N 3"],
    cotangent: Float[Array, "N L F"],
    spec: HashGridSpec,
) -> Float[Array, "N 3"]:
    """Differentiate with respect to the points; zero along axes on which a point was clamped.

    Single entries of the table's columns are summed in one unrolled chain. That takes half the time
    of gathering whole rows and summing over so short an axis.
    """
    cells = _locate(points, spec)
    tx, ty, tz = cells.fractions
    columns = [table[:, index] for index in range(spec.features)]

    def dot_rows(rows: Int[Array, "N L"]) -> Float[Array, "N L"]:
        """Product of the cotangent with a corner's row, over the features of a level."""
        product = jnp.zeros((), cotangent.dtype)
        for index, column in enumerate(columns):
            product = product + _take(column, rows) * cotangent[:, :, index]
        return product

    low = [dot_rows(rows) for rows in cells.rows]
    high = [dot_rows(rows + 1) for rows in cells.rows]
    line = [a * (1 - tx) + b * tx for a, b in zip(low, high, strict=True)]
    weighted = zip(_line_weights(cells), low, high, strict=True)
    along_x = sum((w * (b - a) for w, a, b in weighted), start=jnp.zeros_like(tx))
    along_y = (line[1] - line[0]) * (1 - tz) + (line[3] - line[2]) * tz
    along_z = (line[2] - line[0]) * (1 - ty) + (line[3] - line[1]) * ty
    # The chain rule of scaling a point to a level's cells.
    sizes = jnp.asarray(spec.resolutions, points.dtype)[None, :]
    gradient = [jnp.sum(slope * sizes, axis=1) for slope in (along_x, along_y, along_z)]
    return jnp.where((points >= 0) & (points <= 1), jnp.stack(gradient, axis=-1), 0.0)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _encode(table, points, spec, position_gradient):
    features = _interpolate(table, _locate(points, spec))
    return features.reshape(points.shape[0], spec.width)


def _encode_forward(table, points, spec, position_gradient):
    return _encode(table, points, spec, position_gradient), (table, points)


def _encode_backward(spec, position_gradient, residuals, cotangent):
    """Scatter a chunk of points at a time; cells are computed again instead of stored."""
    table, points = residuals
    count = points.shape[0]
    chunk = min(_BACKWARD_CHUNK, max(count, 1))
    padding = ((0, -count % chunk), (0, 0))  # zero cotangents: padding adds nothing

    def by_level(rows):
        return rows.reshape(-1, spec.levels, spec.features)

    def step(gradient, slices):
        chunk_points, chunk_cotangent = slices
        cells = _locate(chunk_points, spec)
        return _scatter_rows(gradient, cells, by_level(chunk_cotangent)), None

    chunks = (
        jnp.pad(points, padding).reshape(-1, chunk, 3),
        jnp.pad(cotangent, padding).reshape(-1, chunk, spec.width),
    )
    gradient, _ = jax.lax.scan(step, jnp.zeros_like(table), chunks)
    if not position_gradient:
        return gradient, jnp.zeros_like(points)
    return gradient, _point_gradient(table, points, by_level(cotangent), spec)


_encode.defvjp(_encode_forward, _encode_backward)


def encode(
    table: Float[Array, "E F"],
    points: Float[Array, "N 3"],
    *,
    spec: HashGridSpec,
    position_gradient: bool = False,
) -> Float[Array, "N W"]:
    """Encode points of the unit cube as the interpolated features of every level.

    Parameters
    ----------
    table : (E, F) feature rows of all levels, see `init_tables`.
    points : (N, 3) in [0, 1]; values outside are clamped.
    spec : static shape of the encoding.
    position_gradient : whether points receive a gradient. It is exact inside cells, one-sided on
        their faces and zero along a clamped axis; it costs a second pass over the table.

    Returns
    -------
    (N, levels * features), the levels one after another.

    Notes
    -----
    Without ``position_gradient`` the points' gradient is zero. Rows of padding need no care: a
    zero cotangent adds nothing to the table. A NaN in a point gives NaN features of that row.
    """
    points = points if position_gradient else jax.lax.stop_gradient(points)
    return _encode(table, points, spec, position_gradient)


class Layer(eqx.Module):
    """Affine map: ``x @ weights + bias``.

    Attributes
    ----------
    weights : (inputs, outputs).
    bias : (outputs,); None for a layer without bias.
    """

    weights: Float[Array, "I O"]
    bias: Float[Array, " O"] | None


def init_mlp(key: Key[Array, ""], widths: tuple[int, ...], *, bias: bool) -> tuple[Layer, ...]:
    """Draw Kaiming-uniform weights (He et al. 2015, ``±sqrt(6 / inputs)``); biases start at zero.

    Parameters
    ----------
    key : random key of the weights.
    widths : numbers of inputs, of every hidden layer, and of outputs.
    bias : whether layers have biases.

    Returns
    -------
    Layers in order, one fewer than ``widths`` has entries; see `apply_mlp`.
    """
    layers = []
    keys = jax.random.split(key, len(widths) - 1)
    for layer_key, inputs, outputs in zip(keys, widths[:-1], widths[1:], strict=True):
        bound = math.sqrt(6.0 / inputs)
        weights = jax.random.uniform(layer_key, (inputs, outputs), minval=-bound, maxval=bound)
        layers.append(Layer(weights, jnp.zeros((outputs,), weights.dtype) if bias else None))
    return tuple(layers)


def apply_mlp(layers: tuple[Layer, ...], x: Float[Array, "N I"]) -> Float[Array, "N O"]:
    """Evaluate an MLP with rectified (ReLU) hidden layers and a linear output."""
    for index, layer in enumerate(layers):
        x = jnp.matmul(x, layer.weights, precision="highest")
        if layer.bias is not None:
            x = x + layer.bias[None, :]
        if index + 1 < len(layers):
            x = jax.nn.relu(x)
    return x
