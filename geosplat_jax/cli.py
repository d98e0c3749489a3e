"""The ``geosplat-jax`` command: a thin layer over `run.train` and `run.Run`."""

import argparse
import importlib.metadata
import json
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from geosplat_jax.capture.masks import choose_factor, make_masks
from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.fit.cameras import ViewProgress
from geosplat_jax.fit.config import Config, all_settings, config_warnings
from geosplat_jax.fit.folder import RunError
from geosplat_jax.fit.gauge import change_lines
from geosplat_jax.fit.presets import PRESETS, QUALITIES, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
from geosplat_jax.fit.train import Interrupted, TrainingError
from geosplat_jax.fit.train import Progress as StepProgress
from geosplat_jax.gradcheck.report import (
    SINGLE_TOLERANCE,
    STAGES,
    TOLERANCE,
    check_stage,
    passes,
    summary,
    table,
    to_records,
)
from geosplat_jax.io.agreement import agreement_lines
from geosplat_jax.io.checkpoints import CheckpointError
from geosplat_jax.io.dataset import choose_downscale, describe, load_dataset, load_recorded
from geosplat_jax.io.export import LARGEST_TEXTURE
from geosplat_jax.io.images import SceneError
from geosplat_jax.io.poses import PoseSettings, find_poses
from geosplat_jax.materials import MATERIAL_PRIORS
from geosplat_jax.report.consistency import (
    DEFAULT_SIZE,
    DEFAULT_VIEWS,
    Consistency,
    body_of_mesh,
    box_of,
    cameras_around,
    load_mesh,
    measure,
    single_cameras,
)
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.relight import BACKGROUNDS, RelightOptions
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, LARGEST_SAMPLES, RELIGHT_KINDS
from geosplat_jax.run import Run
from geosplat_jax.run import train as train_run

_console = Console(stderr=True, highlight=False)

_SHEETS = ("overview.png", "materials.png", "relight.png")


class GradientError(RuntimeError):
    """A gradient disagrees with differences; the message says where."""


class UsageError(ValueError):
    """A command cannot run as it was called; the message says what to change."""


def _say(text: str, *, style: str = "", label: str = "") -> None:
    """Print a message as it is: what looks like markup may be a path."""
    _console.print(Text.assemble((label, style), text), soft_wrap=True)


def _show_warning(message: Warning | str, *where: Any) -> None:
    """Show a warning as one line, without the place in the program that it comes from."""
    del where
    _say(str(message), label="warning: ", style="yellow")


