"""Options of the commands: one function for each command or group of options."""

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.fit.budget import parse_duration, parse_memory
from geosplat_jax.fit.presets import PRESET_PRIORS, PRESETS, QUALITIES
from geosplat_jax.fit.runtime import installed_versions
from geosplat_jax.gradcheck.report import PARTS
from geosplat_jax.io.poses import PoseSettings
from geosplat_jax.materials import MATERIAL_PRIORS
from geosplat_jax.report.consistency import DEFAULT_VIEWS
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.relight import BACKGROUNDS
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, RELIGHT_KINDS
from geosplat_jax.report.shots import AOVS, SPLITS
from geosplat_jax.viewer.server import DEFAULT_PORT

EXAMPLES = {
    "info": "info examples/duck",
    "poses": "poses cup --size 1600",
    "masks": "masks cup --resume --box -0.4 -0.4 -0.1 0.4 0.4 0.5",
    "train": "train examples/duck --quality draft --output runs/duck",
    "settings": "settings stages.monte_carlo --quality high",
    "evaluate": "evaluate runs/duck --samples 64",
    "report": "report runs/a runs/b --output both.html",
    "consistency": "consistency runs/duck --size 400",
    "render": "render runs/duck --turntable 60 --size 800 --aovs depth --exr",
    "view": "view runs/duck --env examples",
    "relight": "relight runs/duck --env examples/sunset.hdr --turntable 48",
    "refine-cameras": "refine-cameras runs/duck --output cameras.json",
    "export": "export runs/duck --faces 4000 --obj",
    "gradcheck": "gradcheck bsdf --sweep",
}
"""An example of every command, shown at the end of its help."""


_NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$", re.IGNORECASE)


def command_line() -> argparse.ArgumentParser:
    """Describe the command line."""
    parser = argparse.ArgumentParser(
        prog="geosplat-jax",
        description="Photographs in; mesh, PBR materials and light out.",
        epilog="`geosplat-jax COMMAND --help` says what a command takes, and ends with an example.",
    )
    parser.add_argument("--version", action="version", version=installed_versions()["geosplat_jax"])
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    info = _command(commands, "info", "say what was recognised in a scene folder")
    _add_scene_arguments(info)

    _add_poses(_command(commands, "poses", "find the cameras of a folder of photographs"))

    _add_masks(_command(commands, "masks", "cut the object out of photographs with cameras"))
    _add_train(_command(commands, "train", "reconstruct a scene"))
    _add_settings(_command(commands, "settings", "list every setting: default, range, meaning"))
    _add_evaluate(_run_parser(commands, "evaluate", "compare a run with its scene's test views"))
    _add_report(_command(commands, "report", "write report.html of one run, or of several"))
    _add_consistency(
        _command(
            commands, "consistency", "measure how well splats match the mesh that they are put on"
        )
    )
    _add_render(_run_parser(commands, "render", "render a run from its views or any cameras"))
    _add_relight(_run_parser(commands, "relight", "show a run under another light"))
    _add_view(_run_parser(commands, "view", "look at a run in a browser, also while it trains"))
    _add_refine_cameras(
        _run_parser(
            commands, "refine-cameras", "refine pose, focal length and exposure of every view"
        )
    )
    _add_export(_run_parser(commands, "export", "write mesh.glb, gaussians.ply and light.exr"))
    _add_gradcheck(
        _command(commands, "gradcheck", "compare all gradients with float64 finite differences")
    )
    return parser


def _command(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    """Add a command; its help ends with an example."""
    parser = commands.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}.",
        epilog=f"example:\n  geosplat-jax {EXAMPLES[name]}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    # By itself argparse takes -1e-5 for an option; commands and reports print such numbers.
    parser._negative_number_matcher = _NEGATIVE_NUMBER
    return parser


def _add_white_balance(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--white-balance",
        action="store_true",
        help="together with the cameras, refine a white balance (red, green, blue) of every view",
    )


