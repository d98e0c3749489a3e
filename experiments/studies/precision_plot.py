"""Measures of experiments/studies/precision.py, and its figure."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax import hashgrid
from geosplat_jax.core.types import Camera
from geosplat_jax.fit.config import Config
from geosplat_jax.gradcheck.differences import double_precision
from geosplat_jax.hashgrid import HashGridSpec, encode
from geosplat_jax.io.views import Views
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.report.metrics import normal_mae_deg, psnr
from geosplat_jax.report.renderer import Renderer, photograph_on_white, render_on_white
from geosplat_jax.splats.projection import Footprints
from geosplat_jax.splats.rasterize import MAX_ALPHA, MIN_ALPHA, TileLists

GROUPS = ("geometry", "tables", "heads", "light", "exposure")
UNDECIDED = 1e-4
"""Largest relative distance of an alpha from 1/255 at which the precisions may cut differently."""


def cast(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point leaves of a tree; keys and integers stay."""

    def convert(leaf: Any) -> Any:
        is_float = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
        return jnp.asarray(leaf, dtype) if is_float else leaf

    return jax.tree.map(convert, tree)


@dataclass
class Outcome:
    """Results of a run: losses, parameters at some steps (host), test renders, figures, time."""

    losses: list[float]
    snapshots: dict[int, Params]
    images: np.ndarray
    figures: dict[str, float]
    seconds_per_step: float


def group_of(path: tuple[Any, ...]) -> str:
    """Return the group, one of `GROUPS`, that a leaf of the parameters belongs to."""
    names = [str(getattr(key, "name", "")) for key in path]
    if names[0] == "material":
        return "tables" if names[1].endswith("_table") else "heads"
    return "exposure" if names[0] == "log_exposure" else names[0]


def errors(single: Any, double: Any) -> dict[str, float]:
    """Compare two trees of arrays, the second in double precision.

    Returns
    -------
    ``l2`` : relative L2 error.
    ``worst`` : largest error over the largest value.
    ``off``, ``sign`` : shares of entries, among those that are not zero in double precision, whose
        relative error exceeds 1e-3, and whose sign differs.
    ``spurious`` : share of entries that are zero in double precision only.
    """
    flat = [
        np.concatenate([np.ravel(np.asarray(x, np.float64)) for x in jax.tree.leaves(tree)])
        for tree in (single, double)
    ]
    a, b = flat
    error, size, is_nonzero = np.abs(a - b), np.abs(b), b != 0
    return {
        "l2": float(np.sqrt(np.sum(error**2) / max(np.sum(b**2), 1e-300))),
        "worst": float(np.max(error) / max(np.max(size), 1e-300)),
        "off": float(np.mean(error[is_nonzero] > 1e-3 * size[is_nonzero]))
        if is_nonzero.any()
        else 0.0,
        "sign": float(np.mean(np.sign(a[is_nonzero]) != np.sign(b[is_nonzero])))
        if is_nonzero.any()
        else 0.0,
        "spurious": float(np.mean((a != 0) & ~is_nonzero)),
    }


@dataclass(frozen=True)
class Stage:
    """A differentiable function of named groups with named outputs, and where to evaluate it."""

    name: str
    function: Callable[[Any, Any], dict[str, Any]]
    inputs: dict[str, Any]
    constants: Any = ()


def measure(stage: Stage) -> dict[str, Any]:
    """Return the errors of values and gradients in float32, on inputs shared by both precisions."""
    inputs, constants = cast((stage.inputs, stage.constants), np.float32)
    rng = np.random.default_rng(0)

    def cotangent(output: Any) -> Any:
        if output.ndim == 0:
            return np.float32(1)
        return np.float32(rng.standard_normal(output.shape))

    def run(inputs: Any, constants: Any, cotangents: Any) -> Any:
        values, pullback = jax.vjp(lambda x: stage.function(x, constants), inputs)
        return values, pullback(cotangents)[0]

    shapes = jax.eval_shape(stage.function, *cast((inputs, constants), np.float32))
    cotangents = jax.tree.map(cotangent, shapes)
    arguments = (inputs, constants, cotangents)
    single = jax.device_get(jax.jit(run)(*arguments))
    with double_precision():
        double = jax.device_get(jax.jit(run)(*cast(arguments, np.float64)))
    return {
        part: {
            **{name: errors(single_values[name], double_values[name]) for name in single_values},
            "all": max(
                (errors(single_values[n], double_values[n]) for n in single_values),
                key=lambda e: e["l2"],
            ),
        }
        for part, single_values, double_values in zip(
            ("values", "gradients"), single, double, strict=True
        )
    }


