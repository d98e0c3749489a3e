"""The light's pyramid: whole regions of the light learn together, besides single texels.

Adam moves every texel of a light by at most its rate, however large the gradient is. A change on
which all texels of a sky agree is then learned no faster than the noise of a single texel, and
texels that no highlight reflects receive nothing but noise. Here the light is a sum of levels, each
of half the size of the one before, and Adam works on the numbers of every level. A region whose
texels agree then moves as one, while a single texel moves only by a part of the rate.

Only steps are summed, so that parameters, checkpoints and exports hold texels as usual: `to_levels`
turns the gradient in the texels into the gradient in the levels, which the optimiser sees, and
`from_levels` adds up its steps.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALLEST = 4
"""Rows and columns of the coarsest level, at least."""

_NEAR, _FAR = 0.75, 0.25
"""Weights of linear interpolation at a quarter of the way between two texels."""


def _doubled(values: Float[Array, "H W 3"]) -> Float[Array, "2*H 2*W 3"]:
    """Interpolate linearly to twice the rows and columns; columns go around."""

    def along(values: Array, before: Array, after: Array, axis: int) -> Array:
        halves = (_NEAR * values + _FAR * before, _NEAR * values + _FAR * after)
        shape = tuple(2 * n if k == axis else n for k, n in enumerate(values.shape))
        return jnp.stack(halves, axis=axis + 1).reshape(shape)

    above = jnp.concatenate([values[:1], values[:-1]])
    below = jnp.concatenate([values[1:], values[-1:]])
    values = along(values, above, below, 0)
    return along(values, jnp.roll(values, 1, axis=1), jnp.roll(values, -1, axis=1), 1)


def level_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """Return rows and columns of the levels of a light, the texels first."""
    sizes = [(height, width)]
    while min(sizes[-1]) >= 2 * _SMALLEST and not any(n % 2 for n in sizes[-1]):
        rows, columns = sizes[-1]
        sizes.append((rows // 2, columns // 2))
    return sizes


def _levels(gradient: Float[Array, "H W 3"]) -> tuple[Float[Array, "h w 3"], ...]:
    """Return the gradient in the numbers of every level, the texels first."""
    levels = [gradient]
    for rows, columns in level_sizes(*gradient.shape[:2])[1:]:
        half = jnp.zeros((rows, columns, 3), gradient.dtype)
        levels.append(jax.linear_transpose(_doubled, half)(levels[-1])[0])
    return tuple(levels)


def to_levels(gradient: Any) -> Any:
    """Replace the gradient in the light's texels by that in all levels of its pyramid.

    Parameters
    ----------
    gradient : gradient in the parameters, or the parameters where only shapes matter.

    Returns
    -------
    The same tree, with a tuple as ``light.radiance``: (H, W, 3), (H / 2, W / 2, 3) and so on. A
    level is halved while its sizes are even and at least 8; a light of odd size has a single level.
    """
    return eqx.tree_at(lambda tree: tree.light.radiance, gradient, _levels(gradient.light.radiance))


def from_levels(steps: Any, share: Float[Array, ""]) -> Any:
    """Add up the steps of the levels to steps of the texels.

    Parameters
    ----------
    steps : steps in the layout that `to_levels` returns.
    share : () share of its step that every level contributes; 0 for the whole step of the texels
        and none of the other levels.

    Returns
    -------
    The same tree, with (H, W, 3) steps as ``light.radiance``.
    """
    texels, *coarser_levels = steps.light.radiance
    if coarser_levels:
        *middle_levels, total = coarser_levels
        for level in reversed(middle_levels):
            total = _doubled(total) + level
        texels = jnp.where(share > 0, share * (texels + _doubled(total)), texels)
    return eqx.tree_at(
        lambda tree: tree.light.radiance, steps, texels, is_leaf=lambda x: isinstance(x, tuple)
    )
