"""One training step: optimiser, gradient, and an update that only happens when it is sound."""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Batch
from geosplat_jax.fit.config import RateConfig
from geosplat_jax.losses import LossReport, LossWeights, Objective, loss
from geosplat_jax.model import Context, Model, Params


class TrainState(eqx.Module):
    """What a step reads and writes.

    Attributes
    ----------
    params : learned parameters.
    optimizer : state of every group's Adam.
    step : () int32, the number of updates made.
    """

    params: Params
    optimizer: Any
    step: Int[Array, ""]


class StepReport(eqx.Module):
    """Outcome of a step.

    Attributes
    ----------
    total : () the weighted loss.
    loss : terms, image quality and usage.
    finite : whether loss and every gradient were finite.
    fits : whether every buffer was large enough. The state changed only if both hold.
    """

    total: Float[Array, ""]
    loss: LossReport
    finite: Bool[Array, ""]
    fits: Bool[Array, ""]


def parameter_group(path: tuple[Any, ...]) -> str:
    """Name of the learning rate (a field of `RateConfig`) that governs the leaf at ``path``."""
    names = [str(getattr(key, "name", getattr(key, "key", ""))) for key in path]
    if names[0] == "geometry":
        return names[1] if names[1] in ("sdf", "deform") else "weights"
    if names[0] == "material":
        if names[1] == "shift_head":
            return "shift"
        if names[1] == "indirect_head":
            return "indirect"
        return "shine" if names[1].startswith("surface") else "albedo"
    return {"light": "light", "log_exposure": "exposure"}[names[0]]


def scale_by_brightness(knee: float) -> optax.GradientTransformation:
    """Multiply an update by ``1 + value / knee``: absolute steps below the knee, relative above.

    A sun is thousands of times brighter than its sky, and Adam's steps know nothing of that.
    """

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        scaled = jax.tree.map(lambda step, value: step * (1.0 + value / knee), updates, params)
        return scaled, state

    def init(params: Any) -> optax.EmptyState:
        del params
        return optax.EmptyState()

    return optax.GradientTransformation(init, update)


def make_optimizer(rates: RateConfig) -> optax.GradientTransformation:
    """Adam (epsilon 1e-15) with one exponentially decaying rate a parameter group."""

    def group(rate: float, warmup: int) -> optax.GradientTransformation:
        decay = optax.exponential_decay(rate, 1, 0.5 ** (1.0 / rates.half_life))
        if not warmup:
            return optax.adam(decay, eps=1e-15)

        def schedule(count: Any) -> Any:
            return decay(count) * jnp.minimum((count + 1) / warmup, 1.0) ** 2

        return optax.adam(schedule, eps=1e-15)

    surface = ("sdf", "deform", "weights")
    others = ("albedo", "shine", "shift", "indirect", "light", "exposure")
    warmup = dict.fromkeys(surface, rates.warmup)
    warmup |= {"albedo": rates.albedo_warmup, "shine": rates.shine_warmup}
    groups: dict[Any, optax.GradientTransformation] = {
        name: group(getattr(rates, name), warmup.get(name, 0)) for name in surface + others
    }
    if rates.light_knee > 0:
        groups["light"] = optax.chain(groups["light"], scale_by_brightness(rates.light_knee))

    def labels(params: Any) -> Any:
        return jax.tree_util.tree_map_with_path(lambda path, _: parameter_group(path), params)

    return optax.multi_transform(groups, labels)


def initial_state(params: Params, rates: RateConfig) -> TrainState:
    """Build the state before the first step."""
    tree: Any = params
    return TrainState(params, make_optimizer(rates).init(tree), jnp.zeros((), jnp.int32))


def _project(params: Params, smallest_light: float) -> Params:
    """Return to the feasible set: no texel of the light below its floor."""
    radiance = jnp.maximum(params.light.radiance, smallest_light)
    return replace(params, light=replace(params.light, radiance=radiance))


@partial(
    jax.jit,
    static_argnames=(
        "model",
        "objective",
        "capacities",
        "sampling",
        "rates",
        "smallest_light",
    ),
    donate_argnames=("state",),
)
def train_step(
    state: TrainState,
    batch: Batch,
    context: Context,
    weights: LossWeights,
    *,
    model: Model,
    objective: Objective,
    capacities: Capacities,
    sampling: str,
    rates: RateConfig,
    smallest_light: float,
) -> tuple[TrainState, StepReport]:
    """Make one update, or none at all.

    Where a buffer overflows or a number is not finite the state comes back unchanged, bit for bit,
    and the report says so; the host then grows the buffers and repeats the batch, or stops.
    ``state`` is donated: use only what is returned.
    """
    evaluate = jax.value_and_grad(loss, has_aux=True)
    (total, report), gradient = evaluate(
        state.params,
        batch,
        context,
        weights,
        model=model,
        objective=objective,
        capacities=capacities,
        sampling=sampling,
    )
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integer powers
        tree: Any = state.params
        updates, optimizer = make_optimizer(rates).update(gradient, state.optimizer, tree)
    params = _project(jax.tree.map(jnp.add, state.params, updates), smallest_light)
    finite = jnp.isfinite(total) & jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient)])
    )
    fits = capacity_module.fits(report.usage, capacities)
    advanced = TrainState(params, optimizer, state.step + 1)
    chosen = jax.tree.map(lambda new, old: jnp.where(finite & fits, new, old), advanced, state)
    return chosen, StepReport(total, report, finite, fits)
