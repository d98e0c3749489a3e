"""The devices that a training computes on: one, or several that share the views of each step.

With several devices, each one holds all parameters and builds the whole asset, which needs no
communication. The views of a batch are dealt out to them. Two reductions in a step go over all
devices: which splats are seen, and the sum of the gradients, after which the parameters are the
same everywhere. The programs are those of one device (`gradient`, `step`), each inside a
`jax.shard_map`. The mesh of devices spans all processes that `jax.distributed` knows, and every
process calls the same programs in the same order. Decisions between two steps must therefore be the
same on all hosts: they follow from results of the programs, or from `Devices.any_host` and
`Devices.first_host`.
"""

import json
import os
import re
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.types import Batch, Camera
from geosplat_jax.fit import gradient, step
from geosplat_jax.fit.gradient import IN_TURN, QUEUED, Runner, SharedBatch, SideBySide
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.pipeline import ViewReport

_AXIS = "views"
_SAME, _OWN = PartitionSpec(), PartitionSpec(_AXIS)
"""Placement of arrays that are the same on all devices, and of arrays whose first axis counts the
devices."""

_FORCED = "xla_force_host_platform_device_count"

_Result = TypeVar("_Result")


class Devices:
    """A single device, which needs no placement of arrays and no agreement of hosts.

    See `ManyDevices` for several devices.
    """

    count = 1
    """Number of devices of all hosts."""
    count_here = 1
    """Number of devices of this process."""
    is_first_host = True
    """Whether this process is the one that writes the run's folder."""

    def program(self, program: Any) -> Any:
        """Return the version of a program of `gradient` or `step` that runs on these devices."""
        return program

    def runner(self, *, fits_twice: bool = False) -> Runner:
        """Return the `Runner` that calls programs on these devices.

        ``fits_twice`` : whether the memory holds two programs at a time.
        """
        if jax.default_backend() != "cpu":
            return QUEUED
        return SideBySide() if fits_twice else IN_TURN

    def shapes(self, tree: Any) -> Any:
        """Replace the arrays of a tree by their shapes and placements, for compilation."""
        # Keep weak types: for another type another program would be compiled.
        return _mapped(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=_is_weak(x)), tree
        )

    def place(self, tree: Any) -> Any:
        """Put arrays on all devices."""
        return tree

    def place_again(self, tree: Any) -> Any:
        """Put arrays on all devices, without copying those that the previous call has placed."""
        return tree

    def local(self, tree: Any) -> Any:
        """Return arrays that all devices share as arrays of one device of this process."""
        return tree

    def share_out(self, batch: Batch) -> Batch | SharedBatch:
        """Deal the views of a batch out."""
        return batch

    def any_host(self, flag: bool) -> bool:
        """Tell whether a flag is set on any host."""
        return flag

    def first_host(self, value: Any) -> Any:
        """Return the value that the first host passed; it must be representable in JSON."""
        return value

    def together(self, action: Callable[[], _Result]) -> _Result:
        """Call a function on every host; where it fails on one host, it fails on all.

        Raises
        ------
        TrainingError
            If the function succeeded on this host and failed on another.
        """
        return action()


ONE_DEVICE = Devices()


def _is_weak(x: Any) -> bool:
    return getattr(x, "weak_type", False)


def _is_placed(x: Any) -> bool:
    """Whether an array, or its shape, says on which mesh it lies."""
    sharding = getattr(x, "sharding", None)
    return isinstance(sharding, NamedSharding) and sharding.mesh.axis_names == (_AXIS,)


def _mapped(change: Callable[[Any], Any], tree: Any) -> Any:
    """Apply a function to the arrays of a tree, or their shapes; leave everything else as it is."""
    return jax.tree.map(lambda x: change(x) if hasattr(x, "dtype") else x, tree)


