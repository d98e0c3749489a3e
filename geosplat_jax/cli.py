"""The ``geosplat-jax`` command: info, train, evaluate, render, relight, export, gradcheck."""

import argparse
import importlib.metadata
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from geosplat_jax.fit.config import PRESETS, QUALITIES, Config, doubts, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
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
from geosplat_jax.io.dataset import Dataset, describe, load_recorded
from geosplat_jax.io.images import SceneError, write_png
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.relight import BACKGROUNDS, RelightOptions
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, RELIGHT_KINDS

_console = Console(stderr=True, highlight=False)


_SHEETS = ("overview.png", "materials.png", "relight.png")


class GradientError(RuntimeError):
    """A gradient disagrees with differences; the message says where."""


class UsageError(ValueError):
    """A command cannot run as it was called; the message says what to change."""


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

    train = commands.add_parser("train", help="reconstruct a scene")
    _add_scene_arguments(train)
    train.add_argument("--output", type=Path, help="run folder (default: runs/SCENE)")
    train.add_argument("--preset", choices=PRESETS, default="default")
    train.add_argument("--quality", choices=QUALITIES, default="standard")
    train.add_argument(
        "--kind",
        default="hybrid",
        help="guess about the material: outdoor, diffuse, hybrid, specular or glossy",
    )
    train.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="SECTION.FIELD=VALUE"
    )
    train.add_argument("--seed", type=int, help="seed of every random choice")
    start = train.add_mutually_exclusive_group()
    start.add_argument("--resume", action="store_true", help="continue from the last checkpoint")
    start.add_argument(
        "--stage-1", type=Path, metavar="RUN", help="take over stage 1 of another run of the scene"
    )

    evaluate = commands.add_parser("evaluate", help="figures and overview.png of a run")
    evaluate.add_argument("run", type=Path)
    evaluate.add_argument("--protocol", choices=PROTOCOLS, default=PROTOCOLS[0])
    evaluate.add_argument(
        "--samples", type=int, default=DEFAULT_SAMPLES, help="rays a splat (default: %(default)s)"
    )
    evaluate.add_argument(
        "--relight-indirect",
        choices=RELIGHT_KINDS,
        default="traced",
        help="light from blocked directions under new lights (default: %(default)s)",
    )

    render = commands.add_parser("render", help="render a run's test or training views")
    render.add_argument("run", type=Path)
    render.add_argument("--views", choices=("test", "train"), default="test")
    render.add_argument("--output", type=Path, help="folder (default: RUN/renders)")

    _add_relight(commands.add_parser("relight", help="show a run under another light"))

    export = commands.add_parser("export", help="mesh.glb, gaussians.ply and light.exr of a run")
    export.add_argument("run", type=Path)
    export.add_argument("--output", type=Path, help="folder (default: RUN/export)")
    export.add_argument("--vertex-colors", action="store_true", help="instead of textures")
    export.add_argument("--texture-size", type=int, default=1024)

    gradcheck = commands.add_parser(
        "gradcheck", help="prove the gradients: float64 differences of every stage"
    )
    gradcheck.add_argument(
        "stages", nargs="*", metavar="STAGE", help=f"some of {', '.join(STAGES)} (default: all)"
    )
    gradcheck.add_argument("--sweep", action="store_true", help="show the error at every step size")
    gradcheck.add_argument("--seed", type=int, default=0, help="of numbers, samples, directions")
    gradcheck.add_argument("--json", type=Path, help="also write every comparison to this file")
    return parser


def _add_relight(relight: argparse.ArgumentParser) -> None:
    """Describe the relight command."""
    relight.add_argument("run", type=Path)
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
    relight.add_argument(
        "--samples", type=int, default=DEFAULT_SAMPLES, help="rays a splat (default: %(default)s)"
    )
    relight.add_argument("--indirect", choices=RELIGHT_KINDS, default="traced")


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what tells how to read a scene."""
    parser.add_argument("scene", type=Path, help="scene folder")
    parser.add_argument("--downscale", type=int, default=1, help="reduce the images by this factor")
    parser.add_argument("--light", help="training light, where a scene has several")
    parser.add_argument(
        "--bounds",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box around the object (default: from masks and cameras)",
    )


def _scene_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what `load_dataset` needs, in a form that JSON keeps."""
    return {
        "downscale": arguments.downscale,
        "light": arguments.light,
        "bounds": arguments.bounds,
    }


def _info(arguments: argparse.Namespace) -> None:
    """Print what was recognised."""
    print(describe(load_recorded(arguments.scene, _scene_options(arguments))))


