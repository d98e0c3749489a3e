"""The trainings of a sweep: its runs, and stages that several runs share, trained once."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sweep import Sweep, SweepRun, in_scene

from geosplat_jax.fit.config import Config


@dataclass(frozen=True)
class Job:
    """The work of one process, in a form for JSON.

    Attributes
    ----------
    label : ``scene/name``, for messages.
    scene, folder : folder of the scene, and folder of the run.
    config, options : settings, and options of reading the scene, of `geosplat_jax.run.train`.
    source, first_stage : folder of a run whose stages are taken over, and the first stage to train;
        None to train all stages.
    evaluate : keyword arguments of `Run.evaluate`; None for no evaluation.
    evaluate_options : how to read the scene for the evaluation; None for as in training.
    """

    label: str
    scene: str
    folder: str
    config: dict[str, Any]
    options: dict[str, Any]
    source: str | None
    first_stage: str | None
    evaluate: dict[str, Any] | None
    evaluate_options: dict[str, Any] | None = None


def homes(sweep: Sweep) -> dict[str, str]:
    """Map every run to the first one with equal settings and evaluation, which alone is trained."""
    settings = {
        run.name: (sweep.config(run), sweep.evaluation(run), run.downscale) for run in sweep.runs
    }
    names = list(settings)
    return {name: next(n for n in names if settings[n] == settings[name]) for name in names}


def beginning(config: Config, count: int) -> Config:
    """Return the settings of a run's first ``count`` stages, without those of later stages."""
    return replace(config, stages=config.active_stages[:count])


def shared_stages(config: Config, others: Iterable[Config]) -> Config | None:
    """Return the longest beginning that a run shares with another run, or None.

    A stage is shared if it, all stages before it, and all settings common to the stages are equal.
    The last stage of a run is never shared, because nothing would be left to train. Runs that
    continue from the end of this run are not considered: they take over from the run itself.
    """
    count = len(config.active_stages)
    partners = [x for x in others if len(x.active_stages) <= count or not _begins(config, x)]
    for length in range(count - 1, 0, -1):
        first = beginning(config, length)
        if any(_begins(first, other) for other in partners):
            return first
    return None


def _begins(first: Config, config: Config) -> bool:
    """Whether the run of ``config`` starts with all stages of ``first``."""
    count = len(first.active_stages)
    return beginning(config, count) == beginning(first, count)


@dataclass(frozen=True)
class Part:
    """A training that a sweep needs in every scene: a run, or stages that several runs share.

    Attributes
    ----------
    folder : name of its folder within the folder of a scene.
    config : settings.
    source : folder of the part whose stages it takes over; None for none.
    first_stage : name of the first stage that it trains itself; None where ``source`` is None.
    run : the run; None for stages that several runs share.
    downscale : factor by which the training images are reduced.
    """

    folder: str
    config: Config
    source: str | None
    first_stage: str | None
    run: SweepRun | None
    downscale: int


def parts_of(sweep: Sweep) -> dict[str, Part]:
    """List the parts of a sweep by folder, sources first.

    The folder of shared stages is ``_RUN.STAGE``, named after the first run that has them and after
    the last of them; no run has such a name, since those start with a letter or a digit. A run that
    ends with the shared stages is itself the source. Runs that are trained on images of different
    sizes share nothing.
    """
    where, parts = homes(sweep), {}
    runs = [run for run in sweep.runs if where[run.name] == run.name]
    for factor in dict.fromkeys(run.downscale for run in runs):
        parts |= _parts_of(sweep, [run for run in runs if run.downscale == factor])
    return parts


def _parts_of(sweep: Sweep, runs: list[SweepRun]) -> dict[str, Part]:
    """List the parts of runs that are trained on the same images."""
    downscale = runs[0].downscale
    configs = {run.name: sweep.config(run) for run in runs}
    wanted: list[Config] = []
    for name, config in configs.items():
        others = [other for key, other in configs.items() if key != name]
        first = shared_stages(config, others)
        if first is not None and first not in wanted:
            wanted.append(first)
    folders = [_folder_of(first, configs) for first in wanted]

    def part(folder: str, config: Config, run: SweepRun | None) -> Part:
        count = len(config.active_stages)
        before = [
            (len(first.stages), name)
            for first, name in zip(wanted, folders, strict=True)
            if len(first.stages) < count and _begins(first, config)
        ]
        if not before:
            return Part(folder, config, None, None, run, downscale)
        length, source = max(before)
        return Part(folder, config, source, config.active_stages[length].name, run, downscale)

    shared = [
        part(folder, first, None)
        for first, folder in zip(wanted, folders, strict=True)
        if folder not in configs
    ]
    found = [*shared, *(part(run.name, configs[run.name], run) for run in runs)]
    # Sources come before the parts that need them; otherwise the order is that of the sweep.
    parts: dict[str, Part] = {}

    def add(one: Part) -> None:
        if one.source is not None and one.source not in parts:
            add(next(other for other in found if other.folder == one.source))
        parts.setdefault(one.folder, one)

    for one in found:
        if one.run is not None:
            add(one)
    return parts


def _folder_of(first: Config, configs: dict[str, Config]) -> str:
    """Name the folder of shared stages: that of a run that ends with them, if there is one."""
    having = [name for name, config in configs.items() if _begins(first, config)]
    ending = [n for n in having if len(configs[n].active_stages) == len(first.stages)]
    return ending[0] if ending else f"_{having[0]}.{first.stages[-1].name}"


def plan(
    sweep: Sweep, root: Path, output: Path, *, scenes: Iterable[str], names: Iterable[str]
) -> list[Job]:
    """List the jobs for some scenes and runs, in the order to do them.

    Shared stages come before the runs that take them over, and are left out if all of these runs
    are trained already.

    Parameters
    ----------
    sweep : the sweep.
    root : folder of the scene folders.
    output : folder of all runs.
    scenes, names : scenes and runs to train.
    """
    where, parts, jobs = homes(sweep), parts_of(sweep), []
    wanted = {where[name] for name in names}
    usual = {"downscale": sweep.downscale, "light": None, "bounds": None}
    for scene in scenes:

        def job(part: Part, scene: str = scene) -> Job:
            is_wanted = part.folder in wanted
            return Job(
                label=f"{scene}/{part.folder}",
                scene=str((root / scene).resolve()),
                folder=str(output / scene / part.folder),
                config=in_scene(part.config, root / scene).to_dict(),
                options=usual | {"downscale": part.downscale},
                source=None if part.source is None else str(output / scene / part.source),
                first_stage=part.first_stage,
                evaluate=sweep.evaluation(part.run) if part.run and is_wanted else None,
                evaluate_options=None if part.downscale == sweep.downscale else usual,
            )

        all_jobs = {name: job(part) for name, part in parts.items()}
        needed = set(wanted)
        for name in reversed(parts):
            source = parts[name].source
            if source is not None and name in needed and not is_trained(all_jobs[name]):
                needed.add(source)
        jobs += [one for name, one in all_jobs.items() if name in needed]
    return jobs


def is_trained(job: Job) -> bool:
    """Whether the training of a run came to its end."""
    return (Path(job.folder) / "training.json").exists()


def is_finished(job: Job) -> bool:
    """Whether a run is trained and, if the job asks for it, evaluated."""
    needed = ["training.json"] + ["metrics.json", "evaluation.json"] * (job.evaluate is not None)
    return all((Path(job.folder) / name).exists() for name in needed)