def _run_parser(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    """Add a command that works on a run."""
    parser = _command(commands, name, text)
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("--scene", type=Path, help="where the run's scene is now, if it has moved")
    return parser


def _add_train(train: argparse.ArgumentParser) -> None:
    """Describe the train command."""
    _add_scene_arguments(train)
    train.add_argument("--output", type=Path, help="run folder (default: runs/SCENE)")
    _add_config_arguments(train)
    train.add_argument(
        "--budget",
        type=_measured(parse_duration),
        metavar="TIME",
        help="time limit, such as 90s, 5min or 2h: choose settings that this machine can finish in "
        "that time, and adapt the steps so as to end in time (instead of --quality and --preset)",
    )
    train.add_argument(
        "--memory",
        type=_measured(parse_memory),
        metavar="SIZE",
        help="with --budget: memory limit, such as 4GB (default: all memory of the machine)",
    )
    train.add_argument(
        "--model",
        choices=("auto",),
        help="auto: first find out in short trainings which parts of the model the scene needs, "
        "and leave the others out; docs/models.md",
    )
    train.add_argument(
        "--refine-cameras",
        type=int,
        nargs="?",
        const=1,
        metavar="ROUNDS",
        help="first make this many short trainings, each followed by a refinement of the cameras "
        "against its result (1 where no number is given); docs/cameras.md",
    )
    _add_white_balance(train)
    train.add_argument(
        "--csv", type=Path, metavar="FILE", help="also write loss, terms and PSNR of every step"
    )
    train.add_argument(
        "--tensorboard",
        action="store_true",
        help="also write steps and previews as event files, to the run's folder",
    )
    start_group = train.add_mutually_exclusive_group()
    start_group.add_argument(
        "--resume",
        action="store_true",
        help="continue from the last checkpoint; where there is none, start from the beginning",
    )
    start_group.add_argument(
        "--force", action="store_true", help="replace the run in the output folder"
    )
    train.add_argument(
        "--from",
        dest="source",
        type=Path,
        metavar="RUN",
        help="reuse the first stages of another run of the same scene; needs --stage",
    )
    train.add_argument(
        "--stage", metavar="NAME", help="with --from: the first stage that is trained here"
    )
    _add_devices(train)


def _add_settings(settings: argparse.ArgumentParser) -> None:
    """Describe the settings command."""
    settings.add_argument(
        "prefix", nargs="?", default="", help="list only the settings whose names begin with this"
    )
    _add_config_arguments(settings)


def _add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    """Describe the evaluate command."""
    evaluate.add_argument(
        "--protocol",
        choices=PROTOCOLS,
        default=PROTOCOLS[0],
        help="whose conventions the metrics follow (default: %(default)s)",
    )
    _add_samples(evaluate)
    evaluate.add_argument(
        "--relight-indirect",
        choices=RELIGHT_KINDS,
        default="traced",
        help="under new lights, light from directions that the object blocks: traced from what is "
        "hit there, path traced, none (black), or unshadowed (no rays, so no shadows) "
        "(default: %(default)s)",
    )
    evaluate.add_argument(
        "--stage", help="evaluate the end of this stage instead of the latest checkpoint"
    )


def _add_report(report: argparse.ArgumentParser) -> None:
    """Describe the report command."""
    report.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    report.add_argument(
        "--output", type=Path, help="file (default: RUN/report.html; needed for several runs)"
    )


def _add_consistency(consistency: argparse.ArgumentParser) -> None:
    """Describe the consistency command."""
    consistency.add_argument(
        "subject", type=Path, metavar="RUN|MESH", help="folder of a run, or file of a closed mesh"
    )
    consistency.add_argument(
        "--scene",
        type=Path,
        help="for a run: where its scene is now, if it has moved; for a mesh: the scene whose "
        f"cameras look at it (default: {DEFAULT_VIEWS} cameras around the mesh)",
    )
    consistency.add_argument("--stage", help="for a run: measure the end of this stage")
    consistency.add_argument(
        "--size", type=int, help="pixels along the longer side of the views (default: the scene's)"
    )
    consistency.add_argument("--json", type=Path, help="also write the figures to this file")


def _add_render(render: argparse.ArgumentParser) -> None:
    """Describe the render command."""
    _add_cameras(render, "test")
    _add_images(render, ["normal"])
    render.add_argument(
        "--turntable", type=int, default=0, metavar="N", help="N cameras around the object"
    )
    _add_samples(render)
    render.add_argument("--output", type=Path, help="folder (default: RUN/renders)")


def _add_view(view: argparse.ArgumentParser) -> None:
    """Describe the view command."""
    view.add_argument(
        "--env",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="further environment maps to choose from, as files or folders of them",
    )
    view.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        help="port on this machine to serve the viewer at (default: %(default)s)",
    )


def _add_refine_cameras(refine: argparse.ArgumentParser) -> None:
    """Describe the refine-cameras command."""
    refine.add_argument("--output", type=Path, help="file (default: RUN/cameras.json)")
    _add_white_balance(refine)


def _add_export(export: argparse.ArgumentParser) -> None:
    """Describe the export command."""
    export.add_argument("--output", type=Path, help="folder (default: RUN/export)")
    export.add_argument(
        "--vertex-colors",
        action="store_true",
        help="store the materials on the vertices instead of in textures",
    )
    export.add_argument(
        "--texture-size",
        type=int,
        default=1024,
        help="edge of the square textures in texels (default: %(default)s)",
    )
    export.add_argument(
        "--faces",
        type=int,
        metavar="N",
        help="reduce the mesh to about N faces, and bake a normal map of the full one",
    )
    export.add_argument(
        "--obj", action="store_true", help="also write mesh.obj, with mesh.mtl and PNG textures"
    )
    export.add_argument(
        "--usd", action="store_true", help="also write mesh.usdc, with PNG textures"
    )


