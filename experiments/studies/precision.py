"""Measure the errors of float32 against float64, and the effects of bfloat16 (docs/numerics.md).

``stages RUN`` measures every stage on a trained run, ``train SCENE`` measures whole training runs,
``plot`` draws the figure from the results of both in ``--output``.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import precision_plot as measures
from precision_plot import GROUPS, Outcome, Stage, cast, errors, save

from geosplat_jax.adapter import FaceSplats, face_splats, shift_inwards
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Batch, Camera, EnvLight, Materials, Mesh
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.loop import start_keys
from geosplat_jax.fit.planning import plan_capacities
from geosplat_jax.fit.presets import SPLIT_SUM, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.stages import (
    build_pipeline,
    initial_params,
    make_batch,
    pipeline_at,
    update_rule,
)
from geosplat_jax.fit.step import StepReport, initial_state, train_step
from geosplat_jax.gradcheck.differences import double_precision
from geosplat_jax.gradcheck.whole_parts import _from_groups, _groups
from geosplat_jax.hashgrid import HashGridSpec, Layer, encode
from geosplat_jax.io.dataset import Dataset, load_dataset
from geosplat_jax.io.images import encode_srgb
from geosplat_jax.losses import (
    image_dissimilarity,
    image_l1,
    light_error,
    mask_error,
    over_background,
)
from geosplat_jax.materials import (
    ROUGHNESS_MINIMUM,
    MaterialField,
    MaterialSpec,
    smoothness,
    to_unit_cube,
)
from geosplat_jax.pipeline import LossReport, Pipeline
from geosplat_jax.render import Params
from geosplat_jax.run import Run
from geosplat_jax.splats.rasterize import TileLists, composite
from geosplat_jax.surface.grids import sdf_entropy
from geosplat_jax.transport.environment import prefilter
from geosplat_jax.transport.split_sum import SplitSum, split_sum

STORED = (
    "hash tables",
    "MLP weights",
    "MLP activations",
    "light texels",
    "prefiltered light",
    "splat colours",
    "conics",
    "means2d",
    "SDF",
)


def to_bfloat16(x: jax.Array) -> jax.Array:
    """Round values to bfloat16 but keep the dtype; the gradient is that of the identity."""
    rounded = jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=7)
    return x + jax.lax.stop_gradient(rounded - x)


@dataclass(frozen=True)
class Variant:
    """One training run: precision, seed, and groups that the forward pass rounds to bfloat16.

    ``nudged`` : whether the first SDF values are changed by one rounding step.
    """

    name: str
    dtype: str = "float32"
    seed: int = 0
    nudged: bool = False
    rounded: tuple[str, ...] = ()


def flags_of(variant: Variant) -> dict[str, jax.Array]:
    """Return, for each group, whether a variant rounds it."""
    return {name: jnp.asarray(name in variant.rounded) for name in GROUPS}


VARIANTS = (
    Variant("float64", "float64"),
    Variant("float32"),
    Variant("first SDF one rounding off", nudged=True),
    Variant("another seed", seed=1),
    Variant("a third seed", seed=2),
    Variant("bfloat16: tables", rounded=("tables",)),
    Variant("bfloat16: tables, MLPs", rounded=("tables", "heads")),
    Variant("bfloat16: light", rounded=("light",)),
    Variant("bfloat16: geometry", rounded=("geometry",)),
    Variant("bfloat16: everything", rounded=GROUPS),
)


def rounded_where(params: Params, is_rounded: dict[str, jax.Array]) -> Params:
    """Round the chosen groups to bfloat16 with a straight-through gradient."""

    def leaf(path: tuple[Any, ...], x: jax.Array) -> jax.Array:
        return jnp.where(is_rounded[measures.group_of(path)], to_bfloat16(x), x)

    return jax.tree_util.tree_map_with_path(leaf, params)


class RoundedPipeline(Pipeline):
    """A pipeline whose loss sees some groups of the parameters rounded to bfloat16.

    Attributes
    ----------
    is_rounded : by group; traced, so that all variants share a program.
    """

    is_rounded: dict[str, jax.Array] = eqx.field(default_factory=dict)

    def loss(self, params: Params, batch: Batch) -> tuple[jax.Array, LossReport]:
        """Evaluate the loss at the rounded parameters."""
        return super().loss(rounded_where(params, self.is_rounded), batch)


def start(dataset: Dataset, config: Config, variant: Variant) -> tuple[Params, RoundedPipeline]:
    """Build parameters and pipeline as `train.fit` does."""
    shape_key, field_key = start_keys(config)
    surface, shape = config.geometry.start(dataset, shape_key)
    params = initial_params(shape, config, field_key)
    if variant.nudged:
        sdf = jnp.nextafter(params.geometry.sdf, jnp.inf)
        params = replace(params, geometry=replace(params.geometry, sdf=sdf))
    base_pipeline = build_pipeline(config, config.stage(SPLIT_SUM), surface)
    field_values = {f.name: getattr(base_pipeline, f.name) for f in fields(base_pipeline)}
    return params, RoundedPipeline(**field_values, is_rounded=flags_of(variant))


def run_variant(
    variant: Variant, dataset: Dataset, config: Config, capacities: Capacities
) -> tuple[list[float], dict[int, Params], float]:
    """Train one variant; return losses, snapshots and the median seconds of a step."""
    config = replace(config, run=replace(config.run, seed=variant.seed))
    stage = config.stage(SPLIT_SUM)
    params, pipeline = start(dataset, config, variant)
    snapshot_steps, losses, seconds = set(measures.snapshot_steps(stage.steps)), [], []
    snapshots = {0: jax.device_get(params)}

    def train() -> None:
        state, buffer_sizes = initial_state(cast(params, variant.dtype)), capacities
        for step in range(stage.steps):
            batch = make_batch(dataset.train, step, stage, seed=config.run.seed)
            began = time.perf_counter()
            inputs = (
                batch,
                pipeline_at(pipeline, config, stage, step),
                update_rule(config, stage, params, step),
            )
            batch, step_pipeline, rule = cast(inputs, variant.dtype)

            def attempt(
                buffer_sizes: Capacities,
                batch: Batch = batch,
                step_pipeline: Any = step_pipeline,
                rule: Any = rule,
            ) -> tuple[StepReport, Usage]:
                nonlocal state
                resized_pipeline = replace(step_pipeline, capacities=buffer_sizes)
                state, report = train_step(state, batch, resized_pipeline, rule)
                return report, report.loss.usage

            report, buffer_sizes = capacity_module.retry(attempt, buffer_sizes)
            losses.append(float(report.total))
            seconds.append(time.perf_counter() - began)
            if step + 1 in snapshot_steps:
                snapshots[step + 1] = jax.device_get(state.params)

    if variant.dtype == "float64":
        with double_precision():
            train()
    else:
        train()
    return losses, snapshots, float(np.median(seconds))


def train_command(arguments: argparse.Namespace) -> None:
    """Train the variants, and compare each with the first, which is in float64."""
    overrides = (f"stages.{SPLIT_SUM}.steps={arguments.steps}", *arguments.set)
    config = make_config("default", arguments.quality, overrides=overrides)
    dataset = load_dataset(arguments.scene)
    params, pipeline = start(dataset, config, Variant("float32"))
    capacities = plan_capacities(
        pipeline, params, dataset.train.camera(), limits=config.geometry.limits
    )
    capacities = Capacities(
        **{k: capacity_module.bucket(int(1.15 * v)) for k, v in capacities.items()}
    )
    pipeline = replace(pipeline, capacities=capacities)
    outcomes, records = {}, {}
    for variant in VARIANTS[: arguments.variants]:
        result = run_variant(variant, dataset, config, capacities)
        losses, snapshots, seconds = result
        final = rounded_where(cast(snapshots[max(snapshots)], np.float32), flags_of(variant))
        images, figures = measures.held_out(final, pipeline, dataset.test)
        outcome = Outcome(losses, snapshots, images, figures, seconds)
        outcomes[variant.name] = outcome
        reference = next(iter(outcomes.values()))
        record = records[variant.name] = measures.compare_runs(outcome, reference)
        if "float32" in outcomes:
            record["from float32"] = measures.compare_runs(outcome, outcomes["float32"])
        print(
            f"{variant.name:28s} {record['psnr']:7.3f} dB  "
            f"{record.get('normal_deg', float('nan')):6.3f} deg  "
            f"loss {record['final_loss']:.5f}  curve {record['loss_distance']:.1e}  "
            f"renders {record['renders_psnr']:6.2f} dB  "
            f"geometry {record['drift']['geometry'][-1]:.1e}  "
            f"tables {record['drift']['tables'][-1]:.1e}  {seconds:.2f} s/step",
            flush=True,
        )
        save(arguments.output / "train.json", records)


Store = Callable[[str, jax.Array], jax.Array]


def exact(name: str, x: jax.Array) -> jax.Array:
    """Store a value as it is."""
    return x


def heads(field: MaterialField, features: jax.Array, spec: MaterialSpec, store: Store):
    """Evaluate `materials.attributes_at` behind the encoding, with every activation stored."""
    active = []

    def affine(layer: Layer, x: jax.Array) -> jax.Array:
        x = x @ layer.weights
        return x if layer.bias is None else x + layer.bias[None, :]

    def apply(layers: tuple[Layer, ...], x: jax.Array) -> jax.Array:
        layers = jax.tree.map(lambda w: store("MLP weights", w), layers)
        for layer in layers[:-1]:
            x = store("MLP activations", jax.nn.relu(affine(layer, x)))
            active.append(x > 0)
        return affine(layers[-1], x)

    surface = apply(field.surface_head, features)
    logits = jnp.stack(
        [surface[:, 0] + spec.initial_roughness_logit, surface[:, 1] + spec.initial_metallic_logit]
    )
    roughness, metallic = jax.nn.sigmoid(logits)
    albedo = jax.nn.sigmoid(apply(field.albedo_head, features))
    shift = jax.nn.sigmoid(apply(field.shift_head, features)[:, 0])
    scaled = roughness * (1 - ROUGHNESS_MINIMUM) + ROUGHNESS_MINIMUM
    return Materials(albedo, scaled, metallic), shift, jnp.concatenate(active, axis=1)


def chain(
    params: Params,
    camera: Camera,
    pipeline: Pipeline,
    *,
    lists: TileLists | None = None,
    store: Store = exact,
) -> dict[str, Any]:
    """Render one view, with every intermediate by name; `stages_command` compares with `render`."""
    spec, box = pipeline.fields, pipeline.surface.box
    assert isinstance(pipeline.transport, SplitSum)
    assert isinstance(pipeline.splats, FaceSplats)
    geometry = replace(params.geometry, sdf=store("SDF", params.geometry.sdf))
    surface = pipeline.surface.extract(geometry, capacities=pipeline.capacities)
    mesh, normals = surface.mesh, vertex_normals(surface.mesh)
    splats = face_splats(mesh, normals, constants=pipeline.splats.constants, unit=box.half_extent)
    unit = to_unit_cube(jax.lax.stop_gradient(splats.anchors), box)
    table = store("hash tables", params.material.albedo_table)
    encoded = store("MLP activations", encode(table, unit, spec=spec.grid))
    materials, shift, active = heads(params.material, encoded, spec, store)
    shifted_splats = shift_inwards(splats, mesh, shift)
    if lists is None:
        lists = pipeline.visible(shifted_splats, camera)
    gather = lists.gather
    light = EnvLight(store("light texels", params.light.radiance))
    light = prefilter(light, pipeline.transport.operators)
    light = replace(light, specular=store("prefiltered light", light.specular))
    means, lit = gather(shifted_splats.means), jax.tree.map(gather, materials)
    view = safe_normalize(camera.centers - means)
    shaded = split_sum(
        lit, gather(shifted_splats.normals), view, light, pipeline.transport.fg_table
    )
    splat_inputs = {"means": means, "quats": gather(shifted_splats.quats)}
    splat_inputs["scales"] = gather(shifted_splats.scales)
    footprints = pipeline.project(**splat_inputs, camera=camera)
    footprints = replace(
        footprints,
        means2d=store("means2d", footprints.means2d),
        conics=store("conics", footprints.conics),
    )
    colours = store("splat colours", shaded.rgb)
    opacities = gather(shifted_splats.opacities)
    features = jnp.concatenate([colours, shaded.diffuse_light, shaded.specular], axis=1)
    image, alpha = composite(
        footprints,
        opacities,
        features,
        lists,
        height=camera.height,
        width=camera.width,
        tile_size=pipeline.raster.tile_size,
    )
    intermediates = {"mesh": mesh, "vertex normals": normals, "splats": splats, "unit": unit}
    intermediates |= {"encoded": encoded, "active": active, "materials": materials, "shift": shift}
    intermediates |= {
        "lists": lists,
        "light": light,
        "lit": lit,
        "seen normals": gather(shifted_splats.normals),
    }
    intermediates |= {"view": view, "colours": colours, "splat inputs": splat_inputs}
    intermediates |= {"footprints": footprints, "opacities": opacities}
    return intermediates | {"image": image[..., :3], "lights": image[..., 3:], "alpha": alpha}


def surface_stages(params: Params, pipeline: Pipeline, got: dict[str, Any]) -> list[Stage]:
    """Stages from the isosurface to the splats."""
    geometry = {"geometry": params.geometry}

    def extract(x: Any, pipeline: Pipeline) -> Any:
        return pipeline.surface.extract(x["geometry"], capacities=pipeline.capacities)

    def surface(x: Any, pipeline: Pipeline) -> dict[str, Any]:
        return {"vertices": extract(x, pipeline).mesh.vertices}

    def deviation(x: Any, pipeline: Pipeline) -> dict[str, Any]:
        return {"L_dev": extract(x, pipeline).deviation}

    def normals(x: Any, mesh: Mesh) -> dict[str, Any]:
        return {"normals": vertex_normals(replace(mesh, vertices=x["vertices"]))}

    def adapter(x: Any, constants: Any) -> dict[str, Any]:
        mesh, pipeline = constants
        splats = face_splats(
            replace(mesh, vertices=x["vertices"]),
            x["normals"],
            constants=pipeline.splats.constants,
            unit=pipeline.surface.box.half_extent,
        )
        return {name: getattr(splats, name) for name in ("means", "quats", "scales", "normals")}

    mesh, vertices = got["mesh"], {"vertices": got["mesh"].vertices}
    adapter_inputs = {**vertices, "normals": got["vertex normals"]}
    return [
        Stage("isosurface", surface, geometry, pipeline),
        Stage("L_dev", deviation, geometry, pipeline),
        Stage("vertex normals", normals, vertices, mesh),
        Stage("adapter", adapter, adapter_inputs, (mesh, pipeline)),
    ]


def shading_stages(params: Params, pipeline: Pipeline, got: dict[str, Any]) -> list[Stage]:
    """Stages of materials and light."""
    spec, field = pipeline.fields, params.material
    assert isinstance(pipeline.transport, SplitSum)

    def hash_grid(x: Any, unit: Any) -> dict[str, Any]:
        return {"features": encode(x["tables"], unit, spec=spec.grid)}

    def mlps(x: Any, constants: Any) -> dict[str, Any]:
        materials, shift, _ = heads(x["heads"], x["features"], spec, exact)
        return {"materials": materials, "shift": shift}

    def light(x: Any, operators: Any) -> dict[str, Any]:
        return {"levels": prefilter(EnvLight(x["light"]), operators).specular}

    def shade(x: Any, table: Any) -> dict[str, Any]:
        prefiltered = replace(got["light"], specular=x["levels"])
        shaded = split_sum(x["materials"], x["normals"], x["view"], prefiltered, table)
        return {"rgb": shaded.rgb}

    shade_inputs = {"materials": got["lit"], "normals": got["seen normals"], "view": got["view"]}
    shade_inputs["levels"] = got["light"].specular
    head_params = replace(field, albedo_table=None)
    return [
        Stage("hash grid", hash_grid, {"tables": field.albedo_table}, got["unit"]),
        Stage("MLPs", mlps, {"heads": head_params, "features": got["encoded"]}),
        Stage("prefilter", light, {"light": params.light.radiance}, pipeline.transport.operators),
        Stage("split sum", shade, shade_inputs, pipeline.transport.fg_table),
    ]


def image_stages(camera: Camera, pipeline: Pipeline, got: dict[str, Any]) -> list[Stage]:
    """Return the stages of footprints and images; both precisions rasterise the same lists."""
    footprint_fields = ("means2d", "conics", "compensation", "depths")
    tile_size = pipeline.raster.tile_size

    def projection(x: Any, constants: Any) -> dict[str, Any]:
        camera, pipeline = constants
        footprints = pipeline.project(**x, camera=camera)
        return {name: getattr(footprints, name) for name in footprint_fields}

    def rasteriser(x: Any, constants: Any) -> dict[str, Any]:
        footprints, lists, pixel_mask = constants
        footprints = replace(footprints, **{name: x[name] for name in footprint_fields[:3]})
        image, alpha = composite(
            footprints,
            x["opacities"],
            x["colours"],
            lists,
            height=camera.height,
            width=camera.width,
            tile_size=tile_size,
        )
        return {"image": pixel_mask[..., None] * image, "alpha": pixel_mask * alpha}

    inputs = {name: getattr(got["footprints"], name) for name in footprint_fields[:3]}
    inputs |= {"opacities": got["opacities"], "colours": got["colours"]}
    splat_count = int(np.sum(np.asarray(got["lists"].index) < len(got["shift"])))
    splat_inputs = {name: x[:splat_count] for name, x in got["splat inputs"].items()}
    raster_constants = (got["footprints"], got["lists"])
    decided_mask = np.float64(~measures.undecided(got, tile_size, camera))
    return [
        Stage("projection", projection, splat_inputs, (camera, pipeline)),
        Stage("rasteriser", rasteriser, inputs, (*raster_constants, np.ones_like(decided_mask))),
        Stage("- undecided pixels", rasteriser, inputs, (*raster_constants, decided_mask)),
    ]


PHOTOMETRIC = {"l1": image_l1, "ssim": image_dissimilarity, "mask": mask_error}
"""The terms of Eq. 13."""


def loss_stages(
    params: Params,
    batch: Batch,
    pipeline: Pipeline,
    got: dict[str, Any],
    last_weights: dict[str, float],
) -> list[Stage]:
    """Every term of the loss on its own inputs, and the whole loss from the parameters."""
    photo = {"rgb": got["image"][None], "alpha": got["alpha"][None]}
    photo["exposure"] = params.log_exposure
    # In pixels without splats the tone map gives 2e-8 instead of 0, and L1 a sign of no meaning.
    coverage_mask = np.float64(photo["alpha"] > 0)
    background = jax.random.uniform(jax.random.key(0), batch.image[:1, ..., :3].shape)

    def photometric(term: str) -> Stage:
        def function(x: Any, constants: Any) -> dict[str, Any]:
            image, backdrop, coverage_mask = constants
            rgb = coverage_mask[..., None] * tone_map(x["rgb"], x["exposure"])
            images = over_background(
                rgb, coverage_mask * x["alpha"], image, backdrop, None, srgb=False
            )
            return {term: PHOTOMETRIC[term](images)}

        return Stage(f"loss: {term}", function, photo, (batch.image[:1], background, coverage_mask))

    def smooth(x: Any, constants: Any) -> dict[str, Any]:
        points, mask, key, pipeline = constants
        variations = smoothness(
            x["material"], points, mask, key, pipeline.surface.box, spec=pipeline.fields
        )
        return {"smoothness": variations.albedo + variations.roughness + variations.metallic}

    def light(x: Any, image: Any) -> dict[str, Any]:
        return {"light": light_error(x["diffuse"], x["specular"], x["exposure"], image)}

    def entropy(x: Any, pipeline: Any) -> dict[str, Any]:
        return {"entropy": sdf_entropy(x["geometry"], pipeline.surface.grid)}

    def whole(x: Any, constants: Any) -> dict[str, Any]:
        batch, pipeline = constants
        total, report = pipeline.loss(_from_groups(x), batch)
        # Terms are only reported, and get no cotangent.
        return {"total": total, **jax.lax.stop_gradient(report.terms)}

    excluded_terms = {
        "whole loss": (),
        "- smoothness": ("smoothness",),
        "- smoothness, L1": ("smoothness", "l1"),
    }
    losses = {
        title: replace(
            pipeline,
            weights={
                name: jnp.float32(weight)
                for name, weight in last_weights.items()
                if not name.startswith(prefixes)
            },
        )
        for title, prefixes in excluded_terms.items()
    }
    count = pipeline.objective.smoothness_samples
    sample_rows = np.linspace(0, int(got["splats"].count) - 1, count).astype(int)
    points, mask = np.asarray(got["splats"].means)[sample_rows], np.ones(count, bool)
    lights = {"diffuse": got["lights"][None, ..., :3], "specular": got["lights"][None, ..., 3:]}
    lights["exposure"] = params.log_exposure
    smoothness_constants = (points, mask, jax.random.key(1), pipeline)
    return [
        *(photometric(term) for term in PHOTOMETRIC),
        Stage("loss: smoothness", smooth, {"material": params.material}, smoothness_constants),
        Stage("loss: light", light, lights, batch.image[:1]),
        Stage("loss: entropy", entropy, {"geometry": params.geometry}, pipeline),
        *(Stage(name, whole, _groups(params), (batch, p)) for name, p in losses.items()),
    ]


def half_rows(params: Params, batch: Batch, pipeline: Pipeline) -> dict[str, Any]:
    """Measure how rounding one kind of stored value changes image and gradient of one view."""

    def picture(
        params: Params, batch: Batch, pipeline: Pipeline, is_rounded: dict[str, Any]
    ) -> Any:
        def store(name: str, x: jax.Array) -> jax.Array:
            return jnp.where(is_rounded[name], to_bfloat16(x), x)

        intermediates = chain(params, batch.camera, pipeline, store=store)
        rgb = tone_map(intermediates["image"], params.log_exposure)
        target = batch.image[:1]
        black = jnp.zeros_like(target[..., :3])
        images = over_background(
            rgb[None], intermediates["alpha"][None], target, black, None, srgb=False
        )
        weights = {"l1": 0.8, "ssim": 0.2, "mask": 5.0}
        total = sum(weight * PHOTOMETRIC[name](images) for name, weight in weights.items())
        return total, rgb + (1.0 - intermediates["alpha"])[..., None]

    run = jax.jit(jax.value_and_grad(picture, has_aux=True))
    choices = {"nothing (float32)": ()} | {name: (name,) for name in STORED}
    choices["all but conics, means2d, SDF"] = STORED[:6]
    choices["everything"] = STORED
    flags = {
        n: {name: np.array(name in selection) for name in STORED}
        for n, selection in choices.items()
    }
    with double_precision():
        inputs = cast((params, batch, pipeline), np.float64)
        exact_result = jax.device_get(run(*inputs, flags["nothing (float32)"]))
    records = {}
    for name, selection in flags.items():
        (_, image), gradient = jax.device_get(run(params, batch, pipeline, selection))
        (_, exact_image), exact_gradient = exact_result
        error = np.mean((encode_srgb(image.clip(0, 1)) - encode_srgb(exact_image.clip(0, 1))) ** 2)
        groups, exact_groups = _groups(gradient), _groups(exact_gradient)
        records[name] = {
            "psnr": float(-10 * np.log10(error)),
            "worst": float(np.max(np.abs(image - exact_image))),
            **{k: errors(groups[k], exact_groups[k])["l2"] for k in groups},
        }
    return records


def stages_command(arguments: argparse.Namespace) -> None:
    """Measure every stage on a trained run, the whole chain, and the effects of bfloat16."""
    run = Run(arguments.run_folder, scene=arguments.scene)
    config, params, pipeline, stage = run.config, run.params, run.pipeline, run.trained.stage
    if not isinstance(pipeline.transport, SplitSum):
        raise SystemExit(f"{run.folder} ended in {stage.name}; train it without that stage's steps")
    batch = make_batch(run.dataset.train, run.trained.step, stage, seed=config.run.seed)
    camera = batch.camera.view(0)
    first_batch = replace(batch, camera=camera, image=batch.image[:1])
    forward = jax.jit(chain)
    single = jax.device_get(forward(params, camera, pipeline))
    with double_precision():
        double = jax.device_get(forward(*cast((params, camera, pipeline), np.float64)))
    single_shared = jax.device_get(forward(params, camera, pipeline, lists=double["lists"]))
    expected = jax.jit(Pipeline.render)(pipeline, params, camera).rgb[0]
    assert errors(single["image"], expected)["l2"] < 1e-5, "the chain differs from render"

    stages = [
        *surface_stages(params, pipeline, double),
        *shading_stages(params, pipeline, double),
        *image_stages(camera, pipeline, double),
        *loss_stages(params, batch, pipeline, double, stage.weights_at(stage.steps)),
    ]
    record: dict[str, Any] = {"stages": {}}
    print(f"{'stage':18s} | values: L2, worst, off | gradients: L2, worst, off, other sign")
    for part in stages:
        figures = record["stages"][part.name] = measures.measure(part)
        v, g = figures["values"]["all"], figures["gradients"]["all"]
        print(
            f"{part.name:18s} | {v['l2']:.1e} {v['worst']:.1e} {v['off']:.1e} "
            f"| {g['l2']:.1e} {g['worst']:.1e} {g['off']:.1e} {g['sign']:.1e}",
            flush=True,
        )
        save(arguments.output / "stages.json", record)
    record["decisions"] = measures.decisions(single, single_shared, double, config, camera)
    record["chain"] = measures.accumulated(single, single_shared, double)
    record["bfloat16"] = half_rows(params, first_batch, pipeline)
    points = double["unit"][: int(double["splats"].count)]
    specs = {"draft": config.material.grid, "standard": HashGridSpec()}
    record["times"] = {name: measures.half_times(points, spec) for name, spec in specs.items()}
    for part in ("decisions", "chain", "bfloat16", "times"):
        print(f"\n{part}")
        for name, figures in record[part].items():
            print(f"  {name:28s} {figures}")
    save(arguments.output / "stages.json", record)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    train = commands.add_parser("train", help="whole training runs")
    train.add_argument("scene", type=Path)
    train.add_argument("--quality", default="draft")
    train.add_argument("--steps", type=int, default=120)
    train.add_argument("--set", nargs="*", default=[], help="overrides of settings")
    train.add_argument("--variants", type=int, default=len(VARIANTS), help="only the first so many")
    train.set_defaults(run=train_command)
    stages = commands.add_parser("stages", help="every stage on a trained run")
    stages.add_argument("run_folder", metavar="RUN", type=Path)
    stages.add_argument("--scene", type=Path, help="where the scene is now, if it has moved")
    stages.set_defaults(run=stages_command)
    plot = commands.add_parser("plot", help="the figure")
    plot.add_argument("--image", type=Path, default=Path("docs/images/precision.png"))
    plot.set_defaults(run=lambda options: measures.figure(options.output, options.image))
    for command in (train, stages, plot):
        command.add_argument("--output", type=Path, default=Path("runs/precision"))
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
