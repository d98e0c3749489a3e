"""From one stage to the next: entries, kept parameters, and runs through both stages."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import MONTE_CARLO, TWO_STAGES, ball, sphere_dataset, tiny_config

from geosplat_jax.fit import loop as loop_module
from geosplat_jax.fit.begin import Resume, TakeOver
from geosplat_jax.fit.config import Rate, Stage
from geosplat_jax.fit.entering import FreshAlbedo
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.presets import PRESETS, QUALITIES, make_config
from geosplat_jax.fit.stages import begin_stage, build_pipeline, require_rates
from geosplat_jax.fit.train import Interrupted, TrainingError, fit, load_trained
from geosplat_jax.materials import materials_at
from geosplat_jax.surface.grids import grid_vertices


def _begun(config, params, pipeline):
    return begin_stage(params, pipeline, config, config.stage("monte_carlo"))


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("fresh", [True, False])
def test_a_stage_keeps_or_redraws_the_albedo_as_asked(shared, fresh):
    config = tiny_config(
        *MONTE_CARLO,
        "geometry.resolution=6",
        f"material.shared={str(shared).lower()}",
        *(() if fresh else ("stages.monte_carlo.enter=[]",)),
    )
    pipeline, params = ball(config)
    begun_params = _begun(config, params, pipeline)

    def same(a, b):
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        return all(np.array_equal(x, y) for x, y in pairs)

    old_material, new_material = params.material, begun_params.material
    assert same(old_material.albedo_head, new_material.albedo_head) is not fresh
    # A shared encoding cannot be initialised again for the albedo alone.
    assert same(old_material.albedo_table, new_material.albedo_table) is (shared or not fresh)
    assert same(old_material.surface_table, new_material.surface_table)
    assert same(old_material.surface_head, new_material.surface_head)
    assert same(old_material.shift_head, new_material.shift_head)
    assert same(
        (params.geometry, params.light, params.log_exposure),
        (begun_params.geometry, begun_params.light, begun_params.log_exposure),
    )
    assert old_material.indirect_head is None
    assert new_material.indirect_head[-1].weights.shape[1] == 6
    assert same(_begun(config, params, pipeline), begun_params)


def _varied_ball(*overrides, radius=0.4):
    """Settings, pipeline and parameters of a ball whose albedo varies in space."""
    config = tiny_config(*MONTE_CARLO, "geometry.resolution=12", *overrides)
    pipeline, params = ball(config, radius=radius)
    table = params.material.albedo_table
    noise = jnp.asarray(np.random.default_rng(3).normal(size=table.shape), jnp.float32)
    return config, pipeline, replace(params, material=replace(params.material, albedo_table=noise))


def _albedo(params, points, pipeline):
    evaluate = partial(jax.jit, static_argnames=("spec",))(materials_at)
    points = jnp.asarray(points, jnp.float32)
    materials = evaluate(params.material, points, pipeline.surface.box, spec=pipeline.fields)
    return np.asarray(materials.albedo)


def test_a_fresh_albedo_is_the_mean_of_the_stage_before_beside_the_surface():
    config, pipeline, params = _varied_ball()
    begun_params = _begun(config, params, pipeline)
    grid = pipeline.surface.grid
    points = np.asarray(grid_vertices(grid))
    is_inside = np.asarray(params.geometry.sdf) < 0
    is_near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 1.01 * float(grid.cell_size)
    is_beside = np.any(is_near & (is_inside[:, None] != is_inside[None]), axis=1)
    assert 20 < is_beside.sum() < len(points) - 20
    old_albedo = _albedo(params, points, pipeline)
    assert np.std(old_albedo[is_beside], axis=0).min() > 0.01
    new_albedo = _albedo(
        begun_params, np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3)), pipeline
    )
    np.testing.assert_allclose(
        new_albedo, np.tile(old_albedo[is_beside].mean(axis=0), (50, 1)), rtol=1e-5
    )


@pytest.mark.parametrize(
    ("override", "radius"),
    [
        ('stages.monte_carlo.enter=[{kind="fresh_albedo", colour="grey"}]', 0.4),
        ("run.seed=0", -1.0),
    ],
)
def test_a_fresh_albedo_is_grey_where_asked_and_where_there_is_no_surface(override, radius):
    """The first case asks for grey; in the second there is no mean over an empty surface."""
    config, pipeline, params = _varied_ball(override, radius=radius)
    begun_params = _begun(config, params, pipeline)
    np.testing.assert_allclose(_albedo(begun_params, np.zeros((4, 3)), pipeline), 0.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("after", "is_kept"), [("harmonics", True), ("radiometric", False), ("constant", False)]
)
def test_a_head_of_indirect_light_is_kept_where_it_means_the_same(after, is_kept):
    """Harmonics (arriving light) and radiometric (sent light) have equally many coefficients.

    The encoding that a head reads is kept with it, whatever happens to the albedo.
    """
    config = tiny_config(
        "geometry.resolution=6",
        "material.shared=false",
        'stages.refine.enter=[{kind="fresh_albedo"}]',
        "stages.monte_carlo.steps=1",
        "stages.monte_carlo.transport.indirect=harmonics",
        "stages.refine.steps=1",
        f"stages.refine.transport.indirect={after}",
    )
    pipeline, params = ball(config, stage="monte_carlo")
    begun_params = begin_stage(params, pipeline, config, config.stage("refine"))
    old_weights, new_weights = (
        x.material.indirect_head[-1].weights for x in (params, begun_params)
    )
    assert new_weights.shape[1] == (6 if after == "constant" else 27)
    assert np.array_equal(old_weights, new_weights) is is_kept
    old_table, new_table = (x.material.albedo_table for x in (params, begun_params))
    assert np.array_equal(old_table, new_table) is is_kept
    assert not begun_params.material.albedo_head[-1].weights.any()


def _refined_twice(change, **learned):
    """Splats at the start of a second stage of free splats, with harmonics in the first one.

    The second stage is the first one with the changes that `change` gives; `learned` are values
    that the splats of the first one end with.
    """
    config = tiny_config(
        "geometry.resolution=6",
        "stages.monte_carlo.steps=1",
        "stages.monte_carlo.transport.indirect=harmonics",
        "stages.refine.steps=1",
        "stages.refine.transport.indirect=harmonics",
    )
    refine = config.stage("refine")
    again = replace(refine, name="again", **change(refine))
    config = replace(config, stages=(*config.stages, again))
    pipeline, params = ball(config, stage="monte_carlo")
    refined = begin_stage(params, pipeline, config, refine)
    values = {name: jnp.full_like(getattr(refined.splats, name), x) for name, x in learned.items()}
    refined = replace(refined, splats=replace(refined.splats, **values))
    refined_pipeline = replace(
        build_pipeline(config, refine, pipeline.surface), capacities=pipeline.capacities
    )
    return begin_stage(refined, refined_pipeline, config, again).splats


@pytest.mark.parametrize("after", ["harmonics", "constant"])
def test_free_splats_forget_indirect_light_that_means_something_else(after):
    """A second stage of free splats takes over what the first one has learned, if it can."""
    splats = _refined_twice(
        lambda refine: {"transport": replace(refine.transport, indirect=after)}, indirect=7.0
    )
    assert splats.indirect.shape[1] == (27 if after == "harmonics" else 6)
    assert bool((splats.indirect == 7.0).all()) is (after == "harmonics")


@pytest.mark.parametrize("is_fresh", [True, False])
def test_a_fresh_albedo_is_that_of_free_splats_as_well(is_fresh):
    entries = (FreshAlbedo("grey"),) if is_fresh else ()
    splats = _refined_twice(lambda _: {"enter": entries}, albedo=0.25)
    np.testing.assert_allclose(splats.albedo, 0.5 if is_fresh else 0.25, rtol=1e-6)


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("preset", PRESETS)
def test_presets_have_a_rate_for_everything_that_their_stages_learn(preset, quality):
    require_rates(make_config(preset, quality))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((), r"stages\.polish\.rates lacks "),
        (
            (
                "stages.split_sum.transport.kind=monte_carlo",
                "stages.split_sum.transport.indirect=constant",
            ),
            r"split_sum\.rates lacks indirect",
        ),
    ],
)
def test_a_stage_that_lacks_a_rate_is_refused_before_any_is_trained(tmp_path, overrides, message):
    config = make_config("default", "draft", overrides=overrides)
    rates = {"albedo": Rate(1e-3)}
    polish = Stage(
        name="polish", steps=5, batch_views=1, rates=rates, weights=config.stages[0].weights
    )
    config = replace(config, stages=(*config.stages, polish))
    with pytest.raises(TrainingError, match=message):
        fit(sphere_dataset(count=3, size=8), config, tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_training_that_is_refused_when_it_begins_leaves_its_folder_free(tmp_path, monkeypatch):
    def fails(*arguments):
        raise ValueError("no such thing")

    monkeypatch.setattr(loop_module.Loop, "prepare", fails)
    with pytest.raises(ValueError, match="no such thing"):
        fit(sphere_dataset(count=3, size=8), tiny_config(), tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()


def test_traced_indirect_light_learns_nothing():
    traced = "stages.monte_carlo.transport.indirect=traced"
    _, params = ball(
        tiny_config(*MONTE_CARLO, "geometry.resolution=6", traced), stage="monte_carlo"
    )
    assert params.material.indirect_head is None


RUN = TWO_STAGES
OTHER = "stages.monte_carlo.rates.sdf=0.5"


def lines_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset()


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory):
    """An uninterrupted run through both stages, with three steps each."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    return folder, fit(dataset, tiny_config(*RUN), folder)


