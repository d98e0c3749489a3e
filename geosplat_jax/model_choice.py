"""The smallest model that explains a scene: a ladder of parts, of which those that help are kept.

Beginning with the smallest model, the parts of `fit.model_parts.LADDER` are tried one after the
other. The larger model is trained as long as the smaller one, from the same first stage and on the
same views, and views that were held back show whether it is better (`fit.evidence`). Trainings are
short and use reduced photographs. In the end, kept parts that later ones may have made unnecessary
are tried once more. Every measurement is written to a file, so that a choice that was interrupted
continues without repeating a training.
"""

import hashlib
import json
import math
import shutil
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from geosplat_jax.core.settings import PositiveCount, settings
from geosplat_jax.fit.begin import ANEW, Begin, Resume
from geosplat_jax.fit.blocked import blocked_share
from geosplat_jax.fit.budget import reduction_factor, with_steps
from geosplat_jax.fit.config import Config, Stage
from geosplat_jax.fit.entering import Start
from geosplat_jax.fit.evidence import Rung, compare, every_nth, neighbouring_blocks
from geosplat_jax.fit.folder import RunError, RunFolder, folder_beside, locked_folder
from geosplat_jax.fit.listener import NOBODY, Listener
from geosplat_jax.fit.model_parts import LADDER, Part, offered_parts, without
from geosplat_jax.fit.train import TrainingError, fit, load_trained
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import written_aside
from geosplat_jax.io.memory import is_out_of_memory
from geosplat_jax.io.views import Views, some_views
from geosplat_jax.report.renderer import Renderer, photograph_on_white, render_on_white

_USUAL_CELLS = 48
"""Cells that photographs are reduced for where the surface has none."""

_SAMPLES = 64
"""Rays per splat when held-back views are rendered."""

_BATCH_VIEWS = 2
"""Most views per step of a trial."""

_FEWEST_HELD = 3
"""Fewest held-back views from which models are compared."""

_BLOCKED = 0.02
"""Shadows are kept if the surface blocks more than this share of a uniform sky's light from
itself."""

_CLEAR_GAIN = 2.0
"""A part is not tried again if it gained more than this many times what later parts gained."""

_NEGLIGIBLE_GAIN = 0.1
"""A part that is tried again stays if it gains more than this, in decibels."""

_LATER_PARTS = ("shift", "hash", "light")
"""Parts that the first stages do without, which trials share."""

_UNTRIED = "untried, since it changes no stage of the trials"

_STATE = "choice.json"


@settings
class ModelChoice:
    """How a model is chosen."""

    by_hand: tuple[str, ...] = ()
    """Paths of settings that were set by hand; the parts that they decide are not tried."""
    steps: PositiveCount = 150
    """Most steps of the first stage, and of every trial after it."""
    seeds: PositiveCount = 2
    """Most trainings of a model, each with its own seed. The first seed decides about a part that
    gains less than its standard error; a part that gains more is compared with the spread over
    seeds of the smaller model, and if that is larger, the larger model gets every seed as well."""
    hold_back: Annotated[int, Field(ge=2)] = 8
    """One in this many training views is held back."""


@dataclass(frozen=True)
class ChosenModel:
    """A chosen model, and the evidence for it.

    Attributes
    ----------
    config : settings of the training that is to follow, on all views.
    kept : names of the parts that were chosen.
    rungs : results of all parts in the order in which they were tried; of a part that was tried
        again, the last one counts.
    by_hand : titles of the parts that were set by hand, and of those that these need.
    held_back : names of the views that were held back.
    trainings : number of trainings of models, those that failed included, first stages not.
    seconds : time that they took, first stages included.
    """

    config: Config
    kept: tuple[str, ...]
    rungs: tuple[Rung, ...]
    by_hand: tuple[str, ...]
    held_back: tuple[str, ...]
    trainings: int
    seconds: float

    def record(self) -> dict[str, Any]:
        """Return the choice as plain values for ``run.json``."""
        return {
            "kept": list(self.kept),
            "rungs": [asdict(rung) for rung in self.rungs],
            "by_hand": list(self.by_hand),
            "held_back": list(self.held_back),
            "trainings": self.trainings,
            "seconds": round(self.seconds, 1),
        }


