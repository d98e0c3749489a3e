"""Training within a time budget: the choice of settings, and a pacer that adapts the steps.

`plan` chooses settings between the quality levels, by the time and memory that they are expected to
take on this machine. `Pacer` measures the steps of the training, and shortens or lengthens what is
left of every stage. Schedules are stretched along with the steps, so that rates and weights reach
their final values in a shortened training as well.
"""

import math
import re
import statistics
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax

from geosplat_jax.fit.config import Budget, Config, Pace, Stage, override_paths
from geosplat_jax.fit.costs import (
    StageCost,
    expected_costs,
    expected_memory,
    expected_seconds,
)
from geosplat_jax.fit.entering import FreshAlbedo
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.presets import QUALITIES, between_qualities, mesh_settings
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.io.memory import memory_of_machine

_EFFORTS = tuple(0.25 * number for number in range(4 * (len(QUALITIES) - 1) + 1))
"""Efforts that `plan` tries, in order of cost: 0, 1 and 2 are the quality levels."""

_SHORTEST, _LONGEST = 0.4, 3.0
"""Smallest and largest factor by which `plan` scales the steps. The largest also limits `Pacer`,
relative to the planned steps."""

_PIXELS_PER_CELL = 6.0
"""Pixels per grid cell, along the longer side, that photographs are reduced to. The factor is a
whole number, so up to one and a half times as many pixels may remain."""

_TIMED = 5
"""Fewest timed steps from which the duration of a step is estimated."""

_RECENT = 20
"""Most steps that this estimate uses: the latest ones."""

_EVERY = 10
"""Steps between two checks of the pace."""

_TOLERANCE = 0.04
"""Relative change of a stage's remaining steps up to which the pace stays as it is."""

_FEWEST = 0.1
"""Least share of its planned steps that a stage makes unless it is left out, however late it is."""

_WORTHWHILE, _WORTHWHILE_ANEW = 30.0, 75.0
"""Fewest steps for which a later stage is worth its time, or half of its planned steps if that is
less; a stage that would make fewer is left out. The first number is for stages that continue the
one before, as a refinement does. The second is for stages that start with a new albedo of one
colour, as Monte Carlo does: until that albedo is learned, the result is worse than without the
stage."""

_TO_COME_BACK = 1.2
"""A stage that was left out returns only when it would make this factor times its fewest worthwhile
steps, so that a stage near the limit does not come and go at every check."""