@pytest.mark.slow
def test_a_run_goes_through_both_stages(whole):
    folder, state = whole
    lines = lines_of(folder)
    assert [line["step"] for line in lines] == list(range(6))
    assert [line["stage"] for line in lines] == ["split_sum"] * 3 + ["monte_carlo"] * 3
    assert all(np.isfinite(line["loss"]) for line in lines)
    assert ["cell_patches" in line["usage"] for line in lines] == [False] * 3 + [True] * 3
    # The second stage starts with buffers for what the first one needed, and adds new ones.
    old_capacities, new_capacities = lines[2]["capacities"], lines[3]["capacities"]
    assert set(new_capacities) - set(old_capacities) == {"cell_patches"}
    assert all(
        lines[2]["usage"][name] <= new_capacities[name] <= size
        for name, size in old_capacities.items()
    )
    for name in ("term.indirect", "term.light"):
        assert [line.get(name, 0) > 0 for line in lines] == [False] * 3 + [True] * 3
    assert int(state.step) == 6
    trained = load_trained(folder)
    assert (trained.stage.name, trained.step) == ("monte_carlo", 6)
    first = load_trained(folder, stage="split_sum")
    for end in (trained, first):
        last_weights = end.stage.weights_at(end.stage.steps - 1)
        assert {n: float(w) for n, w in end.pipeline.weights.items()} == pytest.approx(last_weights)
    assert first.stage.weights_at(0) != first.stage.weights_at(2)
    assert trained.config == tiny_config(*RUN)
    assert_same(trained.params, state.params)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [2, 3, 4, 5])
