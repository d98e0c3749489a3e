"""Needs that exceed the memory are refused beforehand, with the setting that causes them."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.fit.memory import (
    fits_twice,
    require_program_memory,
    require_rendering_memory,
    require_training_memory,
    training_needs,
)
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import peak_memory_mb
from geosplat_jax.fit.stages import initial_params
from geosplat_jax.fit.step import initial_state
from geosplat_jax.fit.train import fit
from geosplat_jax.io import memory
from geosplat_jax.io.frames import Frame, Listing
from geosplat_jax.io.images import SceneError, read_image, write_png
from geosplat_jax.io.lenses import AngleLens
from geosplat_jax.io.loading import load_views
from geosplat_jax.io.memory import Need, memory_of_machine, memory_refusal
from geosplat_jax.io.windows import around_object
from geosplat_jax.surface.hull import fit_grid
from geosplat_jax.transport.environment import LightSpec, operator_bytes, prefilter_operators

GIGA = 10**9


@pytest.fixture
def machine(monkeypatch):
    """Return a function that sets the memory of the machine, in GB."""

    def set_to(gigabytes):
        count = None if gigabytes is None else int(gigabytes * GIGA)
        monkeypatch.setattr(memory, "memory_of_machine", lambda: count)

    set_to(16)
    return set_to


def byte_count(tree):
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def test_the_machine_has_memory():
    machine_bytes = memory_of_machine()
    assert machine_bytes is None or machine_bytes > 10**8


def test_the_limit_of_a_container_counts_where_it_is_the_smaller_one(tmp_path, monkeypatch):
    limited, unlimited = tmp_path / "limited", tmp_path / "unlimited"
    limited.write_text("1000000\n")
    unlimited.write_text("max\n")
    monkeypatch.setattr(memory, "_CONTAINER_LIMITS", (unlimited, tmp_path / "missing"))
    machine_bytes = memory_of_machine()
    if machine_bytes is None:
        pytest.skip("this system does not tell how much memory it has")
    assert machine_bytes > 10**8
    monkeypatch.setattr(memory, "_CONTAINER_LIMITS", (unlimited, limited))
    assert memory_of_machine() == 1_000_000


def test_a_refusal_names_the_largest_needs_first(machine):
    needs = [Need("small", GIGA), Need("large", 12 * GIGA), Need("middle", 4 * GIGA)]
    assert memory_refusal(needs) == (
        "at least 17.0 GB of memory would be needed, and there are 16.0 GB: large 12.0 GB, "
        "middle 4.0 GB, small 1.0 GB"
    )
    assert memory_refusal(needs[1:]) is None
    machine(None)
    assert memory_refusal(needs) is None


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (("material.grid.log2_entries=30", "material.grid.finest=4096"), "material.grid"),
        (("geometry.resolution=512",), "geometry"),
        (("geometry.resolution=400", "geometry.cubic=true"), "geometry"),
        (("light.width=8192", "light.height=4096"), "light"),
        (("objective.smoothness_samples=1000000000",), "objective.smoothness_samples"),
        (
            (
                "geometry.resolution=128",
                "stages.monte_carlo.transport.light_count=4096",
                "stages.monte_carlo.transport.diffuse_count=4096",
            ),
            r"stages.*.transport.*_count",
        ),
    ],
)
def test_settings_that_cannot_fit_are_refused_by_their_names(machine, overrides, named):
    config, dataset = make_config(overrides=overrides), sphere_dataset(size=4)
    with pytest.raises(TrainingError, match=r"\d GB of memory would be needed, and") as error_info:
        require_training_memory(config, dataset)
    assert f"there are 16.0 GB: {named} " in str(error_info.value)
    assert "\n" not in str(error_info.value)


def test_a_program_that_does_not_fit_is_refused_once_it_is_compiled(machine):
    """The program has a small input and output, and an outer product of four megabytes between."""

    @jax.jit
    def program(x):
        return jnp.sum(jnp.sort(jnp.outer(x, x), axis=0))

    compiled = program.trace(jax.ShapeDtypeStruct((1000,), jnp.float32)).lower().compile()
    machine(0.0045)
    require_program_memory("program", compiled)
    assert not fits_twice(compiled)
    machine(0.016)
    assert fits_twice(compiled)
    for gigabytes, copies in ((0.0035, 1), (0.0045, 2)):
        machine(gigabytes)
        with pytest.raises(
            TrainingError, match="the program program 0.0 GB; lower geom"
        ) as error_info:
            require_program_memory("program", compiled, copies)
        assert "\n" not in str(error_info.value)


class Accelerator:
    """Reports its memory as JAX's devices do."""

    def __init__(self, limit, peak):
        self.stats = {"bytes_limit": limit, "peak_bytes_in_use": peak}

    def memory_stats(self):
        return self.stats


def test_an_accelerator_has_memory_of_its_own(machine, monkeypatch):
    """Programs have to fit into the memory of an accelerator, whatever memory the machine has.

    Several accelerators hold one copy each.
    """
    program = jax.jit(lambda x: jnp.sum(jnp.sort(jnp.outer(x, x), axis=0)))
    compiled = program.trace(jax.ShapeDtypeStruct((1000,), jnp.float32)).lower().compile()
    accelerators = [Accelerator(8 * GIGA, 3 * GIGA), Accelerator(4_500_000, 2**20)]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: accelerators)
    machine(0.001)
    require_program_memory("program", compiled, 2)
    assert not fits_twice(compiled)
    assert peak_memory_mb() == 3 * GIGA // 2**20
    accelerators[1].stats["bytes_limit"] = 3_500_000
    with pytest.raises(TrainingError, match="there are 0.0 GB: the program program 0.0 GB"):
        require_program_memory("program", compiled)
    accelerators[:] = [accelerators[1]]
    accelerators[0].stats = None  # some devices report no memory
    require_program_memory("program", compiled)
    assert peak_memory_mb() == 0


