"""Lower bound of a training's memory, computed from its settings before anything is spent.

Only what has a known size is counted: the photographs, the views of a step, the parameters with
their gradients and Adam's moments, constants of the light transport, the points of the smoothness
terms, and the samples of the least number of splats. Whatever else depends on the number of splats
is not known beforehand; it has its own limit (`SurfaceSettings.limits`). Settings that are refused
can therefore not work, and others may still need more memory. How much a program needs is known
once it is compiled, and checked before it runs (`require_program_memory`).
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from geosplat_jax.fit.config import Config
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.pyramid import level_sizes
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.memory import Need, accelerator_refusal, memory_refusal
from geosplat_jax.io.windows import window_size
from geosplat_jax.materials import init_materials

_COPIES_LEARNED = 4
"""A learned number, its gradient, and the two moments of Adam."""

_FLOAT_BYTES = 4

_SMOOTHNESS = {"smoothness_albedo", "smoothness_roughness_metallic"}
"""Terms of the loss that are evaluated at points of their own."""

_PIXEL_BYTES = 4 * _FLOAT_BYTES
"""RGBA in single precision."""


def training_needs(config: Config, dataset: Dataset) -> list[Need]:
    """List the least memory that a training needs at one time, by the settings that decide it.

    Stages follow one another, so where they need different amounts, the largest counts.
    """
    train, test = dataset.train, dataset.test
    pixels = math.prod(window_size(train, largest=config.run.window))
    images = train.images.nbytes + test.images.nbytes
    views = max((min(stage.batch_views, len(train)) for stage in config.active_stages), default=0)
    light = _light_numbers(config) * _FLOAT_BYTES
    return [
        Need("the photographs (--downscale)", images),
        Need("stages.*.batch_views", views * pixels * _PIXEL_BYTES),
        Need("geometry", _COPIES_LEARNED * config.geometry.parameter_bytes(dataset.bounds)),
        Need("light", light + _transport_bytes(config)),
        *(Need(need.what, _COPIES_LEARNED * need.byte_count) for need in _field_needs(config)),
        Need("objective.smoothness_samples", _smoothness_bytes(config)),
        Need("stages.*.transport.*_count", _sample_bytes(config)),
    ]


def require_training_memory(config: Config, dataset: Dataset) -> None:
    """Refuse a training that cannot fit into the memory.

    Raises
    ------
    TrainingError
        One line, with the settings that take most.
    """
    refusal = memory_refusal(training_needs(config, dataset))
    if refusal is not None:
        raise TrainingError(f"{refusal}; change the first of these")


def require_program_memory(name: str, compiled: jax.stages.Compiled, copies: int = 1) -> None:
    """Refuse a compiled program whose arguments, results and temporaries do not fit.

    Parameters
    ----------
    name : name of the program.
    compiled : the program, for a processor or an accelerator.
    copies : devices of this process; processors share the memory of the machine, and every
        accelerator has its own.

    Raises
    ------
    TrainingError
        In one line, with the settings that make the program large.
    """
    refusal = _program_refusal(name, compiled, copies)
    if refusal is not None:
        raise TrainingError(
            f"{refusal}; lower geometry.resolution, stages.*.transport.*_count, the size of the "
            "images (--downscale) or stages.*.batch_views"
        )


def fits_twice(compiled: jax.stages.Compiled) -> bool:
    """Whether the memory of the machine holds a program twice; False with an accelerator."""
    return jax.default_backend() == "cpu" and _program_refusal("", compiled, 2) is None


def _program_refusal(name: str, compiled: jax.stages.Compiled, copies: int) -> str | None:
    """Return why ``copies`` copies of a program do not fit into the memory; None where they do."""
    sizes = compiled.memory_analysis()
    if sizes is None:
        return None
    need = sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    need -= sizes.alias_size_in_bytes
    if jax.default_backend() != "cpu":
        return accelerator_refusal([Need(f"the program {name}", need)])
    return memory_refusal([Need(f"the program {name}", copies * need)])


def require_rendering_memory(
    config: Config, capacities: Mapping[str, int], where: str | Path
) -> None:
    """Refuse a checkpoint whose parameters and buffers cannot fit into the memory.

    Parameters
    ----------
    config : settings of the checkpoint.
    capacities : sizes of its buffers; a row of a buffer counts as one number.
    where : file of the checkpoint.

    Raises
    ------
    TrainingError
        In one line, with the file and the settings that need most.
    """
    needs = [
        *_field_needs(config),
        Need("light", _transport_bytes(config)),
        *(Need(f"capacities.{name}", _FLOAT_BYTES * n) for name, n in capacities.items()),
    ]
    refusal = memory_refusal(needs)
    if refusal is not None:
        raise TrainingError(f"{where}: {refusal}")


def _field_needs(config: Config) -> list[Need]:
    """Count the bytes of the material field, once: its tables and its heads."""
    outputs = max((stage.transport.indirect_outputs for stage in config.active_stages), default=0)
    field = jax.eval_shape(
        lambda key: init_materials(key, config.material, indirect_outputs=outputs),
        jax.random.key(0),
    )
    tables = _byte_count((field.albedo_table, field.surface_table))
    return [
        Need("material.grid", tables),
        Need("material.*_hidden", _byte_count(field) - tables),
    ]


def _light_numbers(config: Config) -> int:
    """Count a light's texels and their gradient, and the moments of the levels of its pyramid."""
    height, width = config.light.height, config.light.width
    levels = sum(rows * columns for rows, columns in level_sizes(height, width))
    return 3 * (2 * height * width + 2 * levels)


def _transport_bytes(config: Config) -> int:
    """Count the bytes of the light transport's constants, in the stage that has most."""
    stages = config.active_stages
    return max((stage.transport.constant_bytes(config.light) for stage in stages), default=0)


def _sample_bytes(config: Config) -> int:
    """Count the bytes that the samples of the least number of splats take."""
    numbers = max((stage.transport.numbers_per_splat for stage in config.active_stages), default=0)
    return _FLOAT_BYTES * config.geometry.fewest_splats * numbers


def _smoothness_bytes(config: Config) -> int:
    """Count the bytes of the smoothness terms' encoded points and displaced copies (Eq. 16)."""
    if not any(_SMOOTHNESS & set(stage.weights_at(0)) for stage in config.active_stages):
        return 0
    width = config.material.grid.width * config.material.encodings
    return 2 * config.objective.smoothness_samples * width * _FLOAT_BYTES


def _byte_count(tree: Any) -> int:
    """Count the bytes of the arrays of a tree, or of their shapes."""
    return sum(
        int(np.prod(leaf.shape, dtype=object)) * leaf.dtype.itemsize
        for leaf in jax.tree.leaves(tree)
    )
