"""Configurations: presets, overrides, validation, serialisation."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from geosplat_jax.core.settings import as_written
from geosplat_jax.deferred import PerPixel
from geosplat_jax.fit.config import (
    Config,
    Rate,
    Stage,
    all_settings,
    config_from_dict,
    config_warnings,
    differences,
    moved_setting,
    override_paths,
    parse_override,
)
from geosplat_jax.fit.presets import (
    PRESET_PRIORS,
    PRESETS,
    QUALITIES,
    between_qualities,
    make_config,
)
from geosplat_jax.losses import Schedule
from geosplat_jax.materials import MATERIAL_PRIORS
from geosplat_jax.transport.monte_carlo import MonteCarloSettings


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("quality", QUALITIES)
def test_every_preset_and_quality_survives_json_and_raises_no_warning(preset, quality):
    config = make_config(preset, quality)
    restored_config = config_from_dict(json.loads(json.dumps(config.to_dict())))
    assert restored_config == config
    assert differences(config, restored_config) == []
    assert config_warnings(config) == []


@pytest.mark.parametrize("preset", PRESETS)
def test_every_setting_says_what_it_means(preset):
    lines = all_settings(make_config(preset))
    assert len({path for path, *_ in lines}) == len(lines) > 100
    assert [path for path, _, _, meaning in lines if not meaning] == []


@pytest.mark.parametrize("preset", PRESETS)
def test_every_setting_is_written_as_it_is_set(preset):
    pace = "stages.split_sum.pace=[{step=0,speed=0.5},{step=50,speed=0.75}]"
    config = make_config(
        preset, overrides=(pace, "stages.monte_carlo.transport.denoise.depth_sigma=inf")
    )
    rows = [(path, as_written(value)) for path, value, *_ in all_settings(config)]
    written = dict(rows)
    assert written["stages.split_sum.pace"] == (
        "[{step = 0, speed = 0.5}, {step = 50, speed = 0.75}]"
    )
    assert written["stages.monte_carlo.enter"].startswith("[{kind = ")
    assert written["stages.monte_carlo.transport.denoise.depth_sigma"] == "inf"
    # The name of a stage cannot be set.
    overrides = [f"{path}={text}" for path, text in rows if not path.endswith(".name")]
    assert make_config(preset, overrides=tuple(overrides)) == config


def test_presets_carry_the_numbers_of_the_paper_and_of_the_authors_code():
    paper, code = make_config("paper"), make_config("code")
    assert (paper.adapter.u, paper.adapter.v) == (0.07, 0.22)
    assert code.adapter.u == pytest.approx(0.069444, abs=1e-6)
    assert code.adapter.v == pytest.approx(2 / 9)
    assert (paper.adapter.opacity, code.adapter.opacity) == (1.0, 0.99)
    assert (paper.adapter.shading_frame, code.adapter.shading_frame) == (True, False)
    assert (paper.material.has_shift, code.material.has_shift) == (False, True)
    assert (paper.material.grid.log2_entries, paper.material.grid.coarsest) == (19, 32)
    assert (code.material.grid.log2_entries, code.material.grid.coarsest) == (18, 16)
    assert code.stages[0].transport.baked_diffuse
    assert not paper.stages[0].transport.baked_diffuse
    assert paper.stages[1].transport.indirect == "harmonics"
    assert code.stages[1].transport.indirect == "constant"
    for config in (paper, code, make_config()):
        # The thickness is the authors' exp(-10), and images are compared in linear light.
        assert config.adapter.thickness == pytest.approx(np.exp(-10), rel=1e-3)
        assert config.objective.srgb is False
    for config in (paper, code):
        assert config.geometry.resolution == 96
        assert config.geometry.cubic
        assert config.geometry.reach == 0.25
        # The sum of Eq. 14 would outweigh the image losses and empty the surface.
        assert config.geometry.entropy_reduction == "mean"
        assert not config.raster.cull_backfaces
        assert config.material.position_gradient
        assert not config.material.shared
        assert not config.material.bias
        assert config.objective.relative_albedo == 0
        assert config.stage("refine").splats.darkest_metal == 0
        assert all("light_cast" not in stage.weights for stage in config.stages)
    for quality in QUALITIES:
        config = make_config("default", quality)
        assert config.material.bias
        assert config.objective.relative_albedo == 0.5
        assert config.stage("refine").splats.darkest_metal == 0.2
        casts = [stage.weights_at(0).get("light_cast") for stage in config.stages]
        assert casts == [pytest.approx(0.003), pytest.approx(0.003), None]


@pytest.mark.parametrize("preset", ["paper", "code"])
def test_the_originals_have_the_schedule_of_the_authors_code(preset):
    split_sum, monte_carlo, refine = make_config(preset).stages
    for stage in (split_sum, monte_carlo):
        assert (stage.steps, stage.batch_views, stage.half_life) == (500, 8, 800.0)
        assert stage.light_knee == 0
        assert stage.rates["light"] == Rate(1e-2)
        assert stage.rates["exposure"] == Rate(5e-3)
        assert stage.rates["shift"] == Rate(3e-3)
    # This is 5 % of the steps of the whole training.
    assert split_sum.vertex_fraction * split_sum.steps == 50
    for name in ("sdf", "deform", "weights"):
        assert split_sum.rates[name] == Rate(1e-2)
        assert monte_carlo.rates[name] == Rate(3e-3, 50)
    assert (split_sum.rates["albedo"], monte_carlo.rates["albedo"]) == (Rate(3e-3), Rate(1e-2))
    assert split_sum.rates["roughness_metallic"] == Rate(1.5e-3)
    assert monte_carlo.rates["roughness_metallic"] == Rate(2e-3)
    assert monte_carlo.rates["indirect"] == Rate(1e-2)
    transport = monte_carlo.transport
    assert isinstance(transport, MonteCarloSettings)
    # 8 x 8 strata, each with one sample of the light and one of the BRDF.
    assert transport.light_count == 64
    assert transport.diffuse_count + transport.specular_count == 64
    assert transport.residual_count == 0
    # The refinement has 512 rays per pixel, a fixed mesh, and rates of which some decay.
    assert (refine.steps, refine.transport.light_count) == (100, 256)
    assert isinstance(refine.domain, PerPixel)
    assert refine.domain.points == {"paper": "splats", "code": "mesh"}[preset]
    assert {"sdf", "deform", "weights", "shift"} <= set(refine.frozen)
    first_rates, later_rates = refine.rates_at(0), refine.rates_at(500)
    expected = {
        "splat_means": 1.6e-4, "splat_scales": 5e-3, "splat_quats": 1e-3, "splat_normals": 1e-3,
        "splat_opacities": 5e-2, "splat_albedo": 5e-3, "splat_indirect": 2.5e-3,
        "roughness_metallic": 5e-4, "light": 1e-3, "exposure": 5e-4,
    }  # fmt: skip
    assert {name: first_rates[name] for name in expected} == pytest.approx(expected)
    for name in expected:
        decays = name in ("splat_means", "splat_normals", "light", "exposure")
        assert later_rates[name] == pytest.approx(
            first_rates[name] * (0.5 if decays else 1.0), rel=1e-5
        )


def test_the_weights_of_the_entropy_and_the_smoothness_follow_paper_and_code():
    split_sum, monte_carlo, _ = make_config("paper").stages
    entropy_weights = [
        s.weights_at(n)["entropy"] for s in (split_sum, monte_carlo) for n in (0, 250, 500)
    ]
    assert entropy_weights == pytest.approx([0.2, 0.105, 0.01, 0.01, 0.01, 0.01])
    assert split_sum.weights_at(0)["smoothness_albedo"] == 0.03
    assert split_sum.weights_at(0)["light"] == monte_carlo.weights_at(0)["light"] == 0.15
    split_sum, monte_carlo, refine = make_config("code").stages
    assert [split_sum.weights_at(n)["entropy"] for n in (0, 500)] == pytest.approx([0.2, 0.12])
    assert [monte_carlo.weights_at(n)["entropy"] for n in (0, 500)] == pytest.approx([0.2, 0.01])
    # The authors' code has means over channels, and ours sums.
    assert split_sum.weights_at(0)["smoothness_albedo"] == 0
    assert split_sum.weights_at(500)["smoothness_albedo"] == pytest.approx(0.03 / 3)
    assert split_sum.weights_at(500)["smoothness_roughness_metallic"] == pytest.approx(0.001 / 2)
    assert split_sum.weights_at(0)["white_balance"] == 0.002
    assert "light" not in monte_carlo.weights_at(0)
    assert refine.weights_at(0)["albedo_smoothness"] == pytest.approx(0.2 / 3)
    assert refine.weights_at(0)["smoothness_roughness_metallic"] == pytest.approx(0.05 / 2)
    assert "mask" not in refine.weights_at(0)


def test_priors_of_shiny_materials_change_the_rates_of_the_authors_code():
    hybrid, glossy, specular = (
        make_config("code", material_prior=prior) for prior in ("hybrid", "glossy", "specular")
    )
    assert [c.stages[0].rates["sdf"].value for c in (hybrid, glossy, specular)] == [
        0.01,
        0.01,
        0.05,
    ]
    assert [c.stages[0].rates["light"].value for c in (hybrid, glossy, specular)] == pytest.approx(
        [0.01, 0.03, 0.03]
    )
    assert specular.stages[0].weights_at(0)["smoothness_albedo"] == pytest.approx(0.5 / 3)
    assert specular.stages[1].weights_at(0)["normal_smoothness"] == pytest.approx(0.005)
    assert "normal_smoothness" not in hybrid.stages[1].weights_at(0)
    assert specular.stages[1].steps == 1000


def test_a_draft_of_the_originals_is_smaller_and_keeps_their_method():
    for preset in ("paper", "code"):
        full_config, draft_config = make_config(preset), make_config(preset, "draft")
        assert draft_config.geometry.resolution < full_config.geometry.resolution
        assert draft_config.total_steps < full_config.total_steps
        assert draft_config.adapter == full_config.adapter
        assert draft_config.raster == full_config.raster
        assert [s.weights for s in draft_config.stages] == [s.weights for s in full_config.stages]


def test_a_draft_learns_its_light_twice_as_fast_and_halves_its_rates_once():
    draft, standard = (make_config("default", quality).stages[0] for quality in QUALITIES[:2])
    assert draft.rates["light"].value == 2 * standard.rates["light"].value
    assert draft.rates_at(400)["light"] == pytest.approx(draft.rates["light"].value / 2)
    assert {**draft.rates, "light": Rate(1e-2)} == standard.rates


def test_overrides_reach_nested_settings_and_keep_types():
    config = make_config(
        overrides=(
            "stages.split_sum.steps=7",
            "geometry.initial=sphere",
            "stages.monte_carlo.half_life=1",
            "stages.monte_carlo.enter=[]",
            "stages.monte_carlo.transport.light_count=3",
        )
    )
    assert config.stages[0].steps == 7
    assert config.geometry.initial == "sphere"
    assert isinstance(config.stages[1].half_life, float)
    assert config.stages[1].enter == ()
    assert config.stages[1].transport.light_count == 3


def test_a_number_sets_the_value_of_a_rate_or_a_weight_and_leaves_the_rest():
    config = make_config()
    changed_config = make_config(
        overrides=(
            "stages.monte_carlo.rates.albedo=0.5",
            "stages.split_sum.weights.entropy=0.3",
            "stages.split_sum.weights.light=0.15",
            "stages.split_sum.weights.indirect.end=0.25",
        )
    )
    assert changed_config.stages[1].rates["albedo"] == Rate(
        0.5, config.stages[1].rates["albedo"].warmup
    )
    assert changed_config.stages[0].weights["entropy"] == Schedule(0.3, 0.01, 0.5)
    assert changed_config.stages[0].weights["light"] == Schedule(0.15)
    assert changed_config.stages[0].weights["indirect"] == Schedule(0.0, 0.25)


def test_the_word_none_takes_a_value_away():
    config = make_config(
        overrides=(
            "stages.split_sum.weights.entropy.end=none",
            "stages.refine.rates.splat_means.half_life=none",
        )
    )
    assert config.stages[0].weights["entropy"].end is None
    assert config.stages[2].rates["splat_means"].half_life is None
    assert config_from_dict(json.loads(json.dumps(config.to_dict()))) == config
    ranges = {path: limits for path, _, limits, _ in all_settings(config)}
    assert ranges["stages.split_sum.weights.entropy.end"] == ">= 0 or none"
    with pytest.raises(ValueError, match=r"entropy\.end must be .*equal to 0, got -1"):
        make_config(overrides=("stages.split_sum.weights.entropy.end=-1.0",))


def test_another_kind_replaces_a_section():
    config = make_config(overrides=('stages.monte_carlo.transport={kind="split_sum"}',))
    assert config.stages[1].transport.kind == "split_sum"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("geometry.resolutoin=8", "unknown setting geometry.resolutoin"),
        ("nothing.at.all=1", "unknown setting nothing"),
        ("stages.third.steps=1", "unknown setting stages.third"),
        (
            "stages.split_sum.steps=1.5",
            r"split_sum\.steps must be a valid integer, got 1.5",
        ),
        ("stages.split_sum.steps=-1", r"stages\.split_sum\.steps must be greater than or equal"),
        ("stages.monte_carlo.rates.sdf=-1.0", r"^stages\.monte_carlo\.rates\.sdf\.value must be"),
        ("stages.split_sum.rates.sdf=nan", r"rates\.sdf\.value must be a finite number"),
        ("stages.split_sum.weights.l1=-1.0", r"^stages\.split_sum\.weights\.l1\.value must be"),
        (
            "stages.split_sum.weights.lihgt=1.0",
            r"unknown setting stages.*weights\.lihgt",
        ),
        ("stages.split_sum.rates.colour=1.0", r"unknown setting stages.*rates\.colour"),
        (
            "stages.monte_carlo.transport.bounces=0",
            r"monte_carlo\.transport\.bounces must",
        ),
        ("stages.monte_carlo.transport.light_count=-1", r"transport\.light_count must be"),
        ("stages.monte_carlo.transport.indirect=much", r"transport\.indirect must be 'none'"),
        ("stages.monte_carlo.transport.denoise.iterations=9", r"denoise\.iterations must be less"),
        (
            "stages.monte_carlo.transport.shadows=true",
            "unknown setting stages.*shadows",
        ),
        ("objective.background=red", r"^objective\.background must be"),
        ("geometry.initial=cube", r"geometry\.initial must be"),
        ("geometry.resolution=3", r"geometry\.resolution must be greater"),
        ("adapter.alpha=[1.0]", r"^adapter\.alpha"),
        ("adapter.u=0.4", "u and v must lie in"),
        ("raster.near=nan", r"raster\.near must be a finite number"),
        ("raster.tile_size=0", r"raster\.tile_size must be greater"),
        ("run.seed=-1", r"run\.seed must be greater"),
        ("run.seed=4294967296", r"run\.seed must be less than 4294967296"),
        ("run.initial_light=-1.0", r"run\.initial_light must be greater"),
        ("run.initial_light=nan", r"run\.initial_light must be a finite number"),
        ("run.initial_light=1e39", r"run\.initial_light must be .*single precision, got 1e\+39"),
        ("stages.split_sum.rates.sdf=inf", r"rates\.sdf\.value must be a finite number"),
        ("stages.split_sum.weights.l1=inf", r"weights\.l1\.value must be a finite number"),
        ("stages.split_sum.steps=2147483648", r"split_sum\.steps must be less than 2\*\*31"),
        ("stages.split_sum.steps=2147483647", r"all stages together must have less than 2\*\*31"),
        ("stages=5", "^stages must be an object"),
        ("stages.split_sum=5", r"^stages\.split_sum must be an object, got 5"),
        ("objective.smoothness_radius=-1.0", r"objective\.smoothness_radius must be greater"),
        ("raster.tile_size=257", r"raster\.tile_size must be less than or equal to 256"),
        ("material.albedo_hidden=[-1]", r"material\.albedo_hidden\.0 must be greater"),
        ("material.albedo_hidden=[1000000]", r"material\.albedo_hidden\.0 must be less"),
        ("material.grid.levels=1000000000", r"material\.grid\.levels must be less than or equal"),
        ("stages.monte_carlo.transport.light_count=5000", r"transport\.light_count must be less"),
        ("stages.refine.vertex_fraction=0.5", r"refine\.vertex_fraction: free splats are no samp"),
        ("stages.monte_carlo.vertex_fraction=0.999", r"monte_carlo\.vertex_fraction: no step sam"),
        ("run.seed", "section.field=value"),
        ("..=3", "section.field=value"),
        ("adapter.alpha.x=1", r"^adapter\.alpha must be"),
        ("adapter.u={}", r"^adapter\.u must be"),
        ("adapter.opacity=1e-40", r"^adapter\.opacity must be .*single precision"),
        ("run.seed=2020-01-01", r"^run\.seed must be a valid integer, got '2020-01-01'"),
        ("light.roughness=[12:00:00]", r"^light\.roughness\.0 must be"),
        ("material.initial_shift_logit=1e300", r"initial_shift_logit must be .*single precision"),
        ("stages.monte_carlo.transport.denoise.depth_sigma=1e300", r"depth_sigma must be .*single"),
        ("stages.monte_carlo.transport.kind=[1]", r"transport: kind must be one of"),
        ("quality=draft", "quality is chosen with --quality"),
        ("preset=paper", "preset is chosen with --preset"),
        ("material_prior=diffuse", "material_prior is chosen with --material-prior"),
    ],
)
def test_bad_overrides_say_what_is_wrong(override, message):
    with pytest.raises(ValueError, match=message):
        make_config(overrides=(override,))


def test_every_bad_override_has_a_line_of_its_own():
    overrides = ("run.seed=-1", "stages.split_sum.steps=-1", "stages.monte_carlo.steps=-1")
    with pytest.raises(ValueError, match=".") as error_info:
        make_config(overrides=overrides)
    lines = str(error_info.value).splitlines()
    assert sorted(line.split(" must be ")[0] for line in lines) == [
        "run.seed",
        "stages.monte_carlo.steps",
        "stages.split_sum.steps",
    ]


@pytest.mark.parametrize(
    ("old", "now"),
    [
        ("run.steps", "stages.split_sum.steps"),
        ("run.batch_views", "stages.split_sum.batch_views"),
        ("transport.steps", "stages.monte_carlo.steps"),
        ("rates.sdf", "stages.split_sum.rates.sdf"),
        ("rates.shine_warmup", "stages.split_sum.rates.roughness_metallic.warmup"),
        ("transport.rates.shine", "stages.monte_carlo.rates.roughness_metallic"),
        ("transport.loss.light", "stages.monte_carlo.weights.light"),
        ("loss.entropy_end", "stages.split_sum.weights.entropy.end"),
        ("transport.shading.light", "stages.monte_carlo.transport.light_count"),
        ("transport.shading.occlusion", "stages.monte_carlo.transport.occlusion"),
        ("model.material.grid.levels", "material.grid.levels"),
        ("model.attribute_gradient", "material.position_gradient"),
        ("objective.entropy_reduction", "geometry.entropy_reduction"),
        ("kind", "material_prior"),
        ("geometry.resolution", None),
        ("stages.split_sum.steps", None),
    ],
)
def test_settings_of_earlier_versions_are_refused_with_their_new_names(old, now):
    assert moved_setting(old) == now
    if now is not None:
        with pytest.raises(ValueError, match=f"the setting {old} is now {now}"):
            parse_override(f"{old}=1")


def test_a_run_of_an_earlier_version_is_refused_with_the_first_new_name():
    settings = {"preset": "default", "rates": {"sdf": 0.01}, "run": {"steps": 5}, "kind": "hybrid"}
    with pytest.raises(ValueError, match=r"3 settings are of an earlier version, the first: rates"):
        config_from_dict(settings)


def test_unknown_names_are_refused():
    for arguments in (("fast",), ("default", "ultra")):
        with pytest.raises(ValueError, match="must be one of"):
            make_config(*arguments)
    with pytest.raises(ValueError, match="material_prior must be one of"):
        make_config(material_prior="wet")


@pytest.mark.parametrize("prior", MATERIAL_PRIORS)
def test_a_prior_sets_the_first_roughness_and_metallic(prior):
    material = make_config(material_prior=prior).material
    logits = (material.initial_roughness_logit, material.initial_metallic_logit)
    assert logits == MATERIAL_PRIORS[prior]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("quality", QUALITIES)
def test_without_a_prior_a_preset_takes_its_own(preset, quality):
    config = make_config(preset, quality)
    assert config == make_config(preset, quality, material_prior=PRESET_PRIORS[preset])
    assert config.material_prior == ("satin" if preset == "default" else "hybrid")


def test_between_qualities_the_prior_is_that_of_the_default_preset():
    assert between_qualities(0.5).material_prior == "satin"
    assert between_qualities(0.5, material_prior="neutral").material_prior == "neutral"


def test_an_override_is_toml_or_a_bare_word():
    assert parse_override("a.b=[1, 2]") == {"a": {"b": [1, 2]}}
    assert parse_override("a=true") == {"a": True}
    assert parse_override("a=word") == {"a": "word"}


def test_a_table_changes_the_settings_in_it():
    texts = ["a={b=1, c={d=2}}", "a.b=3", "e=[{f=1}]"]
    assert override_paths(texts) == ("a.b", "a.c.d", "e")


def test_schedules_are_lines_that_stay_at_their_end():
    line = Schedule(0.2, 0.01, 0.5)
    assert [line.at(p) for p in (0.0, 0.25, 0.5, 1.0)] == pytest.approx([0.2, 0.105, 0.01, 0.01])
    assert Schedule(0.3).at(0.7) == 0.3
    assert Schedule().is_zero
    assert not Schedule(0.0, 0.1).is_zero
    stage = Stage(steps=10, weights={"l1": Schedule(0.0), "mask": Schedule(0.0, 1.0)})
    assert stage.weights_at(5) == {"mask": 0.5}


def test_rates_warm_up_quadratically_and_halve():
    stage = Stage(half_life=5.0, rates={"sdf": Rate(0.01, 4), "light": Rate(0.04, 0, 2.0)})
    for step in range(7):
        ramp = min((step + 1) / 4, 1) ** 2
        assert stage.rates_at(step)["sdf"] == pytest.approx(0.01 * 0.5 ** (step / 5) * ramp)
        assert stage.rates_at(step)["light"] == pytest.approx(0.04 * 0.5 ** (step / 2))
    assert Stage(rates={"sdf": Rate(0.0), "light": Rate(0.1)}).frozen == ("sdf",)


def test_steps_belong_to_stages_and_a_stage_without_steps_is_left_out():
    stages = tuple(Stage(name=name, steps=n) for name, n in (("a", 3), ("b", 0), ("c", 2)))
    config = Config(stages=stages)
    assert config.total_steps == 5
    assert [config.stage_at(step).name for step in range(6)] == ["a"] * 3 + ["c"] * 3
    assert [config.first_step(name) for name in "abc"] == [0, 3, 3]
    assert [stage.name for stage in config.active_stages] == ["a", "c"]
    with pytest.raises(ValueError, match="there is no stage 'd'"):
        config.stage("d")


def test_stages_of_one_name_are_refused():
    with pytest.raises(ValueError, match="names of their own"):
        Config(stages=(Stage(name="a"), Stage(name="a")))


def test_differences_name_the_setting_and_both_values():
    config = make_config()
    changed_config = make_config(overrides=("stages.monte_carlo.rates.sdf=0.25",))
    changes = differences(config, changed_config)
    assert changes == ["stages.monte_carlo.rates.sdf.value: 0.001 -> 0.25"]
    assert differences(config, changed_config, stages=["split_sum"]) == []


def test_a_term_that_is_left_out_equals_one_without_weight():
    """A run of an older version, which has no such term, is resumed with a weight of 0."""
    config = make_config()
    stage = config.stages[0]
    other_weights = {name: w for name, w in stage.weights.items() if name != "light_cast"}
    older_config = replace(
        config, stages=(replace(stage, weights=other_weights), *config.stages[1:])
    )
    same_config = make_config(overrides=("stages.split_sum.weights.light_cast=0",))
    assert differences(older_config, same_config) == []
    assert differences(older_config, config) == [
        "stages.split_sum.weights.light_cast.value: 0.0 -> 0.003"
    ]


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            ("stages.monte_carlo.steps=100",),
            ["stages.monte_carlo.rates.albedo.warmup = 150", "rates.roughness_metallic.warmup"],
        ),
        (("stages.split_sum.weights.indirect=1.0",), ["learns no indirect light"]),
        (("adapter.shift=0.2",), ["adapter.shift has no effect"]),
        (("adapter.shift=0.2", "material.has_shift=false"), []),
        (
            (
                "stages.monte_carlo.transport.indirect=traced",
                "stages.monte_carlo.transport.occlusion=false",
            ),
            [
                "stages.monte_carlo.weights.indirect has no effect",
                "blocked directions are black",
                "stages.refine.transport.indirect=constant takes the place of",
            ],
        ),
        (
            (
                "stages.monte_carlo.transport.indirect=radiometric",
                "stages.refine.transport.indirect=radiometric",
                "stages.monte_carlo.weights.radiometric=1",
            ),
            ["stages.refine.transport.indirect=radiometric learns radiance that no loss compares"],
        ),
        (
            (
                "stages.monte_carlo.transport.indirect=traced",
                "stages.monte_carlo.weights.indirect=0",
                "stages.monte_carlo.vertex_fraction=0.5",
                "stages.refine.steps=0",
            ),
            ["surfaces that rays hit look black to indirect=traced"],
        ),
        (
            (
                "stages.monte_carlo.transport.kind=paths",
                "stages.monte_carlo.weights.indirect=0",
                "stages.monte_carlo.splats.kind=vertex",
                "stages.refine.steps=0",
            ),
            ["surfaces that rays hit look black to kind=paths"],
        ),
        (
            ('stages.split_sum.domain={kind="per_pixel",points="mesh"}',),
            ["stages.split_sum.domain.points has no effect in training"],
        ),
        (("stages.monte_carlo.transport.reservoirs.visibility=traced",), ["without candidates"]),
        (
            ("stages.refine.transport.kind=paths", "stages.refine.weights.indirect=0"),
            ["refine.transport.kind=paths takes the place of stages.monte_carlo"],
        ),
        (
            ("stages.monte_carlo.transport.indirect=harmonics", "stages.refine.steps=0"),
            [],
        ),
        (("stages.monte_carlo.steps=0",), []),
        (
            (
                "stages.monte_carlo.transport.reservoirs.candidates=8",
                "stages.monte_carlo.transport.shares_views=false",
                "stages.monte_carlo.transport.bounces=2",
            ),
            ["with shares_views = false", "bounces = 2 has no effect"],
        ),
        (
            (
                "stages.monte_carlo.transport.reservoirs.candidates=8",
                "stages.monte_carlo.domain.kind=per_pixel",
                "stages.monte_carlo.transport.radiometric_gradient=both",
            ),
            ["where pixels are shaded", "radiometric_gradient has no effect"],
        ),
        (("stages.monte_carlo.transport.reservoirs.neighbors=2",), ["without candidates"]),
        (
            (
                "stages.monte_carlo.transport.reservoirs.candidates=8",
                "stages.monte_carlo.transport.light_count=0",
            ),
            ["without samples of the light"],
        ),
    ],
)
def test_settings_without_effect_are_told(overrides, told):
    warnings = config_warnings(make_config(overrides=overrides))
    assert len(warnings) == len(told)
    assert all(phrase in text for phrase, text in zip(told, warnings, strict=True))


def test_a_frozen_group_has_no_warm_up_to_finish():
    overrides = ("stages.monte_carlo.steps=20", "stages.monte_carlo.rates.sdf=0")
    warnings = config_warnings(make_config(overrides=overrides))
    assert any("rates.deform.warmup = 50 is longer" in text for text in warnings)
    assert not any("rates.sdf" in text for text in warnings)


def test_whoever_reads_a_configuration_needs_no_other_module(tmp_path):
    ball, config_path = tmp_path / "ball.ply", tmp_path / "config.json"
    trimesh.creation.icosphere(1).export(ball)
    config_path.write_text(json.dumps(make_config("default", "standard", mesh=ball).to_dict()))
    script = (
        "import json, sys; from geosplat_jax.fit.config import config_from_dict; "
        "config_from_dict(json.load(open(sys.argv[1])))"
    )
    process = subprocess.run([sys.executable, "-c", script, str(config_path)], capture_output=True)
    assert process.returncode == 0, process.stderr.decode()[-500:]


def test_indirect_light_that_a_stage_in_between_drops_is_said():
    config = make_config(overrides=("stages.refine.steps=0",))
    split_sum, monte_carlo = config.stage("split_sum"), config.stage("monte_carlo")
    stages = (monte_carlo, split_sum, replace(monte_carlo, name="again"))
    message = "stages.split_sum has no indirect light: the indirect light that monte_carlo learned"
    assert any(message in text for text in config_warnings(replace(config, stages=stages)))
    usual_stages = (split_sum, monte_carlo, replace(monte_carlo, name="again"))
    usual_warnings = config_warnings(replace(config, stages=usual_stages))
    assert not any("no indirect light" in text for text in usual_warnings)
