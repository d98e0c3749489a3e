"""Refinement of cameras against a trained asset: pose, focal length and exposure of each view.

The asset and its light are held fixed, so views are independent of each other. Each has eight
parameters (ten with white balance), which Levenberg-Marquardt finds from the difference of render
and photograph. The columns of a Jacobian are computed in forward mode
(`RenderPipeline.forward_mode`), which suits few parameters and many pixels. Visibility and depth
order are determined at every iterate and have no derivative.

Splats are shaded towards the initial camera, and keep their colours while the solver runs: cameras
move by less than highlights are wide, and sampling noise would otherwise change at every iterate.
Then everything is repeated from the camera that was found (`CameraSettings.rounds`).

Parameters are dimensionless, and change the image of the object by comparable amounts:

- a rotation vector in radians, about the centre of the object's box, in camera axes. Rotation about
  the object, instead of the camera, keeps rotation and shift apart;
- a shift of the object: across the view in half extents of the box, and along the view in units of
  the distance;
- the logarithm of a factor of both focal lengths, and that of a factor of the exposure;
- with white balance, the logarithms of factors of red and blue. The logarithm for green is minus
  their sum.

A tint that all views share belongs to the light: `with_mean_balance` removes it from the views.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int, Key

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.rotation import rotation_vector_to_matrix
from geosplat_jax.core.settings import NonNegative, Positive, PositiveCount, settings
from geosplat_jax.core.types import Box, Camera, EnvLight, SurfacePoints
from geosplat_jax.io.cameras import RefinedCamera, RefinedSplit
from geosplat_jax.io.views import Views
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.render import Asset, PerSplat, RenderPipeline
from geosplat_jax.splats.rasterize import gather_visible
from geosplat_jax.transport.base import Illumination, Shaded, Transport

PARAMETER_COUNT = 8
"""Rotation (3), shift (3), logarithm of the focal factor, logarithm of the exposure."""

BALANCE_COUNT = 2
"""Logarithms of the factors of red and blue."""

UNIT = 0.01
"""The variables of the solver are the parameters divided by this, since its damping begins at 1 in
units of its variables."""


@settings
class CameraSettings:
    """How cameras are refined; static and hashable.

    The solver minimises a sum of squares that is a negative log posterior, up to a factor: robust
    differences in units of ``pixel_deviation``, and parameters in units of ``prior_deviation``.
    """

    pixel_deviation: Positive = 0.05
    """Usual difference between render and photograph in one channel of a pixel, in linear light;
    the unit of the differences."""
    prior_deviation: Positive = 0.002
    """Change of a parameter that counts as much as one such difference. It is smaller than the
    errors that are to be corrected, since errors of neighbouring pixels are correlated, and still
    hardly affects what the pixels determine well. It decides what they leave open, above all a
    longer lens further away. A large value turns the prior off."""
    coverage_weight: NonNegative = 1.0
    """Weight of the squared difference of coverage and mask, beside one for each colour channel."""
    robust_deviations: Positive = 3.0
    """Differences of more than this many deviations count linearly instead of squared, so that
    whatever the asset lacks does not pull at the camera."""
    rounds: PositiveCount = 2
    """How often the splats are shaded; the solver runs after each time."""
    steps: PositiveCount = 20
    """Most steps of the solver in a round, including rejected ones."""
    white_balance: bool = False
    """Also find factors of red, green and blue for every view, besides that of the exposure."""
    tolerance: Positive = 1e-2
    """The solver stops when a step changes its variables (parameters over `UNIT`) and the residuals
    by less than this, as root mean squares; relative changes of this size are allowed in
    addition."""

    @property
    def parameter_count(self) -> int:
        """Count the parameters of a view."""
        return PARAMETER_COUNT + (BALANCE_COUNT if self.white_balance else 0)


class Baked(Illumination):
    """Colours of N splats, shaded once."""

    shaded: Shaded

    def take(self, rows: Int[Array, " M"]) -> "Baked":
        """See `Illumination.take`."""
        return jax.tree.map(lambda values: gather_visible(rows, values), self)


class BakedTransport(Transport):
    """Transport that returns colours which were shaded before.

    Attributes
    ----------
    shaded : colours and light of all N splats.
    """

    shaded: Shaded

    def prepare(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        light: EnvLight,
        index: RayIndex | None,
        carry: Any = None,
    ) -> tuple[Baked, Any]:
        """Return the stored colours as illumination, and the carry as it is."""
        return Baked(self.shaded), carry

    def shade(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        wo: Float[Array, "M 3"],
        illumination: Baked,
        index: RayIndex | None,
    ) -> Shaded:
        """Return the colours that the illumination of these M points holds."""
        return illumination.shaded


class Subject(eqx.Module):
    """What the cameras look at: an asset under a prepared light.

    Attributes
    ----------
    pipeline, asset, illumination : see `RenderPipeline.render_lit`.
    log_exposure : () logarithm of the exposure that all views share.
    key : random key of the samples that depend on the viewer; None for a transport without any.
    """

    pipeline: RenderPipeline
    asset: Asset
    illumination: Illumination
    log_exposure: Float[Array, ""]
    key: Key[Array, ""] | None

    def seen_from(self, camera: Camera) -> "Subject":
        """Return the subject with its splats shaded once, towards the camera of a single view."""
        asset, transport = self.asset, self.pipeline.transport
        view_vectors = camera.centers - asset.splats.means
        is_facing = jnp.sum(asset.splats.outward * view_vectors, axis=-1) > 0
        mask = is_facing if self.pipeline.raster.cull_backfaces else None
        shaded = transport.shade(
            self.key,
            asset.splats.points(mask),
            asset.attributes,
            safe_normalize(view_vectors),
            self.illumination,
            asset.index,
        )
        # Splats are shaded here, even where the run shades pixels.
        pipeline = replace(
            self.pipeline.forward_mode(), transport=BakedTransport(shaded), domain=PerSplat()
        )
        return replace(
            self, pipeline=pipeline, illumination=Baked(shaded), asset=replace(asset, index=None)
        )


class PosedPhotograph(eqx.Module):
    """A photograph with its camera, to compare with.

    Attributes
    ----------
    camera : initial camera of this single view.
    image : (H, W, 4) linear colour, straight alpha.
    valid : (H, W) pixels that count, 0 or 1.
    """

    camera: Camera
    image: Float[Array, "H W 4"]
    valid: Float[Array, "H W"]


class Fit(eqx.Module):
    """How well a camera fits its photograph.

    Attributes
    ----------
    cost : () robust sum of squares of the pixels, without the prior.
    rms : () root mean square of the differences of colour and coverage over all pixels that count.
    rendered : () sum of the render's coverage over the pixels that count.
    covered : () sum of the mask over these pixels.
    usage : true needs of the buffers of this view.
    """

    cost: Float[Array, ""]
    rms: Float[Array, ""]
    rendered: Float[Array, ""]
    covered: Float[Array, ""]
    usage: Usage


def moved_camera(
    camera: Camera, parameters: Float[Array, " P"], box: Box
) -> tuple[Camera, Float[Array, ""]]:
    """Move the camera of a single view.

    Parameters
    ----------
    camera : camera of a single view.
    parameters : (P,) dimensionless, as the module describes them; not in units of `UNIT`.
    box : box around the object; its centre and half extent are used.

    Returns
    -------
    camera : the moved camera; where all parameters are zero, the given one up to rounding.
    log_exposure : () logarithm of the factor of the exposure.
    """
    rotation, translation = camera.world_to_camera[0, :3, :3], camera.world_to_camera[0, :3, 3]
    product = partial(jnp.matmul, precision="highest")
    center = product(rotation, box.center) + translation
    lengths = jnp.stack([box.half_extent, box.half_extent, center[2]])
    rotation_change = rotation_vector_to_matrix(parameters[:3])
    new_rotation = product(rotation_change, rotation)
    new_translation = center + parameters[3:6] * lengths - product(new_rotation, box.center)
    pose = (
        jnp.eye(4, dtype=rotation.dtype).at[:3, :3].set(new_rotation).at[:3, 3].set(new_translation)
    )
    focal = jnp.exp(parameters[6])
    factors = jnp.ones((3, 3), rotation.dtype).at[(0, 1), (0, 1)].set(focal)
    lens = camera.intrinsics[0] * factors
    return Camera(pose[None], lens[None], camera.height, camera.width), parameters[7]


def log_balance(parameters: Float[Array, " P"]) -> Float[Array, " 3"]:
    """Return the logarithms of the factors of red, green and blue, (3,), whose sum is zero.

    All are zero where ``parameters`` (P,) include no white balance.
    """
    if parameters.shape[0] == PARAMETER_COUNT:
        return jnp.zeros(3, parameters.dtype)
    red, blue = parameters[PARAMETER_COUNT], parameters[PARAMETER_COUNT + 1]
    return jnp.stack([red, -red - blue, blue])


def view_residual(
    parameters: Float[Array, " P"],
    subject: Subject,
    photograph: PosedPhotograph,
    how: CameraSettings,
) -> tuple[Float[Array, " R"], Fit]:
    """Evaluate the residual whose squares are summed, and how well the camera fits.

    Differentiable in the parameters, in forward mode if the subject's pipeline is in that mode.

    Where a buffer overflowed, all residuals are zero. The solver takes such a step for a perfect
    one and stays there, so that the usage of its result shows the overflow; see `refine_view`.

    Parameters
    ----------
    parameters : (P,) in units of `UNIT`; zero is the camera of the photograph.
    subject : asset with colours from `Subject.seen_from`.
    photograph : view to compare with.
    how : settings of the refinement.

    Returns
    -------
    residual : (R,) robust differences of all pixels and channels, then P residuals of the prior.
    fit : how well the camera fits, without gradient.
    """
    pipeline = subject.pipeline
    camera, log_exposure = moved_camera(photograph.camera, UNIT * parameters, pipeline.surface.box)
    output = pipeline.render_lit(subject.asset, subject.illumination, camera, key=subject.key)
    balanced = output.rgb[0] * jnp.exp(log_balance(UNIT * parameters))[None, None]
    rgb = tone_map(balanced, subject.log_exposure + log_exposure)
    mask, valid = photograph.image[..., 3:], photograph.valid[..., None]
    rgb_difference = valid * (rgb - photograph.image[..., :3] * mask)
    coverage_difference = valid * (output.alpha[0][..., None] - mask)
    weight = how.coverage_weight**0.5
    deviations = jnp.concatenate([rgb_difference, weight * coverage_difference], axis=-1)
    robust = _robust(deviations.reshape(-1) / how.pixel_deviation, how.robust_deviations)
    prior = UNIT / how.prior_deviation * parameters
    # The asset is complete: needs of its own buffers do not count here.
    usage = {n: count for n, count in output.usage.items() if n not in subject.asset.usage}
    fits = capacity_module.fits(usage, pipeline.capacities)
    residual = jnp.where(fits, jnp.concatenate([robust, prior]), 0.0)
    squared = jnp.sum(rgb_difference**2) + jnp.sum(coverage_difference**2)
    fit = Fit(
        cost=jnp.sum(robust**2),
        rms=jnp.sqrt(squared / jnp.maximum(4.0 * jnp.sum(valid), 1.0)),
        rendered=jnp.sum(valid[..., 0] * output.alpha[0]),
        covered=jnp.sum(valid * mask),
        usage=usage,
    )
    return residual, jax.lax.stop_gradient(fit)


def _robust(deviations: Float[Array, " R"], knee: float) -> Float[Array, " R"]:
    """Shrink large deviations, so that their squares grow linearly (Charbonnier et al. 1994).

    The square is ``2 knee^2 (sqrt(1 + (d / knee)^2) - 1)``, without cancellation.
    """
    return deviations * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + (deviations / knee) ** 2)))


class Refinement(eqx.Module):
    """What the solver found for one view.

    Attributes
    ----------
    parameters : (P,) in units of `UNIT`, see `moved_camera` and `log_balance`.
    camera : the camera that these parameters give.
    before, after : fits of the initial camera and of the refined one.
    iterations : () steps of the solver, including rejected ones.
    """

    parameters: Float[Array, " P"]
    camera: Camera
    before: Fit
    after: Fit
    iterations: Int[Array, ""]


@partial(jax.jit, static_argnames=("how",))
def _solve(
    start: Float[Array, " P"], subject: Subject, photograph: PosedPhotograph, *, how: CameraSettings
) -> Refinement:
    """Run Levenberg-Marquardt; valid only where both fits' usage is within the capacities."""
    box = subject.pipeline.surface.box
    subject = subject.seen_from(moved_camera(photograph.camera, UNIT * start, box)[0])

    def residual(parameters: Float[Array, " P"], args: None) -> tuple[Float[Array, " R"], Fit]:
        del args
        return view_residual(parameters, subject, photograph, how)

    solver = optx.LevenbergMarquardt(rtol=how.tolerance, atol=how.tolerance, norm=optx.rms_norm)
    solution = optx.least_squares(
        residual, solver, start, has_aux=True, max_steps=how.steps, throw=False
    )
    iterates = jnp.stack([start, solution.value])
    before, after = _both(jax.lax.map(lambda y: residual(y, None)[1], iterates))
    camera, _ = moved_camera(photograph.camera, UNIT * solution.value, box)
    return Refinement(solution.value, camera, before, after, solution.stats["num_steps"])