def _check_folder(folder: Path, record: dict[str, Any], *, resume: bool) -> None:
    """Refuse a folder that holds something else, or a run of another scene."""
    if not resume:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(
                f"{folder} exists already; choose another --output, or --resume to continue it"
            )
        return
    _check_same_scene(folder, record)


def _check_same_scene(folder: Path, record: dict[str, Any]) -> None:
    """Refuse a run of another scene, or of the same read in another way."""
    before = _recorded(folder)
    for name in ("scene", "dataset"):
        if before[name] != record[name]:
            raise UsageError(
                f"{folder / 'run.json'} says that the run was trained with {name} {before[name]}, "
                f"not {record[name]}; take the same, or another folder"
            )


def _config_from(arguments: argparse.Namespace) -> Config:
    """Return the configuration that the arguments ask for."""
    overrides = list(arguments.overrides)
    if arguments.seed is not None:
        overrides.append(f"run.seed={arguments.seed}")
    return make_config(
        arguments.preset, arguments.quality, kind=arguments.kind, overrides=tuple(overrides)
    )


def train_command(
    scene: Path,
    folder: Path,
    config: Config,
    options: dict[str, Any],
    *,
    resume: bool = False,
    stage_1: Path | None = None,
) -> None:
    """Train a scene into a run folder, with progress on the terminal.

    Raises
    ------
    SceneError, UsageError, TrainingError, Interrupted
        See the functions that raise them.
    """
    from geosplat_jax.fit.train import TrainingError, fit

    record = {"scene": str(scene.resolve()), "dataset": options, "config": config.to_dict()}
    _check_folder(folder, record, resume=resume)
    began = time.perf_counter()
    dataset = load_recorded(scene, options)
    if stage_1 is not None:
        _check_same_scene(stage_1, record)
    if not resume:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "run.json").write_text(json.dumps(record, indent=2) + "\n")
    for warning in (*dataset.warnings, *doubts(config)):
        _console.print(f"[yellow]warning:[/] {warning}")
    _console.print(
        f"{dataset.name}: {len(dataset.train.names)} views, {dataset.layout}; compiling ..."
    )
    preview = _Preview(dataset, folder / "previews")
    try:
        with _progress_display(config.total_steps) as show:
            fit(
                dataset,
                config,
                folder,
                resume=resume,
                stage_1=stage_1,
                on_step=show,
                on_preview=preview,
            )
    except TrainingError:
        if not resume and not (folder / "metrics.jsonl").exists():
            (folder / "run.json").unlink()  # nothing was begun: the folder is free again
        raise
    seconds = time.perf_counter() - began
    summary = {"seconds_total": round(seconds, 2)}
    (folder / "training.json").write_text(json.dumps(summary, indent=2) + "\n")
    _console.print(f"trained in {seconds:.0f} s; next: geosplat-jax evaluate {folder}")


