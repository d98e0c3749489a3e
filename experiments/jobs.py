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
    partners = [
        candidate
        for candidate in others
        if len(candidate.active_stages) <= count or not _begins(config, candidate)
    ]
    for length in range(count - 1, 0, -1):
        prefix = beginning(config, length)
        if any(_begins(prefix, partner) for partner in partners):
            return prefix
    return None


def _begins(prefix: Config, config: Config) -> bool:
    """Whether a run with settings ``config`` starts with all stages of ``prefix``."""
    count = len(prefix.active_stages)
    return beginning(config, count) == beginning(prefix, count)


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
    home_names, parts = homes(sweep), {}
    runs = [run for run in sweep.runs if home_names[run.name] == run.name]
    for factor in dict.fromkeys(run.downscale for run in runs):
        parts |= _parts_of(sweep, [run for run in runs if run.downscale == factor])
    return parts


def _parts_of(sweep: Sweep, runs: list[SweepRun]) -> dict[str, Part]:
    """List the parts of runs that are trained on the same images."""
    downscale = runs[0].downscale
    configs = {run.name: sweep.config(run) for run in runs}
    prefixes: list[Config] = []
    for name, config in configs.items():
        other_configs = [other for key, other in configs.items() if key != name]
        prefix = shared_stages(config, other_configs)
        if prefix is not None and prefix not in prefixes:
            prefixes.append(prefix)
    folders = [_folder_of(prefix, configs) for prefix in prefixes]

    def part(folder: str, config: Config, run: SweepRun | None) -> Part:
        count = len(config.active_stages)
        sources = [
            (len(prefix.stages), name)
            for prefix, name in zip(prefixes, folders, strict=True)
            if len(prefix.stages) < count and _begins(prefix, config)
        ]
        if not sources:
            return Part(folder, config, None, None, run, downscale)
        length, source = max(sources)
        return Part(folder, config, source, config.active_stages[length].name, run, downscale)

    shared_parts = [
        part(folder, prefix, None)
        for prefix, folder in zip(prefixes, folders, strict=True)
        if folder not in configs
    ]
    all_parts = [*shared_parts, *(part(run.name, configs[run.name], run) for run in runs)]
    # Sources come before the parts that need them; otherwise the order is that of the sweep.
    parts: dict[str, Part] = {}

    def add(new_part: Part) -> None:
        if new_part.source is not None and new_part.source not in parts:
            add(next(origin for origin in all_parts if origin.folder == new_part.source))
        parts.setdefault(new_part.folder, new_part)

    for new_part in all_parts:
        if new_part.run is not None:
            add(new_part)
    return parts


def _folder_of(prefix: Config, configs: dict[str, Config]) -> str:
    """Name the folder of shared stages: that of a run that ends with them, if there is one."""
    matching_names = [name for name, config in configs.items() if _begins(prefix, config)]
    exact_names = [n for n in matching_names if len(configs[n].active_stages) == len(prefix.stages)]
    return exact_names[0] if exact_names else f"_{matching_names[0]}.{prefix.stages[-1].name}"


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
    home_names, parts, jobs = homes(sweep), parts_of(sweep), []
    wanted_folders = {home_names[name] for name in names}
    default_options = {"downscale": sweep.downscale, "light": None, "bounds": None}
    for scene in scenes:

        def job(part: Part, scene: str = scene) -> Job:
            is_wanted = part.folder in wanted_folders
            return Job(
                label=f"{scene}/{part.folder}",
                scene=str((root / scene).resolve()),
                folder=str(output / scene / part.folder),
                config=in_scene(part.config, root / scene).to_dict(),
                options=default_options | {"downscale": part.downscale},
                source=None if part.source is None else str(output / scene / part.source),
                first_stage=part.first_stage,
                evaluate=sweep.evaluation(part.run) if part.run and is_wanted else None,
                evaluate_options=None if part.downscale == sweep.downscale else default_options,
            )

        all_jobs = {name: job(part) for name, part in parts.items()}
        needed_folders = set(wanted_folders)
        for name in reversed(parts):
            source = parts[name].source
            if source is not None and name in needed_folders and not is_trained(all_jobs[name]):
                needed_folders.add(source)
        jobs += [scene_job for name, scene_job in all_jobs.items() if name in needed_folders]
    return jobs


def is_trained(job: Job) -> bool:
    """Whether the training of a run came to its end."""
    return (Path(job.folder) / "training.json").exists()


def is_finished(job: Job) -> bool:
    """Whether a run is trained and, if the job asks for it, evaluated."""
    file_names = ["training.json"] + ["metrics.json", "evaluation.json"] * (
        job.evaluate is not None
    )
    return all((Path(job.folder) / name).exists() for name in file_names)
