"""Measure how much the points without a derivative matter in one real step of training.

    python experiments/studies/kinks.py RUN [--step-from start last] [--json FILE]

Loads a run (and builds its first state again), makes one optimiser step on the next batch and
counts which discrete states changed: signs, quads, depth order, cells, thresholds. Then it follows
the loss along the update and compares it with what the gradient predicts:

- *first order*: gradient times update;
- *along the path*: the gradient integrated over sixteen pieces of the update. This includes kinks
  and curvature; its difference from the true change is due to jumps, which no gradient shows.

The tables of the bundled scene are in docs/gradients.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.adapter import SPLATS_PER_FACE, FaceSplats
from geosplat_jax.core import capacity
from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Batch, Grid
from geosplat_jax.fit.config import Config, Stage
from geosplat_jax.fit.loop import start_keys
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.stages import (
    build_pipeline,
    initial_params,
    make_batch,
    pipeline_at,
    update_rule,
)
from geosplat_jax.fit.step import StepReport, TrainState, UpdateRule, initial_state, train_step
from geosplat_jax.geometry import FlexiCubes
from geosplat_jax.hashgrid import Layer, encode
from geosplat_jax.io.checkpoints import latest_checkpoint, load_checkpoint
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.losses import over_background, random_background
from geosplat_jax.materials import to_unit_cube
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Asset, Params
from geosplat_jax.run import Run
from geosplat_jax.splats.rasterize import MAX_ALPHA, MIN_ALPHA
from geosplat_jax.transport.bsdf import ROUGHNESS_FLOOR
from geosplat_jax.transport.environment import direction_to_uv, level_of_roughness
from geosplat_jax.transport.split_sum import SplitSum

SEGMENTS = 16
SHOWN = (1, 4, 16)
PER_QUAD = 4 * SPLATS_PER_FACE

GROUPS = {
    "everything": ("",),
    "SDF": (".geometry.sdf",),
    "deformation, weights": tuple(f".geometry.{n}" for n in ("deform", "alpha", "beta", "gamma")),
    "material": (".material",),
    "light, exposure": (".light", ".log_exposure"),
}


@dataclass(frozen=True)
class Row:
    """How often a discrete state changed.

    Attributes
    ----------
    name, unit : kind of point without a derivative, and what is counted.
    population : number of units.
    changed : number of units whose discrete state differs after the step.
    near : number of units that are as near to such a point, on either side, as they move in the
        step; None if not counted.
    """

    name: str
    unit: str
    population: int
    changed: int
    near: int | None


def _hidden_inputs(layers: tuple[Layer, ...], features: jax.Array) -> jax.Array:
    """Lay the inputs of all rectifiers of an MLP side by side."""
    inputs = []
    for layer in layers[:-1]:
        features = features @ layer.weights
        if layer.bias is not None:
            features = features + layer.bias[None, :]
        inputs.append(features)
        features = jax.nn.relu(features)
    return jnp.concatenate(inputs, axis=-1)


def _rectifier_inputs(params: Params, points: jax.Array, pipeline: Pipeline) -> jax.Array:
    """Evaluate the inputs of the rectifiers of every head at points of the unit cube."""
    material, spec = params.material, pipeline.fields.grid
    albedo_features = encode(material.albedo_table, points, spec=spec)
    surface_features = albedo_features
    if material.surface_table is not None:
        surface_features = encode(material.surface_table, points, spec=spec)
    heads = [_hidden_inputs(material.albedo_head, albedo_features)]
    heads.append(_hidden_inputs(material.surface_head, surface_features))
    if material.shift_head is not None:
        heads.append(_hidden_inputs(material.shift_head, surface_features))
    return jnp.concatenate(heads, axis=-1)


def _observe_view(asset: Asset, batch: Batch, view: int, pipeline: Pipeline) -> dict[str, Any]:
    """Evaluate the quantities that depend on one view."""
    camera, splats = batch.camera.view(view), asset.splats
    camera_offsets = camera.centers - splats.means
    footprints = pipeline.project(splats.means, splats.quats, splats.scales, camera)
    lists = pipeline.visible(splats, camera)
    view_directions = safe_normalize(camera_offsets)
    cosine = jnp.sum(splats.normals * view_directions, axis=-1)
    return {
        "outward": jnp.sum(splats.outward * camera_offsets, axis=-1),
        "cosine": cosine,
        "reflected": direction_to_uv(2 * cosine[:, None] * splats.normals - view_directions),
        "means2d": footprints.means2d,
        "conics": footprints.conics,
        "opacity": splats.opacities * footprints.compensation,
        "depths": footprints.depths,
        "index": lists.index,
        "chunk_ranks": lists.chunk_ranks,
        "chunk_tiles": lists.chunk_tiles,
    }


def _residual(rgb: jax.Array, alpha: jax.Array, batch: Batch, pipeline: Pipeline) -> jax.Array:
    """Subtract the composited photographs from the composited images, as the loss does."""
    kind, shape = pipeline.objective.background, (1, *rgb.shape[1:])
    backgrounds = []
    for number in range(rgb.shape[0]):
        # The first of the view's two keys, see `Pipeline.view_loss`.
        key = jax.random.split(batch.view(number).key)[0]
        backgrounds.append(random_background(key, shape, rgb.dtype, kind))
    backgrounds = jnp.concatenate(backgrounds)
    images = over_background(rgb, alpha, batch.image, backgrounds, batch.valid, srgb=False)
    return images.predicted - images.target


@jax.jit
def observe(pipeline: Pipeline, params: Params, batch: Batch) -> dict[str, Any]:
    """Evaluate all quantities whose discrete states are counted."""
    asset = pipeline.reconstruct(params)
    output = pipeline.render_views(asset, params.light, batch.camera)
    roughness = asset.attributes.materials.roughness
    points = to_unit_cube(asset.splats.anchors, pipeline.surface.box)
    levels = pipeline.transport.operators.spec.roughness
    rgb = tone_map(output.rgb, params.log_exposure)
    return {
        "points": points,
        "roughness": roughness,
        "level": level_of_roughness(roughness, levels=levels),
        "normal_uv": direction_to_uv(asset.splats.normals),
        "rectifiers": _rectifier_inputs(params, points, pipeline),
        "residual": _residual(rgb, output.alpha, batch, pipeline),
        "views": [_observe_view(asset, batch, v, pipeline) for v in range(batch.camera.count)],
        "usage": output.usage,
    }


_value_and_gradient = jax.jit(
    lambda pipeline, params, batch: jax.value_and_grad(pipeline.loss, has_aux=True)(params, batch)
)


def _near_border(position: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Whether an integer lies within ``step`` of ``position``, on either side."""
    return np.floor(position - np.abs(step)) != np.floor(position + np.abs(step))


