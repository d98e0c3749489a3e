"""What each command does: a thin layer over `run.train` and `run.Run`."""

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from geosplat_jax.cli.display import ProgressDisplay, WorkDisplay, say
from geosplat_jax.fit.cameras import ViewProgress
from geosplat_jax.fit.config import Config, all_settings, config_warnings
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.gauge import change_lines
from geosplat_jax.fit.presets import make_config
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
from geosplat_jax.io.dataset import choose_downscale, describe, load_recorded
from geosplat_jax.io.export import LARGEST_TEXTURE
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
from geosplat_jax.report.shots import Cameras, Images
from geosplat_jax.run import Run
from geosplat_jax.run import train as train_run

_SHEETS = ("overview.png", "materials.png", "relight.png")


class GradientError(RuntimeError):
    """A gradient disagrees with differences; the message says where."""


class UsageError(ValueError):
    """A command cannot run as it was called; the message says what to change."""


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
    say(chosen.reason)
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
    with WorkDisplay() as display:
        report = find_poses(arguments.folder, settings, force=arguments.force, on_progress=display)
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


@contextmanager
def _table(path: Path | None, folder: Path) -> Iterator[None]:
    """Write the steps of a run as a table when the training ends, however that is."""
    try:
        yield
    finally:
        steps = RunFolder(folder)
        if path is not None and steps.exists:
            steps.write_csv(path)


def _train(arguments: argparse.Namespace) -> None:
    """Train a scene into a run's folder, with progress on the terminal."""
    if (arguments.source is None) != (arguments.stage is None):
        raise UsageError("--from RUN and --stage NAME belong together")
    config = _config_from(arguments)
    folder = arguments.output or Path("runs") / arguments.scene.resolve().name
    dataset = load_recorded(arguments.scene, _scene_options(arguments, config))
    for note in dataset.notes:
        say(note)
    for warning in (*dataset.warnings, *config_warnings(config)):
        say(warning, label="warning: ", style="yellow")
    say(f"{dataset.name}: {len(dataset.train)} views, {dataset.layout} ...")
    with ProgressDisplay(config.total_steps) as display, _table(arguments.csv, folder):
        run = train_run(
            dataset,
            folder,
            config,
            resume=arguments.resume,
            force=arguments.force,
            source=arguments.source,
            first_stage=arguments.stage,
            on_step=display.show,
            on_compile=display.compiling,
        )
    seconds = (run.folder.training() or {})["seconds_total"]
    say(f"trained in {seconds:.0f} s; next: geosplat-jax evaluate {folder}")


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
    pictures = [name for name in _SHEETS if (folder / name).exists()]
    print(f"metrics: {folder / 'metrics.json'}\npictures: {', '.join(pictures)} in {folder}")
    print(f"report: {folder / REPORT}")


def _report(arguments: argparse.Namespace) -> None:
    """Write the page of a run, or of several."""
    first, *others = (Run(folder) for folder in arguments.runs)
    if others and arguments.output is None:
        raise UsageError("a report of several runs needs --output FILE")
    print(f"report: {first.report(arguments.output, others=others)}")


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
    cameras = _cameras_from(arguments)
    with WorkDisplay() as display:
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
            cameras=cameras,
            images=_images_from(arguments),
            intensity=arguments.intensity,
            albedo_scale=arguments.albedo_scale,
            samples=arguments.samples,
            indirect=arguments.indirect,
            on_progress=display,
        )
    print(f"{len(written)} files: {written[0].parent}")


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
        written = Run(arguments.run, scene=arguments.scene).render(
            output=arguments.output,
            cameras=cameras,
            images=images,
            samples=arguments.samples,
            on_progress=display,
        )
    count = sum(path.name.endswith("_rgba.png") for path in written)
    print(f"{count} views, {len(written)} files: {written[0].parent}")


def _refine_cameras(arguments: argparse.Namespace) -> None:
    """Refine the cameras of a run and print what changed."""
    run = Run(arguments.run, scene=arguments.scene)

    def tell(split: str, progress: ViewProgress) -> None:
        camera = progress.camera
        say(
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
    if arguments.faces is not None and arguments.faces < 4:
        raise UsageError(f"--faces must be at least 4, got {arguments.faces}")
    if (arguments.obj or arguments.faces) and arguments.vertex_colors:
        raise UsageError("--obj and --faces need textures; leave --vertex-colors out")
    with WorkDisplay() as display:
        lines = Run(arguments.run, scene=arguments.scene).export(
            arguments.output,
            vertex_colors=arguments.vertex_colors,
            texture_size=arguments.texture_size,
            obj=arguments.obj,
            face_count=arguments.faces,
            on_progress=display,
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


COMMANDS = {
    "info": _info,
    "poses": _poses,
    "train": _train,
    "settings": _settings,
    "evaluate": _evaluate,
    "report": _report,
    "consistency": _consistency,
    "render": _render,
    "refine-cameras": _refine_cameras,
    "relight": _relight,
    "export": _export,
    "gradcheck": _gradcheck,
}