def _both(fits: Fit) -> tuple[Fit, Fit]:
    """Take two stacked fits apart."""
    first, second = (jax.tree.map(lambda x, k=k: x[k], fits) for k in (0, 1))
    return first, second


def refine_view(
    subject: Subject, photograph: PosedPhotograph, how: CameraSettings
) -> tuple[Refinement, Capacities]:
    """Refine the camera of one view, with buffers that grow until no iterate overflows (host side).

    Parameters
    ----------
    subject : trained asset under its light.
    photograph : view to compare with, and its initial camera.
    how : settings of the refinement.

    Returns
    -------
    found : the refined camera, which may be worse than the initial one.
    capacities : buffer sizes that the refinement needed.
    """

    def attempt(capacities: Capacities) -> tuple[Refinement, Usage]:
        pipeline = replace(subject.pipeline, capacities=capacities)
        sized_subject = replace(subject, pipeline=pipeline)
        start = jnp.zeros(how.parameter_count, photograph.image.dtype)
        rounds = []
        for _ in range(how.rounds):
            rounds.append(_solve(start, sized_subject, photograph, how=how))
            start = rounds[-1].parameters
        fits = [fit for result in rounds for fit in (result.before, result.after)]
        steps = sum((result.iterations for result in rounds[1:]), rounds[0].iterations)
        result = replace(rounds[-1], before=rounds[0].before, iterations=steps)
        return result, capacity_module.combine(*(fit.usage for fit in fits))

    return capacity_module.retry(attempt, subject.pipeline.capacities)


