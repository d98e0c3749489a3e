"""What each command does: a thin layer over `run.train` and `run.Run`."""

import argparse
import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from geosplat_jax.capture.masks import choose_factor, make_masks
from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.cli.arguments import command_line
from geosplat_jax.cli.display import ProgressDisplay, WorkDisplay, say, say_refined
from geosplat_jax.cli.training import UsageError, config_from, require_place, scene_options, train
from geosplat_jax.core.settings import as_written
from geosplat_jax.fit.cameras import CameraSettings
from geosplat_jax.fit.config import all_settings
from geosplat_jax.fit.folder import RunError
from geosplat_jax.fit.gauge import change_lines
from geosplat_jax.fit.presets import make_config
from geosplat_jax.gradcheck.report import (
    PARTS,
    SINGLE_TOLERANCE,
    TOLERANCE,
    check_part,
    passes,
    summary,
    table,
    to_records,
)
from geosplat_jax.io.agreement import agreement_lines, hollow_line
from geosplat_jax.io.dataset import describe, load_dataset, load_recorded
from geosplat_jax.io.export import LARGEST_TEXTURE
from geosplat_jax.io.images import SceneError, written_aside
from geosplat_jax.io.poses import PoseSettings, find_poses
from geosplat_jax.report.consistency import (
    DEFAULT_SIZE,
    Consistency,
    body_of_mesh,
    box_of,
    cameras_around,
    load_mesh,
    measure,
    single_cameras,
)
from geosplat_jax.report.page import REPORT
from geosplat_jax.report.relight import RelightOptions
from geosplat_jax.report.renderer import LARGEST_SAMPLES
from geosplat_jax.report.sheets import SHEETS
from geosplat_jax.report.shots import LARGEST_SIZE, Cameras, Images
from geosplat_jax.run import Run
from geosplat_jax.viewer.painter import Viewer
from geosplat_jax.viewer.server import ViewerServer, require_free_port, viser_library
from geosplat_jax.viewer.source import CheckpointWatch, light_files, load_lights

_ONE_LINE = 1000
"""Width of the settings table where the output is no terminal, so that no line is wrapped."""

_LARGEST_FACTOR = 1e6
"""Largest factor on a light or an albedo: far beyond useful ones, yet safe in single precision."""


class GradientError(RuntimeError):
    """A gradient disagrees with differences; the message says where."""


def _info(arguments: argparse.Namespace) -> None:
    """Print what was recognised, and whether masks and cameras agree."""
    dataset = load_recorded(arguments.scene, scene_options(arguments, make_config()))
    print(describe(dataset))
    if dataset.train.has_masks:
        for line in agreement_lines(dataset.train, dataset.bounds):
            print(f"  {line}")
        print(f"  {hollow_line(dataset.train, dataset.bounds)}")


def _poses(arguments: argparse.Namespace) -> None:
    """Find the cameras of photographs, with progress on the terminal, and say how well they fit."""
    if arguments.size < 1:
        raise UsageError(f"--size must be at least 1, got {arguments.size}")
    settings = PoseSettings(
        size=arguments.size, order=arguments.order, lens=arguments.lens, seed=arguments.seed
    )
    with WorkDisplay() as display:
        report = find_poses(arguments.folder, settings, force=arguments.force, on_progress=display)
    total = report.registered + len(report.missing)
    print(f"cameras: {report.registered} of {total} photographs ({report.registered / total:.0%})")
    if report.missing:
        print(f"without a camera, hence left out: {', '.join(report.missing)}")
    print(f"reprojection error: {report.error:.2f} pixels, {report.points} points")
    print(
        "time: " + ", ".join(f"{part} {seconds:.0f} s" for part, seconds in report.seconds.items())
    )
    print(f"model: {report.model}")
    masks_command, train_command = (
        shlex.join(["geosplat-jax", name, str(arguments.folder)]) for name in ("masks", "train")
    )
    print(f"next: masks of the object, by {masks_command} or by hand; then {train_command}")


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
        say(note)
    folder = arguments.output or Path("runs") / f"{arguments.scene.resolve().name}_masks"
    views = dataset.train
    say(f"{dataset.name}: {len(views)} views of {views.width} x {views.height}; compiling ...")
    with ProgressDisplay(settings.steps) as display:
        report = make_masks(
            dataset,
            settings,
            folder,
            box=box,
            downscale=factor,
            resume=arguments.resume,
            force=arguments.force,
            on_step=display.on_step,
        )
    print("\n".join(report.lines()))
    print(f"sheet: {folder / 'masks.png'}; splats: {folder / 'splats.ply'}")
    scene, options = str(arguments.scene), _masks_options(arguments)
    print(
        f"look at the sheet; if it is right, next: {shlex.join(['geosplat-jax', 'train', scene])}; "
        f"if not: {shlex.join(['geosplat-jax', 'masks', scene, *options])} --resume --box ..."
    )