def test_the_memory_of_the_program_that_started_a_training_is_no_part_of_its_own():
    status = Path("/proc/self/status")
    if not status.exists() or "VmHWM" not in status.read_text():
        pytest.skip("the system does not tell the peak of a single program")
    large = np.ones(2**30, np.uint8)
    script = "from geosplat_jax.fit.runtime import peak_memory_mb; print(peak_memory_mb())"
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert large.nbytes // 2**20 == 1024
    assert 30 < int(process.stdout) < 900
    block = np.ones(2**28, np.uint8)
    assert peak_memory_mb() >= block.nbytes // 2**20


def test_a_limit_of_the_process_counts(monkeypatch):
    import resource

    machine_bytes = memory_of_machine()
    if machine_bytes is None:
        pytest.skip("this system does not tell how much memory it has")
    monkeypatch.setattr(
        resource,
        "getrlimit",
        lambda kind: (10**9 if kind == resource.RLIMIT_DATA else resource.RLIM_INFINITY, 0),
    )
    assert memory_of_machine() == 10**9


def test_a_training_that_cannot_fit_makes_no_folder(machine, tmp_path):
    machine(0.0001)
    with pytest.raises(TrainingError, match="change the first of these"):
        fit(sphere_dataset(size=4), tiny_config(), tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("preset", ["default", "paper", "code"])
@pytest.mark.parametrize("quality", ["standard", "high"])
def test_every_preset_fits_into_eight_gigabytes_as_far_as_is_known(machine, preset, quality):
    machine(8)
    require_training_memory(make_config(preset, quality), sphere_dataset(size=4))


def test_what_is_counted_is_what_a_training_makes():
    dataset = sphere_dataset(size=12)
    config = tiny_config("stages.split_sum.batch_views=2", "geometry.resolution=9")
    byte_counts = {need.what: need.byte_count for need in training_needs(config, dataset)}
    surface, shape = config.geometry.start(dataset, jax.random.key(0))
    params = initial_params(shape, config, jax.random.key(0))
    state = initial_state(params)
    # The memory holds the parameters, both moments of Adam and a gradient. Exposure and counters
    # are scalars, which the tolerance covers.
    state_bytes = byte_count((state.params, state.optimizer)) + byte_count(params)
    operators = 2 * operator_bytes(config.light)
    parts = ("geometry", "light", "material.grid", "material.*_hidden")
    assert sum(byte_counts[part] for part in parts) - operators == pytest.approx(
        state_bytes, abs=64
    )
    assert byte_counts["geometry"] == 4 * byte_count(params.geometry)
    assert byte_counts["material.grid"] >= 4 * byte_count(params.material.albedo_table)
    assert byte_counts["the photographs (--downscale)"] == 2 * dataset.train.images.nbytes
    assert byte_counts["stages.*.batch_views"] == 2 * 12 * 12 * 16
    grid = fit_grid(dataset.bounds, 9)
    assert surface.grid.shape == grid.shape


def test_views_of_a_step_are_counted_as_the_windows_that_they_are():
    dataset, config = sphere_dataset(size=100, radius=0.1), tiny_config()
    windows, _ = around_object(dataset.train, largest=config.run.window)
    assert windows.height < 60
    byte_counts = {need.what: need.byte_count for need in training_needs(config, dataset)}
    assert byte_counts["stages.*.batch_views"] == windows.images[0].nbytes


def test_the_operators_of_the_light_are_counted_as_they_are_made():
    spec = LightSpec(height=6, width=10, roughness=(0.0, 0.3, 1.0))
    assert operator_bytes(spec) == np.asarray(prefilter_operators(spec).zonal).nbytes


def test_a_checkpoint_of_large_settings_is_refused_by_its_file(machine):
    config = make_config(overrides=("light.width=8192", "light.height=4096"))
    with pytest.raises(TrainingError, match=r"^run/checkpoint\.npz: at least .*: light "):
        require_rendering_memory(config, {}, "run/checkpoint.npz")
    require_rendering_memory(make_config("paper"), {"hits": 10**6}, "run/checkpoint.npz")
    machine(4)
    with pytest.raises(TrainingError, match=r"^run/checkpoint\.npz: .* capacities\.hits 8\.0 GB"):
        require_rendering_memory(make_config(), {"hits": 2 * GIGA}, "run/checkpoint.npz")


def test_a_picture_larger_than_the_memory_is_refused_by_its_header(machine, tmp_path):
    path = tmp_path / "bomb.png"
    write_png(path, np.ones((400, 500, 4), np.float32))
    machine(0.009)
    with pytest.raises(SceneError, match=r"memory .*: .*bomb\.png of 500 x 400 pixels 0\.0 GB"):
        read_image(path)
    machine(0.010)
    assert read_image(path).shape == (400, 500, 4)


def test_many_pictures_are_refused_after_the_first(machine, tmp_path):
    path = tmp_path / "one.png"
    write_png(path, np.ones((40, 50, 4), np.float32))
    frames = [Frame(f"view_{k}", np.eye(4), AngleLens(1.0), path) for k in range(200)]
    machine(0.005)
    with pytest.raises(SceneError, match=r"200 images like .*one\.png 0\.0 GB.*--downscale"):
        load_views(frames, factor=1, listing=Listing(tuple(frames), ()), most_bytes=GIGA)
    load_views(frames, factor=2, listing=Listing(tuple(frames), ()), most_bytes=GIGA)