_UNITS = {"s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}
_BYTES = {"mb": 1e6, "mib": 2.0**20, "gb": 1e9, "gib": 2.0**30}


def parse_duration(text: str) -> float:
    """Turn ``90s``, ``5min`` or ``1.5h`` into seconds.

    Raises
    ------
    ValueError
        If the text has another form, or the time is zero.
    """
    return _quantity(text, _UNITS, "a time reads 90s, 5min or 1.5h")


def parse_memory(text: str) -> float:
    """Turn ``800MB`` or ``4GB`` into bytes; GiB and MiB are powers of two.

    Raises
    ------
    ValueError
        If the text has another form, or the size is zero.
    """
    return _quantity(text, _BYTES, "a memory size reads 800MB, 4GB or 4GiB")


def _quantity(text: str, units: Mapping[str, float], form: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*", text)
    if match is None or match[2].lower() not in units or float(match[1]) <= 0:
        raise ValueError(f"{form}, got {text!r}")
    return float(match[1]) * units[match[2].lower()]


@dataclass(frozen=True)
class Plan:
    """Settings that were chosen for a budget, and what they are expected to take.

    Attributes
    ----------
    config : the settings.
    downscale : factor that the photographs are to be reduced by.
    effort : place between the quality levels: 0 is the lowest, 2 the highest.
    costs : expected cost of every active stage, by name.
    seconds : expected duration of the training.
    memory : expected largest resident memory, bytes.
    """

    config: Config
    downscale: int
    effort: float
    costs: Mapping[str, StageCost]
    seconds: float
    memory: float

    def describe(self) -> list[str]:
        """Say what was chosen, for people to read."""
        stages = ", ".join(
            f"{stage.name} {stage.steps} steps of {stage.batch_views} views "
            f"({self.costs[stage.name].step:.2f} s each)"
            for stage in self.config.active_stages
        )
        skipped_names = [stage.name for stage in self.config.stages if not stage.steps]
        place = _place(self.effort) + (
            f", without {' and '.join(skipped_names)}" if skipped_names else ""
        )
        cells_along = self.config.geometry.cells_along
        cells = "" if cells_along is None else f"{cells_along} cells, "
        size = "in full size" if self.downscale == 1 else f"reduced by {self.downscale}"
        return [
            f"budget: {place}; {cells}photographs {size}",
            f"budget: {stages}",
            f"budget: about {self.seconds:.0f} s and {self.memory / 1e9:.1f} GB are expected",
        ]


def _place(effort: float) -> str:
    """Say where an effort lies."""
    level = min(int(effort), len(QUALITIES) - 2)
    share = effort - level
    if share in (0.0, 1.0):
        return f"as much as quality {QUALITIES[level + int(share)]}"
    return f"{share:.0%} of the way from quality {QUALITIES[level]} to {QUALITIES[level + 1]}"


def plan(
    budget: Budget,
    size: tuple[int, int],
    *,
    slowness: float,
    material_prior: str | None = None,
    mesh: str | Path | MeshSettings | None = None,
    overrides: Sequence[str] = (),
    downscale: int | None = None,
) -> Plan:
    """Choose the settings that fit into a budget.

    The largest settings that fit with their own numbers of steps are chosen; then their steps are
    scaled to fill the time. If not even the lowest quality fits, the same is done with the first
    stage alone, unless ``overrides`` change a setting of a later stage: in two minutes the first
    stage alone gave better images and shapes, and better relighting except for hard shadows
    (docs/trade.md).

    Parameters
    ----------
    budget : time and memory.
    size : height and width of the photographs in pixels, before any reduction.
    slowness : how many times slower than the reference this machine is, see
        `costs.slowness_of_machine`.
    material_prior, mesh, overrides : see `presets.make_config`.
    downscale : factor that the photographs are reduced by. By default it follows from the cells of
        the grid; for a mesh, from those that an isosurface of the same effort would have.

    Raises
    ------
    TrainingError
        If no stage has steps, or the time or the memory is too small for any settings.
    """
    settings_at = partial(
        between_qualities,
        material_prior=material_prior,
        mesh=None if mesh is None else mesh_settings(mesh),
        overrides=tuple(overrides),
    )
    if not settings_at(_EFFORTS[0]).active_stages:
        raise TrainingError("nothing to train: no stage has steps")
    candidates = [
        _candidate(effort, settings_at(effort), size, slowness, downscale) for effort in _EFFORTS
    ]
    if budget.memory is not None and candidates[0].memory > budget.memory:
        raise TrainingError(
            f"a training takes at least about {candidates[0].memory / 1e9:.1f} GB, more than "
            f"--memory allows ({budget.memory / 1e9:.1f} GB)"
        )
    limits = [limit for limit in (budget.memory, _memory_here()) if limit is not None]
    # Expectations may be wrong: the smallest settings are tried even where they should not fit.
    feasible = [
        candidate for candidate in candidates if candidate.memory <= min(limits, default=math.inf)
    ]
    candidates = feasible or candidates[:1]
    affordable = [candidate for candidate in candidates if candidate.seconds <= budget.seconds]
    if not affordable and not _changes_later_stage(overrides, candidates[0].config):
        candidates = [_first_stage_alone(candidate) for candidate in candidates]
        affordable = [candidate for candidate in candidates if candidate.seconds <= budget.seconds]
    base_plan = affordable[-1] if affordable else candidates[0]
    startup = sum(cost.startup for cost in base_plan.costs.values())
    share = (budget.seconds - startup) / (base_plan.seconds - startup)
    # Other work on this machine may end: a budget is refused only if idle cores cannot meet it.
    least_seconds = (startup + _SHORTEST * (base_plan.seconds - startup)) / max(slowness, 1.0)
    if budget.seconds < least_seconds:
        raise TrainingError(
            f"a budget of {budget.seconds:.0f} s is too short: compilation included, a training "
            f"takes at least about {least_seconds:.0f} s on idle cores"
        )
    config = with_steps(base_plan.config, min(max(share, _SHORTEST), _LONGEST))
    return replace(base_plan, config=config, seconds=expected_seconds(config, base_plan.costs))


def _memory_here() -> int | None:
    """Return the memory of the machine in bytes; None where an accelerator computes.

    Only memory of the machine is estimated, see `costs.expected_memory`.
    """
    return memory_of_machine() if jax.default_backend() == "cpu" else None


def reduction_factor(longest: int, cells: int) -> int:
    """Return the whole number that photographs are reduced by for a grid; see `_PIXELS_PER_CELL`.

    Parameters
    ----------
    longest : longer side of the photographs, pixels.
    cells : number of cells along the longest side of the grid.
    """
    return max(1, math.floor(longest / (_PIXELS_PER_CELL * cells) + 0.5))


def _candidate(
    effort: float,
    config: Config,
    size: tuple[int, int],
    slowness: float,
    downscale: int | None,
) -> Plan:
    """Return the plan for an effort, with the settings' own numbers of steps."""
    if downscale is None:
        cells = config.geometry.cells_along or between_qualities(effort).geometry.cells_along
        downscale = reduction_factor(max(size), cells or max(size))
    pixels = float((size[0] // downscale) * (size[1] // downscale))
    costs = expected_costs(config, pixels, slowness=slowness)
    seconds = expected_seconds(config, costs)
    return Plan(config, downscale, effort, costs, seconds, expected_memory(config, pixels))


def _changes_later_stage(overrides: Sequence[str], config: Config) -> bool:
    """Whether an override changes a setting of a stage after the first."""
    later = tuple(f"stages.{stage.name}." for stage in config.active_stages[1:])
    return any(path.startswith(later) for path in override_paths(overrides))


def _first_stage_alone(candidate: Plan) -> Plan:
    """Leave all stages out but the first."""
    first_stage = candidate.config.active_stages[0]
    config = _without(candidate.config, candidate.config.active_stages[1:])
    costs = {first_stage.name: candidate.costs[first_stage.name]}
    return replace(candidate, config=config, costs=costs, seconds=expected_seconds(config, costs))


def _without(config: Config, skipped_stages: Sequence[Stage]) -> Config:
    """Leave some stages out, by setting their steps to 0."""
    names = {stage.name for stage in skipped_stages}
    stages = (replace(s, steps=0, pace=()) if s.name in names else s for s in config.stages)
    return replace(config, stages=tuple(stages))


def with_steps(config: Config, share: float) -> Config:
    """Scale the steps of all stages, and their schedules with them."""
    return replace(config, stages=tuple(_scaled(stage, 0, share) for stage in config.stages))


def _scaled(
    stage: Stage, done: int, share: float, fewest: int = 1, most: int | None = None
) -> Stage:
    """Scale the steps that a stage has left after ``done`` ones; its schedules still end with it.

    ``fewest``, ``most`` : limits of the steps of the whole stage.
    """
    steps_left = stage.steps - done
    if steps_left <= 0:
        return stage
    new_steps_left = round(share * steps_left)
    if most is not None:
        new_steps_left = min(new_steps_left, most - done)
    new_steps_left = max(new_steps_left, min(fewest - done, steps_left), 1)
    if new_steps_left == steps_left:
        return stage
    speed = (stage.position(stage.steps) - stage.position(done)) / new_steps_left
    pace = (*(change for change in stage.pace if change.step < done), Pace(done, speed))
    return replace(stage, steps=done + new_steps_left, pace=pace)


def _length(stage: Stage) -> float:
    """Return the length of a stage's schedules in planned steps, which the pace does not change."""
    return stage.position(stage.steps)


class Pacer:
    """Keeps a training within its time budget; ``clock`` is its only source of time.

    Every check starts from the planned schedules, whatever earlier checks have changed. So a stage
    that was left out returns once there is time for it again.

    Parameters
    ----------
    budget : time that the training may take.
    config : settings as they were planned.
    costs : expected cost of every stage, by name.
    clock : returns seconds since some fixed moment.
    began : reading of the clock when the command began; by default now.
    """

    def __init__(
        self,
        budget: Budget,
        config: Config,
        costs: Mapping[str, StageCost],
        *,
        clock: Callable[[], float] = time.perf_counter,
        began: float | None = None,
    ) -> None:
        self.budget = budget
        self._clock = clock
        self._end = (clock() if began is None else began) + budget.seconds
        self._costs = costs
        self._planned = config
        self._measured: dict[str, list[float]] = {}

    @property
    def seconds_left(self) -> float:
        """Seconds until the budget is used up; negative after that."""
        return self._end - self._clock()

    def note(self, stage: str, seconds: float) -> None:
        """Record the seconds of a step that did not wait for a compilation."""
        self._measured.setdefault(stage, []).append(seconds)

    def adjusted(self, config: Config, stage: Stage, done: int) -> Config | None:
        """Return settings with other numbers of steps to come; None where no change is needed.

        Parameters
        ----------
        config : settings in use.
        stage : stage that runs, as in ``config``.
        done : steps of this stage that are done.
        """
        if done % _EVERY or len(self._measured.get(stage.name, ())) < _TIMED:
            return None
        steps_left = stage.steps - done
        if steps_left <= _EVERY:
            return None
        stage_index = config.stage_names.index(stage.name)
        later = [other for other in self._planned.stages[stage_index + 1 :] if other.steps]
        ahead = _length(stage) - stage.position(done)
        active_names = {other.name for other in config.stages[stage_index + 1 :] if other.steps}
        share = self._share(stage, ahead, later)
        while short_stages := self._too_short(later, share, active_names):
            later = [other for other in later if other not in short_stages]
            share = self._share(stage, ahead, later)
        is_same = active_names == {other.name for other in later}
        if is_same and abs(share * ahead / steps_left - 1.0) <= _TOLERANCE:
            return None
        retimed_stages = {stage.name: self._scaled(stage, done, share * ahead)}
        retimed_stages |= {
            other.name: self._scaled(other, 0, share * _length(other)) for other in later
        }
        trimmed_config = _without(config, config.stages[stage_index + 1 :])
        stages = tuple(retimed_stages.get(other.name, other) for other in trimmed_config.stages)
        adjusted_config = replace(config, stages=stages)
        return None if adjusted_config == config else adjusted_config

    def _share(self, stage: Stage, ahead: float, later: Sequence[Stage]) -> float:
        """Return the ratio of the time left to the time that the rest of the plan would take.

        The time before the first steps of later stages is subtracted from the time that is left.

        ``ahead`` : what is left of the schedules of ``stage``, in planned steps. ``later`` : stages
        to come, as planned.
        """
        work_seconds = ahead * self._step_seconds(stage.name)
        work_seconds += sum(_length(other) * self._step_seconds(other.name) for other in later)
        startup = sum(self._costs[other.name].startup for other in later)
        return max(self.seconds_left - startup, 0.0) / max(work_seconds, 1e-9)

    def _too_short(
        self, later: Sequence[Stage], share: float, active_names: Collection[str]
    ) -> Sequence[Stage]:
        """Return the first later stage that would make too few steps, and all stages after it."""
        for number, stage in enumerate(later):
            least_steps = self._least_worthwhile(stage)
            if share * _length(stage) < (
                least_steps if stage.name in active_names else _TO_COME_BACK * least_steps
            ):
                return later[number:]
        return ()

    def _least_worthwhile(self, stage: Stage) -> float:
        """Return the fewest steps for which a later stage is worth its time."""
        has_fresh_albedo = any(isinstance(entry, FreshAlbedo) for entry in stage.enter)
        least_steps = _WORTHWHILE_ANEW if has_fresh_albedo else _WORTHWHILE
        return min(least_steps, 0.5 * stage.steps)

    def _scaled(self, stage: Stage, done: int, remaining: float) -> Stage:
        """Give a stage ``remaining`` steps after ``done`` ones, within limits set by the plan."""
        planned_steps = self._planned.stage(stage.name).steps
        fewest, most = math.ceil(_FEWEST * planned_steps), math.ceil(_LONGEST * planned_steps)
        return _scaled(stage, done, remaining / (stage.steps - done), fewest, most)

    def _step_seconds(self, name: str) -> float:
        """Estimate the seconds of a step: the median of measurements, or the expected cost.

        An expected cost is corrected by the ratio of measured to expected seconds in the last stage
        that was measured.
        """
        durations = self._measured.get(name, [])
        if len(durations) >= _TIMED:
            return statistics.median(durations[-_RECENT:])
        expected = self._costs[name].step
        timed_stages = [n for n, times in self._measured.items() if len(times) >= _TIMED]
        if not timed_stages:
            return expected
        last_stage = timed_stages[-1]
        return expected * self._step_seconds(last_stage) / self._costs[last_stage].step