def _masks_options(arguments: argparse.Namespace) -> list[str]:
    """Return the options that another call needs to continue with the same splats."""
    defaults = command_line().parse_args(["masks", str(arguments.scene)])
    options: list[str] = []
    for name in ("output", "steps", "splats", "downscale", "seed"):
        if getattr(arguments, name) != getattr(defaults, name):
            options += [f"--{name}", str(getattr(arguments, name))]
    return options


def _settings(arguments: argparse.Namespace) -> None:
    """List settings with their values under the chosen preset and quality."""
    # Paths are never wrapped, for --set and grep; without a terminal no line is.
    table = Table(box=None, pad_edge=False)
    for title in ("setting", "value", "range", "meaning"):
        table.add_column(title, overflow="fold", no_wrap=title == "setting")
    rows = [
        row for row in all_settings(config_from(arguments)) if row[0].startswith(arguments.prefix)
    ]
    if not rows:
        raise UsageError(f"no setting begins with {arguments.prefix!r}")
    for path, value, limits, meaning in rows:
        table.add_row(*map(Text, (path, as_written(value), limits, meaning)))
    screen = Console(highlight=False)
    if not screen.is_terminal:
        screen.width = _ONE_LINE
    screen.print(table)


def _check_samples(arguments: argparse.Namespace) -> None:
    """Refuse numbers of samples that are out of range."""
    if not 1 <= arguments.samples <= LARGEST_SAMPLES:
        raise UsageError(f"--samples must be from 1 to {LARGEST_SAMPLES}, got {arguments.samples}")


def _evaluate(arguments: argparse.Namespace) -> None:
    """Evaluate a run on its scene's test views and print the means."""
    _check_samples(arguments)
    run = Run(arguments.run, scene=arguments.scene)
    with WorkDisplay() as display:
        metrics = run.evaluate(
            protocol=arguments.protocol,
            samples=arguments.samples,
            relight_indirect=arguments.relight_indirect,
            stage=arguments.stage,
            on_progress=display,
        )
    print(f"protocol: {arguments.protocol}")
    for name, value in metrics["mean"].items():
        print(f"{name:36s} {value:9.4f}")
    for note in metrics["notes"]:
        print(f"note: {note}")
    folder = run.folder.path
    if arguments.stage is not None:
        folder = run.folder.end_of(arguments.stage)
    pictures = [name for name in SHEETS if (folder / name).exists()]
    print(f"metrics: {folder / 'metrics.json'}\npictures: {', '.join(pictures)} in {folder}")
    print(f"report: {folder / REPORT}")


def _report(arguments: argparse.Namespace) -> None:
    """Write the page of a run, or of several."""
    require_place(arguments.output, "--output")
    first, *others = (Run(folder) for folder in arguments.runs)
    if others and arguments.output is None:
        raise UsageError("a report of several runs needs --output FILE")
    print(f"report: {first.report(arguments.output, others=others)}")


def _write_json(path: Path, content: Any) -> None:
    """Write a JSON file atomically."""
    with written_aside(path) as temporary_path:
        temporary_path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _consistency(arguments: argparse.Namespace) -> None:
    """Print the figures of Table 5 for a run, or for splats that are put on a mesh."""
    subject, size = arguments.subject, arguments.size
    if size is not None and not 1 <= size <= LARGEST_SIZE:
        raise UsageError(f"--size must be from 1 to {LARGEST_SIZE} pixels, got {size}")
    require_place(arguments.json, "--json")
    if subject.is_dir():
        figures = Run(subject, scene=arguments.scene).consistency(stage=arguments.stage, size=size)
    else:
        figures = _consistency_of_mesh(arguments)
    print(f"angle between reflected directions        {figures.reflection_deg:9.3f} degrees")
    print(f"error of the distance / box diagonal      {figures.distance:9.5f}")
    print(f"pixels compared                           {figures.pixels:9d}")
    print(f"mesh pixels covered by less than half     {figures.uncovered:9.2%}")
    if figures.behind:
        print(f"mesh pixels seen from inside, left out    {figures.behind:9.2%}")
    if arguments.json is not None:
        _write_json(arguments.json, asdict(figures))


def _consistency_of_mesh(arguments: argparse.Namespace) -> Consistency:
    """Read a mesh, place splats on it, and compare both."""
    path = arguments.subject
    if not path.exists():
        raise UsageError(f"{path} is neither the folder of a run nor a mesh file")
    if arguments.stage is not None:
        raise UsageError(f"--stage needs the folder of a run, and {path} is a file")
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
        if not all(0 <= value <= _LARGEST_FACTOR for value in values):
            raise UsageError(f"--{name} must be from 0 to {_LARGEST_FACTOR:g}, got {values}")
    _check_samples(arguments)
    cameras = _cameras_from(arguments)
    with WorkDisplay() as display:
        paths = Run(arguments.run, scene=arguments.scene).relight(
            arguments.env,
            arguments.output,
            options=RelightOptions(
                turntable=arguments.turntable,
                rotate_env=arguments.rotate_env,
                background=arguments.background,
                suffix=f".{arguments.movie}" if arguments.movie else None,
                frames_per_second=arguments.fps,
            ),
            cameras=cameras,
            images=_images_from(arguments),
            intensity=arguments.intensity,
            albedo_scale=arguments.albedo_scale,
            samples=arguments.samples,
            indirect=arguments.indirect,
            on_progress=display,
        )
    print(f"{len(paths)} files: {paths[0].parent}")


