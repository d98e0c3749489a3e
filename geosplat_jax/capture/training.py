"""Training of splats that carry their own colour, one view per step, with resume.

::

    splats.json           views, settings: what a resumed training must agree with
    checkpoints/          splats, optimiser, step, capacities

Views and random numbers of a step are functions of seed and step alone, so that a training that was
resumed equals one that was not, bit by bit. A step that did not fit into its buffers changes
nothing and is made again with larger ones (`core.capacity.retry`).
"""

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.capture.start import (
    EXTENT,
    first_splats,
    require_trainable,
    standard_world,
)
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage, bucket, retry
from geosplat_jax.core.color import linear_to_srgb
from geosplat_jax.core.settings import to_plain
from geosplat_jax.core.types import Batch, Camera
from geosplat_jax.fit.folder import RunError, locked_folder
from geosplat_jax.fit.listener import Progress
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.step import ADAM, descended
from geosplat_jax.fit.train import Interrupted, stop_requests
from geosplat_jax.io.checkpoints import (
    latest_checkpoint,
    load_checkpoint,
    read_meta,
    save_checkpoint,
)
from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import written_aside
from geosplat_jax.io.layouts.colmap import Points
from geosplat_jax.io.views import Views
from geosplat_jax.losses import image_dissimilarity, image_l1, over_background, random_background
from geosplat_jax.report.metrics import psnr, psnr_of_mse
from geosplat_jax.splats.radiance import RadianceSplats, render_radiance
from geosplat_jax.splats.relocation import DEAD_OPACITY, exploring_noise, relocate

_RELOCATION_STREAM = 2**31
"""Random streams of relocations are numbered from here, by the step; steps use the streams from 0
on."""

TILE_SIZE = 8
"""Side of a tile in pixels; splats of a capture are larger than those of a mesh."""

NEAR = 0.2
"""Splats closer to a camera than this are not drawn, in the standard world with an extent of 4."""

_MOST_HITS = 1 << 26
"""Most pairs of a splat and a tile in one view; more would take many GB."""

_HEADROOM = 1.25
"""Headroom of buffers that grow: the number of splats keeps growing, and every new size takes a
compilation."""
_STEPS_TIMED = 50
"""Number of the last steps from which the time left is estimated."""
_VIEWS_PLANNED = 8
"""Number of views whose needs the first sizes of the buffers hold."""

RECORD = "splats.json"


class RadianceState(eqx.Module):
    """State that a step reads and writes.

    Attributes
    ----------
    splats : splats in the standard world, see `start.standard_world`; rows past ``count`` are
        padding.
    optimizer : state of Adam.
    count : () number of splats in use.
    step : () number of updates made.
    """

    splats: RadianceSplats
    optimizer: Any
    count: Int[Array, ""]
    step: Int[Array, ""]


class StepWeights(eqx.Module):
    """Rates and weights of one step, all traced.

    Attributes
    ----------
    rates : learning rates of the groups of `RadianceSplats`.
    noise : () rate of `exploring_noise`.
    degree : () highest degree of the harmonics in use.
    structure, opacity, scale : () weights of the loss.
    """

    rates: dict[str, Float[Array, ""]]
    noise: Float[Array, ""]
    degree: Int[Array, ""]
    structure: Float[Array, ""]
    opacity: Float[Array, ""]
    scale: Float[Array, ""]


class RadianceReport(eqx.Module):
    """Outcome of a step; the state changes only if the new one is finite and the buffers suffice.

    Attributes
    ----------
    total : () loss.
    mse : () mean squared error of the image.
    usage : true needs of the buffers.
    finite : () whether the loss and all new splats are finite.
    """

    total: Float[Array, ""]
    mse: Float[Array, ""]
    usage: Usage
    finite: Bool[Array, ""]


@dataclass(frozen=True)
class Radiance:
    """Splats that were trained, in the world of the capture; no padding.

    Attributes
    ----------
    splats : splats, all of whose rows are in use.
    near : distance from a camera below which splats are not drawn, world units.
    degree : highest degree of the harmonics in use.
    """

    splats: RadianceSplats
    near: float
    degree: int

    def of(self, rows: Bool[np.ndarray, " N"]) -> "Radiance":
        """Return the splats in the rows of a mask (N,)."""
        indices = np.flatnonzero(rows)
        return replace(self, splats=jax.tree.map(lambda leaf: leaf[indices], self.splats))


