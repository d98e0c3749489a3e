"""The gradient of the loss, part by part: programs that do not grow with the number of views.

The chain rule is written out here between compiled programs: for the asset, the splats that a view
sees, the light, the loss of one view, and the backward pass. The program of a view is called once
per view. So a step of eight views compiles as fast as one of a single view, a buffer that grows
costs a compilation of only those programs that use it, and programs can be compiled in parallel or
before they are needed.

`value_and_gradient` equals ``jax.value_and_grad(pipeline.loss, has_aux=True)`` up to rounding;
groups in ``frozen`` get a gradient of zero.
"""

from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Batch, EnvLight, without_gradient, zero_gradient
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.pipeline import LossReport, Pipeline, ViewReport
from geosplat_jax.render import Params
from geosplat_jax.splats.tiles import LIST_BUFFERS, TileLists
from geosplat_jax.transport.base import Illumination

_Parts = tuple[Any, Any]
"""A pytree split in two: floating-point arrays, which have a derivative, and the rest."""


class Runner:
    """Calls programs one after the other, and waits for each."""

    def __call__(self, program: Any, *arguments: Any) -> Any:
        """Call a program and wait for its results."""
        return jax.block_until_ready(program(*arguments))

    def all(self, *calls: tuple[Any, ...]) -> list[Any]:
        """Call programs that do not wait for each other, each given with its arguments."""
        return [self(*call) for call in calls]


IN_TURN = Runner()
"""The usual runner on a CPU."""


class Queued(Runner):
    """Calls programs without waiting: the host prepares the next while the accelerator works."""

    def __call__(self, program: Any, *arguments: Any) -> Any:
        """Enqueue a program and return its future results."""
        return program(*arguments)


QUEUED = Queued()
"""The usual runner on an accelerator."""


class SideBySide(Runner):
    """Calls two programs at a time if they do not depend on each other.

    XLA spreads the operations of a program over the cores of a CPU, except for sorts and loops, and
    rays are traced in loops. So two programs that trace rays take less time side by side; two other
    programs take more (docs/transport.md). The temporaries of both are in memory at once.
    """

    def all(self, *calls: tuple[Any, ...]) -> list[Any]:
        """See `Runner.all`; every second call is made by another thread."""
        odd_results = in_background(lambda: super(SideBySide, self).all(*calls[1::2]))
        try:
            even_results = super().all(*calls[::2])
        finally:
            wait([odd_results])
        results = [None] * len(calls)
        results[::2], results[1::2] = even_results, odd_results.result()
        return results


class SharedBatch(eqx.Module):
    """A batch whose views lie on several devices, see `devices.ManyDevices.share_out`.

    Attributes
    ----------
    pictures : arrays by name, (devices, views per device, ...). ``keys`` and ``shares`` are those
        of the views in the whole batch; the share of a copy that fills up the last round is 0.
    key : typed PRNG key of the step, the same on all devices.
    carry : see `Batch`.
    """

    pictures: dict[str, Any]
    key: Any
    carry: Any = None

    @property
    def count(self) -> int:
        """Number of views on each device."""
        return self.pictures["shares"].shape[1]


def _cut(tree: Any) -> _Parts:
    return eqx.partition(tree, eqx.is_inexact_array)


@partial(jax.jit, static_argnames=("frozen",))
def _asset(pipeline: Pipeline, params: Params, frozen: tuple[str, ...]) -> tuple[_Parts, Callable]:
    """Reconstruct the asset; also return the pullback from its arrays to the parameters."""
    asset_arrays, pullback, asset_constants = jax.vjp(
        lambda params: _cut(pipeline.reconstruct(without_gradient(params, frozen))),
        params,
        has_aux=True,
    )
    return (asset_arrays, asset_constants), pullback


@jax.jit
def _view(batch: Batch, number: Int[Array, ""]) -> tuple[Batch, Float[Array, ""]]:
    """Take a view and its share in the mean."""
    return batch.view(number), batch.shares[number]


@jax.jit
def _lists(pipeline: Pipeline, asset: _Parts, view: Batch) -> TileLists:
    """List what a view can see."""
    return pipeline.visible(eqx.combine(*asset).splats, view.camera)


@jax.jit
def _seen(pipeline: Pipeline, asset: _Parts, lists: list[TileLists]) -> Bool[Array, " N"] | None:
    """Tell which splats are seen at all."""
    return pipeline.points_seen(eqx.combine(*asset), lists)


@jax.jit
def _lights(
    pipeline: Pipeline,
    asset: _Parts,
    light: EnvLight,
    seen: Bool[Array, " N"] | None,
    batch: Batch,
) -> tuple[_Parts, Any, Callable]:
    """Prepare the light; also return the carry, and the pullback to the asset and the light."""
    asset_arrays, asset_constants = asset

    def prepare(asset_arrays: Any, light: EnvLight) -> tuple[Any, Any]:
        lights, carry = pipeline.lights(
            eqx.combine(asset_arrays, asset_constants), light, seen, batch
        )
        light_arrays, light_constants = _cut(lights)
        return light_arrays, (light_constants, carry)

    light_arrays, pullback, (light_constants, carry) = jax.vjp(
        prepare, asset_arrays, light, has_aux=True
    )
    return (light_arrays, light_constants), carry, pullback


@jax.jit
def _residual_lights(
    pipeline: Pipeline,
    asset: _Parts,
    light: EnvLight,
    seen: Bool[Array, " N"] | None,
    batch: Batch,
) -> Illumination | None:
    """Prepare the light for residuals; see `Pipeline.residual_lights`."""
    return pipeline.residual_lights(eqx.combine(*asset), light, seen, batch)