def test_resuming_in_either_stage_and_between_them_equals_the_run_in_one_go(
    dataset, whole, tmp_path, stop
):
    fit(dataset, tiny_config(*RUN), tmp_path, stop_after=stop)
    assert load_trained(tmp_path).stage.name == ("split_sum" if stop <= 3 else "monte_carlo")
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), tmp_path, begin=Resume()))
    expected, actual = (
        [(line["step"], line["stage"], line["loss"]) for line in lines_of(folder)]
        for folder in (whole[0], tmp_path)
    )
    assert actual == expected


@pytest.mark.slow
def test_the_first_stage_of_another_run_can_be_taken_over_bit_for_bit(
    dataset, whole, tmp_path, monkeypatch
):
    folder, state = whole
    assert_same(
        state, fit(dataset, tiny_config(*RUN), tmp_path, begin=TakeOver(folder, "monte_carlo"))
    )
    assert [line["step"] for line in lines_of(tmp_path)] == [3, 4, 5]
    # This also holds for a run stopped before its first step: its own folder has what it took over.
    early_folder = tmp_path.parent / f"{tmp_path.name}_early"

    def stop(*arguments, **others):
        raise KeyboardInterrupt

    monkeypatch.setattr(loop_module, "train_step", stop)
    with pytest.raises(Interrupted):
        fit(dataset, tiny_config(*RUN), early_folder, begin=TakeOver(folder, "monte_carlo"))
    monkeypatch.undo()
    assert_same(state, fit(dataset, tiny_config(*RUN), early_folder, begin=Resume()))
    assert [line["step"] for line in lines_of(early_folder)] == [3, 4, 5]
    assert [line["loss"] for line in lines_of(tmp_path)] == [
        line["loss"] for line in lines_of(folder)[3:]
    ]


@pytest.mark.slow
def test_a_stage_with_other_settings_does_not_take_over_the_plan_of_its_buffers(
    dataset, whole, tmp_path
):
    transport = "stages.monte_carlo.transport.occlusion=false"
    first_folder, later_folder = tmp_path / "first", tmp_path / "later"
    begin = TakeOver(whole[0], "monte_carlo")
    fit(dataset, tiny_config(*RUN, transport), first_folder, begin=begin)
    begin = TakeOver(first_folder, "monte_carlo")
    fit(dataset, tiny_config(*RUN), later_folder, begin=begin, stop_after=4)
    assert "cell_patches" not in lines_of(first_folder)[0]["capacities"]
    assert "cell_patches" in lines_of(later_folder)[0]["capacities"]


