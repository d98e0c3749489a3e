"""Configurations: presets, overrides, validation, serialisation."""

import json

import pytest

from geosplat_jax.fit.config import (
    PRESETS,
    QUALITIES,
    RateConfig,
    config_from_dict,
    differences,
    doubts,
    make_config,
    parse_override,
)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("quality", QUALITIES)
def test_every_preset_and_quality_survives_json(preset, quality):
    config = make_config(preset, quality)
    again = config_from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert hash(again.model) == hash(config.model)
    assert differences(config, again) == []


def test_presets_carry_the_numbers_of_the_reference():
    paper, code = make_config("paper"), make_config("code")
    assert (paper.model.adapter.u, paper.model.adapter.v) == (0.07, 0.22)
    assert code.model.adapter.u == pytest.approx(0.069444, abs=1e-6)
    assert code.model.adapter.opacity == 0.99
    assert code.model.baked_diffuse
    assert not paper.model.material.has_shift
    assert code.model.material.has_shift
    assert paper.model.material.grid.log2_entries == 19
    assert code.model.material.grid.coarsest == 16


@pytest.mark.parametrize("preset", ["paper", "code"])
def test_stage_2_of_the_originals_has_the_schedule_of_the_reference(preset):
    transport = make_config(preset).transport
    rates = transport.rates
    assert (rates.sdf, rates.deform, rates.weights, rates.warmup) == (3e-3, 3e-3, 3e-3, 50)
    assert (rates.albedo, rates.shine, rates.shift, rates.indirect) == (1e-2, 2e-3, 3e-3, 1e-2)
    assert (rates.light, rates.exposure, rates.half_life) == (1e-2, 5e-3, 800.0)
    assert rates.light_knee == rates.albedo_warmup == rates.shine_warmup == 0
    assert (transport.steps, transport.batch_views, transport.shading.residual) == (500, 8, 0)
    assert transport.loss.l1 == make_config(preset).loss.l1
    assert transport.loss.at(0.0).entropy == pytest.approx(0.2)
    assert transport.loss.at(1.0).entropy == pytest.approx(0.01)


def test_overrides_reach_nested_fields_and_keep_types():
    config = make_config(
        overrides=("rates.sdf=0.5", "run.steps=7", "geometry.initial=sphere", "rates.light=1")
    )
    assert config.rates.sdf == 0.5
    assert config.run.steps == 7
    assert config.geometry.initial == "sphere"
    assert config.rates.light == 1.0
    assert isinstance(config.rates.light, float)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("rates.sfd=1", "unknown setting rates.sfd"),
        ("nothing.at.all=1", "unknown setting nothing"),
        ("run.steps=1.5", "run.steps must be of type int"),
        ("run.steps=0", "run.steps must be at least 1"),
        ("rates.sdf=-1.0", "^rates.sdf must not be negative"),
        ("transport.rates.sdf=-1.0", "^transport.rates.sdf must not be negative"),
        ("transport.loss.l1=-1.0", "^transport.loss.l1 must not be negative"),
        ("transport.shading.bounces=0", "^transport.shading.bounces must be at least 1"),
        ("transport.shading.light=-1", "^transport.shading: counts of samples"),
        ("objective.background=red", "^objective.background must be"),
        ("rates.sdf", "section.field=value"),
        ("geometry.initial=cube", "geometry.initial must be"),
        ("model.adapter.alpha=[1.0]", "alpha and beta need an outer and an inner value"),
        ("model.adapter.alpha=3", "model.adapter.alpha must be of type tuple"),
    ],
)
def test_bad_overrides_say_what_is_wrong(override, message):
    with pytest.raises(ValueError, match=message):
        make_config(overrides=(override,))


def test_unknown_names_are_refused():
    for arguments in (("fast",), ("default", "ultra")):
        with pytest.raises(ValueError, match="must be one of"):
            make_config(*arguments)
    with pytest.raises(ValueError, match="kind must be one of"):
        make_config(kind="wet")


def test_an_override_is_toml_or_a_bare_word():
    assert parse_override("a.b=[1, 2]") == {"a": {"b": [1, 2]}}
    assert parse_override("a=true") == {"a": True}
    assert parse_override("a=word") == {"a": "word"}


def test_entropy_weight_falls_linearly_and_stays():
    loss = make_config("paper").loss
    assert loss.at(0.0).entropy == pytest.approx(0.2)
    assert loss.at(0.25).entropy == pytest.approx(0.105)
    assert loss.at(0.5).entropy == pytest.approx(0.01)
    assert loss.at(1.0).entropy == pytest.approx(0.01)


def test_differences_name_the_setting_and_both_values():
    first, second = make_config(), make_config(overrides=("rates.sdf=0.25",))
    assert differences(first, second) == [f"rates.sdf: {RateConfig().sdf!r} -> 0.25"]


@pytest.mark.parametrize("preset", ["default", "paper", "code"])
@pytest.mark.parametrize("quality", ["draft", "standard", "high"])
def test_the_settings_that_are_offered_raise_no_doubts(preset, quality):
    assert doubts(make_config(preset, quality)) == []


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            ("transport.steps=100",),
            ["transport.rates.albedo_warmup = 150", "transport.rates.shine"],
        ),
        (
            ("rates.albedo_warmup=501",),
            ["rates.albedo_warmup = 501 is longer than the stage's 500"],
        ),
        (("loss.indirect=1.0",), ["loss.indirect has no effect"]),
        (
            ("transport.shading.indirect=traced", "transport.shading.occlusion=false"),
            ["blocked directions are black"],
        ),
        (("transport.steps=0",), []),
    ],
)
def test_settings_without_effect_are_told(overrides, told):
    found = doubts(make_config(overrides=overrides))
    assert len(found) == len(told)
    assert all(words in text for words, text in zip(told, found, strict=True))


def test_a_weight_of_eq_18_switches_it_on_in_either_stage():
    config = make_config(overrides=("loss.light=0.1",))
    assert (config.stage(1).objective.with_light, config.stage(2).objective.with_light) == (1, 0)
    config = make_config(overrides=("transport.loss.light=0.1",))
    assert (config.stage(1).objective.with_light, config.stage(2).objective.with_light) == (0, 1)