def raw_alphas(
    footprints: Footprints, opacities: Any, lists: TileLists, tile: int, width: int
) -> Any:
    """Compute alphas before cut and clamp in the pixels of each hit's tile, and those pixels."""
    is_real = lists.chunk_ranks < len(lists.index)
    ranks = np.where(is_real, lists.chunk_ranks, 0)
    columns = -(-width // tile)
    corner = tile * np.stack([lists.chunk_tiles % columns, lists.chunk_tiles // columns], -1)
    inside = np.stack(np.meshgrid(np.arange(tile), np.arange(tile)), -1).reshape(-1, 2) + 0.5
    pixels = np.broadcast_to(corner[:, None] + inside, (*ranks.shape, tile * tile, 2))
    offset = pixels - np.asarray(footprints.means2d)[ranks][:, :, None]
    dx, dy = offset[..., 0], offset[..., 1]
    xx, xy, yy = np.moveaxis(np.asarray(footprints.conics)[ranks][..., None], 2, 0)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alphas = (opacities * footprints.compensation)[ranks][..., None] * np.exp(-sigma)
    return alphas[is_real], pixels[is_real]


def undecided(got: dict, tile: int, camera: Camera) -> np.ndarray:
    """Mark the pixels in which some alpha lies within `UNDECIDED` of the cut, (H, W)."""
    alphas, pixels = raw_alphas(
        got["footprints"], got["opacities"], got["lists"], tile, camera.width
    )
    is_close = np.abs(alphas - MIN_ALPHA) < UNDECIDED * MIN_ALPHA
    mark = np.zeros((camera.height, camera.width), bool)
    x, y = pixels[is_close].astype(int).T
    inside = (x < camera.width) & (y < camera.height)
    mark[y[inside], x[inside]] = True
    return mark


def decisions(one: dict, shared: dict, two: dict, config: Config, camera: Camera) -> dict[str, Any]:
    """Count the discrete choices that differ between precisions; also return their totals."""
    single_lists, double_lists = one["lists"], two["lists"]
    count = int(two["splats"].count)
    rows = [lists.index[lists.index < count] for lists in (single_lists, double_lists)]
    rank = np.full(count, -1)
    rank[rows[0]] = np.arange(len(rows[0]))
    order = rank[rows[1]]
    hits = []
    for lists in (single_lists, double_lists):
        is_real = lists.chunk_ranks < len(lists.index)
        owner = lists.index[np.where(is_real, lists.chunk_ranks, 0)].astype(np.int64)
        hits.append((lists.chunk_tiles[None, :] * (count + 1) + owner)[is_real])
    tile = config.raster.tile_size
    a, b = (
        raw_alphas(x["footprints"], x["opacities"], double_lists, tile, camera.width)[0]
        for x in (shared, two)
    )
    cells = np.array(config.material.grid.resolutions, np.float32)
    corners = [np.floor(x["unit"][:count, None, :] * cells[None, :, None]) for x in (one, two)]
    active = [x["active"][:count] for x in (one, two)]
    return {
        "faces": (int(np.sum(one["mesh"].faces != two["mesh"].faces)), two["mesh"].faces.size),
        "visible splats": (len(np.setxor1d(*rows)), len(rows[1])),
        "neighbours in depth": (int(np.sum(np.diff(order[order >= 0]) < 0)), len(rows[1])),
        "tile hits": (len(np.setxor1d(*hits)), len(hits[1])),
        "alpha cuts": (int(np.sum((a >= MIN_ALPHA) != (b >= MIN_ALPHA))), a.size),
        "undecided pixels": (int(np.sum(undecided(two, tile, camera))), two["alpha"].size),
        "alpha clamps": (int(np.sum((a < MAX_ALPHA) != (b < MAX_ALPHA))), a.size),
        "hash cells": (int(np.sum(np.any(corners[0] != corners[1], -1))), corners[0][..., 0].size),
        "ReLUs": (int(np.sum(active[0] != active[1])), active[0].size),
    }


def accumulated(one: dict, shared: dict, two: dict) -> dict[str, Any]:
    """Return the errors of every intermediate of the chain in float32.

    ``shared`` is the chain in float32 with the tile lists of double precision, for values that
    depend on the order of splats; ``one`` has its own lists.
    """
    quantities = {
        "vertices": (one, lambda x: x["mesh"].vertices),
        "vertex normals": (one, lambda x: x["vertex normals"]),
        "splat means": (one, lambda x: x["splats"].means),
        "splat quats": (one, lambda x: x["splats"].quats),
        "splat scales": (one, lambda x: x["splats"].scales),
        "hash features": (one, lambda x: x["encoded"]),
        "materials": (one, lambda x: x["materials"]),
        "light levels": (one, lambda x: x["light"].specular),
        "splat colours": (shared, lambda x: x["colours"]),
        "means2d": (shared, lambda x: x["footprints"].means2d),
        "conics": (shared, lambda x: x["footprints"].conics[x["lists"].index < len(x["shift"])]),
        "image, same lists": (shared, lambda x: x["image"]),
        "image, own lists": (one, lambda x: x["image"]),
        "alpha, own lists": (one, lambda x: x["alpha"]),
    }
    return {name: errors(select(run), select(two)) for name, (run, select) in quantities.items()}


def snapshot_steps(steps: int) -> list[int]:
    """List the steps after which parameters are compared, dense at first."""
    ladder = (0, 1, 2, 3, 5, 8, 12, 20, 30, 45, 65, 90, 120, 160, 200, 260, 350)
    return sorted({k for k in ladder if k < steps} | {steps})


def drift(one: dict[int, Params], other: dict[int, Params]) -> dict[str, list[float]]:
    """Return the distance between two runs over the distance that the second has travelled.

    By group, for every common step after the first; also the steps.
    """
    steps = sorted(set(one) & set(other) - {0})
    curves: dict[str, list[float]] = {"step": steps}
    for step in steps:
        squared_distances, squared_travel = dict.fromkeys(GROUPS, 0.0), dict.fromkeys(GROUPS, 0.0)
        leaves = (
            jax.tree_util.tree_leaves_with_path(t) for t in (one[step], other[step], other[0])
        )
        for (path, a), (_, b), (_, origin) in zip(*leaves, strict=True):
            group = group_of(path)
            a, b, origin = (np.asarray(x, np.float64) for x in (a, b, origin))
            squared_distances[group] += float(np.sum((a - b) ** 2))
            squared_travel[group] += float(np.sum((b - origin) ** 2))
        for group in GROUPS:
            distance = np.sqrt(squared_distances[group] / max(squared_travel[group], 1e-300))
            curves.setdefault(group, []).append(float(distance))
    return curves


def compare_runs(outcome: Outcome, reference: Outcome) -> dict[str, Any]:
    """Figures of a run, and its distance from the reference."""
    a, b = np.array(outcome.losses), np.array(reference.losses)
    error = np.mean((outcome.images - reference.images) ** 2)
    return {
        **outcome.figures,
        "final_loss": float(np.mean(a[-20:])),
        "loss_distance": float(np.mean(np.abs(a - b)) / np.mean(b)),
        "first_step_above_1e-3": int(np.argmax(np.abs(a - b) > 1e-3 * b))
        if np.any(np.abs(a - b) > 1e-3 * b)
        else -1,
        "renders_psnr": float(-10 * np.log10(error)) if error > 0 else float("inf"),
        "seconds_per_step": outcome.seconds_per_step,
        "losses": outcome.losses,
        "drift": drift(outcome.snapshots, reference.snapshots),
    }


def held_out(
    params: Params, pipeline: Pipeline, test: Views
) -> tuple[np.ndarray, dict[str, float]]:
    """Render test views in float32 from the parameters as stored; PSNR and normal error."""
    renderer = Renderer(pipeline, params)
    images, scores, angles = [], [], []
    for index in range(len(test)):
        view, image = renderer(test.camera(np.array([index]))), test.images[index]
        truth, picture = photograph_on_white(image), render_on_white(view.rgb, view.alpha)
        images.append(picture)
        scores.append(float(psnr(picture, truth)))
        if "normal" in test.truth:
            normal = test.truth["normal"][index]
            angles.append(float(normal_mae_deg(view.aovs["normal"], normal, image[..., 3])))
    figures = {"psnr": float(np.mean(scores))}
    if angles:
        figures["normal_deg"] = float(np.mean(angles))
    return np.stack(images), figures


def half_times(points: Any, spec: HashGridSpec, repeats: int = 21) -> dict[str, Any]:
    """Time encoding and its table gradient with float32 and bfloat16 tables, interleaved."""
    table = jax.random.normal(jax.random.key(0), (spec.total_entries, spec.features))
    points = jnp.asarray(points, jnp.float32)
    cotangents = jax.random.normal(jax.random.key(1), (len(points), spec.levels, spec.features))
    chunk_size = 8192

    def gradient(points: Any, cotangents: Any, dtype: Any) -> jax.Array:
        def step(total: Any, block: Any) -> Any:
            cells = hashgrid._locate(block[0], spec)
            return hashgrid._scatter_rows(total, cast(cells, dtype), block[1].astype(dtype)), None

        count = len(points) // chunk_size * chunk_size
        blocks = [x[:count].reshape(-1, chunk_size, *x.shape[1:]) for x in (points, cotangents)]
        return jax.lax.scan(step, jnp.zeros(table.shape, dtype), tuple(blocks))[0]

    half_table = table.astype(jnp.bfloat16)
    forward = jax.jit(partial(encode, spec=spec))
    backward = jax.jit(gradient, static_argnames="dtype")
    jobs = {
        "forward, float32": lambda: forward(table, points),
        "forward, bfloat16 table": lambda: forward(half_table, points),
        "table gradient, float32": lambda: backward(points, cotangents, jnp.float32),
        "table gradient, bfloat16": lambda: backward(points, cotangents, jnp.bfloat16),
    }
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats + 1):
        for name, job in jobs.items():
            began = time.perf_counter()
            jax.block_until_ready(job())
            times[name].append(1e3 * (time.perf_counter() - began))
    summed_gradients = [
        np.asarray(backward(points, cotangents, d), np.float64) for d in (jnp.bfloat16, jnp.float32)
    ]
    return {
        "points": len(points),
        "table_mb": table.size * 4 / 2**20,
        "milliseconds": {name: float(np.median(t[1:])) for name, t in times.items()},
        "gradient summed in bfloat16": errors(*summed_gradients)["l2"],
    }


def draw_errors(axis: Any, stages: dict[str, Any]) -> None:
    """Bars of the relative L2 error of values and gradients, a pair per stage."""
    names = [name for name in stages if not name.startswith("-")]
    positions = np.arange(len(names))
    for shift, part, colour in ((-0.2, "values", "#4c72b0"), (0.2, "gradients", "#dd8452")):
        sizes = [max(stages[name][part]["all"]["l2"], 1e-9) for name in names]
        axis.barh(positions + shift, sizes, height=0.4, color=colour, label=part)
    axis.axvline(float(np.finfo(np.float32).eps) / 2, color="grey", linewidth=0.8, linestyle=":")
    axis.set_yticks(positions, names)
    axis.invert_yaxis()
    axis.set(xscale="log", xlim=(2e-9, 1e-3), xlabel="relative L2 error, float32 against float64")
    axis.set_title("Each stage on the same inputs", fontsize=10)
    axis.legend(loc="upper right", fontsize=8)


def draw_drift(axis: Any, runs: dict[str, Any], shown: dict[str, tuple[str, str]]) -> None:
    """Draw the drift of the geometry from the float64 run, or from float32 for the nudged run."""
    for name, (colour, style) in shown.items():
        is_nudged = "rounding" in name
        curve = (runs[name]["from float32"] if is_nudged else runs[name])["drift"]
        label = "one rounding off, from float32" if is_nudged else name
        axis.plot(curve["step"], curve["geometry"], style, color=colour, label=label, linewidth=1.4)
    axis.set(xscale="log", yscale="log", xlabel="training step", ylim=(2e-7, 2))
    axis.set_ylabel("distance / distance travelled")
    axis.set_title("Geometry: apart from the float64 run", fontsize=10)
    axis.legend(loc="lower right", fontsize=8)


def draw_quality(axis: Any, runs: dict[str, Any]) -> None:
    """Draw the held-out PSNR of every run."""
    names = list(runs)
    values = [runs[name]["psnr"] for name in names]
    axis.plot(values, names, "o", color="#4c72b0", markersize=5)
    seeds = [runs[name]["psnr"] for name in names if "seed" in name] + [runs["float32"]["psnr"]]
    axis.axvspan(min(seeds), max(seeds), color="grey", alpha=0.2)
    axis.invert_yaxis()
    axis.set(xlabel="held-out PSNR, dB", xlim=(min(values) - 0.2, max(values) + 0.2))
    axis.set_title("Quality at the end (grey: three seeds)", fontsize=10)


def save(path: Path, record: Any) -> None:
    """Write a record."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1) + "\n")


def figure(folder: Path, path: Path) -> None:
    """Draw the records of a study."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    stages = json.loads((folder / "stages.json").read_text())["stages"]
    runs = json.loads((folder / "train.json").read_text())
    styles = {
        "another seed": ("#7f7f7f", "-"),
        "bfloat16: everything": ("#c44e52", "-"),
        "bfloat16: light": ("#dd8452", "-"),
        "float32": ("#4c72b0", "-"),
        "first SDF one rounding off": ("#55a868", "--"),
    }
    plot, axes = plt.subplots(1, 3, figsize=(13, 4.6), width_ratios=(1.1, 1, 0.8))
    draw_errors(axes[0], stages)
    draw_drift(axes[1], runs, styles)
    draw_quality(axes[2], runs)
    plot.tight_layout()
    plot.savefig(path, dpi=95)
    plt.close(plot)