def _parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parser = argparse.ArgumentParser(
        prog="geosplat-jax",
        description="Photographs in; mesh, PBR materials and light out.",
    )
    parser.add_argument(
        "--version", action="version", version=importlib.metadata.version("geosplat_jax")
    )
    commands = parser.add_subparsers(dest="command", required=True)

    info = commands.add_parser("info", help="say what was recognised in a scene folder")
    _add_scene_arguments(info)

    _add_poses(commands.add_parser("poses", help="find the cameras of a folder of photographs"))

    _add_masks(commands.add_parser("masks", help="cut the object out of photographs with cameras"))

    train = commands.add_parser("train", help="reconstruct a scene")
    _add_scene_arguments(train)
    train.add_argument("--output", type=Path, help="run folder (default: runs/SCENE)")
    _add_config_arguments(train)
    start = train.add_mutually_exclusive_group()
    start.add_argument(
        "--resume", action="store_true", help="continue from the last checkpoint, or start again"
    )
    start.add_argument("--force", action="store_true", help="replace the run in the output folder")
    start.add_argument(
        "--from", dest="source", type=Path, metavar="RUN", help="take the first stages from a run"
    )
    train.add_argument("--stage", metavar="NAME", help="with --from: the stage to begin with")

    settings = commands.add_parser("settings", help="list every setting: default, range, meaning")
    settings.add_argument("prefix", nargs="?", default="", help="of the settings to list")
    _add_config_arguments(settings)

    evaluate = _run_parser(commands, "evaluate", "metrics and pictures of a run's test views")
    evaluate.add_argument("--protocol", choices=PROTOCOLS, default=PROTOCOLS[0])
    _add_samples(evaluate)
    evaluate.add_argument(
        "--relight-indirect",
        choices=RELIGHT_KINDS,
        default="traced",
        help="light from blocked directions under new lights (default: %(default)s)",
    )

    evaluate.add_argument(
        "--stage", help="what this stage ended with, instead of the run as it is now"
    )

    consistency = commands.add_parser(
        "consistency", help="how well splats stand for the mesh of a run, or for any mesh"
    )
    consistency.add_argument(
        "subject", type=Path, metavar="RUN|MESH", help="folder of a run, or file of a closed mesh"
    )
    consistency.add_argument(
        "--scene",
        type=Path,
        help="where the run's scene is now; or the scene whose cameras see the mesh (default: "
        f"{DEFAULT_VIEWS} cameras around it)",
    )
    consistency.add_argument("--stage", help="of a run, as for evaluate")
    consistency.add_argument(
        "--size", type=int, help="pixels along the longer side of the views (default: the scene's)"
    )
    consistency.add_argument("--json", type=Path, help="also write the figures to this file")

    render = _run_parser(commands, "render", "render a run's test or training views")
    render.add_argument("--views", choices=("test", "train"), default="test")
    render.add_argument("--output", type=Path, help="folder (default: RUN/renders)")

    _add_relight(_run_parser(commands, "relight", "show a run under another light"))

    refine = _run_parser(
        commands, "refine-cameras", "pose, focal length and exposure of every view of a run"
    )
    refine.add_argument("--output", type=Path, help="file (default: RUN/cameras.json)")

    export = _run_parser(commands, "export", "mesh.glb, gaussians.ply and light.exr of a run")
    export.add_argument("--output", type=Path, help="folder (default: RUN/export)")
    export.add_argument("--vertex-colors", action="store_true", help="instead of textures")
    export.add_argument("--texture-size", type=int, default=1024)

    gradcheck = commands.add_parser(
        "gradcheck", help="prove the gradients: float64 differences of every part"
    )
    gradcheck.add_argument(
        "stages", nargs="*", metavar="PART", help=f"some of {', '.join(STAGES)} (default: all)"
    )
    gradcheck.add_argument("--sweep", action="store_true", help="show the error at every step size")
    gradcheck.add_argument("--seed", type=int, default=0, help="of numbers, samples, directions")
    gradcheck.add_argument("--json", type=Path, help="also write every comparison to this file")
    return parser


def _run_parser(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    """Add a command that works on a run."""
    parser = commands.add_parser(name, help=text)
    parser.add_argument("run", type=Path)
    parser.add_argument("--scene", type=Path, help="where the run's scene is now, if it has moved")
    return parser


def _add_poses(poses: argparse.ArgumentParser) -> None:
    """Describe the poses command."""
    standard = PoseSettings()
    poses.add_argument("folder", type=Path, help="photographs, in FOLDER/images or FOLDER")
    poses.add_argument("--force", action="store_true", help="replace the cameras in FOLDER")
    poses.add_argument(
        "--size",
        type=int,
        default=standard.size,
        help="pixels of the longer side that details are looked for in (default: %(default)s)",
    )
    poses.add_argument(
        "--order",
        choices=get_args(PoseSettings.__annotations__["order"]),
        default=standard.order,
        help="sequence: compare those that follow each other by name (default: every two)",
    )
    poses.add_argument(
        "--lens",
        choices=get_args(PoseSettings.__annotations__["lens"]),
        default=standard.lens,
        help="one for all photographs, or one for each (default: %(default)s)",
    )
    poses.add_argument("--seed", type=int, default=standard.seed, help="of random searches")


def _add_masks(masks: argparse.ArgumentParser) -> None:
    """Describe the masks command."""
    standard = RadianceSettings()
    masks.add_argument("scene", type=Path, help="folder of a capture; SCENE/masks is written")
    masks.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="around the object (default: around what all cameras look at)",
    )
    masks.add_argument(
        "--output", type=Path, help="folder of splats and sheet (default: runs/SCENE_masks)"
    )
    masks.add_argument("--steps", type=int, default=standard.steps, help="(default: %(default)s)")
    masks.add_argument(
        "--splats",
        type=int,
        default=standard.capacity,
        metavar="N",
        help="most that there may be (default: %(default)s)",
    )
    masks.add_argument(
        "--downscale",
        type=_downscale,
        default="auto",
        metavar="N",
        help="reduce the images by this factor; auto: to at most as many pixels as 270 x 480",
    )
    masks.add_argument("--seed", type=int, default=standard.seed, help="of every random choice")
    start = masks.add_mutually_exclusive_group()
    start.add_argument(
        "--resume",
        action="store_true",
        help="continue the training; where it is done, only make the masks again, in another --box",
    )
    start.add_argument("--force", action="store_true", help="replace splats and masks")