@jax.jit
def _view_gradient(
    pipeline: Pipeline,
    log_exposure: Float[Array, ""],
    asset: _Parts,
    lights: _Parts,
    residual_lights: Illumination | None,
    lists: TileLists,
    view: tuple[Batch, Float[Array, ""]],
) -> tuple[Any, ViewReport]:
    """Return the loss of a view times its share, its gradient, and the report of the view."""
    batch, share = view
    residual = pipeline.residual_image(
        log_exposure, eqx.combine(*asset), residual_lights, lists, batch
    )

    def loss(log_exposure: Array, asset_arrays: Any, light_arrays: Any) -> tuple[Array, ViewReport]:
        value, report = pipeline.view_loss(
            log_exposure,
            eqx.combine(asset_arrays, asset[1]),
            eqx.combine(light_arrays, lights[1]),
            lists,
            batch,
            residual,
        )
        return share * value, report.times(share)

    (value, report), gradient = jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(
        log_exposure, asset[0], lights[0]
    )
    return (value, gradient), report


@partial(jax.jit, donate_argnums=(0,))
def _plus(first: tuple[Any, ViewReport], second: tuple[Any, ViewReport]) -> tuple[Any, ViewReport]:
    """Add the losses, gradients and reports of two views."""
    total = jax.tree.map(jnp.add, first[0], second[0])
    return total, first[1].plus(second[1])


@partial(jax.jit, static_argnames=("frozen",))
def _back(
    pipeline: Pipeline,
    params: Params,
    asset: _Parts,
    lights: _Parts,
    pullbacks: tuple[Callable, Callable],
    views: tuple[Any, ViewReport],
    batch: Batch,
    carry: Any,
    frozen: tuple[str, ...],
) -> tuple[tuple[Float[Array, ""], LossReport], Params]:
    """Add the terms that depend on no view, and backpropagate to the parameters."""
    asset_arrays, asset_constants = asset
    (value, (by_exposure, by_asset, by_light)), report = views

    def shared_loss(
        params: Params, asset_arrays: Any, light_arrays: Any
    ) -> tuple[Array, dict[str, Array]]:
        return pipeline.shared_loss(
            without_gradient(params, frozen),
            eqx.combine(asset_arrays, asset_constants),
            eqx.combine(light_arrays, lights[1]),
            batch,
        )

    (shared_value, terms), (direct_gradient, from_shared, shared_by_light) = jax.value_and_grad(
        shared_loss, (0, 1, 2), has_aux=True
    )(params, asset_arrays, lights[0])
    from_light, light_gradient = pullbacks[1](jax.tree.map(jnp.add, by_light, shared_by_light))
    (gradient,) = pullbacks[0](jax.tree.map(lambda *x: sum(x), by_asset, from_light, from_shared))
    gradient = jax.tree.map(jnp.add, gradient, direct_gradient)
    gradient = replace(
        gradient,
        light=jax.tree.map(jnp.add, gradient.light, light_gradient),
        log_exposure=gradient.log_exposure + by_exposure,
    )
    loss_report = pipeline.report(eqx.combine(asset_arrays, asset_constants), report, terms, carry)
    return (value + shared_value, loss_report), zero_gradient(gradient, frozen)


def _divided(capacities: Capacities) -> tuple[dict[str, int], dict[str, int]]:
    """Separate the buffers of a view's lists from all others."""
    list_sizes = {name: size for name, size in capacities.items() if name in LIST_BUFFERS}
    return list_sizes, {n: size for n, size in capacities.items() if n not in LIST_BUFFERS}


def value_and_gradient(
    pipeline: Pipeline,
    params: Params,
    batch: Batch | SharedBatch,
    *,
    frozen: tuple[str, ...],
    run: Runner = IN_TURN,
) -> tuple[tuple[Any, LossReport], Params]:
    """Evaluate `Pipeline.loss` and its gradient, view by view (host side).

    Parameters
    ----------
    pipeline, params, batch : see `Pipeline.loss`; a `SharedBatch` for several devices.
    frozen : groups of parameters whose gradient is zero.
    run : calls the programs.

    Returns
    -------
    (total, report), gradient : as from ``jax.value_and_grad``.
    """
    # Lists of another size need another program to make them, but the asset's program stays.
    listing_pipeline, pipeline = (
        replace(pipeline, capacities=Capacities(**sizes)) for sizes in _divided(pipeline.capacities)
    )
    # Side by side is faster only for programs that trace rays, see `SideBySide`.
    run_all = run.all if pipeline.uses_rays else partial(Runner.all, run)
    asset, asset_pullback = run(_asset, pipeline, params, frozen)
    numbers = jax.device_put([np.int32(number) for number in range(batch.count)])
    views = [run(_view, batch, number) for number in numbers]
    # Lists are sorted, which uses one core; so they are made side by side in every stage.
    lists = run.all(*((_lists, listing_pipeline, asset, view) for view, _ in views))
    seen = run(_seen, pipeline, asset, lists)
    light_arguments = (pipeline, asset, params.light, seen, batch)
    (lights, carry, lights_pullback), residual_lights = run_all(
        (_lights, *light_arguments), (_residual_lights, *light_arguments)
    )
    shared_arguments = (pipeline, params.log_exposure, asset, lights, residual_lights)
    total, *view_results = run_all(
        *(
            (_view_gradient, *shared_arguments, *view_arguments)
            for view_arguments in zip(lists, views, strict=True)
        )
    )
    for view_result in view_results:
        total = run(_plus, total, view_result)
    pullbacks = (asset_pullback, lights_pullback)
    return run(_back, pipeline, params, asset, lights, pullbacks, total, batch, carry, frozen)
