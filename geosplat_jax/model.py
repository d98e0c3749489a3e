"""What is learned, what it means, and what stays constant: the arguments of rendering."""

from dataclasses import dataclass

import equinox as eqx
from jaxtyping import Array, Float

from geosplat_jax.adapter import AdapterConstants
from geosplat_jax.core.types import EnvLight, Geometry, Grid
from geosplat_jax.materials import MaterialField, MaterialSpec
from geosplat_jax.splats.rasterize import DEFAULT_TILE_SIZE
from geosplat_jax.transport.base import Transport
from geosplat_jax.transport.environment import LightSpec, PrefilterOperators


class Params(eqx.Module):
    """Everything that is learned, and nothing else; the only differentiated argument of `loss`.

    Attributes
    ----------
    geometry : isosurface on the grid.
    material : attribute fields.
    light : environment map.
    log_exposure : () natural logarithm of the exposure before the tone map.
    """

    geometry: Geometry
    material: MaterialField
    light: EnvLight
    log_exposure: Float[Array, ""]


@dataclass(frozen=True)
class Model:
    """Static description of what `Params` mean and how they are rendered; hashable.

    Attributes
    ----------
    adapter, material, light, transport : constants of the stages.
    baked_diffuse : the authors' stage 1, where the albedo field *is* the diffuse radiance and is
        not multiplied by irradiance.
    attribute_gradient : let the attributes pull on the geometry: the fields are differentiated in
        the Gaussians' positions. Off, as in the authors' code, they move with the surface.
    cull_backfaces : leave out Gaussians whose face looks away from the camera. Half the work on a
        closed surface; the far side no longer shines through the gaps between splats.
    tile_size : edge of the rasteriser's square tiles, pixels.
    near : near plane, in half the longest side of the grid's box.
    """

    adapter: AdapterConstants = AdapterConstants()
    material: MaterialSpec = MaterialSpec()
    light: LightSpec = LightSpec()
    transport: Transport = Transport()
    baked_diffuse: bool = False
    attribute_gradient: bool = False
    cull_backfaces: bool = True
    tile_size: int = DEFAULT_TILE_SIZE
    near: float = 0.01


class Context(eqx.Module):
    """Arrays that rendering needs and training does not change.

    Attributes
    ----------
    grid : where the isosurface lives.
    operators : linear maps that prefilter the light.
    fg_table : the split sum's precomputed BRDF integral.
    """

    grid: Grid
    operators: PrefilterOperators
    fg_table: Float[Array, "n m 2"]
