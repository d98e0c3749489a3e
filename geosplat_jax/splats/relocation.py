"""Relocation of a fixed number of splats by Markov chain Monte Carlo (Kheradmand et al. 2024).

Training is treated as sampling: positions receive noise, and splats that have become transparent
are moved onto opaque ones, so that several splats represent what one did before. Their opacities
and scales are chosen so that the image stays the same (Eq. 9 of that paper). All shapes are static.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.core.numerics import safe_log, safe_logit
from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.splats.radiance import RadianceSplats

DEAD_OPACITY = 0.005
"""A splat of at most this opacity is dead: it is never a target of a move."""

_HIGHEST_OPACITY = 1.0 - 1e-6
"""Largest shared opacity; at 1 the logit would be infinite."""
_GATE_SHARPNESS = 100.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_FARTHEST = 4.5  # end of the integral over t in Eq. 9; the rest is below 1e-9


def shared_opacity(
    opacities: Float[Array, " N"], sharers: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Opacity of several equal splats at one place that together are as opaque as a single one.

    ``1 - (1 - o)^(1 / n)``, in a form that keeps its digits for small opacities.

    Parameters
    ----------
    opacities : (N,) o, of the single splat, in [0, 1).
    sharers : (N,) n, number of splats that replace it, at least 1.

    Returns
    -------
    (N,) opacity of each of them, in [0, 1).
    """
    return -jnp.expm1(jnp.log1p(-opacities) / sharers)


def shared_scale_factor(
    opacities: Float[Array, " N"], shared: Float[Array, " N"], sharers: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Factor on the scales of several equal splats at one place that replace a single one.

    It keeps the integral of alpha along any line through their centre (Eq. 9). The factor is
    ``o / D``, where D is ``2 / sqrt(pi)`` times the integral of ``1 - (1 - o' exp(-t^2))^n`` over
    t > 0. A Gauss-Legendre rule of 16 points evaluates it with an error of 4e-7 at opacities up to
    .999, and of 2e-5 at any opacity.

    Parameters
    ----------
    opacities : (N,) o, of the single splat, in (0, 1).
    shared : (N,) o', of each of the splats that replace it; see `shared_opacity`.
    sharers : (N,) n, number of splats that replace it, at least 1.

    Returns
    -------
    (N,) positive.
    """
    nodes = jnp.asarray(0.5 * _FARTHEST * (_NODES + 1.0), opacities.dtype)
    weights = jnp.asarray(0.5 * _FARTHEST * _WEIGHTS * 2.0 / np.sqrt(np.pi), opacities.dtype)
    alpha = shared[:, None] * jnp.exp(-nodes * nodes)[None, :]
    coverage = -jnp.expm1(sharers[:, None] * jnp.log1p(-alpha))
    return opacities / jnp.sum(coverage * weights[None, :], axis=1)


def _drawn_rows(
    weights: Float[Array, " N"], key: Key[Array, ""], count: int
) -> Int[Array, " count"]:
    """Draw rows with a probability in proportion to their weights; never one without weight."""
    # In float32 the sums of a parallel scan may decrease, and may grow at rows without weight.
    running_sum = jax.lax.cummax(jnp.where(weights > 0.0, jnp.cumsum(weights), 0.0))
    last_row = jnp.max(jnp.where(weights > 0.0, jnp.arange(weights.shape[0]), 0)).astype(jnp.int32)
    draws = jax.random.uniform(key, (count,), weights.dtype) * running_sum[-1]
    rows = jnp.searchsorted(running_sum, draws, side="right").astype(jnp.int32)
    return jnp.minimum(rows, last_row)


def relocate(
    splats: RadianceSplats,
    is_free: Bool[Array, " N"],
    is_live: Bool[Array, " N"],
    key: Key[Array, ""],
) -> tuple[RadianceSplats, Bool[Array, " N"]]:
    """Move free splats onto others without changing the image (Eq. 9).

    Every free splat becomes a copy of a target, which is drawn with a probability proportional to
    its opacity; a target and its copies then share its opacity and extent. Nothing changes where no
    splat can be a target.

    Parameters
    ----------
    splats : N splats.
    is_free : (N,) rows to move; their parameters are discarded.
    is_live : (N,) rows that may be targets; free ones, and those of at most `DEAD_OPACITY`, never
        are.
    key : random key of the draws.

    Returns
    -------
    splats : N splats, in the same rows.
    is_changed : (N,) rows that were moved or were targets; an optimiser's moments of these rows are
        no longer valid.
    """
    opacities = splats.opacities
    is_candidate = is_live & ~is_free & (opacities > DEAD_OPACITY)
    weights = jnp.where(is_candidate, opacities, 0.0)
    target_rows = _drawn_rows(weights, key, splats.capacity)
    is_free = is_free & jnp.any(is_candidate)
    copies = jnp.zeros_like(opacities).at[target_rows].add(is_free.astype(opacities.dtype))
    sharers = 1.0 + copies
    old_opacities = jnp.clip(opacities, DEAD_OPACITY, _HIGHEST_OPACITY)
    shared_opacities = shared_opacity(old_opacities, sharers)
    factor = shared_scale_factor(old_opacities, shared_opacities, sharers)
    shared_opacities = jnp.clip(shared_opacities, DEAD_OPACITY, _HIGHEST_OPACITY)
    is_target = copies > 0.0
    logits = jnp.where(is_target, safe_logit(shared_opacities), splats.opacity_logits)
    log_scales = jnp.where(
        is_target[:, None], splats.log_scales + safe_log(factor)[:, None], splats.log_scales
    )
    thinned = replace(splats, opacity_logits=logits, log_scales=log_scales)
    source = jnp.where(is_free, target_rows, jnp.arange(splats.capacity, dtype=jnp.int32))
    return jax.tree.map(lambda leaf: leaf[source], thinned), is_free | is_target


def exploring_noise(
    splats: RadianceSplats, key: Key[Array, ""], *, rate: Float[Array, ""] | float
) -> Float[Array, "N 3"]:
    """Draw noise for the positions: as wide as the splat, nearly none above opacity .05 (Eq. 8).

    ``rate Sigma xi sigmoid(-100 (o - 0.005))`` with the covariance Sigma of the splat, its opacity
    o, and standard normal numbers xi.

    Parameters
    ----------
    splats : N splats.
    key : random key of the noise.
    rate : () learning rate of the positions times the strength of the noise.

    Returns
    -------
    (N, 3) displacements, world.
    """
    noise = jax.random.normal(key, splats.means.shape, jnp.float32).astype(splats.means.dtype)
    rotation = quaternion_to_matrix(splats.quats)
    local = jnp.einsum("nji,nj->ni", rotation, noise, precision="highest")
    spread = jnp.einsum(
        "nij,nj->ni", rotation, jnp.exp(2.0 * splats.log_scales) * local, precision="highest"
    )
    gate = jax.nn.sigmoid(-_GATE_SHARPNESS * (splats.opacities - DEAD_OPACITY))
    return rate * gate[:, None] * spread
