"""The parts by name, and the table of what was compared."""

from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from geosplat_jax.gradcheck.differences import STEPS, Comparison, Problem, compare, double_precision
from geosplat_jax.gradcheck.geometry_parts import adapter_problems, isosurface_problems
from geosplat_jax.gradcheck.image_parts import (
    denoiser_problems,
    loss_term_problems,
    projection_problems,
    rasteriser_problems,
)
from geosplat_jax.gradcheck.mesh_parts import mesh_problems
from geosplat_jax.gradcheck.shading_parts import (
    bsdf_problems,
    face_problems,
    hash_grid_problems,
    light_problems,
    material_problems,
    model_problems,
    path_problems,
    split_sum_problems,
    transport_problems,
)
from geosplat_jax.gradcheck.whole_parts import (
    loss_problems,
    refinement_problems,
    smoothness_problems,
)

TOLERANCE = 1e-6
"""Largest relative error in float64 that passes."""

SINGLE_TOLERANCE = 1e-3
"""Largest relative error of a float32 gradient against the float64 one that passes."""

PARTS: dict[str, Callable[[np.random.Generator], list[Problem]]] = {
    "isosurface": isosurface_problems,
    "mesh": mesh_problems,
    "adapter": adapter_problems,
    "hashgrid": hash_grid_problems,
    "materials": material_problems,
    "models": model_problems,
    "smoothness": smoothness_problems,
    "bsdf": bsdf_problems,
    "light": light_problems,
    "splitsum": split_sum_problems,
    "transport": transport_problems,
    "faces": face_problems,
    "paths": path_problems,
    "projection": projection_problems,
    "rasterizer": rasteriser_problems,
    "denoiser": denoiser_problems,
    "terms": loss_term_problems,
    "loss": loss_problems,
    "refinement": refinement_problems,
}
"""What can be checked, from the surface to the whole loss."""

_HEADER = (
    f"{'output <- input':<36} {'entries':>11} {'rel. L2':>8} {'1 - cos':>8} {'along':>8} "
    f"{'random':>8} {'+-':>8} {'step':>8} {'float32':>8}  worst entry: difference, gradient"
)


def check_part(name: str, *, seed: int = 0, single: bool = True) -> list[Comparison]:
    """Compare every problem of a part.

    Parameters
    ----------
    name : a key of `PARTS`.
    seed : seed of the problems' numbers, samples and directions.
    single : also compare float32 with float64.

    Returns
    -------
    One comparison for every pair of an output and a group, of all problems.

    Raises
    ------
    ValueError
        On an unknown name.
    """
    if name not in PARTS:
        raise ValueError(f"unknown part {name!r}; expected some of {', '.join(PARTS)}")
    with double_precision():
        problems = PARTS[name](np.random.default_rng(seed))
        return [row for p in problems for row in compare(p, single=single, seed=seed)]


def passes(row: Comparison) -> bool:
    """Whether a comparison lies within `TOLERANCE` and `SINGLE_TOLERANCE`."""
    return row.agrees(TOLERANCE, SINGLE_TOLERANCE)


def _is_independent(row: Comparison) -> bool:
    """Whether gradient and differences both say that the output ignores the group."""
    return row.norm == 0 and passes(row)


def table(rows: Iterable[Comparison], *, sweep: bool = False) -> str:
    """Lay out comparisons as text, one block per problem.

    Pairs where gradient and differences are both zero share one line. With ``sweep``, each row is
    followed by the errors of plain central differences at every step, from the largest to the
    smallest: truncation shows on the left, rounding on the right.
    """
    lines: list[str] = []
    by_problem: dict[str, list[Comparison]] = {}
    for row in rows:
        by_problem.setdefault(row.problem, []).append(row)
    for problem, problem_rows in by_problem.items():
        lines += ["", problem, _HEADER]
        for row in problem_rows:
            if not _is_independent(row):
                lines += [_line(row)] + ([_sweep_line(row)] if sweep else [])
        zero_pairs = [
            f"{row.output} <- {row.group}" for row in problem_rows if _is_independent(row)
        ]
        if zero_pairs:
            lines.append(f"no dependence, zero in both: {'; '.join(zero_pairs)}")
    return "\n".join(lines[1:])


def _single_text(row: Comparison) -> str:
    return "       -" if row.single is None else f"{row.single:8.1e}"


def _line(row: Comparison) -> str:
    entries = f"{row.checked}/{row.total}{' J' if row.is_full else '  '}"
    difference, gradient = row.worst_values
    errors = (
        row.relative,
        row.one_minus_cosine,
        row.along_gradient,
        row.random_direction,
        row.uncertainty,
        row.step,
    )
    numbers = " ".join([f"{value:8.1e}" for value in errors] + [_single_text(row)])
    verdict = "" if passes(row) else "  FAILS"
    return (
        f"{row.output + ' <- ' + row.group:<36} {entries:>11} {numbers}  "
        f"{row.worst}: {difference:.9g}, {gradient:.9g}{verdict}"
    )


def _sweep_line(row: Comparison) -> str:
    steps = "  ".join(f"{h:.0e}: {e:.0e}" for h, e in zip(STEPS, row.sweep, strict=True))
    return f"    plain differences by step  {steps}"


def summary(checked: dict[str, list[Comparison]]) -> str:
    """Lay out one line per part, with its largest errors."""
    lines = [f"{'part':<12} {'pairs':>6} {'rel. L2':>8} {'1 - cos':>8} {'directions':>10} float32"]
    for part, rows in checked.items():
        # np.max is NaN where any value is NaN; Python's max may not be.
        directions = np.max([(row.along_gradient, row.random_direction) for row in rows])
        verdict = "" if all(map(passes, rows)) else "  FAILS"
        lines.append(
            f"{part:<12} {len(rows):>6} {np.max([r.relative for r in rows]):8.1e} "
            f"{np.max([r.one_minus_cosine for r in rows]):8.1e} {directions:10.1e} "
            f"{np.max([r.single or 0.0 for r in rows]):7.1e}{verdict}"
        )
    return "\n".join(lines)


def to_records(checked: dict[str, list[Comparison]]) -> list[dict[str, Any]]:
    """Plain dictionaries of all comparisons, ready for JSON."""
    return [{"part": part, **asdict(row)} for part, rows in checked.items() for row in rows]