def radiance_loss(
    splats: RadianceSplats,
    count: Int[Array, ""],
    batch: Batch,
    weights: StepWeights,
    *,
    capacities: Capacities,
    background: str,
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Usage]]:
    """Compare the render of one view with its photograph, both in sRGB.

    Parameters
    ----------
    splats : splats in the standard world.
    count : () number of rows in use.
    batch : a single view.
    weights : rates and weights of the step.
    capacities : static; sizes of the buffers.
    background : static; see `RadianceSettings.background`.

    Returns
    -------
    total : () loss.
    mse, usage : () mean squared error of the image, and true needs of the buffers.
    """
    rgb, alpha, usage = render_radiance(
        splats,
        count,
        batch.camera,
        degree=weights.degree,
        capacities=capacities,
        near=NEAR,
        tile_size=TILE_SIZE,
    )
    photograph = jnp.concatenate(
        [linear_to_srgb(batch.image[..., :3]), batch.image[..., 3:]], axis=-1
    )
    backdrop = random_background(batch.key, (1, *rgb.shape), rgb.dtype, background)
    images = over_background(rgb[None], alpha[None], photograph, backdrop, batch.valid, srgb=False)
    in_use = (jnp.arange(splats.capacity, dtype=jnp.int32) < count).astype(rgb.dtype)
    share = in_use / jnp.maximum(count, 1).astype(rgb.dtype)
    total = (
        (1.0 - weights.structure) * image_l1(images)
        + weights.structure * image_dissimilarity(images)
        + weights.opacity * jnp.sum(share * splats.opacities)
        + weights.scale * jnp.sum(share[:, None] * splats.scales) / 3.0
    )
    return total, (images.mse, usage)


@partial(jax.jit, static_argnames=("capacities", "background"), donate_argnames=("state",))
def radiance_step(
    state: RadianceState,
    batch: Batch,
    weights: StepWeights,
    *,
    capacities: Capacities,
    background: str,
) -> tuple[RadianceState, RadianceReport]:
    """Make one update and add noise to the positions, or change nothing; see `RadianceReport`."""
    batch_key, noise_key = jax.random.split(batch.key)
    (total, (mse, usage)), gradient = jax.value_and_grad(radiance_loss, has_aux=True)(
        state.splats,
        state.count,
        replace(batch, key=batch_key),
        weights,
        capacities=capacities,
        background=background,
    )
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integer powers
        directions, optimizer = ADAM.update(gradient, state.optimizer)
    splats = descended(state.splats, directions, weights.rates)
    noise = exploring_noise(splats, noise_key, rate=weights.noise)
    splats = replace(splats, means=splats.means + noise)
    is_finite = jnp.isfinite(total) & jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(splats)])
    )
    sizes = {name: jnp.int32(capacities[name]) for name in usage}
    is_sound = is_finite & capacity_module.fits(usage, sizes)
    updated_state = RadianceState(splats, optimizer, state.count, state.step + 1)
    next_state = jax.tree.map(lambda new, old: jnp.where(is_sound, new, old), updated_state, state)
    return next_state, RadianceReport(total, mse, usage, is_finite)


@partial(jax.jit, donate_argnames=("state",))
def relocated(state: RadianceState, count: Int[Array, ""], key: Key[Array, ""]) -> RadianceState:
    """Move dead splats onto live ones, then add splats up to ``count``.

    Adam's moments of all rows that change become zero. See `relocation.relocate`.
    """
    dead_key, birth_key = jax.random.split(key)
    rows = jnp.arange(state.splats.capacity, dtype=jnp.int32)
    in_use = rows < state.count
    is_dead = in_use & (state.splats.opacities <= DEAD_OPACITY)
    splats, first = relocate(state.splats, is_dead, in_use, dead_key)
    is_born = (rows >= state.count) & (rows < count)
    splats, second = relocate(splats, is_born, in_use, birth_key)
    new_count = jnp.where(jnp.any(second & is_born), jnp.maximum(count, state.count), state.count)
    is_changed = first | second

    def cleared(moments: Any) -> Any:
        return jax.tree.map(
            lambda m: jnp.where(is_changed.reshape(-1, *[1] * (m.ndim - 1)), 0.0, m), moments
        )

    optimizer = state.optimizer._replace(
        mu=cleared(state.optimizer.mu), nu=cleared(state.optimizer.nu)
    )
    return RadianceState(splats, optimizer, new_count, state.step)


