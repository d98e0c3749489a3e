"""The ``geosplat-jax`` command: info, train, evaluate, render, export, gradcheck."""

import argparse
import importlib.metadata
import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from geosplat_jax.config import PRESETS, QUALITIES, Config, make_config
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
from geosplat_jax.io.dataset import Dataset, describe, load_dataset
from geosplat_jax.io.images import SceneError, write_png
from geosplat_jax.process import enable_compilation_cache, retain_freed_memory

_console = Console(stderr=True, highlight=False)


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
    train.add_argument("--resume", action="store_true", help="continue from the last checkpoint")

    evaluate = commands.add_parser("evaluate", help="figures and overview.png of a run")
    evaluate.add_argument("run", type=Path)

    render = commands.add_parser("render", help="render a run's test or training views")
    render.add_argument("run", type=Path)
    render.add_argument("--views", choices=("test", "train"), default="test")
    render.add_argument("--output", type=Path, help="folder (default: RUN/renders)")

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


def _load(scene: str | Path, options: dict[str, Any]) -> Dataset:
    """Load a dataset from recorded options."""
    bounds = options.get("bounds")
    return load_dataset(
        Path(scene),
        downscale=options.get("downscale", 1),
        light=options.get("light"),
        bounds=None if bounds is None else (tuple(bounds[:3]), tuple(bounds[3:])),
    )


def _info(arguments: argparse.Namespace) -> None:
    """Print what was recognised."""
    print(describe(_load(arguments.scene, _scene_options(arguments))))


def _check_folder(folder: Path, record: dict[str, Any], *, resume: bool) -> None:
    """Refuse a folder that holds something else, or a run of another scene."""
    path = folder / "run.json"
    if not resume:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(
                f"{folder} exists already; choose another --output, or --resume to continue it"
            )
        return
    before = _recorded(folder)
    for name in ("scene", "dataset"):
        if before[name] != record[name]:
            raise UsageError(
                f"{path} says that the run was trained with {name} {before[name]}, not "
                f"{record[name]}; resume with the same, or choose another --output"
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
) -> None:
    """Train a scene into a run folder, with progress on the terminal.

    Raises
    ------
    SceneError, UsageError, TrainingError, Interrupted
        See the functions that raise them.
    """
    from geosplat_jax.train import fit

    record = {"scene": str(scene.resolve()), "dataset": options, "config": config.to_dict()}
    _check_folder(folder, record, resume=resume)
    began = time.perf_counter()
    dataset = _load(scene, options)
    if not resume:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "run.json").write_text(json.dumps(record, indent=2) + "\n")
    for warning in dataset.warnings:
        _console.print(f"[yellow]warning:[/] {warning}")
    _console.print(
        f"{dataset.name}: {len(dataset.train.names)} views, {dataset.layout}; compiling ..."
    )
    preview = _Preview(dataset, config, folder / "previews")
    with _progress_display(config.run.steps) as show:
        fit(dataset, config, folder, resume=resume, on_step=show, on_preview=preview)
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
                f"step {progress.step}/{progress.steps}  loss {progress.total:.4f}  "
                f"{progress.psnr:.2f} dB  {progress.gaussian_count:,} Gaussians  "
                f"{progress.seconds:.0f} s, {progress.seconds_left:.0f} s left"
            )


class _Preview:
    """Write truth, render and normals of one view side by side while training."""

    def __init__(self, dataset: Dataset, config: Config, folder: Path) -> None:
        self._views = dataset.test if dataset.test.names else dataset.train
        self._config = config
        self._folder = folder

    def __call__(self, params, context, capacities, step: int) -> None:
        """Render and write one preview."""
        from geosplat_jax.evaluate import preview_image

        self._folder.mkdir(exist_ok=True)
        image = preview_image(self._config, params, context, capacities, self._views)
        write_png(self._folder / f"step_{step:06d}.png", image)


def _recorded(run: Path) -> dict[str, Any]:
    """Read what a run folder says about itself."""
    path = run / "run.json"
    if not path.exists():
        raise UsageError(f"{run} is not a run (it has no run.json)")
    return json.loads(path.read_text())


def evaluate_command(run: Path) -> dict[str, Any]:
    """Evaluate a run on its scene's test views and print the means."""
    from geosplat_jax.evaluate import evaluate_run
    from geosplat_jax.train import load_run

    record = _recorded(run)
    dataset = _load(record["scene"], record["dataset"])
    if not dataset.test.names:
        raise UsageError(f"{record['scene']} has no test views to evaluate on")
    config, params, context, capacities, meta = load_run(run)
    training = run / "training.json"
    extra = {
        "scene": record["scene"],
        "dataset": record["dataset"],
        "step": meta["step"],
        "training": json.loads(training.read_text()) if training.exists() else None,
        "training_peak_memory_mb": _peak_memory(run),
    }
    figures = evaluate_run(config, params, context, capacities, dataset.test, run, meta=extra)
    for name, value in figures["mean"].items():
        print(f"{name:24s} {value:8.4f}")
    print(f"figures: {run / 'metrics.json'}\npictures: {run / 'overview.png'}")
    return figures


def _peak_memory(run: Path) -> int | None:
    """Largest resident memory that training noted, in MB."""
    path = run / "metrics.jsonl"
    if not path.exists():
        return None
    lines = path.read_text().splitlines()
    return max((json.loads(line)["peak_memory_mb"] for line in lines), default=None)


def render_command(run: Path, views: str, output: Path | None) -> None:
    """Render every view of a split into ``rgb_*.png`` with straight alpha, and its normals."""
    import numpy as np

    from geosplat_jax.evaluate import Renderer, straight_rgba
    from geosplat_jax.io.sheets import normals_to_rgb
    from geosplat_jax.train import load_run

    record = _recorded(run)
    dataset = _load(record["scene"], record["dataset"])
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
    from geosplat_jax.assets import export_assets
    from geosplat_jax.train import load_run

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
        )
    elif arguments.command == "evaluate":
        evaluate_command(arguments.run)
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
    from geosplat_jax.io.checkpoints import CheckpointError
    from geosplat_jax.train import Interrupted, TrainingError

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