class _progress_display:
    """A bar on a terminal, a line every fiftieth step elsewhere."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._bar = None
        if _console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.completed:.0f}/{task.total:.0f}"),
                BarColumn(),
                TextColumn("loss {task.fields[loss]:.4f}"),
                TextColumn("{task.fields[psnr]:.2f} dB"),
                TextColumn("{task.fields[gaussians]:,} Gaussians"),
                TimeRemainingColumn(),
                console=_console,
            )

    def __enter__(self):
        """Start the bar."""
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(
                "", total=self._steps, loss=float("nan"), psnr=0.0, gaussians=0
            )
        return self.show

    def __exit__(self, *unused: object) -> None:
        """Stop the bar."""
        if self._bar is not None:
            self._bar.stop()

    def show(self, progress) -> None:
        """Display one step."""
        if self._bar is not None:
            self._bar.update(
                self._task,
                completed=progress.step,
                loss=progress.total,
                psnr=progress.psnr,
                gaussians=progress.gaussian_count,
            )
        elif progress.step % 50 == 0 or progress.step in (1, progress.steps):
            _console.print(
                f"stage {progress.stage}, step {progress.step}/{progress.steps}  "
                f"loss {progress.total:.4f}  "
                f"{progress.psnr:.2f} dB  {progress.gaussian_count:,} Gaussians  "
                f"{progress.seconds:.0f} s, {progress.seconds_left:.0f} s left",
                soft_wrap=True,
            )


class _Preview:
    """Write truth, render and normals of one view side by side while training."""

    def __init__(self, dataset: Dataset, folder: Path) -> None:
        self._views = dataset.test if dataset.test.names else dataset.train
        self._folder = folder

    def __call__(self, config, params, context, capacities, step: int) -> None:
        """Render and write one preview."""
        from geosplat_jax.report.evaluate import preview_image

        self._folder.mkdir(exist_ok=True)
        image = preview_image(config, params, context, capacities, self._views)
        write_png(self._folder / f"step_{step:06d}.png", image)


def _recorded(run: Path) -> dict[str, Any]:
    """Read what a run folder says about itself."""
    path = run / "run.json"
    if not path.exists():
        raise UsageError(f"{run} is not a run (it has no run.json)")
    return json.loads(path.read_text())


def evaluate_command(
    run: Path,
    *,
    protocol: str = PROTOCOLS[0],
    samples: int = DEFAULT_SAMPLES,
    relight_indirect: str = "traced",
) -> dict[str, Any]:
    """Evaluate a run on its scene's test views and print the means."""
    from geosplat_jax.fit.train import load_run
    from geosplat_jax.report.evaluate import evaluate_run
    from geosplat_jax.report.relight import load_light

    record = _recorded(run)
    dataset = load_recorded(record["scene"], record["dataset"])
    if not dataset.test.names:
        raise UsageError(f"{record['scene']} has no test views to evaluate on")
    config, params, context, capacities, meta = load_run(run)
    training = run / "training.json"
    extra = {
        "scene": record["scene"],
        "dataset": record["dataset"],
        "step": meta["step"],
        "stage": meta["stage"],
        "training": json.loads(training.read_text()) if training.exists() else None,
        "training_peak_memory_mb": _peak_memory(run),
    }
    lights = {name: load_light(path) for name, path in dataset.lights.items()}
    figures = evaluate_run(
        config,
        params,
        context,
        capacities,
        dataset.test,
        run,
        meta=extra,
        protocol=protocol,
        lights=lights,
        train_light=lights.get(dataset.train_light or ""),
        samples=samples,
        relight_indirect=relight_indirect,
    )
    print(f"protocol: {protocol}")
    for name, value in figures["mean"].items():
        print(f"{name:36s} {value:9.4f}")
    for note in figures["notes"]:
        print(f"note: {note}")
    pictures = [name for name in _SHEETS if (run / name).exists()]
    print(f"figures: {run / 'metrics.json'}\npictures: {', '.join(pictures)} in {run}")
    return figures


def relight_command(
    run: Path,
    env: Path,
    output: Path | None = None,
    *,
    options: RelightOptions | None = None,
    intensity: float = 1.0,
    albedo_scale: Sequence[float] = (1.0, 1.0, 1.0),
    samples: int = DEFAULT_SAMPLES,
    indirect: str = "traced",
) -> list[Path]:
    """Render the test views, and movies, of a run under another light; return the files."""
    from geosplat_jax.core.types import EnvLight
    from geosplat_jax.fit.train import load_run
    from geosplat_jax.report.relight import load_light, relight_views
    from geosplat_jax.report.renderer import Renderer

    record = _recorded(run)
    options = options or RelightOptions()
    options.check()
    light = EnvLight(intensity * load_light(env).radiance)
    dataset = load_recorded(record["scene"], record["dataset"])
    views = dataset.test if dataset.test.names else dataset.train
    config, params, context, capacities, _ = load_run(run)
    renderer = Renderer(config, params, context, capacities, samples=samples)
    relit = renderer.relit(light, albedo_scale=albedo_scale, indirect=indirect)
    folder = output or run / f"relight_{env.stem}"
    folder.mkdir(parents=True, exist_ok=True)
    written = relight_views(relit, light, views, folder, options)
    print(f"{len(written)} files: {folder}")
    return written