def _add_samples(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--samples", type=int, default=DEFAULT_SAMPLES, help="rays per splat (default: %(default)s)"
    )


def _add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what chooses the settings of a run."""
    parser.add_argument("--preset", choices=PRESETS, default="default")
    parser.add_argument("--quality", choices=QUALITIES, default="standard")
    parser.add_argument(
        "--material-prior",
        choices=sorted(MATERIAL_PRIORS),
        default="hybrid",
        help="where roughness and metallic start (default: %(default)s)",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.FIELD=VALUE",
        help="change a setting; geosplat-jax settings lists them",
    )
    parser.add_argument("--seed", type=int, help="seed of every random choice")


def _add_relight(relight: argparse.ArgumentParser) -> None:
    """Describe the relight command."""
    relight.add_argument(
        "--env", type=Path, required=True, help="lat-long environment map: .hdr, .exr or an image"
    )
    relight.add_argument("--output", type=Path, help="folder (default: RUN/relight_NAME)")
    relight.add_argument(
        "--turntable", type=int, default=0, metavar="N", help="movie of N frames around the object"
    )
    relight.add_argument(
        "--rotate-env", type=int, default=0, metavar="N", help="movie of N frames, the light turns"
    )
    relight.add_argument("--fps", type=float, default=24.0, help="frames a second of the movies")
    relight.add_argument("--movie", choices=("gif", "mp4"), help="(default: mp4 if it can be made)")
    relight.add_argument(
        "--background", choices=BACKGROUNDS, default="light", help="(default: %(default)s)"
    )
    relight.add_argument("--intensity", type=float, default=1.0, help="factor of the light")
    relight.add_argument(
        "--albedo-scale", type=float, nargs=3, default=(1.0, 1.0, 1.0), metavar=("R", "G", "B")
    )
    _add_samples(relight)
    relight.add_argument("--indirect", choices=RELIGHT_KINDS, default="traced")


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what tells how to read a scene."""
    parser.add_argument("scene", type=Path, help="scene folder")
    parser.add_argument(
        "--downscale",
        type=_downscale,
        default=1,
        metavar="N",
        help="reduce the images by this factor; auto: by what the grid's cells can resolve",
    )
    parser.add_argument("--light", help="training light, where a scene has several")
    parser.add_argument(
        "--bounds",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box around the object (default: from masks and cameras)",
    )
    parser.add_argument(
        "--cameras", type=Path, metavar="FILE", help="instead of the scene's: see refine-cameras"
    )


def _downscale(text: str) -> int | str:
    """Read a factor, or ``auto``."""
    return text if text == "auto" else int(text)


def _scene_options(arguments: argparse.Namespace, config: Config) -> dict[str, Any]:
    """Return what `load_recorded` needs, in a form that JSON keeps; say what was chosen."""
    options = {
        "light": arguments.light,
        "bounds": arguments.bounds,
        "cameras": arguments.cameras,
    }
    if arguments.downscale != "auto":
        return {**options, "downscale": arguments.downscale}
    cells = getattr(config.geometry, "resolution", None)
    if cells is None:
        raise UsageError("--downscale auto needs a surface of cells; give a number")
    corners = arguments.bounds
    reading = {**options, "bounds": None if corners is None else (corners[:3], corners[3:])}
    chosen = choose_downscale(arguments.scene, cells, **reading)
    _say(chosen.reason)
    return {**options, "downscale": chosen.factor}


def _info(arguments: argparse.Namespace) -> None:
    """Print what was recognised, and whether masks and cameras agree."""
    dataset = load_recorded(arguments.scene, _scene_options(arguments, make_config()))
    print(describe(dataset))
    for line in agreement_lines(dataset.train, dataset.bounds):
        print(f"  {line}")


def _poses(arguments: argparse.Namespace) -> None:
    """Find the cameras of photographs, with progress on the terminal, and say how well they fit."""
    if arguments.size < 1 or arguments.seed < 0:
        raise UsageError("--size must be at least 1, and --seed must not be negative")
    settings = PoseSettings(
        size=arguments.size, order=arguments.order, lens=arguments.lens, seed=arguments.seed
    )
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        console=_console,
        disable=not _console.is_terminal,
    )
    tasks = {}

    def show(part: str, done: int, total: int) -> None:
        if part not in tasks:
            tasks[part] = bar.add_task(part, total=total)
            if bar.disable:
                _say(f"{part} ...")
        bar.update(tasks[part], completed=done)

    with bar:
        report = find_poses(arguments.folder, settings, force=arguments.force, on_progress=show)
    total = report.registered + len(report.missing)
    print(f"cameras: {report.registered} of {total} photographs ({report.registered / total:.0%})")
    if report.missing:
        print(f"without a camera, hence left out: {', '.join(report.missing)}")
    print(f"reprojection error: {report.error:.2f} pixels, {report.points} points")
    print("time: " + ", ".join(f"{part} {s:.0f} s" for part, s in report.seconds.items()))
    print(f"model: {report.model}")
    print(
        f"next: masks of the object (docs/captures.md), then geosplat-jax train {arguments.folder}"
    )


