"""Parts of a model: each can be left out, alone or with others, and a valid model remains."""

import jax
import jax.numpy as jnp
import pytest
from support import tiny_config

from geosplat_jax.fit.config import config_from_dict, config_warnings, differences
from geosplat_jax.fit.model_parts import LADDER, offered_parts, without
from geosplat_jax.fit.presets import PRESETS, QUALITIES, make_config
from geosplat_jax.fit.stages import initial_params, update_rule
from geosplat_jax.materials import init_materials
from geosplat_jax.render import Params
from geosplat_jax.transport.environment import LightSpec, init_light
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.split_sum import SplitSumSettings

NAMES = [part.name for part in LADDER]


def changed_by(name, config):
    """Paths of the settings that change when the part is left out."""
    part = LADDER[NAMES.index(name)]
    return {line.partition(":")[0] for line in differences(config, part.removed(config))}


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_smaller_model_has_settings_that_can_be_written_and_trained(preset, quality):
    config = make_config(preset, quality)
    parts = offered_parts(config)
    for count in range(len(parts) + 1):
        smaller = without(config, parts[count:])
        assert config_from_dict(smaller.to_dict()) == smaller
        offered_names = {part.name for part in offered_parts(smaller)}
        remaining_names = {part.name for part in parts[:count]}
        # Parts that are chosen by size can be reduced once more.
        assert remaining_names <= offered_names <= remaining_names | {"hash", "light", "cells"}
        assert config_warnings(smaller) == config_warnings(config)


def test_the_default_model_has_all_parts_and_the_smallest_none():
    config = make_config()
    assert [part.name for part in offered_parts(config)] == NAMES
    smallest = without(config, LADDER)
    material = smallest.material
    assert (material.specular, material.has_metallic, material.has_shift) == ("none", False, False)
    assert (smallest.light.height, smallest.light.width) == (16, 32)
    assert smallest.geometry.resolution == 32
    assert material.grid == make_config(quality="draft").material.grid
    assert {type(stage.transport) for stage in smallest.stages} == {SplitSumSettings}
    # Parts that are chosen by size can be halved once more; the others cannot be left out again.
    assert {part.name for part in offered_parts(smallest)} <= {"hash", "light", "cells"}


def test_what_needs_another_part_is_taken_out_with_its_own_settings_only():
    config = make_config()
    assert changed_by("specular", config) == {"material.specular"}
    assert changed_by("roughness", config) == {"material.specular"}
    assert changed_by("metallic", config) == {"material.has_metallic"}
    direct_config = LADDER[NAMES.index("indirect")].removed(config)
    transport = direct_config.stage("monte_carlo").transport
    assert isinstance(transport, MonteCarloSettings)
    assert (transport.indirect, transport.occlusion) == ("none", True)
    assert "indirect" not in direct_config.stage("monte_carlo").weights


@pytest.mark.parametrize("kind", ["monte_carlo", "paths"])
def test_without_shadows_light_is_sampled_and_meets_no_surface(kind):
    overrides = (
        f"stages.monte_carlo.transport.kind={kind}",
        "stages.monte_carlo.transport.light_count=7",
        "stages.monte_carlo.transport.residual_count=3",
        "stages.refine.domain.kind=per_pixel",
        "stages.refine.domain.points=mesh",
    )
    config = make_config(overrides=overrides)
    open_config = LADDER[NAMES.index("shadows")].removed(config)
    transport = open_config.stage("monte_carlo").transport
    assert isinstance(transport, MonteCarloSettings)
    assert (transport.occlusion, transport.indirect) == (False, "none")
    assert (transport.light_count, transport.residual_count) == (7, 3)
    for stage in open_config.stages:
        assert not stage.domain.uses_rays
        assert not stage.transport.build(LightSpec()).uses_rays
        assert "indirect" not in stage.weights
    assert open_config.stage("split_sum") == config.stage("split_sum")


@pytest.mark.parametrize(
    ("paths", "missing"),
    [
        (["material.specular"], {"specular", "roughness"}),
        (["material.has_metallic"], {"metallic", "specular"}),  # with the part that it needs
        (["stages.monte_carlo.transport.occlusion"], {"shadows", "sampling"}),
        (["stages.monte_carlo.transport.kind"], {"shadows", "sampling"}),
        (["stages.monte_carlo.transport.indirect"], {"indirect", "shadows", "sampling"}),
        (["material.grid.levels", "light.width"], {"hash", "light"}),
        (["geometry.resolution", "material.has_shift"], {"cells", "shift"}),
        (["run.seed", "stages.monte_carlo.steps"], set()),
    ],
)
def test_what_was_set_by_hand_is_not_chosen(paths, missing):
    offered_names = {part.name for part in offered_parts(make_config(), paths)}
    assert offered_names == set(NAMES) - missing


@pytest.mark.parametrize(
    ("overrides", "missing"),
    [
        (("material.specular=none",), {"specular", "roughness", "metallic"}),
        (("material.specular=uniform",), {"roughness"}),
        (
            ("stages.monte_carlo.steps=0", "stages.refine.steps=0"),
            {"sampling", "shadows", "indirect"},
        ),
        (
            (
                "stages.monte_carlo.transport.occlusion=false",
                "stages.refine.transport.occlusion=false",
            ),
            {"shadows"},
        ),
        (("geometry.resolution=5",), {"cells"}),
    ],
)
def test_parts_that_settings_lack_or_never_use_are_not_offered(overrides, missing):
    offered_names = {part.name for part in offered_parts(make_config(overrides=overrides))}
    assert offered_names == set(NAMES) - missing


def test_what_is_left_out_has_no_parameters():
    """Every part adds parameters, except those of light transport, and cells of a given shape."""
    config = tiny_config("light.height=16", "light.width=32", "material.grid.finest=64")
    shape = {"sdf": jax.numpy.zeros(3)}

    def count(parts):
        smaller = without(config, parts)
        params = jax.eval_shape(lambda: initial_params(shape, smaller, jax.random.key(0)))
        return sum(leaf.size for leaf in jax.tree.leaves(params))

    sizes = [count(LADDER[n:]) for n in range(len(LADDER) + 1)]
    adds_parameters = {name: b > a for name, a, b in zip(NAMES, sizes, sizes[1:], strict=False)}
    assert adds_parameters == {
        **dict.fromkeys(("specular", "roughness", "metallic", "shift", "hash", "light"), True),
        **dict.fromkeys(("sampling", "shadows", "indirect", "cells"), False),
    }


@pytest.mark.parametrize("specular", ["none", "uniform", "field"])
@pytest.mark.parametrize("preset", PRESETS)
def test_every_model_of_the_material_has_its_learning_rates(preset, specular):
    config = make_config(preset, overrides=(f"material.specular={specular}",))
    field = jax.eval_shape(lambda: init_materials(jax.random.key(0), config.material))
    params = Params(geometry=(), material=field, light=init_light(2), log_exposure=jnp.zeros(()))
    for stage in config.stages:
        update_rule(config, stage, params, 0)  # raises where a group has none
