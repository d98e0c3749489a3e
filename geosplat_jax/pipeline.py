"""The method as one object: ``pipeline.render(params, camera)``, ``pipeline.loss(params, batch)``.

A `Pipeline` is a pytree: its arrays are constants of training, its static fields say which surface,
splats, transport and terms are meant. Nothing is threaded beside it::

    (total, report), gradient = jax.value_and_grad(pipeline.loss, has_aux=True)(params, batch)
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.capacity import Usage, combine
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.numerics import safe_log
from geosplat_jax.core.types import Batch
from geosplat_jax.losses import TERM_AOVS, LossInputs, Objective, evaluate
from geosplat_jax.render import Asset, Params, RenderPipeline
from geosplat_jax.transport.base import Transport

_DECIBEL = 10.0 / 2.302585092994046
_LIGHT_STREAM = 3
_RESIDUAL_STREAM = 4
"""Numbers of the random streams of the light's samples; 0 to 2 are those of the loss itself."""


class LossReport(eqx.Module):
    """What a step says about itself.

    Attributes
    ----------
    terms : unweighted value of every term that has a weight.
    psnr : () decibels of the composited training images, tone mapped, linear.
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
    weights : of the terms by name (see `losses.TERMS` and `SurfaceModel.penalties`); terms without
        one are not computed. Arrays, so that schedules cost no compilation.
    objective : static choices.
    """

    weights: dict[str, Float[Array, ""]] = eqx.field(default_factory=dict)
    objective: Objective = eqx.field(static=True, default=Objective())

    def loss(self, params: Params, batch: Batch) -> tuple[Float[Array, ""], LossReport]:
        """Evaluate Eq. 19 on a batch of views; differentiate in ``params`` with ``has_aux=True``.

        With a transport that draws samples, these are constants, and the gradient is not that of
        the returned, noisy value; see `_with_independent_residual`.

        Returns
        -------
        total : () weighted sum of the terms. Valid only where ``fits(report.usage, capacities)``.
        report : see `LossReport`.
        """
        asset = self.reconstruct(params)
        output = self.render_views(
            asset,
            params.light,
            batch.camera,
            aov_names=tuple(
                dict.fromkeys(aov for name in self.weights for aov in TERM_AOVS.get(name, ()))
            ),
            key=jax.random.fold_in(batch.key, _LIGHT_STREAM),
            carry=batch.carry,
        )
        rgb = tone_map(output.rgb, params.log_exposure)
        residual = self.transport.for_residual()
        if residual is not None:
            rgb = self._with_independent_residual(rgb, asset, params, batch, residual)
        inputs = LossInputs(
            params, batch, asset, output, rgb, self.surface, self.fields, self.objective
        )
        terms = evaluate(inputs, self.weights)
        weighted = [self.weights[name] * terms[name] for name in self.weights]  # Eq. 19
        report = LossReport(
            terms=terms,
            psnr=-_DECIBEL * safe_log(inputs.comparison.mse),
            splat_count=asset.splats.count,
            face_count=asset.mesh.face_count,
            usage=combine(output.usage),
            carry=output.carry,
        )
        return jnp.sum(jnp.stack(weighted)), report

    def _with_independent_residual(
        self,
        rgb: Float[Array, "V H W 3"],
        asset: Asset,
        params: Params,
        batch: Batch,
        transport: Transport,
    ) -> Float[Array, "V H W 3"]:
        """Return the values of an image drawn with other samples, with the derivative of ``rgb``.

        The gradient of a distance is residual times derivative. From the same samples the two
        depend on each other: the mean of the product is not the product of the means, and descent
        lowers whatever makes noise, the sun above all (docs/transport.md). From different samples
        it is, which for a squared distance is the gradient at the mean image, and for L1 and SSIM
        comes close. Eq. 18 keeps the first image.
        """
        output = replace(self, transport=transport).render_views(
            jax.lax.stop_gradient(asset),
            jax.lax.stop_gradient(params.light),
            batch.camera,
            key=jax.random.fold_in(batch.key, _RESIDUAL_STREAM),
        )
        value = tone_map(output.rgb, params.log_exposure)
        return rgb + jax.lax.stop_gradient(value - rgb)
