"""Compare a function's reverse mode with central differences, in double precision.

A `Problem` is a function of named groups of numbers with named outputs. Every pair of a group and
an output gives one `Comparison`:

- *entries*: the Jacobian, entry by entry. Of a large group only a sample is compared (its largest
  gradients and random ones); of a large output only random combinations.
- *along the gradient* and *random*: directional derivatives of a random combination of the output.
- *float32*: the same Jacobian computed in single precision, against the double one.

Central differences err by truncation, which falls with the square of the step, and by rounding,
which grows with its inverse. Each derivative is therefore computed with a ladder of steps, and
every two neighbours are extrapolated (Richardson). The step is chosen at which the estimate changes
least, with a bound of the rounding added. The choice never looks at the gradient under test. The
change that remains is reported as the *uncertainty* of the differences: no gradient can be verified
more closely.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from geosplat_jax.core.types import Box

STEPS = tuple(2.0**-9 * 4.0**-k for k in range(8))
"""The ladder of steps, in units of a group's scale: from 2e-3 down to 1.2e-7."""

_SAMPLED_ENTRIES = 48
_RANDOM_DIRECTIONS = 3
_LARGEST_ENTRY = 3.0
"""Largest entry of a direction along a gradient, about that of a random direction."""
_CHUNK = 64
"""Points that one call of a compiled function evaluates; the last call is padded."""

Function = Callable[[dict[str, Any], Any], dict[str, Any]]


def unit_box(dtype: Any) -> Box:
    """Return the box [-1, 1]^3."""
    return Box(jnp.zeros((3,), dtype), jnp.ones((), dtype))


def double_precision() -> AbstractContextManager[Any]:
    """Enable float64 inside a ``with`` block, on every supported version of jax."""
    enable = getattr(jax, "enable_x64", None)
    if enable is None:
        from jax.experimental import enable_x64 as enable  # pyright: ignore[reportAttributeAccessIssue]
    return enable(True)


@dataclass(frozen=True)
class Problem:
    """A differentiable function at a point.

    Attributes
    ----------
    name : shown in the table.
    function : ``(inputs, constants) -> outputs``, both dictionaries of trees of arrays, in the
        precision of the inputs.
    inputs : groups to differentiate, float64 NumPy or JAX arrays.
    constants : arrays that are not differentiated; floats follow the precision of the inputs.
    scales : unit of a step, by group; 1 where absent.
    skip : (output, group) pairs that carry no gradient by contract and are not compared.
    full : groups and outputs with at most this many entries are compared entry by entry; of larger
        groups a sample is compared.
    projections : number of random combinations that are compared of a larger output.
    vectorized : evaluate many points at once; otherwise one after another, which suits functions
        that take long to compile.
    """

    name: str
    function: Function
    inputs: dict[str, Any]
    constants: Any = ()
    scales: dict[str, float] = field(default_factory=dict)
    skip: frozenset[tuple[str, str]] = frozenset()
    full: int = 600
    projections: int = 24
    vectorized: bool = True


@dataclass(frozen=True)
class Comparison:
    """How well a gradient agrees with differences, for one output and one group.

    Errors are relative to the norm of the gradient; where that is zero they are absolute.

    Attributes
    ----------
    problem, output, group : names.
    checked, total : number of entries of the group that were compared, and of all its entries.
    is_full : whether all entries were compared against all entries of the output.
    norm : Euclidean norm of the compared Jacobian.
    relative : L2 norm of the difference of both Jacobians.
    one_minus_cosine : one minus the cosine of the angle between both Jacobians.
    along_gradient : error of the derivative along the gradient.
    random_direction : largest error of the derivatives in several random directions.
    uncertainty : L2 norm of the estimated errors of the differences themselves.
    step : median of the chosen steps, over derivatives that are not tiny.
    single : L2 norm of the float32 Jacobian minus the double one; None where not computed.
    worst : the entry with the largest difference.
    worst_values : value of this entry by differences, and by the gradient.
    sweep : relative L2 error with each step of `STEPS` alone, without extrapolation.
    """

    problem: str
    output: str
    group: str
    checked: int
    total: int
    is_full: bool
    norm: float
    relative: float
    one_minus_cosine: float
    along_gradient: float
    random_direction: float
    uncertainty: float
    step: float
    single: float | None
    worst: str
    worst_values: tuple[float, float]
    sweep: tuple[float, ...]

    def agrees(self, tolerance: float, single_tolerance: float) -> bool:
        """Whether every error lies within the tolerances."""
        # np.max, unlike max, keeps a NaN, which must not pass.
        double = np.max([self.relative, self.along_gradient, self.random_direction])
        single = 0.0 if self.single is None else self.single
        return bool(double <= tolerance and single <= single_tolerance)


