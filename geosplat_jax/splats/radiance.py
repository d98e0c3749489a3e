"""Splats that carry their own colour: vanilla 3D Gaussian splatting (Kerbl et al. 2023).

There is neither a mesh nor a light: the colour of a splat depends on the direction that it is seen
from, by spherical harmonics up to degree 3. Arrays have as many rows as there may ever be splats;
rows past the count are padding. Differentiable in all parameters.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.harmonics import HIGHEST_DEGREE, harmonic_degrees, harmonics
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Camera, learned
from geosplat_jax.splats.rasterize import DEFAULT_TILE_SIZE, rasterize

_MIDDLE = 0.5
"""Colour of a splat whose coefficients are all zero."""


class RadianceSplats(eqx.Module):
    """N splats, of which the first ones are in use.

    Attributes
    ----------
    means : (N, 3) world.
    log_scales : (N, 3) natural logarithms of standard deviations in world units.
    quats : (N, 4) (w, x, y, z), of any length.
    opacity_logits : (N,).
    base : (N, 3) coefficients of the constant harmonic, for colours in sRGB.
    rest : (N, 15, 3) coefficients of the others, in the order of `core.harmonics.harmonics`.
    """

    means: Float[Array, "N 3"] = learned("means")
    log_scales: Float[Array, "N 3"] = learned("scales")
    quats: Float[Array, "N 4"] = learned("quats")
    opacity_logits: Float[Array, " N"] = learned("opacities")
    base: Float[Array, "N 3"] = learned("base")
    rest: Float[Array, "N 15 3"] = learned("rest")

    @property
    def capacity(self) -> int:
        """Number of rows, padding included."""
        return self.means.shape[0]

    @property
    def opacities(self) -> Float[Array, " N"]:
        """Opacities in [0, 1], also of the padding."""
        return jax.nn.sigmoid(self.opacity_logits)

    @property
    def scales(self) -> Float[Array, "N 3"]:
        """Standard deviations, world units."""
        return jnp.exp(self.log_scales)


def colors_seen_from(
    splats: RadianceSplats, center: Float[Array, " 3"], *, degree: Int[Array, ""] | int
) -> Float[Array, "N 3"]:
    """Colours, (N, 3) sRGB, of splats that are seen from a point; clipped below at zero.

    Differentiable in the splats and the point. A splat at the point itself has no direction; its
    harmonics, which are polynomials of the direction, are evaluated at zero.

    Parameters
    ----------
    splats : N splats.
    center : (3,) the point, world.
    degree : highest degree of the harmonics that are used; may be traced.
    """
    directions = safe_normalize(splats.means - center[None, :])
    basis = harmonics(directions, degree=HIGHEST_DEGREE)
    is_used = jnp.asarray(harmonic_degrees(HIGHEST_DEGREE)) <= degree
    basis = jnp.where(is_used[None, :], basis, 0.0)
    coefficients = jnp.concatenate([splats.base[:, None, :], splats.rest], axis=1)
    values = jnp.sum(basis[:, :, None] * coefficients, axis=1)
    return jnp.maximum(_MIDDLE + values, 0.0)


def render_radiance(
    splats: RadianceSplats,
    count: Int[Array, ""] | int,
    camera: Camera,
    *,
    degree: Int[Array, ""] | int = HIGHEST_DEGREE,
    capacities: Capacities,
    near: Float[Array, ""] | float = 0.01,
    tile_size: int = DEFAULT_TILE_SIZE,
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W"], Usage]:
    """Render one view, in exact order of the depths in the camera.

    Parameters
    ----------
    splats : N splats.
    count : number of splats in use, which are the first rows.
    camera : of a single view.
    degree : highest degree of the harmonics; may be traced.
    capacities, tile_size : static; see `rasterize`.
    near : depth of the near plane, world units.

    Returns
    -------
    rgb : (H, W, 3) sRGB, premultiplied.
    alpha : (H, W) coverage in [0, 1].
    usage : true needs of the buffers. Where it exceeds ``capacities`` the image must be discarded.
    """
    view: dict[str, Any] = {
        "world_to_camera": camera.world_to_camera[0],
        "intrinsics": camera.intrinsics[0],
        "height": camera.height,
        "width": camera.width,
    }
    return rasterize(
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        colors_seen_from(splats, camera.centers[0], degree=degree),
        jnp.arange(splats.capacity, dtype=jnp.int32) < count,
        capacities=capacities,
        near=near,
        tile_size=tile_size,
        **view,
    )