def _crossing(name: str, unit: str, before: np.ndarray, after: np.ndarray) -> Row:
    """Count changes of sign of a quantity."""
    is_near = np.abs(before) <= np.abs(after - before)
    return Row(
        name, unit, before.size, int(np.sum((before < 0) != (after < 0))), int(is_near.sum())
    )


def _cells(name: str, unit: str, before: np.ndarray, after: np.ndarray) -> Row:
    """Count rows (n, axes) whose integer part changed along any axis."""
    has_changed = np.any(np.floor(before) != np.floor(after), axis=1)
    is_near = np.any(_near_border(before, after - before), axis=1)
    return Row(name, unit, len(before), int(has_changed.sum()), int(is_near.sum()))


def quad_keys(sdf: np.ndarray, grid: Grid) -> np.ndarray:
    """Return keys of the quads, in their order: grid edge and side, comparable between states."""
    nx, ny, nz = grid.shape
    inside = sdf.reshape(nz + 1, ny + 1, nx + 1) < 0
    lower = inside[:-1, :-1, :-1]
    k, j, i = np.indices((nz, ny, nx))
    inner = {0: i > 0, 1: j > 0, 2: k > 0}
    upper = (inside[:-1, :-1, 1:], inside[:-1, 1:, :-1], inside[1:, :-1, :-1])
    is_crossed = np.stack(
        [(lower != upper[a]) & inner[(a + 1) % 3] & inner[(a + 2) % 3] for a in range(3)],
        axis=-1,
    )
    owners = np.flatnonzero(is_crossed)
    return 2 * owners + lower.reshape(-1)[owners // 3]


def _surface_vertices(sdf: np.ndarray, grid: Grid) -> np.ndarray:
    """Return a flat mask of the grid vertices at the ends of crossed edges."""
    nx, ny, nz = grid.shape
    inside = sdf.reshape(nz + 1, ny + 1, nx + 1) < 0
    is_endpoint = np.zeros(inside.shape, bool)
    for axis in range(3):
        is_crossed = np.diff(inside, axis=axis)
        padding = [(0, 0)] * 3
        for side in ((1, 0), (0, 1)):
            padding[axis] = side
            is_endpoint |= np.pad(is_crossed, padding)
    return is_endpoint.reshape(-1)


def _hits(view: dict[str, np.ndarray], splat_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Tile and splat of every hit, tile by tile, front to back."""
    ranks = view["chunk_ranks"]
    tiles = np.repeat(view["chunk_tiles"], ranks.shape[0])
    ranks = ranks.T.reshape(-1)
    is_real = ranks < len(view["index"])
    rows = view["index"][ranks[is_real]]
    assert np.all(rows < splat_count)
    return tiles[is_real], rows


def _alpha(view: dict, rows: np.ndarray, tiles: np.ndarray, columns: int, size: int) -> np.ndarray:
    """Alpha before clamp and cut of splats in all pixels of tiles, (n, pixels)."""
    v, u = (x.reshape(-1) + 0.5 for x in np.indices((size, size)))
    x = (tiles % columns * size)[:, None] + u - view["means2d"][rows, 0, None]
    y = (tiles // columns * size)[:, None] + v - view["means2d"][rows, 1, None]
    xx, xy, yy = view["conics"][rows].T[:, :, None]
    sigma = 0.5 * (xx * x * x + yy * y * y) + xy * x * y
    return view["opacity"][rows, None] * np.exp(-sigma)


def _count_view(
    before: dict, after: dict, rows: tuple[np.ndarray, np.ndarray], config: Config, width: int
) -> list[Row]:
    """Count changes that depend on one view; ``rows`` are the splats that both states have."""
    old_rows, new_rows = rows
    partner = np.full(len(before["depths"]), -1)
    partner[old_rows] = new_rows
    lit = np.intersect1d(before["index"], old_rows)
    lit_partners = partner[lit]
    old_values, new_values = before["outward"][old_rows], after["outward"][new_rows]
    counts = [_crossing("back-face culling", "splats", old_values, new_values)]
    old_values, new_values = before["cosine"][lit], after["cosine"][lit_partners]
    counts.append(_crossing("flip of the shading normal", "visible splats", old_values, new_values))
    tiles, hit = _hits(before, len(partner))
    adjacent = (tiles[1:] == tiles[:-1]) & (partner[hit[1:]] >= 0) & (partner[hit[:-1]] >= 0)
    front, back = hit[:-1][adjacent], hit[1:][adjacent]
    gap = before["depths"][back] - before["depths"][front]
    gap_after = after["depths"][partner[back]] - after["depths"][partner[front]]
    counts.append(_crossing("depth order", "neighbours in a tile's list", gap, gap_after))
    is_swapped = (gap < 0) != (gap_after < 0)
    is_same_quad = (front // PER_QUAD == back // PER_QUAD)[is_swapped]
    counts.append(
        Row(
            "swapped within one quad",
            "swapped pairs",
            is_same_quad.size,
            int(is_same_quad.sum()),
            0,
        )
    )

    size = config.raster.tile_size
    columns = -(-width // size)
    inverse_partner = np.full(len(after["depths"]), -1)
    inverse_partner[new_rows] = old_rows
    later_hits = _hits(after, len(inverse_partner))
    pairs = [np.stack([tiles, hit])[:, partner[hit] >= 0]]
    pairs.append(
        np.stack([later_hits[0], inverse_partner[later_hits[1]]])[
            :, inverse_partner[later_hits[1]] >= 0
        ]
    )
    tiles, hit = np.unique(np.concatenate(pairs, axis=1), axis=1)
    old_values = _alpha(before, hit, tiles, columns, size)
    new_values = _alpha(after, partner[hit], tiles, columns, size)
    is_visible = (old_values >= MIN_ALPHA) | (new_values >= MIN_ALPHA)
    old_values, new_values = np.log(old_values[is_visible]), np.log(new_values[is_visible])
    for name, limit in (("alpha threshold 1/255", MIN_ALPHA), ("alpha clamp .999", MAX_ALPHA)):
        counts.append(
            _crossing(
                name, "(splat, pixel) pairs", old_values - np.log(limit), new_values - np.log(limit)
            )
        )
    texels = np.array([config.light.width, config.light.height])
    old_values = before["reflected"][lit] * texels - 0.5
    new_values = after["reflected"][lit_partners] * texels - 0.5
    counts.append(_cells("texel of the reflected view", "visible splats", old_values, new_values))
    old_values, new_values = (
        127 * np.abs(x)[:, None] for x in (before["cosine"][lit], after["cosine"][lit_partners])
    )
    counts.append(_cells("cell of the FG table in n.v", "visible splats", old_values, new_values))
    return counts


def _count_geometry(before: Params, after: Params, grid: Grid) -> list[Row]:
    """Count changes of SDF signs, quads and FlexiCubes weights."""
    old_sdf, new_sdf = (np.asarray(p.geometry.sdf) for p in (before, after))
    is_endpoint = _surface_vertices(old_sdf, grid)
    old_keys, new_keys = quad_keys(old_sdf, grid), quad_keys(new_sdf, grid)
    counts = [
        _crossing(
            "sign of the SDF", "ends of crossed edges", old_sdf[is_endpoint], new_sdf[is_endpoint]
        )
    ]
    died_count = len(np.setdiff1d(old_keys, new_keys))
    born_count = len(np.setdiff1d(new_keys, old_keys))
    counts.append(Row("quads that died", "quads", len(old_keys), died_count, None))
    counts.append(Row("quads that were born", "quads", len(old_keys), born_count, None))

    def weights(params: Params) -> np.ndarray:
        geometry = params.geometry
        weight_arrays = (geometry.alpha, geometry.beta, geometry.gamma)
        return np.concatenate([np.asarray(x).reshape(-1) for x in weight_arrays])

    old_weights, new_weights = weights(before), weights(after)
    zero_count = int(np.sum(old_weights == 0))
    counts.append(Row("raw weights at exactly 0", "weights", old_weights.size, zero_count, None))
    counts.append(
        _crossing(
            "sign of a raw weight",
            "weights",
            old_weights[old_weights != 0],
            new_weights[old_weights != 0],
        )
    )
    return counts


def _count_fields(
    old_state: dict, new_state: dict, rows: tuple[np.ndarray, ...], config: Config
) -> list[Row]:
    """Count changes that depend on splats, but on no view."""
    names = ("points", "rectifiers", "level", "roughness", "normal_uv")
    pair = {name: (old_state[name][rows[0]], new_state[name][rows[1]]) for name in names}
    counts = []
    for level, cells in enumerate(config.material.grid.resolutions):
        name = f"hash cell, level {level} ({cells})"
        counts.append(_cells(name, "splats", *(x * cells for x in pair["points"])))
    counts.append(_crossing("rectifiers of the heads", "(splat, unit) pairs", *pair["rectifiers"]))
    counts.append(_cells("level of roughness", "splats", *(x[:, None] for x in pair["level"])))
    excess = (x - ROUGHNESS_FLOOR for x in pair["roughness"])
    counts.append(_crossing("roughness floor .08", "splats", *excess))
    texels = np.array([config.light.width, config.light.height])
    texel_positions = (x * texels - 0.5 for x in pair["normal_uv"])
    counts.append(_cells("texel of the normal", "splats", *texel_positions))
    return counts


def count_changes(
    before: Params, after: Params, seen: list[dict], config: Config, grid: Grid, width: int
) -> list[Row]:
    """Count all kinds of points; ``seen`` holds the results of `observe` before and after."""
    rows = _count_geometry(before, after, grid)
    keys = [quad_keys(np.asarray(p.geometry.sdf), grid) for p in (before, after)]
    for key, state in zip(keys, seen, strict=True):
        assert len(key) == int(state["usage"]["quads"])
    _, *quads = np.intersect1d(*keys, assume_unique=True, return_indices=True)
    common_rows = tuple((q[:, None] * PER_QUAD + np.arange(PER_QUAD)).reshape(-1) for q in quads)
    views = [
        _count_view(a, b, common_rows, config, width)
        for a, b in zip(seen[0]["views"], seen[1]["views"], strict=True)
    ]
    for kind_rows in zip(*views, strict=True):
        sums = {n: sum(getattr(p, n) for p in kind_rows) for n in ("population", "changed", "near")}
        rows.append(replace(kind_rows[0], **sums))
    rows += _count_fields(seen[0], seen[1], common_rows, config)
    old_residual, new_residual = (state["residual"].reshape(-1) for state in seen)
    is_nonzero = (old_residual != 0) | (new_residual != 0)
    rows.append(
        _crossing(
            "sign of the L1 residual",
            "pixel channels",
            old_residual[is_nonzero],
            new_residual[is_nonzero],
        )
    )
    zero_count = int(np.sum(~is_nonzero))
    rows.append(
        Row("L1 residual at exactly 0", "pixel channels", old_residual.size, zero_count, None)
    )
    light = np.asarray(after.light.radiance)
    floor_count = int(np.sum(light <= np.float32(config.run.smallest_light)))
    rows.append(
        Row("texels put back to their floor", "texel channels", light.size, floor_count, None)
    )
    return rows


def _chosen(update: Params, prefixes: tuple[str, ...]) -> Params:
    """Keep the update of one group and set the others to zero."""

    def pick(path: Any, leaf: jax.Array) -> jax.Array:
        is_kept = jax.tree_util.keystr(path).startswith(prefixes)
        return leaf if is_kept else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(pick, update)


def _product(gradient: Params, update: Params) -> float:
    """Inner product of two sets of parameters, accumulated in double precision."""
    pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(update), strict=True)
    return float(sum(np.sum(np.asarray(a, np.float64) * np.asarray(b)) for a, b in pairs))


def _move(params: Params, update: Params, fraction: float) -> Params:
    """Add a fraction of the update to the parameters."""
    return jax.tree.map(lambda p, u: p + fraction * u, params, update)


def follow(
    params: Params, update: Params, evaluate: Callable[[Params], tuple[float, dict, Params]]
) -> list[dict[str, Any]]:
    """Compare the loss along the update of every group with predictions by gradients."""
    value, terms, gradient = evaluate(params)
    results = []
    for name, prefixes in GROUPS.items():
        group_update = _chosen(update, prefixes)
        slope, path = _product(gradient, group_update), 0.0
        for segment in range(SEGMENTS):
            # The gradient is taken in the middle of a piece, so that a path may start on a kink.
            moved_params = _move(params, group_update, (segment + 0.5) / SEGMENTS)
            path += _product(evaluate(moved_params)[2], group_update) / SEGMENTS
            fraction = (segment + 1) / SEGMENTS
            if segment + 1 not in SHOWN:
                continue
            moved_value, last_terms, _ = evaluate(_move(params, group_update, fraction))
            results.append(
                {
                    "group": name,
                    "fraction": fraction,
                    "change": moved_value - value,
                    "first_order": fraction * slope,
                    "path": path,
                    "jumps": moved_value - value - path,
                }
            )
        results[-1]["terms"] = {key: last_terms[key] - terms[key] for key in terms}
    return results


def _first_state(dataset: Dataset, config: Config) -> tuple[FlexiCubes, TrainState]:
    """Build the surface and the state before the first step, as training does."""
    shape_key, field_key = start_keys(config)
    surface, shape = config.geometry.start(dataset, shape_key)
    assert isinstance(surface, FlexiCubes)
    return surface, initial_state(initial_params(shape, config, field_key))


def _last_state(run: Run) -> TrainState:
    """Read parameters and optimiser state from the last checkpoint."""
    path = latest_checkpoint(run.folder.checkpoints)
    assert path is not None
    template = {
        "state": jax.eval_shape(lambda: initial_state(run.params)),
        "surface": jax.eval_shape(lambda: run.pipeline.surface),
    }
    return load_checkpoint(path, like=template)[0]["state"]


def _advance(
    state: TrainState, batch: Batch, pipeline: Pipeline, rule: UpdateRule
) -> tuple[TrainState, StepReport, Pipeline]:
    """Make a step, growing buffers as needed."""

    def attempt(capacities: Capacities) -> tuple[tuple[TrainState, StepReport], Usage]:
        state_copy = jax.tree.map(jnp.copy, state)  # the step consumes it
        resized_pipeline = replace(pipeline, capacities=capacities)
        next_state, report = train_step(state_copy, batch, resized_pipeline, rule)
        return (next_state, report), report.loss.usage

    (next_state, report), capacities = capacity.retry(attempt, pipeline.capacities)
    return next_state, report, replace(pipeline, capacities=capacities)


def study(
    state: TrainState, dataset: Dataset, config: Config, stage: Stage, pipeline: Pipeline
) -> dict[str, Any]:
    """Make one step from ``state``, count changes, and follow the loss."""
    step = int(state.step)
    stage_step = step - config.first_step(stage.name)
    pipeline = pipeline_at(pipeline, config, stage, stage_step)
    if not isinstance(pipeline.splats, FaceSplats):
        raise SystemExit(f"step {step} samples vertices; only face sampling is counted here")
    assert isinstance(pipeline.surface, FlexiCubes)
    batch = make_batch(dataset.train, step, stage, seed=config.run.seed)
    old_params = state.params
    rule = update_rule(config, stage, old_params, stage_step)
    next_state, report, pipeline = _advance(state, batch, pipeline, rule)
    new_params = next_state.params

    def look(params: Params) -> dict[str, Any]:
        observations = observe(pipeline, params, batch)
        assert bool(capacity.fits(observations["usage"], pipeline.capacities))
        return jax.device_get(observations)

    def evaluate(params: Params) -> tuple[float, dict[str, float], Params]:
        (total, loss_report), gradient = _value_and_gradient(pipeline, params, batch)
        assert bool(capacity.fits(loss_report.usage, pipeline.capacities))
        terms = {
            n: float(pipeline.weights[n]) * float(value) for n, value in loss_report.terms.items()
        }
        return float(total), terms, gradient

    observations = [look(old_params), look(new_params)]
    grid = pipeline.surface.grid
    rows = count_changes(old_params, new_params, observations, config, grid, batch.camera.width)
    update = jax.tree.map(jnp.subtract, new_params, old_params)
    return {
        "step": step,
        "loss": float(report.total),
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(old_params)),
        "parameters_moved": sum(int(jnp.sum(leaf != 0)) for leaf in jax.tree.leaves(update)),
        "counts": [vars(row) for row in rows],
        "along": follow(old_params, update, evaluate),
    }


def show(result: dict[str, Any]) -> None:
    """Print both tables of one step."""
    print(
        f"\nstep {result['step']}: loss {result['loss']:.6f}, {result['parameters']} parameters, "
        f"{result['parameters_moved']} of them moved"
    )
    print(f"{'point':<34} {'of':<28} {'number':>9} {'changed':>9} {'share':>8} {'near':>8}")
    for row in result["counts"]:
        size = max(row["population"], 1)
        near_share = "" if row["near"] is None else f"{row['near'] / size:8.3%}"
        print(
            f"{row['name']:<34} {row['unit']:<28} {row['population']:>9} {row['changed']:>9} "
            f"{row['changed'] / size:8.3%} {near_share:>8}"
        )
    print(
        f"\n{'update of':<22} {'fraction':>8} {'change':>11} {'first order':>11} {'path':>11} "
        f"{'jumps':>11} {'change / first order':>21}"
    )
    for row in result["along"]:
        ratio = row["change"] / row["first_order"] if row["first_order"] else float("nan")
        print(
            f"{row['group']:<22} {row['fraction']:8.4f} {row['change']:11.3e} "
            f"{row['first_order']:11.3e} {row['path']:11.3e} {row['jumps']:11.3e} {ratio:21.3f}"
        )
        if "terms" in row:
            term_changes = ", ".join(f"{n} {v:+.1e}" for n, v in row["terms"].items() if v)
            print(f"    by term: {term_changes}")


def main() -> None:
    """Study the chosen states of a run, and print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument(
        "--step-from", nargs="+", choices=("start", "last"), default=["start", "last"]
    )
    parser.add_argument("--scene", type=Path, help="where the scene lies now, if it was moved")
    parser.add_argument("--json", type=Path, help="default: kinks.json in the run")
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()

    run = Run(arguments.run, scene=arguments.scene)
    config, last_stage = run.config, run.trained.stage
    if not isinstance(run.pipeline.transport, SplitSum):
        parser.error(
            f"{arguments.run} ended in {last_stage.name}; train it without that stage's steps"
        )
    results = {}
    for state_name in arguments.step_from:
        if state_name == "start":
            stage = config.active_stages[0]
            surface, state = _first_state(run.dataset, config)
            pipeline = build_pipeline(config, stage, surface)
            pipeline = replace(pipeline, capacities=run.pipeline.capacities)
        else:
            stage, pipeline, state = last_stage, run.pipeline, _last_state(run)
        results[state_name] = study(state, run.dataset, config, stage, pipeline)
        show(results[state_name])
    path = arguments.json or arguments.run / "kinks.json"
    path.write_text(json.dumps(results, indent=1) + "\n")
    print(f"\nfigures: {path}")


if __name__ == "__main__":
    main()
