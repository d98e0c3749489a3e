"""What `test_devices` runs in processes of their own: jax counts its devices once, at the start.

``python two_devices.py gradient FOLDER`` : one process with two devices against one device.
``python two_devices.py train FOLDER PORT HOST`` : one of two processes that train together.
"""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

os.environ["XLA_FLAGS"] = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)

import jax
import jax.numpy as jnp
import numpy as np
from support import sphere_dataset, sphere_views, tiny_config
from test_pipeline import problem

from geosplat_jax.fit import loop as loop_module
from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.devices import choose_devices, connect_hosts
from geosplat_jax.fit.gradient import value_and_gradient
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.train import Interrupted, TrainingError, fit

VIEWS = 3
"""Views of a step: two devices have two and one, so that one place is filled up."""


def gradients():
    """Return what one and two devices make of the same batch, as numbers."""
    devices = choose_devices(2)
    _, pipeline, params, batch = problem(stage="split_sum")
    views = sphere_views(VIEWS, size=14)
    # The second view counts for less.
    valid = jnp.ones((VIEWS, 14, 14)).at[1, :, :5].set(0.0)
    batch = replace(
        batch, camera=views.camera(range(VIEWS)), image=jnp.asarray(views.images), valid=valid
    )
    single = value_and_gradient(pipeline, params, batch, frozen=("light",))
    sharded = value_and_gradient(
        devices.place(pipeline),
        devices.place(params),
        devices.share_out(batch),
        frozen=("light",),
        run=devices.runner(),
    )
    copies = [
        [shard.data for shard in leaf.addressable_shards] for leaf in jax.tree.leaves(sharded)
    ]
    assert all(len(shards) == 2 for shards in copies)
    return {
        "one": jax.tree.leaves(single),
        "two": jax.tree.leaves(devices.local(sharded)),
        "apart": np.array([not np.array_equal(*shards) for shards in copies]),
    }


def trained(folder, host):
    """Train with interruptions, overflows and a refusal; return what this host saw."""
    devices = choose_devices(1)
    dataset = sphere_dataset()
    errors = {}

    def attempt(name, config, **options):
        try:
            fit(dataset, config, folder, devices=devices, **options)
        except (Interrupted, TrainingError) as error:
            errors[name] = f"{type(error).__name__}: {error}"

    config = tiny_config("stages.split_sum.batch_views=2")
    if host == 1:
        attempt("other settings", replace(config, run=replace(config.run, seed=5)))
    else:
        attempt("other settings", config)
    stop_signals = []

    def too_small(*args, **kwargs):
        planned_capacities = plan(*args, **kwargs)
        # The hosts plan differently, and the first one's buffers are too small.
        return planned_capacities.resized(hits=128 if host == 0 else planned_capacities["hits"])

    plan, loop_module.plan_capacities = loop_module.plan_capacities, too_small
    resize, sizes = loop_module.Loop._resize, []

    def noted(loop, capacities, step):
        sizes.append([step, loop.pipeline.capacities["hits"], capacities["hits"]])
        resize(loop, capacities, step)
        if host == 1 and loop.step == 1 and not stop_signals:
            # Only the second host is asked to stop, in its second step.
            stop_signals.append(True)
            os.kill(os.getpid(), signal.SIGINT)

    loop_module.Loop._resize = noted
    attempt("stop", config)
    attempt("resume", config, begin=Resume())
    state = fit(dataset, config, folder, devices=devices, begin=Resume())
    return {"said": errors, "sizes": sizes, "step": int(state.step)}, jax.tree.leaves(state.params)


def main():
    """Run what the arguments ask for, and leave it in the folder."""
    task, folder, *other_arguments = sys.argv[1:]
    enable_compilation_cache(Path(sys.prefix) / "cache")
    folder = Path(folder)
    if task == "gradient":
        results = gradients()
        arrays = {f"{name}{k}": x for name in ("one", "two") for k, x in enumerate(results[name])}
        np.savez(folder / "gradient.npz", apart=results["apart"], **arrays)
        return
    port, host = other_arguments
    # Machines of tests may stand still for minutes.
    connect_hosts("2", host=int(host), coordinator=f"localhost:{port}", patience=3600)
    report, leaves = trained(folder / "run", int(host))
    (folder / f"host{host}.json").write_text(json.dumps(report))
    np.savez(folder / f"host{host}.npz", *leaves)


if __name__ == "__main__":
    main()
