"""The method as one object: ``pipeline.render(params, camera)``, ``pipeline.loss(params, batch)``.

A `Pipeline` is a pytree: its arrays are constants of training, its static fields say which surface,
splats, transport and terms are meant. Nothing is threaded beside it::

    (total, report), gradient = jax.value_and_grad(pipeline.loss, has_aux=True)(params, batch)

The loss is a mean over views of `Pipeline.view_loss`, weighted by each view's share of the pixels
that count (`Batch.shares`), plus `Pipeline.shared_loss`. Training makes the same gradient from
these parts, see `fit.gradient`.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.capacity import Usage, combine
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.numerics import safe_log
from geosplat_jax.core.types import Batch, EnvLight
from geosplat_jax.losses import (
    Objective,
    SharedInputs,
    ViewInputs,
    shared_terms,
    term_aovs,
    view_terms,
)
from geosplat_jax.render import Asset, Params, RenderPipeline
from geosplat_jax.splats.tiles import TileLists
from geosplat_jax.transport.base import Illumination

_DECIBEL = 10.0 / 2.302585092994046
_SHARED_STREAM = 2**31
_LIGHT_STREAM = 2**31 + 1
_RESIDUAL_STREAM = 2**31 + 2
"""Numbers that are folded into a key for streams of their own; those of the views count from 0."""


class ViewReport(eqx.Module):
    """Report about one view, or the mean over several views.

    Attributes
    ----------
    terms : unweighted terms of the loss, by name.
    mse : () mean squared difference of the linear images.
    usage : true needs of the view's buffers.
    """

    terms: dict[str, Float[Array, ""]]
    mse: Float[Array, ""]
    usage: Usage

    def times(self, share: Float[Array, ""]) -> "ViewReport":
        """Multiply terms and squared difference by the share of a view in a mean."""
        terms = {name: share * term for name, term in self.terms.items()}
        return ViewReport(terms, share * self.mse, self.usage)

    def plus(self, other: "ViewReport") -> "ViewReport":
        """Add two reports that were scaled; of the needs, take the larger."""
        terms = {name: term + other.terms[name] for name, term in self.terms.items()}
        return ViewReport(terms, self.mse + other.mse, combine(self.usage, other.usage))


class LossReport(eqx.Module):
    """Report about a training step.

    Attributes
    ----------
    terms : unweighted value of every term that has a weight.
    psnr : () decibels of the training images over their backgrounds; linear, exposed and softly
        clipped at one (`core.color.tone_map`).
    splat_count, face_count : () int32.
    usage : true needs of every buffer.
    carry : what the transport keeps for the next step.
    """

    terms: dict[str, Float[Array, ""]]
    psnr: Float[Array, ""]
    splat_count: Int[Array, ""]
    face_count: Int[Array, ""]
    usage: Usage
    carry: object = None


class Pipeline(RenderPipeline):
    """`RenderPipeline` with an objective.

    Attributes
    ----------
    weights : of the terms by name (see `losses.term_names` and `SurfaceModel.penalties`); terms
        without one are not computed. Arrays, so that schedules cost no compilation.
    objective : static choices.
    """

    weights: dict[str, Float[Array, ""]] = eqx.field(default_factory=dict)
    objective: Objective = eqx.field(static=True, default=Objective())

    def loss(self, params: Params, batch: Batch) -> tuple[Float[Array, ""], LossReport]:
        """Evaluate Eq. 19 on a batch of views; differentiate in ``params`` with ``has_aux=True``.

        Samples are constants. Where the transport draws a second set of them
        (`Transport.for_residual`), the value comes from the second image and the gradient is not
        its derivative; see `residual_image`.

        Returns
        -------
        total : () weighted sum of the terms. Valid only where ``fits(report.usage, capacities)``.
        report : see `LossReport`.
        """
        asset = self.reconstruct(params)
        views = [batch.view(number) for number in range(batch.camera.count)]
        lists = [self.visible(asset.splats, view.camera) for view in views]
        is_seen = self.points_seen(asset, lists)
        lights, carry = self.lights(asset, params.light, is_seen, batch)
        residual_lights = self.residual_lights(asset, params.light, is_seen, batch)
        total, shared = self.shared_loss(params, asset, lights, batch)
        reports = []
        for view, view_lists, share in zip(views, lists, batch.shares, strict=True):
            residual = self.residual_image(
                params.log_exposure, asset, residual_lights, view_lists, view
            )
            value, report = self.view_loss(
                params.log_exposure, asset, lights, view_lists, view, residual
            )
            total = total + share * value
            reports.append(report.times(share))
        mean = reports[0]
        for report in reports[1:]:
            mean = mean.plus(report)
        return total, self.report(asset, mean, shared, carry)

    def lights(
        self, asset: Asset, light: EnvLight, seen: Bool[Array, " N"] | None, batch: Batch
    ) -> tuple[Illumination, object]:
        """Prepare the light of a step for all its views.

        Parameters
        ----------
        asset, light : what is lit, and by what.
        seen : (N,) splats that some view sees; None for all.
        batch : whose key and carry are used.

        Returns
        -------
        illumination : for `view_loss`.
        carry : what the transport keeps for the next step.
        """
        key = jax.random.fold_in(batch.key, _LIGHT_STREAM)
        return self.illuminate(asset, light, key=key, mask=seen, carry=batch.carry)

    def residual_lights(
        self, asset: Asset, light: EnvLight, seen: Bool[Array, " N"] | None, batch: Batch
    ) -> Illumination | None:
        """Prepare the light with other samples for `residual_image`; not differentiable.

        None where the residual comes from the image that is differentiated.
        """
        transport = self.transport.for_residual()
        if transport is None:
            return None
        asset, light = jax.lax.stop_gradient((asset, light))
        key = jax.random.fold_in(batch.key, _RESIDUAL_STREAM)
        return replace(self, transport=transport).illuminate(asset, light, key=key, mask=seen)[0]

    def residual_image(
        self,
        log_exposure: Float[Array, ""],
        asset: Asset,
        lights: Illumination | None,
        lists: TileLists,
        view: Batch,
    ) -> Float[Array, "1 H W 3"] | None:
        """Render a view with samples of its own, as a constant from which Eq. 13 is evaluated.

        The gradient of a distance is the residual times the derivative of the image. Computed from
        the same samples, these two factors are correlated: the mean of their product is not the
        product of their means, and descent lowers whatever makes noise, bright suns above all
        (docs/transport.md). With independent samples the mean of the product is the product of the
        means. For a squared distance that is the gradient at the mean image; for L1 and SSIM it is
        close to it. Eq. 18 is evaluated on the first image.

        Returns
        -------
        (1, H, W, 3) tone-mapped colours, premultiplied, without gradient; None where the transport
        draws no second set of samples.
        """
        transport = self.transport.for_residual()
        if transport is None or lights is None:
            return None
        output = replace(self, transport=transport).render_view(
            asset, lights, lists, view.camera, key=jax.random.fold_in(view.key, _RESIDUAL_STREAM)
        )
        return jax.lax.stop_gradient(tone_map(output.rgb, log_exposure))

    def view_loss(
        self,
        log_exposure: Float[Array, ""],
        asset: Asset,
        lights: Illumination,
        lists: TileLists,
        view: Batch,
        residual: Float[Array, "1 H W 3"] | None,
    ) -> tuple[Float[Array, ""], ViewReport]:
        """Evaluate the weighted terms of a single view.

        Parameters
        ----------
        log_exposure : () that of the parameters.
        asset, lights : see `reconstruct` and `lights`.
        lists : what the view can see, see `visible`.
        view : batch of one view, see `Batch.view`.
        residual : (1, H, W, 3) image that replaces the values of the rendered image, but not its
            derivative, see `residual_image`; None to use the rendered image for both.

        Returns
        -------
        value : () weighted sum of the view's terms.
        report : see `ViewReport`.
        """
        background_key, sample_key = jax.random.split(view.key)
        output = self.render_view(
            asset,
            lights,
            lists,
            view.camera,
            aov_names=term_aovs(self.weights),
            key=sample_key,
        )
        rgb = tone_map(output.rgb, log_exposure)
        if residual is not None:
            rgb = rgb + jax.lax.stop_gradient(residual - rgb)
        inputs = ViewInputs(view, output, rgb, log_exposure, self.objective, background_key)
        terms = view_terms(inputs, self.weights)
        return self._weighted(terms), ViewReport(terms, inputs.pair.mse, lists.usage)

    def shared_loss(
        self, params: Params, asset: Asset, lights: Illumination, batch: Batch
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Sum the weighted terms that do not depend on a view; also return them by name.

        Returns
        -------
        total : () weighted sum.
        terms : by name, unweighted.
        """
        key = jax.random.fold_in(batch.key, _SHARED_STREAM)
        transport = self.domain.adapted(self.transport)
        inputs = SharedInputs(
            params=params,
            asset=asset,
            surface=self.surface,
            fields=self.fields,
            objective=self.objective,
            key=key,
            transport=transport,
            lights=lights,
        )
        terms = shared_terms(inputs, self.weights)
        return self._weighted(terms), terms

    def report(
        self,
        asset: Asset,
        views: ViewReport,
        shared: dict[str, Float[Array, ""]],
        carry: object,
    ) -> LossReport:
        """Assemble the report of a step from the mean over its views and the shared terms."""
        terms = {**views.terms, **shared}
        return LossReport(
            terms={name: terms[name] for name in self.weights},
            psnr=-_DECIBEL * safe_log(views.mse),
            splat_count=asset.splats.count,
            face_count=asset.mesh.face_count,
            usage=combine(asset.usage, views.usage),
            carry=carry,
        )

    def _weighted(self, terms: dict[str, Float[Array, ""]]) -> Float[Array, ""]:
        """Sum up terms with their weights (Eq. 19)."""
        weighted_terms = [self.weights[name] * term for name, term in terms.items()]
        return jnp.sum(jnp.stack(weighted_terms)) if weighted_terms else jnp.zeros(())