def _cameras_from(arguments: argparse.Namespace, turntable: int = 0) -> Cameras:
    """Return the cameras that the arguments ask for."""
    cameras = Cameras(
        views=arguments.views,
        file=arguments.cameras,
        turntable=turntable,
        size=arguments.size,
        field_of_view=arguments.field_of_view,
    )
    cameras.check()
    return cameras


def _images_from(arguments: argparse.Namespace) -> Images:
    return Images(aovs=tuple(dict.fromkeys(arguments.aovs)), exr=arguments.exr)


def _render(arguments: argparse.Namespace) -> None:
    """Render views of a split, or from other cameras."""
    _check_samples(arguments)
    cameras, images = _cameras_from(arguments, arguments.turntable), _images_from(arguments)
    with WorkDisplay() as display:
        paths = Run(arguments.run, scene=arguments.scene).render(
            output=arguments.output,
            cameras=cameras,
            images=images,
            samples=arguments.samples,
            on_progress=display,
        )
    count = sum(path.name.endswith("_rgba.png") for path in paths)
    print(f"{count} views, {len(paths)} files: {paths[0].parent}")


def _view(arguments: argparse.Namespace) -> None:
    """Show a run in a browser until Ctrl-C."""
    viser_library()
    require_free_port(arguments.port)
    run = Run(arguments.run, scene=arguments.scene)
    scene_lights, views = {}, None
    try:
        scene_lights, views = run.dataset.lights, run.dataset.train
    except (RunError, SceneError) as error:
        say(f"without photographs: {error}", label="warning: ", style="yellow")
    lights = load_lights(light_files(arguments.env), scene_lights)
    viewer = Viewer(CheckpointWatch(run.folder), lights)
    server = ViewerServer(viewer, views, port=arguments.port)
    print(f"open {server.url} in a browser; Ctrl-C ends", flush=True)
    say("the first pictures of every size wait for a compilation, once on this machine")
    server.serve()


def _refine_cameras(arguments: argparse.Namespace) -> None:
    """Refine the cameras of a run and print what changed."""
    require_place(arguments.output, "--output")
    run = Run(arguments.run, scene=arguments.scene)
    settings = CameraSettings(white_balance=arguments.white_balance)
    refined_splits = run.refine_cameras(arguments.output, how=settings, on_view=say_refined)
    for split, cameras in refined_splits.items():
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
    if arguments.faces is not None and arguments.faces < 4:
        raise UsageError(f"--faces must be at least 4, got {arguments.faces}")
    if (arguments.obj or arguments.usd or arguments.faces) and arguments.vertex_colors:
        raise UsageError("--obj, --usd and --faces need textures; leave --vertex-colors out")
    with WorkDisplay() as display:
        lines = Run(arguments.run, scene=arguments.scene).export(
            arguments.output,
            vertex_colors=arguments.vertex_colors,
            texture_size=arguments.texture_size,
            obj=arguments.obj,
            usd=arguments.usd,
            face_count=arguments.faces,
            on_progress=display,
        )
    for name, text in lines.items():
        print(f"{name}: {text}")


def _gradcheck(arguments: argparse.Namespace) -> None:
    """Compare gradients with float64 differences and print the tables."""
    names = list(dict.fromkeys(arguments.parts)) or list(PARTS)
    unknown_names = [name for name in names if name not in PARTS]
    if unknown_names:
        raise UsageError(f"unknown part {unknown_names[0]!r}; expected some of {', '.join(PARTS)}")
    require_place(arguments.json, "--json")
    results = {}
    for name in names:
        results[name] = check_part(name, seed=arguments.seed)
        print(f"{table(results[name], sweep=arguments.sweep)}\n", flush=True)
    print(summary(results))
    if arguments.json is not None:
        _write_json(arguments.json, to_records(results))
    failures = [row for rows in results.values() for row in rows if not passes(row)]
    if failures:
        raise GradientError(
            f"{len(failures)} comparisons exceed {TOLERANCE:g} (float64) or {SINGLE_TOLERANCE:g} "
            f"(float32); the first: {failures[0].problem}, {failures[0].worst}"
        )


COMMANDS = {
    "info": _info,
    "poses": _poses,
    "masks": _masks,
    "train": train,
    "settings": _settings,
    "evaluate": _evaluate,
    "report": _report,
    "consistency": _consistency,
    "render": _render,
    "view": _view,
    "refine-cameras": _refine_cameras,
    "relight": _relight,
    "export": _export,
    "gradcheck": _gradcheck,
}