class ViewProgress(NamedTuple):
    """Progress of a refinement after a view.

    Attributes
    ----------
    done, total : number of views that are done, and of all views.
    name : name of the last view.
    camera : its camera.
    """

    done: int
    total: int
    name: str
    camera: RefinedCamera


def refine_views(
    subject: Subject,
    views: Views,
    how: CameraSettings | None = None,
    *,
    on_view: Callable[[ViewProgress], None] | None = None,
) -> RefinedSplit:
    """Refine the camera and the exposure of every view (host side).

    A view keeps its camera, with a note of the reason, if there are no masks, if its render or its
    mask shows nothing, or if its error did not fall.

    Parameters
    ----------
    subject : trained asset under its light, see `Renderer.subject`.
    views : views with their initial cameras.
    how : settings; by default those of `CameraSettings`.
    on_view : called after every view.

    Returns
    -------
    Cameras of all views by name.
    """
    how, cameras = how or CameraSettings(), {}
    for index, name in enumerate(views.names):
        if views.has_masks:
            result, capacities = refine_view(subject, _photograph(views, index), how)
            subject = replace(subject, pipeline=replace(subject.pipeline, capacities=capacities))
            cameras[name] = _refined(result, views, index)
        else:  # alpha is one everywhere: the object would be enlarged to fill the photograph
            cameras[name] = _kept(views, index, "there are no masks")
        if on_view is not None:
            on_view(ViewProgress(index + 1, len(views), name, cameras[name]))
    return RefinedSplit(views.width, views.height, cameras)