def choice_folder(output: str | Path) -> Path:
    """Return the folder beside a run's own that trials are made in."""
    return folder_beside(output, "model")


def choose_model(
    dataset: Dataset,
    config: Config,
    output: str | Path,
    how: ModelChoice | None = None,
    *,
    begin: Begin = ANEW,
    listener: Listener = NOBODY,
) -> ChosenModel:
    """Find the smallest model that explains the training views of a scene.

    Parameters
    ----------
    dataset : the scene.
    config : settings of the largest model, with the steps and samples of the training to follow.
    output : folder of the run to come. Trials are made beside it, in ``OUTPUT_model``; the file
        ``choice.json`` and a lock stay there.
    how : settings of the choice; by default those of `ModelChoice`.
    begin : `Resume` continues a choice that was interrupted, without repeating trainings that are
        done. `Anew` with ``replace`` removes a choice that is there already, and a run that
        ``output`` holds.
    listener : receives the events of every training, and the result of every part.

    Raises
    ------
    ValueError
        If there are too few views to hold any back, nothing is trained, or the surface cannot start
        in the scene.
    RunError
        If there is a choice already that is neither to be resumed nor replaced, that was begun with
        other settings or photographs, or that another process is making.
    TrainingError, Interrupted
        See `fit.train.fit`; a part whose training fails is left out.
    """
    how = how or ModelChoice()
    trials = _Trials(dataset, config, choice_folder(output), how, listener)
    candidate_parts = offered_parts(config, how.by_hand)
    kept_names: frozenset[str] = frozenset()
    rungs: list[Rung] = []
    models_of_trials: dict[str, frozenset[str]] = {}
    with locked_folder(trials.state_path.parent, own=trials.state_path):
        trials.open(begin)
        if begin.replace:
            config.geometry.notes(dataset)  # Refuses a start mesh that does not fit the scene.
            RunFolder(output).make_room()
        for part in candidate_parts:
            if not kept_names.issuperset(_among(part.follows, candidate_parts)):
                continue
            trial_names = kept_names | {part.name} | _among(part.needs, candidate_parts)
            if part.shows_in_photographs:
                rung = _tried(trials, part, kept_names, trial_names)
            else:
                rung = _seen_on_surface(trials, part, kept_names, trial_names)
            if rung.is_kept:
                kept_names = models_of_trials[part.name] = trial_names
            rungs.append(rung)
            listener.on_rung(rung)
        for part in reversed(candidate_parts):
            if models_of_trials.get(part.name) == kept_names:
                continue  # Nothing has changed since it was kept.
            if _is_doubtful(part, kept_names, rungs):
                rung = _tried_again(trials, part, kept_names)
                kept_names = kept_names if rung.is_kept else kept_names - {part.name}
                rungs.append(rung)
                listener.on_rung(rung)
        trials.close()
    return ChosenModel(
        config=trials.model(kept_names),
        kept=tuple(part.name for part in LADDER if part.name in kept_names),
        rungs=tuple(rungs),
        by_hand=tuple(
            part.title for part in LADDER if part.is_in(config) and part not in candidate_parts
        ),
        held_back=trials.held.names,
        trainings=trials.count,
        seconds=trials.seconds,
    )


def _among(names: Iterable[str], parts: Iterable[Part]) -> frozenset[str]:
    """Return those names that are parts to choose."""
    return frozenset(names) & {part.name for part in parts}


def _added(part: Part, kept_names: Collection[str], trial_names: Collection[str]) -> str:
    """Name the parts that are added with a part, because it needs them."""
    names = set(trial_names) - {*kept_names, part.name}
    titles = [added_part.title for added_part in LADDER if added_part.name in names]
    return f"with {', '.join(titles)}" if titles else ""


