"""What float32 costs against float64, and where bfloat16 would pay (docs/numerics.md).

``stages RUN`` measures every stage on a trained run, ``train SCENE`` whole training runs, ``plot``
draws the figure from what the two left in ``--output``.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import precision_plot as measures
from precision_plot import GROUPS, Outcome, Stage, cast, errors, save

from geosplat_jax import render as render_module
from geosplat_jax.adapter import GAUSSIANS_PER_FACE, face_gaussians, shift_inwards
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Batch, Camera, EnvLight, Grid, Materials, Mesh
from geosplat_jax.fit.config import Config, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
from geosplat_jax.fit.stages import initial_params, initial_sdf, make_batch, make_context
from geosplat_jax.fit.step import make_optimizer
from geosplat_jax.fit.train import load_run, plan_capacities
from geosplat_jax.geometry import face_normals_and_areas, isosurface, sdf_entropy, vertex_normals
from geosplat_jax.gradcheck.differences import double_precision
from geosplat_jax.gradcheck.whole_stages import _from_groups, _groups
from geosplat_jax.hashgrid import HashGridSpec, Layer, encode
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.io.images import encode_srgb
from geosplat_jax.io.views import Views
from geosplat_jax.losses import light_term, loss, photometric_terms
from geosplat_jax.materials import (
    ROUGHNESS_MINIMUM,
    MaterialField,
    MaterialSpec,
    smoothness,
    to_unit_cube,
)
from geosplat_jax.model import Context, Params
from geosplat_jax.render import grid_center_and_extent
from geosplat_jax.splats.projection import project
from geosplat_jax.splats.rasterize import TileLists, composite, gather_visible
from geosplat_jax.surface.hull import fit_grid
from geosplat_jax.transport.environment import prefilter
from geosplat_jax.transport.split_sum import split_sum

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
    """Round values to bfloat16, keep the dtype, and let gradients pass as if nothing had been."""
    rounded = jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=7)
    return x + jax.lax.stop_gradient(rounded - x)


# --- whole training runs ------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """One training run: its precision, its seed, and what the forward pass rounds to bfloat16."""

    name: str
    dtype: str = "float32"
    seed: int = 0
    nudged: bool = False
    rounded: tuple[str, ...] = ()


def flags_of(variant: Variant) -> dict[str, jax.Array]:
    """Whether each group is rounded."""
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


@partial(jax.jit, static_argnames=("config", "capacities"))
def training_step(params, optimizer, batch, context, weights, is_rounded, *, config, capacities):
    """`step.train_step` with rounding in the forward pass; rounding is traced: one compilation."""

    def evaluate(params: Params) -> tuple[jax.Array, Any]:
        return loss(
            rounded_where(params, is_rounded),
            batch,
            context,
            weights,
            model=config.model,
            objective=config.objective,
            capacities=capacities,
        )

    (total, report), gradient = jax.value_and_grad(evaluate, has_aux=True)(params)
    updates, optimizer = make_optimizer(config.rates).update(gradient, optimizer, params)
    moved = jax.tree.map(jnp.add, params, updates)
    radiance = jnp.maximum(moved.light.radiance, config.run.smallest_light)
    moved = replace(moved, light=replace(moved.light, radiance=radiance))
    return moved, optimizer, total, report.usage


def start(views: Views, bounds: Any, config: Config) -> tuple[Params, Context]:
    """Build parameters and constants as `train.fit` does."""
    sdf_key, field_key = jax.random.split(jax.random.key(config.run.seed))
    grid = fit_grid(bounds, config.geometry.resolution)
    sdf = initial_sdf(grid, views, config, sdf_key)
    return initial_params(sdf, grid, config, field_key), make_context(grid, config.model)


def run_variant(
    variant: Variant,
    views: Views,
    bounds: Any,
    config: Config,
    capacities: Capacities,
) -> tuple[list[float], dict[int, Params], float]:
    """Train one variant; return losses, snapshots and the median seconds a step."""
    config = replace(config, run=replace(config.run, seed=variant.seed))
    params, context = start(views, bounds, config)
    if variant.nudged:
        sdf = jnp.nextafter(params.geometry.sdf, jnp.inf)
        params = replace(params, geometry=replace(params.geometry, sdf=sdf))
    is_rounded = flags_of(variant)
    keep, losses, seconds = set(measures.snapshot_steps(config.run.steps)), [], []
    snapshots = {0: jax.device_get(params)}
    batches = (make_batch(views, step, config) for step in range(config.run.steps))

    def train() -> None:
        state = cast(params, variant.dtype)
        constants = cast(context, variant.dtype)
        optimizer = make_optimizer(config.rates).init(state)
        room = capacities
        for step, batch in enumerate(batches):
            began = time.perf_counter()
            weights = config.loss.at(step / config.run.steps)
            inputs = (state, optimizer, cast(batch, variant.dtype), constants, weights, is_rounded)
            while True:
                *new, total, needed = training_step(*inputs, config=config, capacities=room)
                if not capacity_module.overflowed(needed, room):
                    break
                room = capacity_module.grow(room, needed)
            state, optimizer = new
            losses.append(float(total))
            seconds.append(time.perf_counter() - began)
            if step + 1 in keep:
                snapshots[step + 1] = jax.device_get(state)

    if variant.dtype == "float64":
        with double_precision():
            train()
    else:
        train()
    return losses, snapshots, float(np.median(seconds))


def train_command(arguments: argparse.Namespace) -> None:
    """Train every variant; distances are from the float64 run of the same seed."""
    overrides = (f"run.steps={arguments.steps}", *arguments.set)
    config = make_config("default", arguments.quality, overrides=overrides)
    dataset = load_dataset(arguments.scene)
    params, context = start(dataset.train, dataset.bounds, config)
    room = plan_capacities(
        params,
        dataset.train.camera(),
        context,
        model=config.model,
        sampling="face",
        max_quads=config.geometry.max_quads,
    )
    room = Capacities(**{k: capacity_module.bucket(int(1.15 * v)) for k, v in vars(room).items()})
    outcomes, records = {}, {}
    for variant in VARIANTS[: arguments.variants]:
        trained = run_variant(variant, dataset.train, dataset.bounds, config, room)
        losses, snapshots, seconds = trained
        final = rounded_where(cast(snapshots[max(snapshots)], np.float32), flags_of(variant))
        images, figures = measures.held_out(final, context, config, room, dataset.test)
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


# --- the stages of a trained run ----------------------------------------------------------------

Store = Callable[[str, jax.Array], jax.Array]


def exact(name: str, x: jax.Array) -> jax.Array:
    """Store a value as it is."""
    return x


def heads(field: MaterialField, features: jax.Array, spec: MaterialSpec, store: Store):
    """`materials.attributes_at` behind the encoding, with every activation stored."""
    field = jax.tree.map(lambda w: store("MLP weights", w), replace(field, albedo_table=None))
    active = []

    def apply(layers: tuple[Layer, ...], x: jax.Array) -> jax.Array:
        for layer in layers[:-1]:
            x = store("MLP activations", jax.nn.relu(x @ layer.weights))
            active.append(x > 0)
        return x @ layers[-1].weights

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
    context: Context,
    *,
    config: Config,
    capacities: Capacities,
    lists: TileLists | None = None,
    store: Store = exact,
) -> dict[str, Any]:
    """`render.render` of one view with every intermediate by name; `stages` checks that it is."""
    model, grid, spec = config.model, context.grid, config.model.material
    pose, intrinsics = camera.world_to_camera[0], camera.intrinsics[0]
    frame = {"height": camera.height, "width": camera.width}
    geometry = replace(params.geometry, sdf=store("SDF", params.geometry.sdf))
    surface = isosurface(geometry, grid, capacities=capacities, training=True)
    mesh, normals = surface.mesh, vertex_normals(surface.mesh)
    center, half = grid_center_and_extent(grid)
    gaussians = face_gaussians(mesh, normals, constants=model.adapter, unit=half)
    unit = to_unit_cube(jax.lax.stop_gradient(gaussians.means), center, half)
    table = store("hash tables", params.material.albedo_table)
    encoded = store("MLP activations", encode(table, unit, spec=spec.grid))
    materials, shift, active = heads(params.material, encoded, spec, store)
    face_normal, area = face_normals_and_areas(mesh)
    moved = shift_inwards(gaussians, face_normal, area, shift)
    if lists is None:
        outward = jnp.repeat(face_normal, GAUSSIANS_PER_FACE, axis=0)
        settings = {"model": model, "capacities": capacities}
        lists = render_module._visible_in_view(
            moved, outward, pose, intrinsics, grid, image_shape=tuple(frame.values()), **settings
        )
    seen = partial(gather_visible, lists.index)
    light = prefilter(EnvLight(store("light texels", params.light.radiance)), context.operators)
    light = replace(light, specular=store("prefiltered light", light.specular))
    means, lit = seen(moved.means), jax.tree.map(seen, materials)
    view = safe_normalize(camera.centers[0][None, :] - means)
    shaded = split_sum(lit, seen(moved.normals), view, light, context.fg_table)
    splat_inputs = {"means": means, "quats": seen(moved.quats)}
    splat_inputs["scales"] = seen(moved.scales, padding=1.0)
    near = model.near * half
    cameras = {"world_to_camera": pose, "intrinsics": intrinsics, "near": near, **frame}
    splats = project(**splat_inputs, **cameras)
    splats = replace(
        splats,
        means2d=store("means2d", splats.means2d),
        conics=store("conics", splats.conics),
    )
    colours = store("splat colours", shaded.rgb)
    opacities = seen(moved.opacities)
    features = jnp.concatenate([colours, shaded.diffuse_light, shaded.specular_light], axis=1)
    image, alpha = composite(splats, opacities, features, lists, tile_size=model.tile_size, **frame)
    got = {"mesh": mesh, "vertex normals": normals, "gaussians": gaussians, "unit": unit}
    got |= {"encoded": encoded, "active": active, "materials": materials, "shift": shift}
    got |= {"lists": lists, "light": light, "lit": lit, "seen normals": seen(moved.normals)}
    got |= {"view": view, "colours": colours, "splat inputs": splat_inputs, "splats": splats}
    got |= {"opacities": opacities, "image": image[..., :3], "lights": image[..., 3:]}
    return got | {"alpha": alpha}


def surface_stages(params: Params, grid: Grid, got: dict[str, Any], config: Config, room) -> list:
    """Stages from the isosurface to the Gaussians."""
    geometry = {"geometry": params.geometry}
    unit = grid_center_and_extent(grid)[1]

    def surface(x: Any, grid: Grid) -> dict[str, Any]:
        out = isosurface(x["geometry"], grid, capacities=room, training=True)
        return {"vertices": out.mesh.vertices}

    def deviation(x: Any, grid: Grid) -> dict[str, Any]:
        return {"L_dev": isosurface(x["geometry"], grid, capacities=room, training=True).deviation}

    def normals(x: Any, mesh: Mesh) -> dict[str, Any]:
        return {"normals": vertex_normals(replace(mesh, vertices=x["vertices"]))}

    def adapter(x: Any, constants: Any) -> dict[str, Any]:
        mesh = replace(constants["mesh"], vertices=x["vertices"])
        made = face_gaussians(
            mesh, x["normals"], constants=config.model.adapter, unit=constants["unit"]
        )
        return {name: getattr(made, name) for name in ("means", "quats", "scales", "normals")}

    mesh, vertices = got["mesh"], {"vertices": got["mesh"].vertices}
    both = {**vertices, "normals": got["vertex normals"]}
    return [
        Stage("isosurface", surface, geometry, grid),
        Stage("L_dev", deviation, geometry, grid),
        Stage("vertex normals", normals, vertices, mesh),
        Stage("adapter", adapter, both, {"mesh": mesh, "unit": unit}),
    ]


def shading_stages(params: Params, context: Context, got: dict[str, Any], config: Config) -> list:
    """Stages of materials and light."""
    spec, field = config.model.material, params.material

    def hash_grid(x: Any, unit: Any) -> dict[str, Any]:
        return {"features": encode(x["tables"], unit, spec=spec.grid)}

    def mlps(x: Any, table: Any) -> dict[str, Any]:
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
    return [
        Stage("hash grid", hash_grid, {"tables": field.albedo_table}, got["unit"]),
        Stage(
            "MLPs", mlps, {"heads": replace(field, albedo_table=None), "features": got["encoded"]}
        ),
        Stage("prefilter", light, {"light": params.light.radiance}, context.operators),
        Stage("split sum", shade, shade_inputs, context.fg_table),
    ]


def image_stages(camera: Camera, got: dict[str, Any], near: Any, config: Config) -> list:
    """Stages of splats and images; the rasteriser uses the same lists in both precisions."""
    frame = {"height": camera.height, "width": camera.width}
    parts = ("means2d", "conics", "compensation", "depths")

    def projection(x: Any, constants: Any) -> dict[str, Any]:
        camera, near = constants
        splats = project(
            **x,
            world_to_camera=camera.world_to_camera[0],
            intrinsics=camera.intrinsics[0],
            near=near,
            **frame,
        )
        return {name: getattr(splats, name) for name in parts}

    def rasteriser(x: Any, constants: Any) -> dict[str, Any]:
        splats, lists, kept = constants
        splats = replace(splats, **{name: x[name] for name in parts[:3]})
        image, alpha = composite(
            splats, x["opacities"], x["colours"], lists, tile_size=config.model.tile_size, **frame
        )
        return {"image": kept[..., None] * image, "alpha": kept * alpha}

    inputs = {name: getattr(got["splats"], name) for name in parts[:3]}
    inputs |= {"opacities": got["opacities"], "colours": got["colours"]}
    real = int(np.sum(np.asarray(got["lists"].index) < len(got["shift"])))
    splat_inputs = {name: x[:real] for name, x in got["splat inputs"].items()}
    both = (got["splats"], got["lists"])
    clear = np.float64(~measures.undecided(got, config.model.tile_size, camera))
    return [
        Stage("projection", projection, splat_inputs, (camera, near)),
        Stage("rasteriser", rasteriser, inputs, (*both, np.ones_like(clear))),
        Stage("- undecided pixels", rasteriser, inputs, (*both, clear)),
    ]


def loss_stages(params: Params, batch: Batch, context: Context, got, config: Config, room) -> list:
    """Every term of the loss on its own inputs, and the whole loss from the parameters."""
    photo = {"rgb": got["image"][None], "alpha": got["alpha"][None]}
    photo["exposure"] = params.log_exposure
    # Where no splat is, the tone map gives 2e-8 instead of 0, and L1 its sign, which nothing reads.
    covered = np.float64(photo["alpha"] > 0)
    background = jax.random.uniform(jax.random.key(0), batch.image[:1, ..., :3].shape)

    def photometric(term: str) -> Stage:
        def function(x: Any, constants: Any) -> dict[str, Any]:
            image, behind, covered = constants
            rgb = covered[..., None] * tone_map(x["rgb"], x["exposure"])
            terms, _ = photometric_terms(rgb, covered * x["alpha"], image, behind, srgb=False)
            return {term: terms[term]}

        return Stage(f"loss: {term}", function, photo, (batch.image[:1], background, covered))

    def smooth(x: Any, constants: Any) -> dict[str, Any]:
        points, mask, key, center, half = constants
        spec = config.model.material
        settings = {"spec": spec, "center": center, "half_extent": half}
        return {"smoothness": smoothness(x["material"], points, mask, key, **settings)}

    def light(x: Any, image: Any) -> dict[str, Any]:
        return {"light": light_term(x["diffuse"], x["specular"], image)}

    def entropy(x: Any, grid: Grid) -> dict[str, Any]:
        return {"entropy": sdf_entropy(x["geometry"], grid)}

    def whole(x: Any, constants: Any) -> dict[str, Any]:
        settings = {"model": config.model, "objective": config.objective, "capacities": room}
        total, report = loss(_from_groups(x), *constants, **settings)
        # Terms that are only read have no cotangent.
        return {"total": total, **jax.lax.stop_gradient(report.terms)}

    full = config.loss.at(1.0)
    weights = {"whole loss": full, "- smoothness": replace(full, smoothness=0.0)}
    weights["- smoothness, L1"] = replace(full, smoothness=0.0, l1=0.0)
    count = config.objective.smoothness_samples
    picked = np.linspace(0, int(got["gaussians"].count) - 1, count).astype(int)
    points, mask = np.asarray(got["gaussians"].means)[picked], np.ones(count, bool)
    where = grid_center_and_extent(context.grid)
    lights = {"diffuse": got["lights"][None, ..., :3], "specular": got["lights"][None, ..., 3:]}
    return [
        *(photometric(term) for term in ("l1", "ssim", "mask")),
        Stage(
            "loss: smoothness",
            smooth,
            {"material": params.material},
            (points, mask, jax.random.key(1), *where),
        ),
        Stage("loss: light", light, lights, batch.image[:1]),
        Stage("loss: entropy", entropy, {"geometry": params.geometry}, context.grid),
        *(Stage(name, whole, _groups(params), (batch, context, w)) for name, w in weights.items()),
    ]


def half_rows(params: Params, batch: Batch, context: Context, config: Config, room) -> dict:
    """Effect on image and gradient of one view of rounding one kind of stored value at a time."""

    def picture(params: Params, batch: Batch, context: Context, is_rounded: dict[str, Any]) -> Any:
        def store(name: str, x: jax.Array) -> jax.Array:
            return jnp.where(is_rounded[name], to_bfloat16(x), x)

        settings = {"config": config, "capacities": room, "store": store}
        got = chain(params, batch.camera, context, **settings)
        rgb = tone_map(got["image"], params.log_exposure)
        target = batch.image[:1]
        black = jnp.zeros_like(target[..., :3])
        terms, _ = photometric_terms(rgb[None], got["alpha"][None], target, black, srgb=False)
        total = 0.8 * terms["l1"] + 0.2 * terms["ssim"] + 5.0 * terms["mask"]
        return total, rgb + (1.0 - got["alpha"])[..., None]

    run = jax.jit(jax.value_and_grad(picture, has_aux=True))
    choices = {"nothing (float32)": ()} | {name: (name,) for name in STORED}
    choices["all but conics, means2d, SDF"] = STORED[:6]
    choices["everything"] = STORED
    flags = {
        n: {name: np.array(name in chosen) for name in STORED} for n, chosen in choices.items()
    }
    with double_precision():
        inputs = cast((params, batch, context), np.float64)
        exact_result = jax.device_get(run(*inputs, flags["nothing (float32)"]))
    found = {}
    for name, chosen in flags.items():
        (_, image), gradient = jax.device_get(run(params, batch, context, chosen))
        (_, exact_image), exact_gradient = exact_result
        error = np.mean((encode_srgb(image.clip(0, 1)) - encode_srgb(exact_image.clip(0, 1))) ** 2)
        groups, exact_groups = _groups(gradient), _groups(exact_gradient)
        found[name] = {
            "psnr": float(-10 * np.log10(error)),
            "worst": float(np.max(np.abs(image - exact_image))),
            **{k: errors(groups[k], exact_groups[k])["l2"] for k in groups},
        }
    return found


def stages_command(arguments: argparse.Namespace) -> None:
    """Measure every stage on a trained run, the whole chain, and what bfloat16 would do."""
    config, params, context, room, meta = load_run(arguments.run_folder)
    if meta["stage"] != 1:
        raise SystemExit(
            f"{arguments.run_folder} ended in stage 2; train it with --set transport.steps=0"
        )
    dataset = load_dataset(arguments.scene)
    batch = make_batch(dataset.train, meta["step"], config)
    camera = jax.tree.map(lambda x: x[:1], batch.camera)
    first = replace(batch, camera=camera, image=batch.image[:1])
    forward = jax.jit(partial(chain, config=config, capacities=room))
    one = jax.device_get(forward(params, camera, context))
    with double_precision():
        two = jax.device_get(forward(*cast((params, camera, context), np.float64)))
    shared = jax.device_get(forward(params, camera, context, lists=two["lists"]))
    output = jax.jit(partial(render_module.render, model=config.model, capacities=room))
    expected = output(params, camera, context).rgb[0]
    assert errors(one["image"], expected)["l2"] < 1e-5, "the chain differs from render"

    near = config.model.near * grid_center_and_extent(context.grid)[1]
    stages = [
        *surface_stages(params, context.grid, two, config, room),
        *shading_stages(params, context, two, config),
        *image_stages(camera, two, near, config),
        *loss_stages(params, batch, context, two, config, room),
    ]
    record: dict[str, Any] = {"stages": {}}
    print(f"{'stage':18s} | values: L2, worst, off | gradients: L2, worst, off, other sign")
    for stage in stages:
        found = record["stages"][stage.name] = measures.measure(stage)
        v, g = found["values"]["all"], found["gradients"]["all"]
        print(
            f"{stage.name:18s} | {v['l2']:.1e} {v['worst']:.1e} {v['off']:.1e} "
            f"| {g['l2']:.1e} {g['worst']:.1e} {g['off']:.1e} {g['sign']:.1e}",
            flush=True,
        )
        save(arguments.output / "stages.json", record)
    record["decisions"] = measures.decisions(one, shared, two, config, camera)
    record["chain"] = measures.accumulated(one, shared, two)
    record["bfloat16"] = half_rows(params, first, context, config, room)
    points = two["unit"][: int(two["gaussians"].count)]
    specs = {"draft": config.model.material.grid, "standard": HashGridSpec()}
    record["times"] = {name: measures.half_times(points, spec) for name, spec in specs.items()}
    for part in ("decisions", "chain", "bfloat16", "times"):
        print(f"\n{part}")
        for name, found in record[part].items():
            print(f"  {name:28s} {found}")
    save(arguments.output / "stages.json", record)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    train = commands.add_parser("train", help="whole training runs")
    train.add_argument("scene", type=Path)
    train.add_argument("--quality", default="draft")
    train.add_argument("--steps", type=int, default=120)
    train.add_argument("--set", nargs="*", default=[], help="overrides, e.g. loss.smoothness=0.0")
    train.add_argument("--variants", type=int, default=len(VARIANTS), help="only the first so many")
    train.set_defaults(run=train_command)
    stages = commands.add_parser("stages", help="every stage on a trained run")
    stages.add_argument("run_folder", metavar="RUN", type=Path)
    stages.add_argument("--scene", type=Path, default=Path("examples/duck"))
    stages.set_defaults(run=stages_command)
    plot = commands.add_parser("plot", help="the figure")
    plot.add_argument("--image", type=Path, default=Path("docs/images/precision.png"))
    plot.set_defaults(run=lambda given: measures.figure(given.output, given.image))
    for command in (train, stages, plot):
        command.add_argument("--output", type=Path, default=Path("runs/precision"))
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