class ManyDevices(Devices):
    """Several devices, of one or of several processes.

    Parameters
    ----------
    devices : JAX devices, at least one of every process; see `choose_devices`.
    """

    def __init__(self, devices: list[Any]) -> None:
        self.mesh = Mesh(np.array(devices), (_AXIS,), axis_types=(AxisType.Explicit,))
        self.count = len(devices)
        self.count_here = len(self._mine)
        self.is_first_host = jax.process_index() == 0
        self._placed: dict[int, tuple[Any, Any]] = {}

    def __repr__(self) -> str:
        return f"ManyDevices({self.count})"

    @property
    def _mine(self) -> list[tuple[int, Any]]:
        """Devices of this process, with their numbers among all."""
        own_index = jax.process_index()
        return [
            (n, d) for n, d in enumerate(self.mesh.devices.flat) if d.process_index == own_index
        ]

    def program(self, program: Any) -> Any:
        """See `Devices.program`."""
        return _programs(self.mesh)[program]

    def runner(self, *, fits_twice: bool = False) -> Runner:
        """See `Devices.runner`; programs run one at a time, since all hosts need the same order."""
        return _OnAll(self)

    def shapes(self, tree: Any) -> Any:
        """See `Devices.shapes`."""

        def shape(x: Any) -> jax.ShapeDtypeStruct:
            spec = x.sharding.spec if _is_placed(x) else _SAME
            sharding = NamedSharding(self.mesh, spec)
            return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding, weak_type=_is_weak(x))

        return _mapped(shape, tree)

    def place(self, tree: Any) -> Any:
        """See `Devices.place`; arrays that are placed stay."""
        return _mapped(self._copied, tree)

    def place_again(self, tree: Any) -> Any:
        """See `Devices.place_again`."""
        placements, self._placed = self._placed, {}

        def placed(x: Any) -> Any:
            placement = placements.get(id(x))
            copy = placement[1] if placement is not None and placement[0] is x else self._copied(x)
            self._placed[id(x)] = (x, copy)
            return copy

        return _mapped(placed, tree)

    def _copied(self, x: Any) -> Any:
        if _is_placed(x):
            return x
        copies = [jax.device_put(x, device) for _, device in self._mine]
        sharding = NamedSharding(self.mesh, _SAME)
        return jax.make_array_from_single_device_arrays(copies[0].shape, sharding, copies)

    def local(self, tree: Any) -> Any:
        """See `Devices.local`."""
        return _mapped(lambda x: x.addressable_data(0) if _is_placed(x) else x, tree)

    def share_out(self, batch: Batch) -> SharedBatch:
        """See `Devices.share_out`: view n goes to device n modulo the number of devices.

        Where the views do not divide evenly, copies of the last view fill up the last round. Their
        share is 0, so they add nothing; they cost no time, since their devices would have to wait.
        """
        count, rounds = batch.count, -(-batch.count // self.count)
        numbers = jnp.arange(count, dtype=jnp.int32)
        pictures = {
            "world_to_camera": batch.camera.world_to_camera,
            "intrinsics": batch.camera.intrinsics,
            "image": batch.image,
            "views": batch.views,
            "valid": batch.valid,
            "keys": jax.vmap(lambda number: jax.random.fold_in(batch.key, number))(numbers),
            "shares": batch.shares,
        }

        def dealt(name: str, values: Array) -> Array:
            shards = []
            for number, device in self._mine:
                rows = number + self.count * np.arange(rounds)
                shard = values[np.minimum(rows, count - 1)]
                if name == "shares":
                    shard = jnp.where(rows < count, shard, 0.0)
                shards.append(jax.device_put(shard[None], device))
            shape = (self.count, *shards[0].shape[1:])
            sharding = NamedSharding(self.mesh, _OWN)
            return jax.make_array_from_single_device_arrays(shape, sharding, shards)

        return SharedBatch(
            {name: dealt(name, x) for name, x in pictures.items() if x is not None},
            self._copied(batch.key),
        )

    def any_host(self, flag: bool) -> bool:
        """See `Devices.any_host`."""
        if jax.process_count() == 1:
            return flag
        return bool(np.any(multihost_utils.process_allgather(np.array(flag))))

    def first_host(self, value: Any) -> Any:
        """See `Devices.first_host`."""
        if jax.process_count() == 1:
            return value
        text = np.frombuffer(json.dumps(value).encode(), np.uint8)
        length = int(multihost_utils.broadcast_one_to_all(np.int32(text.size)))
        # Broadcast arrays must have the same size on all hosts: repeat or cut this text to it.
        resized_text = np.resize(text, length)
        return json.loads(np.asarray(multihost_utils.broadcast_one_to_all(resized_text)).tobytes())

    def together(self, action: Callable[[], _Result]) -> _Result:
        """See `Devices.together`."""
        try:
            result = action()
        except Exception:
            self.any_host(True)
            raise
        if self.any_host(False):
            raise TrainingError("stopped because another host did; its message says why")
        return result


class _OnAll(Runner):
    """Calls programs on many devices, after placing those arguments that are not placed yet."""

    def __init__(self, devices: ManyDevices) -> None:
        self.devices = devices

    def __call__(self, program: Any, *arguments: Any) -> Any:
        """See `Runner`."""
        return super().__call__(self.devices.program(program), *self.devices.place(arguments))


def _local(tree: Any) -> Any:
    """Take away the axis that counts the devices."""
    return jax.tree.map(lambda x: x[0], tree)


def _own(tree: Any) -> Any:
    """Put the axis that counts the devices in front."""
    return jax.tree.map(lambda x: x[None], tree)


def _common(batch: SharedBatch) -> Batch:
    """Return a batch with the key and carry of a step; camera and image are placeholders."""
    placeholders = jnp.zeros((1, 4, 4)), jnp.zeros((1, 3, 3))
    return Batch(Camera(*placeholders, 1, 1), jnp.zeros((1, 1, 1, 4)), batch.key, carry=batch.carry)


def _view(batch: SharedBatch, number: Int[Array, ""]) -> Any:
    """See `gradient._view`; ``number`` counts the views of this device."""
    pictures = _local(batch.pictures)
    height, width = pictures["image"].shape[1:3]
    camera = Camera(pictures["world_to_camera"], pictures["intrinsics"], height, width)
    local_view = Batch(
        camera, pictures["image"], batch.key, pictures.get("views"), pictures.get("valid")
    ).view(number)
    local_view = eqx.tree_at(lambda view: view.key, local_view, pictures["keys"][number])
    return _own((local_view, pictures["shares"][number]))


def _lists(pipeline: Any, asset: Any, view: Any) -> Any:
    """See `gradient._lists`."""
    return _own(gradient._lists(pipeline, asset, _local(view)))


def _seen(pipeline: Any, asset: Any, lists: Any) -> Bool[Array, " N"] | None:
    """See `gradient._seen`: by a view of any device."""
    seen = gradient._seen(pipeline, asset, _local(lists))
    return None if seen is None else jax.lax.pmax(seen.astype(jnp.int32), _AXIS) > 0


def _lights(pipeline: Any, asset: Any, light: Any, seen: Any, batch: SharedBatch) -> Any:
    """See `gradient._lights`."""
    return gradient._lights(pipeline, asset, light, seen, _common(batch))


def _residual_lights(pipeline: Any, asset: Any, light: Any, seen: Any, batch: SharedBatch) -> Any:
    """See `gradient._residual_lights`."""
    return gradient._residual_lights(pipeline, asset, light, seen, _common(batch))


def _view_gradient(
    pipeline: Any,
    log_exposure: Float[Array, ""],
    asset: Any,
    lights: Any,
    residual_lights: Any,
    lists: Any,
    view: Any,
) -> Any:
    """See `gradient._view_gradient`."""
    return _own(
        gradient._view_gradient(
            pipeline, log_exposure, asset, lights, residual_lights, _local(lists), _local(view)
        )
    )


def _plus(first: Any, second: Any) -> Any:
    """See `gradient._plus`."""
    return _own(gradient._plus(_local(first), _local(second)))


def _back(
    pipeline: Any,
    params: Any,
    asset: Any,
    lights: Any,
    pullbacks: Any,
    views: Any,
    batch: SharedBatch,
    carry: Any,
    frozen: tuple[str, ...],
) -> Any:
    """See `gradient._back`: every device backpropagates its own views; gradients are summed.

    Terms that depend on no view are evaluated by every device, with weights divided by the number
    of devices. Other results are taken from the first device: a GPU may add up the same numbers in
    another order and round differently, and parameters must stay the same everywhere.
    """
    loss_gradient, report = _local(views)
    share = 1.0 / jax.lax.axis_size(_AXIS)
    weights = {name: share * weight for name, weight in pipeline.weights.items()}
    pipeline = eqx.tree_at(lambda p: p.weights, pipeline, weights)
    usage = jax.lax.pmax(report.usage, _AXIS)
    terms, mse = jax.lax.psum((report.terms, report.mse), _AXIS)
    (total, loss_report), local_gradient = gradient._back(
        pipeline,
        params,
        asset,
        lights,
        pullbacks,
        (loss_gradient, ViewReport(terms, mse, usage)),
        _common(batch),
        carry,
        frozen,
    )
    total, gradient_sum = jax.lax.psum((total, local_gradient), _AXIS)
    usage, loss_report = jax.lax.pmax(loss_report.usage, _AXIS), _of_first_device(loss_report)
    loss_report = eqx.tree_at(lambda report: report.usage, loss_report, usage)
    return (total, loss_report), gradient_sum


def _of_first_device(tree: Any) -> Any:
    """Give every device what the first one has."""
    is_first = jax.lax.axis_index(_AXIS) == 0

    def sent(x: Array) -> Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(sent(jax.random.key_data(x)))
        if x.dtype == bool:
            return sent(x.astype(jnp.int32)) > 0
        return jax.lax.psum(jnp.where(is_first, x, jnp.zeros_like(x)), _AXIS)

    return jax.tree.map(sent, tree)


@cache
def _programs(mesh: Mesh) -> dict[Any, Any]:
    """Map each program of `gradient` and `step` to its version for the devices of a mesh."""
    specs_of_batch: Any = (_OWN, _SAME, _SAME)
    batch = SharedBatch(*specs_of_batch)

    def spread(
        body: Callable[..., Any], arguments: Iterable[Any], result: Any, **options: Any
    ) -> Any:
        """Compile ``body`` for all devices; specs say how its arguments and results are placed."""
        specs = tuple(arguments)

        def program(*values: Any) -> Any:
            arrays, static = values[: len(specs)], values[len(specs) :]
            sharded_body = jax.shard_map(
                lambda *blocks: body(*blocks, *static),
                mesh=mesh,
                in_specs=specs,
                out_specs=result,
                check_vma=False,
            )
            return sharded_body(*arrays)

        program.__name__ = body.__name__
        return jax.jit(program, **options)

    s, o = _SAME, _OWN
    return {
        gradient._asset: spread(gradient._asset, (s, s), s, static_argnums=2),
        gradient._view: spread(_view, (batch, s), o),
        gradient._lists: spread(_lists, (s, s, o), o),
        gradient._seen: spread(_seen, (s, s, o), s),
        gradient._lights: spread(_lights, (s, s, s, s, batch), s),
        gradient._residual_lights: spread(_residual_lights, (s, s, s, s, batch), s),
        gradient._view_gradient: spread(_view_gradient, (s, s, s, s, s, o, o), o),
        gradient._plus: spread(_plus, (o, o), o, donate_argnums=0),
        gradient._back: spread(_back, (s, s, s, s, s, o, batch, s), s, static_argnums=8),
        step._update: spread(step._update, (s, s, s, s, s), s, donate_argnums=0),
    }


def choose_devices(count: int = 1) -> Devices:
    """Return the devices of a training: ``count`` of every process.

    Without an accelerator the processor is split into that many devices, which share its cores;
    this is meant for tests. Several processes must be connected beforehand, with
    `jax.distributed.initialize`.

    Parameters
    ----------
    count : number of devices of this process; the same in every process.

    Raises
    ------
    TrainingError
        If ``count`` is less than 1, or a process has fewer devices.
    """
    if count < 1:
        raise TrainingError(f"a training needs at least one device, got {count}")
    if count > 1 and _FORCED not in os.environ.get("XLA_FLAGS", ""):
        try:
            jax.config.update("jax_num_cpu_devices", count)
        except RuntimeError:
            pass  # jax is initialised already; its devices are counted below
    devices = jax.local_devices()
    if len(devices) < count:
        raise TrainingError(
            f"--devices {count}: this process has {len(devices)} of kind {devices[0].platform}; "
            "ask for fewer (a CPU can be split into several devices only before jax first uses it)"
        )
    if count == 1 and jax.process_count() == 1:
        return ONE_DEVICE
    by_process: dict[int, list[Any]] = {}
    for device in jax.devices():
        by_process.setdefault(device.process_index, []).append(device)
    fewest_devices = min(map(len, by_process.values()))
    if fewest_devices < count:
        raise TrainingError(f"--devices {count}: a host has {fewest_devices} only; ask for fewer")
    return ManyDevices(
        [d for _, process_devices in sorted(by_process.items()) for d in process_devices[:count]]
    )


def connect_hosts(
    hosts: str, *, host: int | None = None, coordinator: str | None = None, patience: int = 100
) -> None:
    """Make this process one of several; call it before jax computes anything.

    Parameters
    ----------
    hosts : number of processes; ``auto`` to take it from Slurm, Open MPI, Kubernetes or a TPU pod.
    host : number of this process, from 0.
    coordinator : ADDRESS:PORT of process 0, which all others must be able to reach.
    patience : seconds without a sign of life after which a process is taken for dead, and that a
        process that has ended waits for the others.

    Raises
    ------
    TrainingError
        If the processes do not find each other, their number is not known, or the coordinator has
        no port.
    """
    if coordinator is not None and not re.fullmatch(r".+:\d+", coordinator):
        raise TrainingError(f"--coordinator reads ADDRESS:PORT, got {coordinator!r}")
    process_options = {} if hosts == "auto" else {"num_processes": int(hosts), "process_id": host}
    try:
        jax.distributed.initialize(
            coordinator_address=coordinator,
            heartbeat_timeout_seconds=patience,
            shutdown_timeout_seconds=patience,
            **process_options,
        )
    except (ValueError, RuntimeError) as error:
        message = str(error).splitlines()[0]
        raise TrainingError(f"the hosts cannot be connected: {message}") from error