def _cast(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point leaves of a tree."""

    def convert(leaf: Any) -> Any:
        if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating):
            return jnp.asarray(leaf, dtype)
        return leaf

    return jax.tree.map(convert, tree)


def _entry_names(tree: Any) -> list[str]:
    """Name every number of a tree, in the order of `ravel_pytree`."""
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        stem = jax.tree_util.keystr(path[1:]).lstrip(".")
        for index in np.ndindex(np.shape(leaf)):
            names.append(stem + (f"[{', '.join(map(str, index))}]" if index else ""))
    return names


def _spans(tree: dict[str, Any]) -> dict[str, slice]:
    """Where each named part lies in the raveled vector."""
    spans, start = {}, 0
    for name in sorted(tree):
        size = sum(int(np.size(leaf)) for leaf in jax.tree.leaves(tree[name]))
        spans[name] = slice(start, start + size)
        start += size
    return spans


class _Flat:
    """A problem as a function of one vector, compiled once for values and once for gradients."""

    def __init__(self, problem: Problem, dtype: Any):
        inputs = _cast(problem.inputs, dtype)
        constants = _cast(problem.constants, dtype)
        point, restore = ravel_pytree(inputs)

        def value(vector: jax.Array, constants: Any) -> jax.Array:
            return ravel_pytree(problem.function(restore(vector), constants))[0]

        batch_size = _CHUNK if problem.vectorized else None

        def values(points: jax.Array, constants: Any) -> jax.Array:
            return jax.lax.map(lambda p: value(p, constants), points, batch_size=batch_size)

        def pull(vector: jax.Array, cotangents: jax.Array, constants: Any) -> jax.Array:
            _, pullback = jax.vjp(lambda p: value(p, constants), vector)
            return jax.lax.map(lambda c: pullback(c)[0], cotangents, batch_size=batch_size)

        shapes = jax.eval_shape(problem.function, inputs, constants)
        self.point = np.asarray(point)
        self.inputs, self.outputs = inputs, shapes
        self._values, self._pull, self._constants = jax.jit(values), jax.jit(pull), constants

    def values(self, points: np.ndarray) -> np.ndarray:
        """Evaluate the outputs (P, m) at points (P, n)."""
        return self._chunked(lambda chunk: self._values(chunk, self._constants), points)

    def pull(self, cotangents: np.ndarray) -> np.ndarray:
        """Gradients (R, n) of the combinations (R, m) of the outputs."""
        return self._chunked(lambda c: self._pull(self.point, c, self._constants), cotangents)

    def _chunked(self, compiled: Callable[[np.ndarray], jax.Array], rows: np.ndarray) -> np.ndarray:
        """Run a function of `_CHUNK` rows over any number of them."""
        rows = np.asarray(rows, self.point.dtype)
        padding = -len(rows) % _CHUNK
        padded = np.concatenate([rows, np.repeat(rows[:1], padding, axis=0)])
        chunks = [
            np.asarray(compiled(padded[i : i + _CHUNK])) for i in range(0, len(padded), _CHUNK)
        ]
        return np.concatenate(chunks)[: len(rows)]


def _differences(
    flat: _Flat, directions: np.ndarray, combinations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Plain central differences with every step, (D, K, R), and the rounding each may hold."""
    steps = np.array(STEPS)
    epsilon = np.finfo(flat.point.dtype).eps
    signed = np.stack([steps, -steps], axis=1).reshape(-1)
    differences, rounding = [], []
    for first in range(0, len(directions), _CHUNK):
        block = directions[first : first + _CHUNK]
        points = flat.point + signed[None, :, None] * block[:, None, :]
        outputs = flat.values(points.reshape(-1, points.shape[-1]))
        outputs = outputs.reshape(len(block), len(steps), 2, -1)
        changes = (outputs[:, :, 0] - outputs[:, :, 1]) @ combinations.T
        differences.append(changes / (2 * steps[:, None]))
        magnitudes = np.max(np.abs(outputs), axis=(0, 1, 2)) @ np.abs(combinations).T
        rounding.append(np.broadcast_to(epsilon * magnitudes / steps[:, None], changes.shape))
    return np.concatenate(differences), np.concatenate(rounding)


def _settled(
    differences: np.ndarray, rounding: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose, for every derivative, the extrapolated value that changes least between steps.

    Returns values, their uncertainty and the index of the step, each (D, R).
    """
    extrapolated = (16 * differences[:, 1:] - differences[:, :-1]) / 15
    uncertainty = np.abs(extrapolated[:, 1:] - extrapolated[:, :-1]) + rounding[:, 2:]
    best_steps = np.argmin(uncertainty, axis=1)[:, None]
    values = np.take_along_axis(extrapolated[:, 1:], best_steps, axis=1)[:, 0]
    return values, np.take_along_axis(uncertainty, best_steps, axis=1)[:, 0], best_steps[:, 0] + 2


def _relative(error: np.ndarray, norm: float) -> float:
    """L2 of an error in units of ``norm``, absolute where that is zero."""
    error_norm = float(np.sqrt(np.sum(np.square(error))))
    return error_norm / norm if norm > 0 else error_norm


def _one_minus_cosine(first: np.ndarray, second: np.ndarray) -> float:
    """``1 - cos`` of the angle between two arrays, without cancellation; 0 if both are zero."""
    lengths = [np.sqrt(np.sum(np.square(x))) for x in (first, second)]
    if min(lengths) == 0:
        return 0.0 if max(lengths) == 0 else 1.0
    return float(0.5 * np.sum(np.square(first / lengths[0] - second / lengths[1])))


def _combinations(
    outputs: dict[str, slice], size: int, problem: Problem, rng: np.random.Generator
) -> dict[str, tuple[np.ndarray, bool]]:
    """Rows (R, m) that select the entries of each output, or add them up with random signs.

    Each with a flag that says whether all entries are selected.
    """
    combinations = {}
    for name, span in outputs.items():
        count = span.stop - span.start
        is_full = count <= problem.full
        rows = np.zeros((count if is_full else problem.projections, size))
        rows[:, span] = np.eye(count) if is_full else rng.choice([-1.0, 1.0], (len(rows), count))
        combinations[name] = (rows, is_full)
    return combinations


def _chosen_entries(
    gradients: np.ndarray, span: slice, limit: int, rng: np.random.Generator
) -> np.ndarray:
    """All entries of a group, or its largest gradients and as many random ones."""
    count = span.stop - span.start
    if count <= limit:
        return np.arange(span.start, span.stop)
    magnitudes = np.sqrt(np.sum(np.square(gradients[:, span]), axis=0))
    largest_entries = np.argsort(-magnitudes, kind="stable")[: _SAMPLED_ENTRIES // 2]
    other_entries = np.setdiff1d(np.arange(count), largest_entries)
    random_entries = rng.choice(other_entries, _SAMPLED_ENTRIES // 2, replace=False)
    return span.start + np.sort(np.concatenate([largest_entries, random_entries]))


def _directional_errors(
    flat: _Flat,
    span: slice,
    scale: float,
    combinations: np.ndarray,
    gradients: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Errors (R, 2) of R combinations: along their gradient, and the worst of random directions."""
    count = span.stop - span.start
    norms = np.sqrt(np.sum(np.square(gradients), axis=1))
    # Directions along a gradient are as long as random ones, along which a typical derivative is
    # the norm of the gradient. Where a few entries hold all of it they are shorter: those entries
    # would otherwise move by hundreds of steps, past kinks of the function.
    unit_gradients = gradients / np.where(norms > 0, norms, 1.0)[:, None]
    largest_entries = np.max(np.abs(unit_gradients), axis=1)
    lengths = np.minimum(np.sqrt(count), _LARGEST_ENTRY / np.where(norms > 0, largest_entries, 1.0))
    lengths = np.where(norms > 0, lengths, np.sqrt(count))
    gradient_directions = np.where(norms[:, None] > 0, lengths[:, None] * unit_gradients, 1.0)
    group_directions = np.concatenate(
        [gradient_directions, rng.standard_normal((_RANDOM_DIRECTIONS, count))]
    )
    directions = np.zeros((len(group_directions), len(flat.point)))
    directions[:, span] = scale * group_directions
    derivatives = _settled(*_differences(flat, directions, combinations))[0] / scale
    error = (
        np.abs(derivatives - group_directions @ gradients.T)
        / np.where(norms > 0, norms, 1.0)[None, :]
    )
    rows = np.arange(len(gradients))
    return np.stack([error[rows, rows] / lengths, np.max(error[len(rows) :], axis=0)], axis=1)


def compare(problem: Problem, *, single: bool = True, seed: int = 0) -> list[Comparison]:
    """Compare reverse mode with differences for every output and group of a problem.

    Must run inside `double_precision`.

    Parameters
    ----------
    problem : what to differentiate.
    single : also compute the Jacobian in float32.
    seed : seed of samples and random directions.

    Returns
    -------
    One comparison for every pair of a group and an output that is not skipped.
    """
    rng = np.random.default_rng(seed)
    flat = _Flat(problem, np.float64)
    flat_single = _Flat(problem, np.float32) if single else None
    inputs, outputs = _spans(flat.inputs), _spans(flat.outputs)
    size = sum(span.stop - span.start for span in outputs.values())
    input_names, output_names = _entry_names(flat.inputs), _entry_names(flat.outputs)
    combinations = _combinations(outputs, size, problem, rng)
    gradients = {name: flat.pull(rows) for name, (rows, _) in combinations.items()}
    singles = (
        {name: flat_single.pull(combinations[name][0]) for name in combinations}
        if flat_single
        else {}
    )

    comparisons = []
    for group, span in inputs.items():
        compared_outputs = [name for name in combinations if (name, group) not in problem.skip]
        if not compared_outputs:
            continue
        scale = problem.scales.get(group, 1.0)
        entries = _chosen_entries(
            np.concatenate([gradients[name] for name in compared_outputs]), span, problem.full, rng
        )
        directions = np.zeros((len(entries), len(flat.point)))
        directions[np.arange(len(entries)), entries] = scale
        rows = np.concatenate([combinations[name][0] for name in compared_outputs])
        differences, rounding = (x / scale for x in _differences(flat, directions, rows))
        coefficients = {
            name: rng.standard_normal(len(combinations[name][0])) for name in compared_outputs
        }
        directional = _directional_errors(
            flat,
            span,
            scale,
            np.stack([coefficients[name] @ combinations[name][0] for name in compared_outputs]),
            np.stack([coefficients[name] @ gradients[name][:, span] for name in compared_outputs]),
            rng,
        )
        start = 0
        for output, errors in zip(compared_outputs, directional, strict=True):
            combination, is_full = combinations[output]
            columns = slice(start, start + len(combination))
            start = columns.stop
            expected = gradients[output][:, entries].T
            single_gradient = singles[output][:, entries].T if singles else None
            labels = [input_names[e] for e in entries], output_names[outputs[output]]
            comparisons.append(
                _summary(
                    (problem.name, output, group),
                    expected,
                    single_gradient,
                    _settled(differences[:, :, columns], rounding[:, :, columns]),
                    (float(errors[0]), float(errors[1])),
                    (labels[0], labels[1] if is_full else None),
                    span.stop - span.start,
                    differences[:, :, columns],
                )
            )
    return comparisons


def _summary(
    names: tuple[str, str, str],
    expected: np.ndarray,
    single: np.ndarray | None,
    estimates: tuple[np.ndarray, np.ndarray, np.ndarray],
    directional: tuple[float, float],
    labels: tuple[list[str], list[str] | None],
    total: int,
    differences: np.ndarray,
) -> Comparison:
    """Condense the Jacobians (entries, outputs) of one pair into a row of the table."""
    problem, output, group = names
    values, uncertainty, step = estimates
    norm = float(np.sqrt(np.sum(np.square(expected))))
    error = values - expected
    is_significant = np.abs(values) >= 1e-3 * np.max(np.abs(values))
    row, column = np.unravel_index(np.argmax(np.abs(error)), error.shape)
    entry_names, output_names = labels
    output_label = output_names[column] if output_names else f"(combination {column})"
    return Comparison(
        problem=problem,
        output=output,
        group=group,
        checked=len(entry_names),
        total=total,
        is_full=output_names is not None and len(entry_names) == total,
        norm=norm,
        relative=_relative(error, norm),
        one_minus_cosine=_one_minus_cosine(values, expected),
        along_gradient=directional[0],
        random_direction=directional[1],
        uncertainty=_relative(uncertainty, norm),
        step=float(np.median(np.array(STEPS)[step[is_significant]])),
        single=None if single is None else _relative(single - expected, norm),
        worst=f"d {output}{output_label} / d {group}{entry_names[row]}",
        worst_values=(float(values[row, column]), float(expected[row, column])),
        sweep=tuple(_relative(differences[:, k] - expected, norm) for k in range(len(STEPS))),
    )
