"""The train command: interpretation of its options, and the training with progress."""

import argparse
import os
import shlex
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from geosplat_jax.camera_rounds import refined_cameras, round_config
from geosplat_jax.cli.arguments import command_line
from geosplat_jax.cli.display import ProgressDisplay, console, say, say_refined
from geosplat_jax.fit.begin import Anew, Begin, Resume, TakeOver
from geosplat_jax.fit.cameras import CameraSettings
from geosplat_jax.fit.config import Budget, Config, config_warnings, override_paths
from geosplat_jax.fit.devices import Devices, choose_devices, connect_hosts
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.listener import NOBODY, Listener, Listeners
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.start_mesh import MeshSettings
from geosplat_jax.fit.surfaces import SurfaceSettings
from geosplat_jax.io.dataset import choose_downscale, load_recorded
from geosplat_jax.model_choice import ModelChoice
from geosplat_jax.report.events import EventLog
from geosplat_jax.report.facts import rung_row
from geosplat_jax.run import mesh_of_run, plan_training
from geosplat_jax.run import train as train_run


class UsageError(ValueError):
    """A command cannot run as it was called; the message says what to change."""


def require_place(file: Path | None, option: str) -> None:
    """Refuse an output file that cannot be written, before any work is done.

    Parameters
    ----------
    file : file that will be written, whose folder need not exist yet; None for no file.
    option : option that named the file, for the message.

    Raises
    ------
    UsageError
    """
    if file is None:
        return
    if file.is_dir():
        raise UsageError(f"{option} needs a file, and {file} is a folder")
    parent = next(folder for folder in file.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UsageError(f"{option} {file}: nothing can be written in {parent}")


def scene_options(arguments: argparse.Namespace, config: Config) -> dict[str, Any]:
    """Return the options of `load_recorded`, in a form for JSON; print an automatic choice."""
    options = {
        "light": arguments.light,
        "bounds": arguments.bounds,
        "cameras": arguments.cameras,
    }
    if arguments.downscale != "auto":
        return {**options, "downscale": arguments.downscale or 1}
    cells = config.geometry.cells_along
    if cells is None:
        raise UsageError(
            "--downscale auto needs a grid, which a start from a mesh lacks; give a number"
        )
    corners = arguments.bounds
    reading = {**options, "bounds": None if corners is None else (corners[:3], corners[3:])}
    choice = choose_downscale(arguments.scene, cells, **reading)
    say(choice.reason)
    return {**options, "downscale": choice.factor}


def config_from(arguments: argparse.Namespace, mesh: MeshSettings | None = None) -> Config:
    """Return the configuration that the arguments ask for.

    ``mesh`` : start mesh of the run that is resumed, used if the arguments name none.
    """
    return make_config(
        arguments.preset or "default",
        arguments.quality or "standard",
        material_prior=arguments.material_prior,
        mesh=arguments.mesh or mesh,
        overrides=_overrides(arguments),
    )


def _overrides(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the changes of ``--set`` and ``--seed``."""
    seed = () if arguments.seed is None else (f"run.seed={arguments.seed}",)
    return (*arguments.overrides, *seed)


@dataclass(frozen=True)
class _Request:
    """What a training has to do.

    Attributes
    ----------
    config : settings of the run.
    reading : how to read the scene, see `load_recorded`.
    budget : limits on time and memory; None for none.
    model : how to choose the parts of the model; None for those of the settings.
    is_recorded : whether all of this comes from the record of a run that is resumed.
    """

    config: Config
    reading: dict[str, Any]
    budget: Budget | None = None
    model: ModelChoice | None = None
    is_recorded: bool = False


_SETTING_OPTIONS = {
    "--set": "overrides",
    "--seed": "seed",
    "--quality": "quality",
    "--preset": "preset",
    "--material-prior": "material_prior",
    "--mesh": "mesh",
    "--downscale": "downscale",
    "--light": "light",
    "--bounds": "bounds",
    "--cameras": "cameras",
}
"""Options whose values are in the record of a run, with their names in the parsed arguments."""


def _require_no_settings(
    arguments: argparse.Namespace, folder: RunFolder, *, but: str | None = None
) -> None:
    """Refuse options that a resumed run takes from its record.

    ``but`` : an option that is accepted, because it agrees with the record.
    """
    defaults = command_line().parse_args(["train", str(arguments.scene)])
    explicit_options = [
        option
        for option, name in _SETTING_OPTIONS.items()
        if option != but and getattr(arguments, name) != getattr(defaults, name)
    ]
    if explicit_options:
        raise UsageError(
            f"--resume continues {folder} with the settings it was begun with; leave "
            f"{', '.join(explicit_options)} out, or train anew into another --output"
        )


def _request_of(arguments: argparse.Namespace, folder: RunFolder) -> _Request:
    """Determine what to do from the options, or from the record of a run that is resumed."""
    recorded_budget = folder.budget() if arguments.resume and folder.exists else None
    if arguments.memory is not None and arguments.budget is None and recorded_budget is None:
        raise UsageError("--memory belongs to --budget")
    if recorded_budget is not None:
        if arguments.model is not None:
            raise UsageError(f"{folder} was begun with a budget; leave --model out")
        limits, chooses_size = (arguments.budget, arguments.memory), arguments.downscale == "auto"
        if limits not in ((None, None), (recorded_budget.seconds, recorded_budget.memory)):
            raise UsageError(
                f"--resume keeps the budget that {folder} was begun with; leave --budget and "
                "--memory out"
            )
        _require_no_settings(arguments, folder, but="--downscale" if chooses_size else None)
        # The settings of the run were chosen for the budget, and have been adapted since.
        reading = folder.record()["dataset"]
        return _Request(folder.config(), reading, recorded_budget, is_recorded=True)
    if arguments.resume and folder.exists and arguments.budget is not None:
        raise UsageError(f"{folder} was begun without a budget; leave --budget out")
    if arguments.resume and folder.has_chosen_model:
        _require_no_settings(arguments, folder)
        return _Request(folder.config(), folder.record()["dataset"], is_recorded=True)
    if arguments.model is not None and (arguments.budget or arguments.source):
        raise UsageError("--model auto chooses for a whole training; leave --budget and --from out")
    if arguments.budget is None:
        mesh = mesh_of_run(folder) if arguments.resume else None
        config, model = config_from(arguments, mesh), None
        if arguments.model is not None:
            model = ModelChoice(by_hand=override_paths(arguments.overrides))
        return _Request(config, scene_options(arguments, config), model=model)
    if arguments.quality is not None or arguments.preset is not None:
        raise UsageError("--budget chooses the settings; leave --quality and --preset out")
    if arguments.source is not None:
        raise UsageError("--budget plans a whole training; leave --from out")
    budget = Budget(arguments.budget, arguments.memory)
    plan = plan_training(
        arguments.scene,
        budget,
        material_prior=arguments.material_prior,
        mesh=arguments.mesh,
        overrides=_overrides(arguments),
        downscale=None if arguments.downscale == "auto" else arguments.downscale,
        light=arguments.light,
    )
    for line in plan.describe():
        say(line)
    arguments.downscale = plan.downscale
    return _Request(plan.config, scene_options(arguments, plan.config), budget)


def _refined_cameras(
    arguments: argparse.Namespace, folder: Path, reading: dict[str, Any], geometry: SurfaceSettings
) -> Path:
    """Refine the cameras before the training itself; return and print the file of cameras."""
    draft_config = round_config(arguments.material_prior, seed=arguments.seed)
    say(
        "cameras first: a short training at quality draft, with half the split-sum steps and no "
        "free splats"
    )
    with ProgressDisplay(draft_config.total_steps) as display:
        cameras = refined_cameras(
            arguments.scene,
            folder,
            rounds=arguments.refine_cameras,
            config=draft_config,
            reading=reading,
            how=CameraSettings(white_balance=arguments.white_balance),
            geometry=geometry,
            replace=arguments.force,
            listener=display,
            on_view=say_refined,
        )
    say(f"cameras: {cameras}")
    return cameras


def _say_model(record: Mapping[str, Any] | None) -> None:
    """Print a table of the parts of the model, and why each was kept or left out."""
    if record is None:
        return
    table = Table(title=f"model, by {len(record['held_back'])} views that were held back")
    for column in ("part", "without", "with", "gain", ""):
        table.add_column(column)
    for rung in record["rungs"]:
        table.add_row(*rung_row(rung))
    for title in record["by_hand"]:
        table.add_row(title, "", "", "", "set by hand")
    console.print(table)
    say(f"choosing took {record['seconds']:.0f} s, {record['trainings']} short trainings")


@contextmanager
def _events(is_enabled: bool, folder: Path) -> Iterator[Listener]:
    """Yield a listener that writes event files during a training, if they are wanted."""
    if not is_enabled:
        yield NOBODY
        return
    log = EventLog(RunFolder(folder))
    try:
        yield log
    finally:
        log.close()


@contextmanager
def _table(path: Path | None, folder: Path) -> Iterator[None]:
    """Write the steps of a run to a CSV file when the training ends, even if it ends with an error.

    A command that is refused has made no step, and does not change the file.
    """
    steps = RunFolder(folder)
    initial_state = _state_of(steps.metrics)
    has_ended = False
    try:
        yield
        has_ended = True
    finally:
        has_steps = has_ended or _state_of(steps.metrics) != initial_state
        if path is not None and has_steps and steps.exists:
            steps.write_csv(path)


def _state_of(path: Path) -> tuple[int, int] | None:
    """Return size and modification time of a file; None if it does not exist."""
    if not path.exists():
        return None
    state = path.stat()
    return state.st_size, state.st_mtime_ns


def begin_from(arguments: argparse.Namespace) -> Begin:
    """Return how a run begins by the arguments: anew, resumed, or from stages of another run."""
    if arguments.source is not None:
        return TakeOver(arguments.source, arguments.stage, replace=arguments.force)
    return Resume() if arguments.resume else Anew(replace=arguments.force)


def _devices(arguments: argparse.Namespace) -> Devices:
    """Return the devices that the options ask for; must come before any other use of JAX."""
    has_value = arguments.host is not None, arguments.coordinator is not None
    if arguments.hosts is None and any(has_value):
        raise UsageError("--host and --coordinator belong to --hosts")
    if arguments.hosts is not None:
        if arguments.hosts != "auto" and not all(has_value):
            raise UsageError("--hosts N needs --host K and --coordinator ADDRESS:PORT")
        single_host_options = (arguments.budget, arguments.refine_cameras, arguments.model)
        if any(value is not None for value in single_host_options):
            raise UsageError(
                "--hosts makes a single training with the settings that are given; leave --budget, "
                "--refine-cameras and --model out"
            )
        connect_hosts(arguments.hosts, host=arguments.host, coordinator=arguments.coordinator)
    return choose_devices(arguments.devices)


def _idle(devices: Devices, config: Config) -> list[str]:
    """Say which stages have fewer views in a step than there are devices."""
    return [
        f"stages.{stage.name}.batch_views = {stage.batch_views} leaves "
        f"{devices.count - stage.batch_views} of {devices.count} devices idle; raise it to "
        f"{devices.count} or more, or use fewer devices"
        for stage in config.active_stages
        if stage.batch_views < devices.count
    ]


def train(arguments: argparse.Namespace) -> None:
    """Train a scene into a run's folder, with progress on the terminal."""
    start_time = time.perf_counter()
    if (arguments.source is None) != (arguments.stage is None):
        raise UsageError("--from RUN and --stage NAME belong together")
    if arguments.refine_cameras is not None and (arguments.budget or arguments.source):
        raise UsageError(
            "--refine-cameras trains before the run itself, which --budget and --from do not "
            "allow; leave --budget and --from out"
        )
    if arguments.source is not None and arguments.resume:
        raise UsageError("--from begins a new run, which --resume does not allow; leave one out")
    if arguments.white_balance and arguments.refine_cameras is None:
        raise UsageError("--white-balance belongs to --refine-cameras")
    require_place(arguments.csv, "--csv")
    devices = _devices(arguments)
    folder = arguments.output or Path("runs") / arguments.scene.resolve().name
    if arguments.force and arguments.source and arguments.source.resolve() == folder.resolve():
        raise UsageError("--force would remove the run that --from reads; take another --output")
    run_folder = RunFolder(folder)
    if not arguments.resume and arguments.hosts is None:
        # Before the scene is read, which may take long. Of several hosts, `fit` asks the first one.
        run_folder.require_free(replace=arguments.force)
    request = _request_of(arguments, run_folder)
    config, reading = request.config, dict(request.reading)
    if arguments.refine_cameras is not None and arguments.resume and run_folder.exists:
        if not run_folder.record()["dataset"].get("cameras"):
            raise UsageError(f"{folder} was begun without --refine-cameras; leave it out")
    # The record of a resumed run names its refined cameras already.
    if arguments.refine_cameras is not None and not request.is_recorded:
        reading["cameras"] = _refined_cameras(arguments, folder, reading, config.geometry)
    dataset = load_recorded(arguments.scene, reading)
    if arguments.resume and run_folder.exists:
        notes = run_folder.record().get("notes", dataset.notes)
    else:
        notes = (*dataset.notes, *config.geometry.notes(dataset))
    for note in notes:
        say(note)
    warnings = (*dataset.warnings, *config_warnings(config), *_idle(devices, config))
    for warning in warnings:
        say(warning, label="warning: ", style="yellow")
    say(f"{dataset.name}: {len(dataset.train)} views, {dataset.layout} ...")
    with (
        ProgressDisplay(config.total_steps) as display,
        _table(arguments.csv if devices.is_first_host else None, folder),
        _events(arguments.tensorboard and devices.is_first_host, folder) as event_listener,
    ):
        run = train_run(
            dataset,
            folder,
            config,
            begin=begin_from(arguments),
            budget=request.budget,
            began=start_time if request.budget is not None else None,
            model=request.model,
            devices=devices,
            listener=Listeners(display, event_listener),
        )
    if not devices.is_first_host:
        return
    if request.model is not None:
        _say_model(run.folder.record().get("model"))
    seconds = (run.folder.training() or {})["seconds_total"]
    next_command = shlex.join(["geosplat-jax", "evaluate", str(folder)])
    say(f"trained in {seconds:.0f} s; next: {next_command}")