@pytest.mark.slow
def test_a_run_that_ended_with_its_first_stage_can_be_taken_further(dataset, whole, tmp_path):
    """The later stages of the first run may differ; here it had none."""
    first_folder, later_folder = tmp_path / "first", tmp_path / "later"
    fit(dataset, tiny_config(*RUN, "stages.monte_carlo.steps=0"), first_folder)
    assert not (first_folder / "stages").exists()
    assert_same(
        whole[1],
        fit(dataset, tiny_config(*RUN), later_folder, begin=TakeOver(first_folder, "monte_carlo")),
    )
    # A run that took over a stage can be resumed as well.
    third_folder = tmp_path / "third"
    fit(
        dataset,
        tiny_config(*RUN),
        third_folder,
        begin=TakeOver(first_folder, "monte_carlo"),
        stop_after=4,
    )
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), third_folder, begin=Resume()))


@pytest.mark.slow
def test_another_first_stage_is_refused_by_name(dataset, whole, tmp_path):
    folder, _ = whole
    with pytest.raises(
        TrainingError, match=r"had other settings: .*split_sum\.rates\.sdf\.value: .* -> 0\.5"
    ):
        fit(
            dataset,
            tiny_config(*RUN, "stages.split_sum.rates.sdf=0.5"),
            tmp_path / "a",
            begin=TakeOver(folder, "monte_carlo"),
        )
    with pytest.raises(TrainingError, match=r"other settings: .*split_sum\.steps: 3 -> 2"):
        fit(
            dataset,
            tiny_config(*RUN, "stages.split_sum.steps=2"),
            tmp_path / "b",
            begin=TakeOver(folder, "monte_carlo"),
        )
    with pytest.raises(RunError, match="is not a run"):
        fit(
            dataset,
            tiny_config(*RUN),
            tmp_path / "c",
            begin=TakeOver(tmp_path / "nowhere", "monte_carlo"),
        )
    fit(dataset, tiny_config(*RUN), tmp_path / "d", stop_after=2)
    other_folder = tmp_path / "other"
    with pytest.raises(
        TrainingError, match="at step 2, in the stage split_sum, not at the end of split_sum"
    ):
        fit(dataset, tiny_config(*RUN), other_folder, begin=TakeOver(tmp_path / "d", "monte_carlo"))


@pytest.mark.slow
def test_taking_over_everything_there_is_to_train_is_refused(dataset, whole, tmp_path):
    with pytest.raises(TrainingError, match=r"nothing to train: stages\.monte_carlo\.steps is 0"):
        fit(dataset, tiny_config(), tmp_path / "e", begin=TakeOver(whole[0], "monte_carlo"))


@pytest.mark.slow
def test_a_surface_that_vanishes_later_is_put_back_as_its_stage_began(
    dataset, whole, tmp_path, monkeypatch
):
    advance, geometries = loop_module.Loop.advance, []

    def sabotage(self, step):
        if step == 3 and not geometries:
            geometries.append(self.state.params.geometry)
            empty_geometry = replace(geometries[0], sdf=jnp.abs(geometries[0].sdf) + 1.0)
            # This is a copy, since the step consumes the buffers of its arguments.
            geometries[0] = jax.tree.map(np.array, geometries[0])
            self.state = replace(
                self.state, params=replace(self.state.params, geometry=empty_geometry)
            )
        return advance(self, step)

    monkeypatch.setattr(loop_module.Loop, "advance", sabotage)
    state = fit(
        dataset,
        tiny_config(*RUN),
        tmp_path,
        begin=TakeOver(whole[0], "monte_carlo"),
        stop_after=4,
    )
    assert_same(state.params.geometry, geometries[0])
    loop = loop_module.resumed_loop(dataset, tiny_config(*RUN), RunFolder(tmp_path))
    assert_same(loop.fallback.shape, geometries[0])


@pytest.mark.slow
def test_resuming_a_later_stage_with_another_setting_of_it_is_refused(dataset, whole):
    changed_config = tiny_config(*RUN, OTHER)
    with pytest.raises(TrainingError, match=r"monte_carlo\.rates\.sdf\.value: .* -> 0\.5"):
        fit(dataset, changed_config, whole[0], begin=Resume())