def _relight(arguments: argparse.Namespace) -> None:
    """Run the relight command from its arguments."""
    factors = {"intensity": [arguments.intensity], "albedo-scale": arguments.albedo_scale}
    for name, values in factors.items():
        if not all(0 <= value < float("inf") for value in values):
            raise UsageError(f"--{name} must be finite and not negative, got {values}")
    for name in ("turntable", "rotate_env"):
        if getattr(arguments, name) < 0:
            raise UsageError(f"--{name.replace('_', '-')} must not be negative")
    relight_command(
        arguments.run,
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


def _peak_memory(run: Path) -> int | None:
    """Largest resident memory that training noted, in MB."""
    path = run / "metrics.jsonl"
    if not path.exists():
        return None
    lines = path.read_text().splitlines()
    return max((json.loads(line)["peak_memory_mb"] for line in lines), default=None)


def render_command(run: Path, views: str, output: Path | None) -> None:
    """Render views of a split: ``NAME_rgba.png`` with straight alpha, and ``NAME_normal.png``."""
    import numpy as np

    from geosplat_jax.fit.train import load_run
    from geosplat_jax.report.pictures import normals_to_rgb
    from geosplat_jax.report.renderer import Renderer, straight_rgba

    record = _recorded(run)
    dataset = load_recorded(record["scene"], record["dataset"])
    chosen = dataset.test if views == "test" else dataset.train
    config, params, context, capacities, _ = load_run(run)
    renderer = Renderer(config, params, context, capacities)
    folder = output or run / "renders"
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(chosen.names):
        view = renderer(chosen.camera(np.array([index])))
        stem = name.replace("/", "_").strip("._")
        write_png(folder / f"{stem}_rgba.png", straight_rgba(view))
        write_png(folder / f"{stem}_normal.png", normals_to_rgb(view.aovs["normal"], view.alpha))
    print(f"{len(chosen.names)} views: {folder}")


def export_command(
    run: Path, output: Path | None, *, vertex_colors: bool, texture_size: int
) -> dict[str, Any]:
    """Export the reconstructed asset: ``mesh.glb``, ``gaussians.ply``, ``light.exr``."""
    from geosplat_jax.fit.train import load_run
    from geosplat_jax.report.assets import export_assets

    _recorded(run)
    config, params, context, capacities, _ = load_run(run)
    folder = output or run / "export"
    folder.mkdir(parents=True, exist_ok=True)
    info = export_assets(
        config,
        params,
        context,
        capacities,
        folder,
        vertex_colors=vertex_colors,
        texture_size=texture_size,
    )
    for name, text in info.items():
        print(f"{name}: {text}")
    return info


def gradcheck_command(
    stages: list[str], *, sweep: bool, seed: int, output: Path | None
) -> dict[str, Any]:
    """Compare the stages' gradients with float64 differences and print the tables.

    Raises
    ------
    GradientError
        If a comparison exceeds its tolerance.
    """
    names = list(dict.fromkeys(stages)) or list(STAGES)
    unknown = [name for name in names if name not in STAGES]
    if unknown:
        raise UsageError(f"unknown stage {unknown[0]!r}; expected some of {', '.join(STAGES)}")
    checked = {}
    for name in names:
        checked[name] = check_stage(name, seed=seed)
        print(f"{table(checked[name], sweep=sweep)}\n", flush=True)
    print(summary(checked))
    if output is not None:
        output.write_text(json.dumps(to_records(checked), indent=1), encoding="utf-8")
    failed = [row for rows in checked.values() for row in rows if not passes(row)]
    if failed:
        raise GradientError(
            f"{len(failed)} comparisons exceed {TOLERANCE:g} (float64) or {SINGLE_TOLERANCE:g} "
            f"(float32); the first: {failed[0].problem}, {failed[0].worst}"
        )
    return {name: len(rows) for name, rows in checked.items()}


def _run(arguments: argparse.Namespace) -> None:
    """Dispatch a command."""
    if arguments.command == "info":
        _info(arguments)
    elif arguments.command == "train":
        train_command(
            arguments.scene,
            arguments.output or Path("runs") / arguments.scene.resolve().name,
            _config_from(arguments),
            _scene_options(arguments),
            resume=arguments.resume,
            stage_1=arguments.stage_1,
        )
    elif arguments.command == "evaluate":
        evaluate_command(
            arguments.run,
            protocol=arguments.protocol,
            samples=arguments.samples,
            relight_indirect=arguments.relight_indirect,
        )
    elif arguments.command == "relight":
        _relight(arguments)
    elif arguments.command == "render":
        render_command(arguments.run, arguments.views, arguments.output)
    elif arguments.command == "gradcheck":
        gradcheck_command(
            arguments.stages,
            sweep=arguments.sweep,
            seed=arguments.seed,
            output=arguments.json,
        )
    else:
        export_command(
            arguments.run,
            arguments.output,
            vertex_colors=arguments.vertex_colors,
            texture_size=arguments.texture_size,
        )


def main(argv: list[str] | None = None) -> int:
    """Run the command line; errors that a user can cure print one line and return 2."""
    arguments = _parser().parse_args(argv)
    enable_compilation_cache()
    retain_freed_memory()
    from geosplat_jax.fit.train import Interrupted, TrainingError
    from geosplat_jax.io.checkpoints import CheckpointError

    try:
        _run(arguments)
    except Interrupted as stop:
        _console.print(str(stop))
        return 130
    except GradientError as error:
        _console.print(str(error), markup=False, soft_wrap=True)
        return 1
    except (SceneError, UsageError, TrainingError, CheckpointError, OSError, ValueError) as error:
        _console.print("[bold red]error:[/]", end=" ")
        _console.print(str(error), markup=False, soft_wrap=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