def _add_gradcheck(gradcheck: argparse.ArgumentParser) -> None:
    """Describe the gradcheck command."""
    gradcheck.add_argument(
        "parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)} (default: all)"
    )
    gradcheck.add_argument("--sweep", action="store_true", help="show the error at every step size")
    gradcheck.add_argument(
        "--seed",
        type=_seed,
        default=0,
        help="seed of numbers, samples and directions (default: %(default)s)",
    )
    gradcheck.add_argument("--json", type=Path, help="also write every comparison to this file")


def _add_poses(poses: argparse.ArgumentParser) -> None:
    """Describe the poses command."""
    defaults = PoseSettings()
    poses.add_argument("folder", type=Path, help="photographs, in FOLDER/images or FOLDER")
    poses.add_argument("--force", action="store_true", help="replace the cameras in FOLDER")
    poses.add_argument(
        "--size",
        type=int,
        default=defaults.size,
        help="longer side, in pixels, that photographs are reduced to in order to find features "
        "(default: %(default)s)",
    )
    poses.add_argument(
        "--order",
        choices=get_args(PoseSettings.__annotations__["order"]),
        default=defaults.order,
        help="any: match every pair of photographs; sequence: mainly those that are close by name, "
        "for frames of a movie (default: %(default)s)",
    )
    poses.add_argument(
        "--lens",
        choices=get_args(PoseSettings.__annotations__["lens"]),
        default=defaults.lens,
        help="one lens for all photographs, or one for each (default: %(default)s)",
    )
    poses.add_argument(
        "--seed",
        type=_seed,
        default=defaults.seed,
        help="seed of the random searches (default: %(default)s)",
    )


def _add_masks(masks: argparse.ArgumentParser) -> None:
    """Describe the masks command."""
    defaults = RadianceSettings()
    masks.add_argument("scene", type=Path, help="folder of a capture; SCENE/masks is written")
    masks.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="two corners of a box around the object (default: a box that is found where the "
        "cameras look)",
    )
    masks.add_argument(
        "--output",
        type=Path,
        help="folder for the splats and the sheet of pictures (default: runs/SCENE_masks)",
    )
    masks.add_argument(
        "--steps",
        type=int,
        default=defaults.steps,
        help="training steps of the splats (default: %(default)s)",
    )
    masks.add_argument(
        "--splats",
        type=int,
        default=defaults.capacity,
        metavar="N",
        help="largest number of splats (default: %(default)s)",
    )
    masks.add_argument(
        "--downscale",
        type=_downscale,
        default="auto",
        metavar="N",
        help="reduce the images by this factor; auto: until none has more pixels than 270 x 480 "
        "(default: %(default)s)",
    )
    masks.add_argument(
        "--seed",
        type=int,
        default=defaults.seed,
        help="seed of every random choice (default: %(default)s)",
    )
    start_group = masks.add_mutually_exclusive_group()
    start_group.add_argument(
        "--resume",
        action="store_true",
        help="continue the training; if it is complete, only make the masks again, for example "
        "with another --box",
    )
    start_group.add_argument(
        "--force", action="store_true", help="train anew; replace the splats and masks"
    )


def _add_devices(train: argparse.ArgumentParser) -> None:
    """Add options for the devices and processes of a training."""
    train.add_argument(
        "--devices",
        type=_at_least_one,
        default=1,
        metavar="N",
        help="share the views of a step between N devices of this process (docs/devices.md)",
    )
    train.add_argument(
        "--hosts",
        type=_hosts,
        metavar="N",
        help="number of processes that train together, including this one; auto: as Slurm or Open "
        "MPI report it",
    )
    train.add_argument(
        "--host", type=int, metavar="K", help="with --hosts N: number of this process, from 0"
    )
    train.add_argument(
        "--coordinator",
        metavar="ADDRESS:PORT",
        help="with --hosts N: address of process 0 that all other processes can reach",
    )


def _add_samples(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--samples", type=int, default=DEFAULT_SAMPLES, help="rays per splat (default: %(default)s)"
    )