def _masks(arguments: argparse.Namespace) -> None:
    """Make masks of a capture, with progress on the terminal, and say how sure they are."""
    factor = arguments.downscale
    if factor == "auto":
        factor = choose_factor(arguments.scene)
    settings = RadianceSettings(
        steps=arguments.steps, capacity=arguments.splats, seed=arguments.seed
    )
    box = None
    if arguments.box is not None:
        box = (np.array(arguments.box[:3]), np.array(arguments.box[3:]))
    dataset = load_dataset(arguments.scene, downscale=factor, bounds=box, mask_files=False)
    for note in dataset.notes:
        _say(note)
    folder = arguments.output or Path("runs") / f"{arguments.scene.resolve().name}_masks"
    views = dataset.train
    _say(f"{dataset.name}: {len(views)} views of {views.width} x {views.height}; compiling ...")
    with _ProgressDisplay(settings.steps) as display:
        report = make_masks(
            dataset,
            settings,
            folder,
            box=box,
            downscale=factor,
            resume=arguments.resume,
            force=arguments.force,
            on_step=display.show,
        )
    print("\n".join(report.lines()))
    print(f"sheet: {folder / 'masks.png'}; splats: {folder / 'splats.ply'}")
    print(
        "look at the sheet; if it is right, next: geosplat-jax train "
        f"{arguments.scene}; if not: geosplat-jax masks {arguments.scene} --resume --box ..."
    )


def _config_from(arguments: argparse.Namespace) -> Config:
    """Return the configuration that the arguments ask for."""
    overrides = list(arguments.overrides)
    if arguments.seed is not None:
        overrides.append(f"run.seed={arguments.seed}")
    return make_config(
        arguments.preset,
        arguments.quality,
        material_prior=arguments.material_prior,
        overrides=tuple(overrides),
    )


def _train(arguments: argparse.Namespace) -> None:
    """Train a scene into a run's folder, with progress on the terminal."""
    if (arguments.source is None) != (arguments.stage is None):
        raise UsageError("--from RUN and --stage NAME belong together")
    config = _config_from(arguments)
    folder = arguments.output or Path("runs") / arguments.scene.resolve().name
    dataset = load_recorded(arguments.scene, _scene_options(arguments, config))
    for note in dataset.notes:
        _say(note)
    for warning in (*dataset.warnings, *config_warnings(config)):
        _say(warning, label="warning: ", style="yellow")
    _say(f"{dataset.name}: {len(dataset.train)} views, {dataset.layout}; compiling ...")
    with _ProgressDisplay(config.total_steps) as display:
        run = train_run(
            dataset,
            folder,
            config,
            resume=arguments.resume,
            force=arguments.force,
            source=arguments.source,
            first_stage=arguments.stage,
            on_step=display.show,
        )
    seconds = (run.folder.training() or {})["seconds_total"]
    _say(f"trained in {seconds:.0f} s; next: geosplat-jax evaluate {folder}")