def weights_at(settings: RadianceSettings, step: int) -> StepWeights:
    """Return the numbers of a step: the rate of positions decays, the degree rises."""
    rates = settings.rates
    progress = step / max(settings.steps - 1, 1)
    # Rates are in units of the extent.
    means_rate = EXTENT * rates.means * (rates.means_last / rates.means) ** progress
    groups = {
        name: getattr(rates, name) for name in ("scales", "quats", "opacities", "base", "rest")
    }
    to_float32 = partial(jnp.asarray, dtype=jnp.float32)
    return StepWeights(
        rates={name: to_float32(rate) for name, rate in {**groups, "means": means_rate}.items()},
        noise=to_float32(means_rate * settings.relocation.noise),
        degree=jnp.int32(min(settings.degree, step // settings.degree_every)),
        structure=to_float32(settings.structure),
        opacity=to_float32(settings.opacity_penalty),
        scale=to_float32(settings.scale_penalty),
    )


def relocates_after(settings: RadianceSettings, step: int) -> bool:
    """Whether splats are relocated after ``step`` updates."""
    schedule = settings.relocation
    return step % schedule.every == 0 and schedule.first <= step <= schedule.until * settings.steps


class _Loop:
    """What is kept from step to step."""

    def __init__(
        self, views: Views, points: Points | None, settings: RadianceSettings, folder: Path
    ) -> None:
        self.settings, self.folder = settings, folder
        self.world = standard_world(views)
        self.views = self.world.views(views)
        if points is not None:
            points = points._replace(positions=self.world.points(points.positions))
        splats, count = first_splats(self.views, points, settings)
        self.state = RadianceState(
            splats=splats,
            optimizer=ADAM.init(splats),  # pyright: ignore[reportArgumentType]
            count=jnp.int32(count),
            step=jnp.int32(0),
        )
        self.capacities = _planned(splats, count, self.views.camera(), NEAR)
        self.has_compiled = False

    def save(self) -> None:
        """Write a checkpoint."""
        save_checkpoint(
            self.folder / "checkpoints",
            int(self.state.step),
            tree=self.state,
            meta={"capacities": dict(self.capacities)},
        )

    def load(self) -> None:
        """Continue from the last checkpoint, if there is one."""
        path = latest_checkpoint(self.folder / "checkpoints")
        if path is not None:
            self.state, _ = load_checkpoint(path, like=self.state)
            self.capacities = Capacities(**read_meta(path)["capacities"])

    def batch(self, step: int) -> Batch:
        """Return the view of a step: all views in random order, then in another one, and so on."""
        epoch, position = divmod(step, len(self.views))
        order = np.random.default_rng((self.settings.seed, epoch)).permutation(len(self.views))
        view = order[position : position + 1]
        valid = self.views.valid
        return Batch(
            camera=self.views.camera(view),
            image=jnp.asarray(self.views.clipped(view)),
            key=jax.random.fold_in(jax.random.key(self.settings.seed), step),
            valid=None if valid is None else jnp.asarray(valid[view]),
        )

    def advance(self, step: int) -> RadianceReport:
        """Make one step, with larger buffers as often as needed."""
        batch, weights = self.batch(step), weights_at(self.settings, step)

        def attempt(capacities: Capacities) -> tuple[RadianceReport, Usage]:
            self.state, report = radiance_step(
                self.state,
                batch,
                weights,
                capacities=capacities,
                background=self.settings.background,
            )
            _require_few_hits(report.usage, step)
            return report, report.usage

        report, self.capacities = retry(attempt, self.capacities, headroom=_HEADROOM)
        if not bool(report.finite):
            raise TrainingError(
                f"step {step}: a number is not finite; the last good checkpoint is kept in "
                f"{self.folder / 'checkpoints'}"
            )
        if relocates_after(self.settings, step + 1):
            grown_count = int(self.settings.relocation.growth * int(self.state.count))
            key = jax.random.fold_in(jax.random.key(self.settings.seed), _RELOCATION_STREAM + step)
            count = jnp.int32(min(self.settings.capacity, grown_count))
            self.state = relocated(self.state, count, key)
        return report

    def result(self) -> Radiance:
        """Return the splats in the world of the capture."""
        count, scale = int(self.state.count), self.world.scale
        splats = jax.tree.map(lambda leaf: leaf[:count], self.state.splats)
        # Transformed in double precision, since the capture may lie far from its origin.
        means = (np.asarray(splats.means, np.float64) - self.world.translation) / scale
        splats = replace(
            splats,
            means=jnp.asarray(means, jnp.float32),
            log_scales=splats.log_scales - jnp.float32(np.log(scale)),
        )
        degree = min(self.settings.degree, (self.settings.steps - 1) // self.settings.degree_every)
        return Radiance(splats, NEAR / scale, degree)


@partial(jax.jit, static_argnames=("capacities",))
def _needs(splats, count, camera, near, *, capacities):
    """Count what one view needs; the image itself is not made."""
    return render_radiance(
        splats, count, camera, capacities=capacities, near=near, tile_size=TILE_SIZE
    )[2]


def _planned(
    splats: RadianceSplats, count: Int[Array, ""] | int, camera: Camera, near: float
) -> Capacities:
    """Choose sizes of buffers that hold the needs of some views; ``visible`` holds all splats."""
    capacities = Capacities(visible=bucket(splats.capacity))
    for view_index in np.unique(np.linspace(0, camera.count - 1, _VIEWS_PLANNED).astype(int)):
        view = camera.view(int(view_index))

        def attempt(sizes: Capacities, view: Camera = view) -> tuple[None, Usage]:
            return None, _needs(splats, count, view, jnp.float32(near), capacities=sizes)

        _, capacities = retry(attempt, capacities, headroom=_HEADROOM)
    return capacities


def _require_few_hits(usage: Usage, step: int) -> None:
    """Stop before buffers exhaust the memory."""
    if int(usage["hits"]) > _MOST_HITS:
        raise TrainingError(
            f"step {step}: {int(usage['hits'])} pairs of a splat and a tile in one view, more than "
            f"{_MOST_HITS}; raise --downscale or lower --splats"
        )


def train_radiance(
    views: Views,
    settings: RadianceSettings,
    folder: str | Path,
    *,
    points: Points | None = None,
    resume: bool = False,
    replace_run: bool = False,
    stop_after: int | None = None,
    on_step: Callable[[Progress], None] | None = None,
) -> Radiance:
    """Train splats on photographs and leave checkpoints in a folder.

    Parameters
    ----------
    views : views without masks; see `start.require_trainable`.
    settings : settings of the training.
    folder : made if it is missing, and locked during the training.
    points : points of structure from motion, in the world of the views; None without any.
    resume : continue from the last checkpoint; the result equals that of the uninterrupted training
        bit for bit.
    replace_run : begin anew in a folder that has a training.
    stop_after : stop, with a checkpoint, once so many steps are done.
    on_step : called after every step.

    Returns
    -------
    The splats, in the world of the views.

    Raises
    ------
    CaptureError, AlignmentError : see `start.require_trainable`.
    RunError : the folder has another training or other files, or is in use.
    TrainingError : a number is not finite, or the splats take too much memory.
    Interrupted : after Ctrl-C or SIGTERM; the training can be resumed.
    """
    require_trainable(views)
    folder = Path(folder)
    with locked_folder(folder, own=folder / RECORD), stop_requests() as stop_requested:
        _begin(folder, views, settings, resume=resume, replace_run=replace_run)
        loop = _Loop(views, points, settings, folder)
        if resume:
            loop.load()
        start_time, last = time.perf_counter(), min(settings.steps, stop_after or settings.steps)
        step_seconds: deque[float] = deque(maxlen=_STEPS_TIMED)
        for step in range(int(loop.state.step), last):
            step_start, sizes = time.perf_counter(), loop.capacities
            report = loop.advance(step)
            steps_done, now = step + 1, time.perf_counter()
            if loop.capacities == sizes and loop.has_compiled:
                step_seconds.append(now - step_start)
            loop.has_compiled = True
            if on_step is not None:
                seconds_left = (
                    float(np.median(step_seconds)) * (settings.steps - steps_done)
                    if step_seconds
                    else None
                )
                on_step(_progress(loop, report, now - start_time, seconds_left))
            is_stopped = stop_requested()
            is_due = steps_done % settings.checkpoint_every == 0 or steps_done == last
            if is_due or is_stopped:
                loop.save()
            if is_stopped:
                raise Interrupted(f"stopped at step {steps_done}; continue with --resume")
        return loop.result()


def _progress(
    loop: _Loop, report: RadianceReport, seconds: float, seconds_left: float | None
) -> Progress:
    return Progress(
        step=int(loop.state.step),
        steps=loop.settings.steps,
        stage="splats",
        total=float(report.total),
        psnr=float(psnr_of_mse(report.mse)),
        splat_count=int(loop.state.count),
        seconds=seconds,
        seconds_left=seconds_left,
    )


def _begin(
    folder: Path, views: Views, settings: RadianceSettings, *, resume: bool, replace_run: bool
) -> None:
    """Write the record of the training, or compare it with that of the training to resume."""
    path = folder / RECORD
    new_record = {
        "views": f"{len(views)} of {views.width} x {views.height}, {views.fingerprint()}",
        "settings": to_plain(settings),
    }
    if path.exists() and resume:
        try:
            record = parse_json(path.read_bytes())
        except ValueError as error:
            raise RunError(f"{path} is damaged: {error}; start again with --force") from None
        if record != new_record:
            raise RunError(
                f"{path} is of other views or settings; give the same as then, or start again "
                "with --force"
            )
        return
    if path.exists() and not replace_run:
        raise RunError(
            f"{folder} has splats already; continue with --resume, replace them with --force, or "
            "choose another --output"
        )
    for old_checkpoint in (folder / "checkpoints").glob("checkpoint_*.npz"):
        old_checkpoint.unlink()
    with written_aside(path) as temporary_path:
        temporary_path.write_text(json.dumps(new_record, indent=2) + "\n", encoding="utf-8")


@partial(jax.jit, static_argnames=("capacities", "degree"))
def _rendered(splats, camera, near, *, capacities, degree):
    return render_radiance(
        splats,
        splats.capacity,
        camera,
        degree=degree,
        capacities=capacities,
        near=near,
        tile_size=TILE_SIZE,
    )


def render_views(
    radiance: Radiance, camera: Camera
) -> tuple[Float[np.ndarray, "V H W 3"], Float[np.ndarray, "V H W"]]:
    """Render views: (V, H, W, 3) premultiplied sRGB, and (V, H, W) alpha."""
    capacities = _planned(radiance.splats, radiance.splats.capacity, camera, radiance.near)
    colors, alphas = [], []
    near = jnp.float32(radiance.near)
    for view_index in range(camera.count):
        view = camera.view(view_index)

        def attempt(sizes: Capacities, view: Camera = view) -> tuple[Any, Usage]:
            rgb, alpha, usage = _rendered(
                radiance.splats, view, near, capacities=sizes, degree=radiance.degree
            )
            return (rgb, alpha), usage

        (rgb, alpha), capacities = retry(attempt, capacities)
        colors.append(np.asarray(rgb))
        alphas.append(np.asarray(alpha))
    return np.stack(colors), np.stack(alphas)


def psnr_by_view(radiance: Radiance, views: Views) -> Float[np.ndarray, " V"]:
    """Return the PSNR of renders against photographs, (V,) decibels, in sRGB over black."""
    rgb, _ = render_views(radiance, views.camera())
    truth = np.asarray(linear_to_srgb(jnp.asarray(views.clipped(range(len(views)))[..., :3])))
    renders = np.clip(rgb, 0.0, 1.0)
    valid = np.ones(renders.shape[:3], np.float32) if views.valid is None else views.valid
    return np.array([float(psnr(*view)) for view in zip(renders, truth, valid, strict=True)])