def _tried(
    trials: "_Trials", part: Part, kept_names: Collection[str], trial_names: Collection[str]
) -> Rung:
    """Compare the models with a part and without it.

    Other seeds are trained only where the gain exceeds its standard error: first of the smaller
    model, and of the larger one if the gain could be due to the seed alone.
    """
    smaller = {0: trials.decibels(kept_names, 0)}
    smaller_mean = float(np.mean(smaller[0]))
    if trials.are_alike(kept_names, trial_names):
        return Rung(part.name, part.title, smaller_mean, None, None, True, _UNTRIED)
    try:
        larger = {0: trials.decibels(trial_names, 0)}
    except TrainingError as error:
        return Rung(part.name, part.title, smaller_mean, None, None, False, str(error))
    note = _added(part, kept_names, trial_names)
    evidence = compare(larger, smaller, trials.blocks)
    if evidence.exceeds_error:
        smaller = trials.decibels_of_seeds(kept_names)
        evidence = compare(larger, smaller, trials.blocks)
        if not evidence.is_kept:
            larger = trials.decibels_of_seeds(trial_names)
            evidence = compare(larger, smaller, trials.blocks)
    seeds = smaller.keys() & larger.keys()
    smaller_mean, larger_mean = (
        float(np.mean([decibels[seed] for seed in seeds])) for decibels in (smaller, larger)
    )
    return Rung(part.name, part.title, smaller_mean, larger_mean, evidence, evidence.is_kept, note)


def _is_doubtful(part: Part, kept_names: Collection[str], rungs: Iterable[Rung]) -> bool:
    """Tell whether parts that were kept after a part may have made it unnecessary.

    Parts stay that photographs cannot judge, that no trial could compare, or without which another
    part would not be there. Where a later part was kept without a gain to compare, any gain is in
    doubt.
    """
    kept_parts = [kept_part for kept_part in LADDER if kept_part.name in kept_names]
    if part not in kept_parts or not part.shows_in_photographs:
        return False
    if any(part.name in (*kept_part.needs, *kept_part.follows) for kept_part in kept_parts):
        return False
    found = {rung.part: rung.found for rung in rungs if rung.is_kept}
    later_parts = kept_parts[kept_parts.index(part) + 1 :]
    # A part that is only there because another one needs it has no entry, and no gain of its own.
    later_gain = sum(
        math.inf if (evidence := found[later_part.name]) is None else evidence.gain
        for later_part in later_parts
        if later_part.name in found
    )
    if part.name not in found:
        return True
    own_evidence = found[part.name]
    return own_evidence is not None and own_evidence.gain <= _CLEAR_GAIN * later_gain


def _tried_again(trials: "_Trials", part: Part, kept_names: Collection[str]) -> Rung:
    """Compare a model with itself without a part, by the first seed.

    The part has already gained more than another seed does, so it is left out only if its gain has
    become negligible and does not exceed the standard error.
    """
    title = f"{part.title}, again"
    larger = trials.decibels(kept_names, 0)
    larger_mean = float(np.mean(larger))
    try:
        smaller = trials.decibels(frozenset(kept_names) - {part.name}, 0)
    except TrainingError as error:
        return Rung(part.name, title, None, larger_mean, None, True, str(error))
    evidence = compare({0: larger}, {0: smaller}, trials.blocks)
    smaller_mean = float(np.mean(smaller))
    is_kept = evidence.is_kept or evidence.gain > _NEGLIGIBLE_GAIN
    return Rung(part.name, title, smaller_mean, larger_mean, evidence, is_kept)