class _ProgressDisplay:
    """A bar on a terminal, a line every fiftieth step elsewhere."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._bar = None
        if _console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.fields[stage]}"),
                TextColumn("{task.completed:.0f}/{task.total:.0f}"),
                BarColumn(),
                TextColumn("loss {task.fields[loss]:.4f}"),
                TextColumn("{task.fields[psnr]:.2f} dB"),
                TextColumn("{task.fields[splats]:,} splats"),
                TextColumn("{task.fields[left]}"),
                console=_console,
            )

    def __enter__(self) -> "_ProgressDisplay":
        """Start the bar."""
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(
                "",
                total=self._steps,
                stage="",
                loss=float("nan"),
                psnr=0.0,
                splats=0,
                left="compiling",
            )
        return self

    def __exit__(self, *unused: object) -> None:
        """Stop the bar."""
        if self._bar is not None:
            self._bar.stop()

    def show(self, progress: StepProgress) -> None:
        """Display one step."""
        left = progress.seconds_left
        remaining = "compiling" if left is None else f"{left:.0f} s left"
        if self._bar is not None:
            self._bar.update(
                self._task,
                completed=progress.step,
                stage=progress.stage,
                loss=progress.total,
                psnr=progress.psnr,
                splats=progress.splat_count,
                left=remaining,
            )
        elif progress.step % 50 == 0 or progress.step in (1, progress.steps):
            _say(
                f"{progress.stage}, step {progress.step}/{progress.steps}  "
                f"loss {progress.total:.4f}  "
                f"{progress.psnr:.2f} dB  {progress.splat_count:,} splats  "
                f"{progress.seconds:.0f} s, {remaining}"
            )


def _settings(arguments: argparse.Namespace) -> None:
    """List settings with their values under the chosen preset and quality."""
    table = Table(box=None, pad_edge=False)
    for title in ("setting", "value", "range", "meaning"):
        table.add_column(title, overflow="fold")
    rows = [
        row for row in all_settings(_config_from(arguments)) if row[0].startswith(arguments.prefix)
    ]
    if not rows:
        raise UsageError(f"no setting begins with {arguments.prefix!r}")
    for path, value, limits, meaning in rows:
        table.add_row(*map(Text, (path, json.dumps(value), limits, meaning)))
    Console(highlight=False).print(table)


def _check_samples(arguments: argparse.Namespace) -> None:
    """Refuse numbers of samples that no image can be made with."""
    if not 1 <= arguments.samples <= LARGEST_SAMPLES:
        raise UsageError(f"--samples must be from 1 to {LARGEST_SAMPLES}, got {arguments.samples}")


def _evaluate(arguments: argparse.Namespace) -> None:
    """Evaluate a run on its scene's test views and print the means."""
    _check_samples(arguments)
    run = Run(arguments.run, scene=arguments.scene)
    metrics = run.evaluate(
        protocol=arguments.protocol,
        samples=arguments.samples,
        relight_indirect=arguments.relight_indirect,
        stage=arguments.stage,
    )
    print(f"protocol: {arguments.protocol}")
    for name, value in metrics["mean"].items():
        print(f"{name:36s} {value:9.4f}")
    for note in metrics["notes"]:
        print(f"note: {note}")
    folder = run.folder.path
    if arguments.stage is not None:
        folder = run.folder.end_of(arguments.stage)
    pictures = [name for name in _SHEETS if (folder / name).exists()]
    print(f"metrics: {folder / 'metrics.json'}\npictures: {', '.join(pictures)} in {folder}")