def _photograph(views: Views, index: int) -> PosedPhotograph:
    """Return a view with its initial camera."""
    valid = np.ones((views.height, views.width), np.float32)
    return PosedPhotograph(
        camera=views.camera([index]),
        image=jnp.asarray(views.clipped([index])[0]),
        valid=jnp.asarray(valid if views.valid is None else views.valid[index]),
    )


def _kept(
    views: Views, index: int, note: str, *, rms: float = 0.0, iterations: int = 0
) -> RefinedCamera:
    """Return the initial camera of a view; ``rms`` is its error, and stays what it was."""
    return RefinedCamera(
        world_to_camera=views.world_to_camera[index],
        intrinsics=views.intrinsics[index],
        exposure=1.0 if views.exposure is None else float(views.exposure[index]),
        residual_before=rms,
        residual_after=rms,
        iterations=iterations,
        accepted=False,
        note=note,
        white_balance=np.ones(3) if views.white_balance is None else views.white_balance[index],
    )


def _refined(result: Refinement, views: Views, index: int) -> RefinedCamera:
    """Return the refined camera of a view, or the initial one where refinement did not help."""
    note = _refusal(result)
    initial_camera = _kept(
        views, index, note, rms=float(result.before.rms), iterations=int(result.iterations)
    )
    if note:
        return initial_camera
    pose = np.asarray(result.camera.world_to_camera[0], np.float64)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right  # rigid in double precision
    lens = views.intrinsics[index].astype(np.float64)
    lens[[0, 1], [0, 1]] *= np.exp(UNIT * float(result.parameters[6]))
    return replace(
        initial_camera,
        world_to_camera=pose,
        intrinsics=lens,
        exposure=initial_camera.exposure * float(np.exp(UNIT * float(result.parameters[7]))),
        residual_after=float(result.after.rms),
        accepted=True,
        white_balance=initial_camera.white_balance
        * np.exp(np.asarray(log_balance(UNIT * result.parameters), float)),
    )