def _add_cameras(parser: argparse.ArgumentParser, views: str | None) -> None:
    """Add options that choose the cameras to render from."""
    default = "%(default)s" if views else "test, or train where the scene has no test views"
    parser.add_argument(
        "--views",
        choices=SPLITS,
        default=views,
        help=f"render from the cameras of these views of the scene (default: {default})",
    )
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="render from the cameras in this file instead; it has the form of a transforms.json, "
        "in the world of the scene",
    )
    parser.add_argument(
        "--size",
        type=int,
        metavar="N",
        help="longer side of the images in pixels (default: that of the photographs)",
    )
    parser.add_argument(
        "--field-of-view",
        type=float,
        metavar="DEGREES",
        help="horizontal field of view in degrees (default: that of the cameras)",
    )


def _add_images(parser: argparse.ArgumentParser, aovs: list[str]) -> None:
    """Add options that choose the images to write."""
    default_names = " ".join(aovs) or "none"
    parser.add_argument(
        "--aovs",
        nargs="*",
        choices=AOVS,
        default=aovs,
        help=f"further images to write; depth is written as EXR only (default: {default_names})",
    )
    parser.add_argument(
        "--exr", action="store_true", help="also write every image as EXR, in linear floats"
    )


def _add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add options that choose the settings of a run."""
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        help="method: this project's own (default), the paper's appendix (paper), or the authors' "
        "program (code)",
    )
    parser.add_argument(
        "--quality",
        choices=QUALITIES,
        help="how much work to spend: cells, steps, views and samples (default: standard)",
    )
    parser.add_argument(
        "--material-prior",
        choices=sorted(MATERIAL_PRIORS),
        help="where roughness and metallic start (default: "
        f"{PRESET_PRIORS['default']}; {PRESET_PRIORS['paper']} with the presets paper and code)",
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
    parser.add_argument(
        "--mesh",
        type=Path,
        metavar="FILE",
        help="start from this mesh: PLY, OBJ, GLB (docs/meshes.md)",
    )


def _add_relight(relight: argparse.ArgumentParser) -> None:
    """Describe the relight command."""
    relight.add_argument(
        "--env", type=Path, required=True, help="lat-long environment map: .hdr, .exr or an image"
    )
    relight.add_argument("--output", type=Path, help="folder (default: RUN/relight_NAME)")
    _add_cameras(relight, None)
    _add_images(relight, [])
    relight.add_argument(
        "--turntable", type=int, default=0, metavar="N", help="movie of N frames around the object"
    )
    relight.add_argument(
        "--rotate-env",
        type=int,
        default=0,
        metavar="N",
        help="movie of N frames in which the light turns around the object",
    )
    relight.add_argument(
        "--fps", type=float, default=24.0, help="frames per second of the movies (default: 24)"
    )
    relight.add_argument(
        "--movie", choices=("gif", "mp4"), help="format of the movies (default: mp4 if possible)"
    )
    relight.add_argument(
        "--background",
        choices=BACKGROUNDS,
        default="light",
        help="what is shown behind the object (default: %(default)s)",
    )
    relight.add_argument(
        "--intensity", type=float, default=1.0, help="factor on the light (default: 1)"
    )
    relight.add_argument(
        "--albedo-scale",
        type=float,
        nargs=3,
        default=(1.0, 1.0, 1.0),
        metavar=("R", "G", "B"),
        help="factors on the albedo (default: 1 1 1)",
    )
    _add_samples(relight)
    relight.add_argument(
        "--indirect",
        choices=RELIGHT_KINDS,
        default="traced",
        help="light from directions that the object blocks: traced from what is hit there, path "
        "traced, none (black), or unshadowed (no rays, so no shadows) (default: %(default)s)",
    )


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scene, and options for reading it."""
    parser.add_argument("scene", type=Path, help="scene folder")
    parser.add_argument(
        "--downscale",
        type=_downscale,
        metavar="N",
        help="reduce the images by this factor (default: 1, or with train --budget what fits the "
        "budget); auto: the largest factor that keeps grid cells two pixels wide or more",
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
        "--cameras",
        type=Path,
        metavar="FILE",
        help="use the cameras of this file, written by refine-cameras, instead of the scene's own",
    )


def _measured(parse: Callable[[str], float]) -> Callable[[str], float]:
    """Wrap a parser of a quantity, so that argparse shows the message of its `ValueError`."""

    def read(text: str) -> float:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def _at_least_one(text: str) -> int:
    """Read a count."""
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {count}")
    return count


def _hosts(text: str) -> str:
    """Read a number of processes, or ``auto``."""
    return text if text == "auto" else str(_at_least_one(text))


def _downscale(text: str) -> int | str:
    """Read a factor, or ``auto``."""
    return text if text == "auto" else _at_least_one(text)


def _seed(text: str) -> int:
    """Read a seed."""
    seed = int(text)
    if not 0 <= seed < 2**31:
        raise argparse.ArgumentTypeError(f"must be from 0 to 2**31 - 1, got {seed}")
    return seed
