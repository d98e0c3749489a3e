"""One training step: Adam, and an update that only happens when it is sound."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.types import Batch, rate_groups
from geosplat_jax.fit import pyramid
from geosplat_jax.fit.gradient import IN_TURN, Runner, SharedBatch, value_and_gradient
from geosplat_jax.pipeline import LossReport, Pipeline
from geosplat_jax.render import Params

ADAM = optax.scale_by_adam(eps=1e-15)
"""Optimiser of all trainings; its steps are multiplied by the rates of the groups."""


class Average(eqx.Module):
    """Mean of the parameters after each of the last steps of a stage.

    Attributes
    ----------
    params : the mean; the last parameters while no step counts.
    count : () int32, number of steps in the mean.
    """

    params: Params
    count: Int[Array, ""]

    @classmethod
    def none_of(cls, params: Params) -> "Average":
        """Begin with a copy of the parameters and no step, since a step consumes both."""
        return cls(jax.tree.map(jnp.array, params), jnp.int32(0))

    def with_step(self, params: Params, counts: Bool[Array, ""]) -> "Average":
        """Include the parameters after a step, or begin anew if the step does not count."""
        count = jnp.where(counts, self.count + 1, 0)
        share = 1.0 / jnp.maximum(count, 1).astype(jnp.float32)

        def mean(old: Array, new: Array) -> Array:
            return jnp.where(count > 1, old + share.astype(new.dtype) * (new - old), new)

        return Average(jax.tree.map(mean, self.params, params), count)


class TrainState(eqx.Module):
    """What a step reads and writes.

    Attributes
    ----------
    params : learned parameters.
    optimizer : state of Adam.
    step : () int32, the number of updates made.
    carry : what the transport keeps from step to step; None for most.
    average : mean over the last steps, in stages that end with it; else None.
    """

    params: Params
    optimizer: Any
    step: Int[Array, ""]
    carry: Any = None
    average: Average | None = None


class UpdateRule(eqx.Module):
    """How far a step goes; everything except the frozen groups is traced.

    Attributes
    ----------
    rates : learning rate of every group (see `core.types.learned`).
    light_knee : () radiance at which steps of the light double, since they grow as ``1 + radiance /
        light_knee``; 0 for no growth.
    light_pyramid : () share of its step that every level of the light's pyramid makes, see
        `pyramid.from_levels`.
    smallest_light : () lower bound of a texel while the light is learned.
    averages : () whether the parameters after the step count for the state's average.
    frozen : static; groups that are not differentiated.
    """

    rates: dict[str, Float[Array, ""]]
    light_knee: Float[Array, ""]
    light_pyramid: Float[Array, ""]
    smallest_light: Float[Array, ""]
    averages: Bool[Array, ""]
    frozen: tuple[str, ...] = eqx.field(static=True, default=())


class StepReport(eqx.Module):
    """Outcome of a step; the state changed only if ``finite`` and ``fits`` hold.

    Attributes
    ----------
    total : () the weighted loss.
    loss : terms, image quality and usage.
    finite : () whether loss and every gradient were finite.
    fits : () whether every buffer was large enough.
    """

    total: Float[Array, ""]
    loss: LossReport
    finite: Bool[Array, ""]
    fits: Bool[Array, ""]


def initial_state(
    params: Params, *, step: int = 0, carry: Any = None, averages: bool = False
) -> TrainState:
    """Build the state before the first step of a stage, which ``averages`` its last ones or not.

    The parameters are copied: a step consumes the buffers of its state, and a pipeline or the
    caller may hold the same arrays.
    """
    params = jax.tree.map(jnp.array, params)
    average = Average.none_of(params) if averages else None
    optimizer = ADAM.init(pyramid.to_levels(params))
    return TrainState(params, optimizer, jnp.asarray(step, jnp.int32), carry, average)


def with_geometry(optimizer: Any, change: Callable[[Any], Any]) -> Any:
    """Apply a function to Adam's moments of the surface's shape.

    Parameters
    ----------
    optimizer : state of Adam.
    change : maps a pytree laid out like the old shape to one laid out like the new shape.
    """
    moments = {
        name: replace(moment, geometry=change(moment.geometry))
        for name, moment in (("mu", optimizer.mu), ("nu", optimizer.nu))
    }
    return optimizer._replace(**moments)


def descended(params: Any, directions: Any, rates: dict[str, Float[Array, ""]]) -> Any:
    """Step against the directions, every group of parameters with its own learning rate."""
    leaves, structure = jax.tree.flatten(params)
    new_leaves = [
        leaf - rates[name].astype(leaf.dtype) * direction
        for leaf, direction, name in zip(
            leaves, jax.tree.leaves(directions), rate_groups(params), strict=True
        )
    ]
    return jax.tree.unflatten(structure, new_leaves)


def _moved(params: Params, directions: Params, rule: UpdateRule) -> Params:
    """Step against the directions, and keep texels of the light above their lower bound."""
    new_params = descended(params, directions, rule.rates)
    # Steps are nearly absolute below the knee and relative above it: a sun is thousands of times
    # brighter than its sky, and Adam's steps do not depend on the brightness. No texel falls below
    # its lower bound.
    old_radiance = params.light.radiance
    knee = rule.light_knee
    growth = jnp.where(knee > 0, 1.0 + old_radiance / jnp.where(knee > 0, knee, 1.0), 1.0)
    radiance = old_radiance + growth * (new_params.light.radiance - old_radiance)
    is_learned = "light" not in rule.frozen
    floor = rule.smallest_light if is_learned else -jnp.inf
    light = replace(params.light, radiance=jnp.maximum(radiance, floor))
    return replace(new_params, light=light)


@partial(jax.jit, donate_argnames=("state",))
def _update(
    state: TrainState,
    gradient: Params,
    loss_and_report: tuple[Float[Array, ""], LossReport],
    sizes: dict[str, Int[Array, ""]],
    rule: UpdateRule,
) -> tuple[TrainState, StepReport]:
    """Move the parameters if every buffer was large enough and every number is finite."""
    total, report = loss_and_report
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integer powers
        updates = pyramid.to_levels(gradient)
        directions, optimizer = ADAM.update(updates, state.optimizer)
    steps = pyramid.from_levels(directions, rule.light_pyramid)
    params = _moved(state.params, steps, rule)
    finite = jnp.isfinite(total) & jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient)])
    )
    fits = capacity_module.fits(report.usage, sizes)
    average = state.average
    if average is not None:
        average = average.with_step(params, rule.averages)
    advanced_state = TrainState(params, optimizer, state.step + 1, report.carry, average)
    new_state = jax.tree.map(
        lambda new, old: jnp.where(finite & fits, new, old), advanced_state, state
    )
    return new_state, StepReport(total, replace(report, carry=None), finite, fits)


def train_step(
    state: TrainState,
    batch: Batch | SharedBatch,
    pipeline: Pipeline,
    rule: UpdateRule,
    *,
    run: Runner = IN_TURN,
) -> tuple[TrainState, StepReport]:
    """Make one update, or none at all.

    Where a buffer overflows or a number is not finite, the state comes back unchanged, bit for bit,
    and the report says so. The caller then grows the buffers and repeats the batch, or stops.

    Parameters
    ----------
    state : parameters and optimiser before the step; donated, so use only what is returned.
    batch : views of the step; a `SharedBatch` for several devices.
    pipeline : pipeline of the stage.
    rule : learning rates of the step.
    run : see `gradient.value_and_gradient`.

    Returns
    -------
    state : parameters and optimiser after the step.
    report : outcome of the step.
    """
    batch = replace(batch, carry=state.carry)
    loss_and_report, gradient = value_and_gradient(
        pipeline, state.params, batch, frozen=rule.frozen, run=run
    )
    sizes = jax.device_put({n: np.int32(pipeline.capacities[n]) for n in loss_and_report[1].usage})
    return run(_update, state, gradient, loss_and_report, sizes, rule)