def _consistency(arguments: argparse.Namespace) -> None:
    """Print the figures of Table 5 for a run, or for splats that are put on a mesh."""
    subject, size = arguments.subject, arguments.size
    if size is not None and size < 1:
        raise UsageError(f"--size must be at least 1 pixel, got {size}")
    if subject.is_dir():
        found = Run(subject, scene=arguments.scene).consistency(stage=arguments.stage, size=size)
    else:
        found = _consistency_of_mesh(arguments)
    print(f"reflected direction, mesh against splats  {found.reflection_deg:9.3f} degrees")
    print(f"distance along the ray, of the diagonal   {found.distance:9.5f}")
    print(f"pixels compared                           {found.pixels:9d}")
    print(f"pixels of the mesh without splats         {found.uncovered:9.2%}")
    if found.behind:
        print(f"pixels that see it from inside, left out  {found.behind:9.2%}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(asdict(found), indent=2) + "\n", encoding="utf-8")


def _consistency_of_mesh(arguments: argparse.Namespace) -> Consistency:
    """Put splats on the mesh of a file, and compare both."""
    path = arguments.subject
    if not path.exists():
        raise UsageError(f"{path} is neither the folder of a run nor a mesh file")
    if arguments.stage is not None:
        raise UsageError(f"--stage is of runs, and {path} is a file")
    mesh = load_mesh(path)
    if arguments.scene is None:
        cameras = cameras_around(box_of(mesh), size=arguments.size or DEFAULT_SIZE)
    else:
        views = load_recorded(arguments.scene, {}).views_to_show
        cameras = single_cameras(views, arguments.size)
    return measure(body_of_mesh(mesh), cameras)


def _relight(arguments: argparse.Namespace) -> None:
    """Run the relight command from its arguments."""
    factors = {"intensity": [arguments.intensity], "albedo-scale": arguments.albedo_scale}
    for name, values in factors.items():
        if not all(0 <= value < float("inf") for value in values):
            raise UsageError(f"--{name} must be finite and not negative, got {values}")
    for name in ("turntable", "rotate_env"):
        if getattr(arguments, name) < 0:
            raise UsageError(f"--{name.replace('_', '-')} must not be negative")
    _check_samples(arguments)
    written = Run(arguments.run, scene=arguments.scene).relight(
        arguments.env,
        arguments.output,
        options=RelightOptions(
            turntable=arguments.turntable,
            rotate_env=arguments.rotate_env,
            background=arguments.background,
            suffix=f".{arguments.movie}" if arguments.movie else None,
            frames_per_second=arguments.fps,
        ),
        intensity=arguments.intensity,
        albedo_scale=arguments.albedo_scale,
        samples=arguments.samples,
        indirect=arguments.indirect,
    )
    print(f"{len(written)} files: {written[0].parent}")


def _render(arguments: argparse.Namespace) -> None:
    """Render the views of a split."""
    written = Run(arguments.run, scene=arguments.scene).render(arguments.views, arguments.output)
    print(f"{len(written) // 2} views: {written[0].parent}")


def _refine_cameras(arguments: argparse.Namespace) -> None:
    """Refine the cameras of a run and print what changed."""
    run = Run(arguments.run, scene=arguments.scene)

    def tell(split: str, progress: ViewProgress) -> None:
        camera = progress.camera
        _say(
            f"{split} {progress.done}/{progress.total} {progress.name}  residual "
            f"{camera.residual_before:.4f} -> {camera.residual_after:.4f}  "
            f"{camera.iterations} steps  {camera.note}"
        )

    refined = run.refine_cameras(arguments.output, on_view=tell)
    for split, cameras in refined.items():
        views = run.dataset.test if split == "test" else run.dataset.train
        for line in change_lines(views, cameras, run.dataset.bounds):
            print(f"{split}: {line}")
    print(f"cameras: {arguments.output or run.folder.path / 'cameras.json'}")


def _export(arguments: argparse.Namespace) -> None:
    """Export the reconstructed asset."""
    if not 1 <= arguments.texture_size <= LARGEST_TEXTURE:
        raise UsageError(
            f"--texture-size must be from 1 to {LARGEST_TEXTURE}, got {arguments.texture_size}"
        )
    lines = Run(arguments.run, scene=arguments.scene).export(
        arguments.output,
        vertex_colors=arguments.vertex_colors,
        texture_size=arguments.texture_size,
    )
    for name, text in lines.items():
        print(f"{name}: {text}")


def _gradcheck(arguments: argparse.Namespace) -> None:
    """Compare gradients with float64 differences and print the tables."""
    names = list(dict.fromkeys(arguments.stages)) or list(STAGES)
    unknown = [name for name in names if name not in STAGES]
    if unknown:
        raise UsageError(f"unknown part {unknown[0]!r}; expected some of {', '.join(STAGES)}")
    checked = {}
    for name in names:
        checked[name] = check_stage(name, seed=arguments.seed)
        print(f"{table(checked[name], sweep=arguments.sweep)}\n", flush=True)
    print(summary(checked))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(to_records(checked), indent=1), encoding="utf-8")
    failed = [row for rows in checked.values() for row in rows if not passes(row)]
    if failed:
        raise GradientError(
            f"{len(failed)} comparisons exceed {TOLERANCE:g} (float64) or {SINGLE_TOLERANCE:g} "
            f"(float32); the first: {failed[0].problem}, {failed[0].worst}"
        )


_COMMANDS = {
    "info": _info,
    "poses": _poses,
    "masks": _masks,
    "train": _train,
    "settings": _settings,
    "evaluate": _evaluate,
    "consistency": _consistency,
    "render": _render,
    "refine-cameras": _refine_cameras,
    "relight": _relight,
    "export": _export,
    "gradcheck": _gradcheck,
}

_CURABLE = (
    SceneError,
    UsageError,
    RunError,
    TrainingError,
    CheckpointError,
    OSError,
    ValueError,
)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; errors that a user can cure print one line and return 2."""
    arguments = _parser().parse_args(argv)
    enable_compilation_cache()
    retain_freed_memory()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            _COMMANDS[arguments.command](arguments)
    except Interrupted as stop:
        _say(str(stop))
        return 130
    except GradientError as error:
        _say(str(error))
        return 1
    except _CURABLE as error:
        _say(str(error), label="error: ", style="bold red")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