def _seen_on_surface(
    trials: "_Trials", part: Part, kept_names: Collection[str], trial_names: Collection[str]
) -> Rung:
    """Keep a part, such as shadows, if the surface blocks enough light from itself.

    For parts that photographs under one light cannot judge (`Part.shows_in_photographs`). A part
    that would be kept is trained once, and left out if that training fails.
    """
    smaller_mean = float(np.mean(trials.decibels(kept_names, 0)))
    share = trials.blocked_share()
    is_kept = share > _BLOCKED
    reason = f"the surface blocks {100 * share:.1f} % of a uniform sky's light from itself"
    added = _added(part, kept_names, trial_names) if is_kept else ""
    note = f"{reason}, {added}" if added else reason
    if is_kept and not trials.are_alike(kept_names, trial_names):
        try:
            trials.decibels(trial_names, 0)
        except TrainingError as error:
            return Rung(part.name, part.title, smaller_mean, None, None, False, str(error))
    return Rung(part.name, part.title, smaller_mean, None, None, is_kept, note)


class _Trials:
    """Short trainings of models of one scene, each measured on the views that were held back.

    Parameters
    ----------
    dataset, config, how : see `choose_model`.
    folder : folder of the trainings and of the measurements.
    listener : receives the events of every training.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        folder: Path,
        how: ModelChoice,
        listener: Listener,
    ) -> None:
        stages = [stage for stage in config.active_stages if not stage.splats.takes_over]
        if not stages:
            raise ValueError("there is no model to choose: no stage has steps")
        # A view without the object scores 200 dB if the render is empty, and a single covered pixel
        # costs more than a hundred of them: such views would decide every comparison.
        shown = np.flatnonzero(dataset.train.coverage > 0.0)
        held = shown[every_nth(len(shown), how.hold_back)[1]]
        used = np.setdiff1d(np.arange(len(dataset.train)), held)
        if len(held) < _FEWEST_HELD:
            raise ValueError(
                f"choosing a model holds back one in {how.hold_back} of the {len(shown)} training "
                f"views that show the object; that makes {len(held)}, and at least "
                f"{_FEWEST_HELD} are needed: take more photographs, or train without --model auto"
            )
        self.how, self._config, self._folder, self._listener = how, config, folder, listener
        self._first, self._last = stages[0], stages[-1]
        self._offered = offered_parts(config, how.by_hand)
        longest_side = max(dataset.train.height, dataset.train.width)
        factor = reduction_factor(longest_side, config.geometry.cells_along or _USUAL_CELLS)
        self.held = some_views(dataset.train, held, factor=factor)
        self._dataset = replace(
            dataset,
            train=some_views(dataset.train, used, factor=factor),
            test=self.held,
            options={**dataset.options, "reduced": factor, "held_back": how.hold_back},
        )
        center = 0.5 * (np.asarray(dataset.bounds[0]) + np.asarray(dataset.bounds[1]))
        view_vectors = self.held.camera_to_world[:, :3, 3] - center
        lengths = np.maximum(np.linalg.norm(view_vectors, axis=1, keepdims=True), 1e-12)
        self.blocks = neighbouring_blocks(view_vectors / lengths)
        self._measured: dict[str, dict[str, Any]] = {}
        self._first_stage_seconds: dict[str, float] = {}
        self._blocked: float | None = None

    @property
    def count(self) -> int:
        """Trainings of models so far, those that failed included."""
        return len(self._measured)

    @property
    def seconds(self) -> float:
        """Seconds that all trainings took, first stages included."""
        trial_seconds = sum(
            float(measurement["seconds"]) for measurement in self._measured.values()
        )
        return trial_seconds + sum(self._first_stage_seconds.values())

    @property
    def state_path(self) -> Path:
        """File of the measurements."""
        return self._folder / _STATE

    def model(self, kept: Collection[str]) -> Config:
        """Return the settings in which, of the parts on offer, only the named ones stay."""
        return without(self._config, [part for part in self._offered if part.name not in kept])

    def are_alike(self, names: Collection[str], others: Collection[str]) -> bool:
        """Tell whether two models have the same trials, since only other stages tell them apart."""
        first, second = (self._trial(self.model(kept), self._last, 0) for kept in (names, others))
        return first == second

    def open(self, begin: Begin) -> None:
        """Begin a choice, or read one that is there already.

        Raises
        ------
        RunError
            See `choose_model`.
        """
        path, mark = self.state_path, self._mark
        if begin.replace and path.exists():
            self.close()
            path.unlink()
        if not path.exists():
            self._save(mark)
            return
        if not begin.resumes:
            raise RunError(
                f"{self._folder} holds a choice of a model; continue it with --resume, or replace "
                "it with --force"
            )
        try:
            state = parse_json(path.read_bytes())
            seconds = {name: float(value) for name, value in state["first_stages"].items()}
            measurements = {
                name: self._checked(measurement) for name, measurement in state["trainings"].items()
            }
            share = state.get("blocked")
            self._blocked = None if share is None else float(share)
            old_mark = state["mark"]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise RunError(f"{path} is damaged: {error}; begin anew with --force") from None
        if old_mark != mark:
            raise RunError(
                f"{path} was begun with other settings or other views, or these were read with "
                "other options, or by another version; use the same again, or begin anew with "
                "--force"
            )
        self._measured, self._first_stage_seconds = measurements, seconds

    def _checked(self, measurement: Mapping[str, Any]) -> dict[str, Any]:
        """Return a measurement from the file; raise an error where it has another form."""
        seconds = float(measurement["seconds"])
        if "failure" in measurement:
            return {"failure": str(measurement["failure"]), "seconds": seconds}
        decibels = [float(value) for value in measurement["psnr"]]
        if len(decibels) != len(self.held) or not np.isfinite(decibels).all():
            raise ValueError(f"a number for each of {len(self.held)} views is expected")
        return {"psnr": decibels, "seconds": seconds}

    def close(self) -> None:
        """Delete the folders of the trainings; what they measured stays in the state file."""
        for path in self._folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)

    @cached_property
    def _mark(self) -> str:
        """Digest of settings, options and photographs, which tells this choice from others."""
        identity = (
            self._config.to_dict(),
            asdict(replace(self.how, by_hand=())),
            [part.name for part in self._offered],
            {name: text for name, text in self._dataset.options.items() if name != "cameras"},
            [[x.fingerprint(), x.mean_colors.tolist()] for x in (self._dataset.train, self.held)],
        )
        text = json.dumps(identity, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _save(self, mark: str) -> None:
        """Write what was measured, in one go."""
        state = {
            "mark": mark,
            "held_back": list(self.held.names),
            "blocks": self.blocks.tolist(),
            "first_stages": self._first_stage_seconds,
            "trainings": self._measured,
            "blocked": self._blocked,
        }
        with written_aside(self.state_path) as temporary_path:
            temporary_path.write_text(json.dumps(state, indent=2) + "\n", encoding="utf-8")

    def decibels(self, kept: Collection[str], seed: int) -> np.ndarray:
        """Return the decibels of a model on every held-back view, (V,); train it first if needed.

        Parameters
        ----------
        kept : names of the model's parts.
        seed : number that is added to the seed of the settings.

        Raises
        ------
        TrainingError
            If its training fails, or has failed before for another reason than a lack of memory.
        """
        name = f"{_name_of(kept)}_seed_{seed}"
        if name not in self._measured:
            start = self._start("cells" in kept)
            folder = self._folder / name
            start_time = time.perf_counter() - _seconds_used(folder)
            config = self._trial(self.model(kept), self._last, seed)
            measurement: dict[str, Any] = {}
            try:
                self._fit(config, folder, start)
                measurement["psnr"] = self._measure(folder).tolist()
            except TrainingError as error:
                if error.__cause__ is not None and is_out_of_memory(error.__cause__):
                    raise  # and go on from the last checkpoint when there is more memory
                measurement["failure"] = str(error)
            measurement["seconds"] = round(time.perf_counter() - start_time, 2)
            self._measured[name] = measurement
            self._save(self._mark)
            shutil.rmtree(folder, ignore_errors=True)  # it may hold nothing yet
        if "failure" in self._measured[name]:
            raise TrainingError(self._measured[name]["failure"])
        return np.asarray(self._measured[name]["psnr"], float)

    def decibels_of_seeds(self, kept: Collection[str]) -> dict[int, np.ndarray]:
        """Return the decibels of a model on every held-back view, (V,), for each of the seeds.

        A seed whose training fails is missing, since it says nothing of the others.
        """
        found = {}
        for seed in range(self.how.seeds):
            with suppress(TrainingError):
                found[seed] = self.decibels(kept, seed)
        return found

    def blocked_share(self) -> float:
        """Return the share of light that the first stage's surface blocks from itself.

        See `blocked.blocked_share`. The share is written to the file, since the first stage is
        removed once the model is chosen.
        """
        if self._blocked is None:
            self._start(False)
            trained = load_trained(self._folder / _first_stage_name(False))
            pipeline = trained.pipeline
            self._blocked = float(
                blocked_share(pipeline.surface, trained.params.geometry, pipeline.capacities)
            )
            self._save(self._mark)
        return self._blocked

    def _start(self, has_finer_cells: bool) -> Start:
        """Return what a first stage ended with; train it first if that was not done.

        There is one first stage for each size of the cells. It has all parts of the material.
        """
        omitted_names = (*_LATER_PARTS, *(() if has_finer_cells else ("cells",)))
        name = _first_stage_name(has_finer_cells)
        omitted_parts = [part for part in self._offered if part.name in omitted_names]
        folder = self._folder / name
        if name not in self._first_stage_seconds:
            start_time = time.perf_counter() - _seconds_used(folder)
            self._fit(
                self._trial(without(self._config, omitted_parts), self._first, 0), folder, None
            )
            self._first_stage_seconds[name] = round(time.perf_counter() - start_time, 2)
            self._save(self._mark)
        return _start_of(folder)

    def _trial(self, config: Config, stage: Stage, seed: int) -> Config:
        """Return settings of a short training of one stage."""
        trial_stage = config.stage(stage.name)
        trial_stage = replace(
            trial_stage, batch_views=min(trial_stage.batch_views, _BATCH_VIEWS), enter=()
        )
        run = replace(
            config.run,
            seed=(config.run.seed + seed) % 2**32,
            checkpoint_every=max(1, self.how.steps // 3),
            preview_every=0,
        )
        trial_config = replace(config, run=run, stages=(trial_stage,))
        return with_steps(trial_config, min(1.0, self.how.steps / trial_stage.steps))

    def _fit(self, config: Config, folder: Path, start: Start | None) -> None:
        begin = Resume(start=start)
        fit(self._dataset, config, folder, begin=begin, listener=self._listener)

    def _measure(self, folder: Path) -> np.ndarray:
        """Compare the held-back views with the photographs, in sRGB on white; decibels, (V,)."""
        renderer = Renderer.of(load_trained(folder), samples=_SAMPLES)
        return np.array([_decibels(renderer, self.held, view) for view in range(len(self.held))])


def _decibels(renderer: Renderer, views: Views, view: int) -> float:
    """Peak signal-to-noise ratio of one view over the pixels that count."""
    output = renderer(views.camera([view]))
    error = render_on_white(output.rgb, output.alpha) - photograph_on_white(views.images[view])
    pixel_weights = np.ones(error.shape[:2]) if views.valid is None else views.valid[view]
    mean_square = float(
        np.sum(pixel_weights[..., None] * error**2) / (3.0 * max(float(pixel_weights.sum()), 1.0))
    )
    return -10.0 * math.log10(max(mean_square, 1e-20))


def _first_stage_name(has_finer_cells: bool) -> str:
    """Name the folder of a first stage."""
    return "first_stage_cells" if has_finer_cells else "first_stage"


def _start_of(folder: Path) -> Start:
    """Return what a first stage has ended with."""
    trained = load_trained(folder)
    return Start(trained.pipeline.surface, trained.params)


def _seconds_used(folder: Path) -> float:
    """Return what a training has taken before it was interrupted."""
    return RunFolder(folder).seconds_used()


def _name_of(kept: Collection[str]) -> str:
    """Return the name of a model's trainings."""
    return "_".join(part.name for part in LADDER if part.name in kept) or "smallest"