def with_mean_balance(splits: Mapping[str, RefinedSplit]) -> dict[str, RefinedSplit]:
    """Divide the factors of white balance by their mean over the training views.

    A tint of all photographs that the light is found from cannot be told from a tint of the light;
    only differences between views belong to the views.

    Parameters
    ----------
    splits : refined splits by name. All are divided by the same mean: that over the views of
        ``train``. Without ``train`` they stay, since other views cannot change the light.

    Returns
    -------
    The splits with the new factors, by name.
    """
    if "train" not in splits:
        return dict(splits)
    training_cameras = splits["train"].cameras.values()
    mean_balance = np.mean([camera.white_balance for camera in training_cameras], axis=0)

    def divided(split: RefinedSplit) -> RefinedSplit:
        cameras = {
            name: replace(camera, white_balance=camera.white_balance / mean_balance)
            for name, camera in split.cameras.items()
        }
        return replace(split, cameras=cameras)

    return {name: divided(split) for name, split in splits.items()}


def _refusal(result: Refinement) -> str:
    """Say why a view keeps its camera; "" where it does not."""
    if float(result.before.covered) == 0:
        return "the mask is empty"
    if float(result.before.rendered) == 0:
        return "nothing of the object is visible"
    if not float(result.after.cost) < float(result.before.cost):
        return "the error did not fall"
    return ""
