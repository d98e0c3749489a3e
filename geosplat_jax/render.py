"""The composition: parameters and cameras in, images out; the only module that sees every stage.

`reconstruct` runs what does not depend on the view (isosurface, adapter, materials), `render_views`
what does (visibility, shading, rasterisation). `render` is the two in a row.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax import capacity as capacity_module
from geosplat_jax.adapter import (
    GAUSSIANS_PER_FACE,
    AdapterConstants,
    face_gaussians,
    shift_inwards,
    vertex_gaussians,
)
from geosplat_jax.capacity import Capacities, Usage
from geosplat_jax.geometry import face_normals_and_areas, isosurface, vertex_normals
from geosplat_jax.light import LightSpec, PrefilteredLight, PrefilterOperators, prefilter
from geosplat_jax.materials import MaterialField, MaterialSpec, attributes_at
from geosplat_jax.numerics import safe_normalize
from geosplat_jax.projection import project
from geosplat_jax.pytree import register_pytree
from geosplat_jax.rasterize import (
    DEFAULT_TILE_SIZE,
    TileLists,
    composite,
    find_visible,
    gather_visible,
)
from geosplat_jax.scene import Camera, EnvLight, Gaussians, Geometry, Grid, Materials, Mesh
from geosplat_jax.shading import split_sum

AOV_NAMES = ("albedo", "roughness", "metallic", "normal", "depth", "diffuse", "specular")


@register_pytree
@dataclass(frozen=True)
class Params:
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
    adapter, material, light : constants of the stages.
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
    baked_diffuse: bool = False
    attribute_gradient: bool = False
    cull_backfaces: bool = True
    tile_size: int = DEFAULT_TILE_SIZE
    near: float = 0.01


@register_pytree
@dataclass(frozen=True)
class Context:
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


@register_pytree
@dataclass(frozen=True)
class Asset:
    """The view-independent half of a render: surface, splats and their materials.

    Attributes
    ----------
    mesh : the isosurface.
    gaussians : N splats that sit on it.
    outward : (N, 3) geometric normal behind each splat, for culling.
    materials : attributes of the N splats.
    deviation : () mean L_dev of the isosurface, in half the longest side of the grid's box.
    usage : true needs of the isosurface's buffers.
    """

    mesh: Mesh
    gaussians: Gaussians
    outward: Float[Array, "N 3"]
    materials: Materials
    deviation: Float[Array, ""]
    usage: Usage


@register_pytree
@dataclass(frozen=True)
class RenderOutput:
    """Images of V views, premultiplied by alpha.

    Attributes
    ----------
    rgb : (V, H, W, 3) linear radiance before exposure.
    alpha : (V, H, W) coverage.
    aovs : the requested extra channels by name, each (V, H, W, c); normals in world axes (unit
        before blending), depth along the camera's axis.
    usage : true needs of every buffer; the images are valid only where `capacity.fits`.
    """

    rgb: Float[Array, "V H W 3"]
    alpha: Float[Array, "V H W"]
    aovs: dict[str, Float[Array, "V H W c"]]
    usage: Usage


def grid_center_and_extent(grid: Grid) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
    """Centre of the grid and half of its longest side: the box that the fields are defined on."""
    cells = jnp.array(grid.shape, grid.origin.dtype)
    half = 0.5 * grid.cell_size * cells
    return grid.origin + half, jnp.max(half)


def _sample(
    mesh: Mesh, grid: Grid, *, model: Model, sampling: str
) -> tuple[Gaussians, Float[Array, "N 3"]]:
    """Run the adapter; return the Gaussians and the geometric normal behind each of them."""
    normals = vertex_normals(mesh)
    _, half_extent = grid_center_and_extent(grid)
    if sampling == "vertex":
        gaussians = vertex_gaussians(mesh, normals, constants=model.adapter, unit=half_extent)
        return gaussians, gaussians.normals
    gaussians = face_gaussians(mesh, normals, constants=model.adapter, unit=half_extent)
    face_normal, _ = face_normals_and_areas(mesh)
    return gaussians, jnp.repeat(face_normal, GAUSSIANS_PER_FACE, axis=0)


def reconstruct(
    params: Params, context: Context, *, model: Model, capacities: Capacities, sampling: str
) -> Asset:
    """Build surface, splats and materials: all that does not depend on a view.

    Parameters
    ----------
    params : learned parameters.
    context : constants; ``context.grid`` must be the grid of ``params.geometry``.
    model, capacities : static.
    sampling : ``"face"`` (six Gaussians a face) or ``"vertex"`` (one a vertex).

    Raises
    ------
    ValueError
        If ``sampling`` is neither.
    """
    if sampling not in ("face", "vertex"):
        raise ValueError(f'sampling must be "face" or "vertex", got {sampling!r}')
    surface = isosurface(params.geometry, context.grid, capacities=capacities, training=True)
    mesh = surface.mesh
    gaussians, outward = _sample(mesh, context.grid, model=model, sampling=sampling)
    center, half_extent = grid_center_and_extent(context.grid)
    # Attributes belong to the face, where a baked texture will be looked up, not to the shifted
    # splat.
    materials, shift = attributes_at(
        params.material,
        gaussians.means,
        spec=model.material,
        center=center,
        half_extent=half_extent,
        position_gradient=model.attribute_gradient,
    )
    if shift is not None and sampling == "face":
        gaussians = shift_inwards(gaussians, *face_normals_and_areas(mesh), shift)
    deviation = surface.deviation / half_extent
    return Asset(mesh, gaussians, outward, materials, deviation, surface.usage)


def _shade(
    means: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    materials: Materials,
    camera_center: Float[Array, " 3"],
    light: PrefilteredLight,
    context: Context,
    *,
    model: Model,
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Radiance of splats towards the camera, and its demodulated diffuse and specular light."""
    towards_viewer = safe_normalize(camera_center[None, :] - means)
    shaded = split_sum(
        materials,
        normals,
        towards_viewer,
        light,
        context.fg_table,
        baked_diffuse=model.baked_diffuse,
    )
    return shaded.rgb, shaded.diffuse_light, shaded.specular_light


def _camera_center(world_to_camera: Float[Array, "4 4"]) -> Float[Array, " 3"]:
    """Position of a rigid camera in the world."""
    return -jnp.einsum("ji,j->i", world_to_camera[:3, :3], world_to_camera[:3, 3])


def _near_plane(grid: Grid, model: Model) -> Float[Array, ""]:
    """Depth of the near plane, world units."""
    _, half_extent = grid_center_and_extent(grid)
    return model.near * half_extent


def _visible_in_view(
    gaussians: Gaussians,
    outward: Float[Array, "N 3"],
    world_to_camera: Float[Array, "4 4"],
    intrinsics: Float[Array, "3 3"],
    grid: Grid,
    *,
    model: Model,
    capacities: Capacities,
    image_shape: tuple[int, int],
) -> TileLists:
    """List what one view can see; no gradients."""
    gaussians, outward = jax.lax.stop_gradient((gaussians, outward))
    height, width = image_shape
    eligible = gaussians.mask
    if model.cull_backfaces:
        towards_camera = _camera_center(world_to_camera)[None, :] - gaussians.means
        eligible = eligible & (jnp.sum(outward * towards_camera, axis=-1) > 0)
    splats = project(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        world_to_camera=world_to_camera,
        intrinsics=intrinsics,
        height=height,
        width=width,
        near=_near_plane(grid, model),
    )
    return find_visible(
        splats,
        gaussians.opacities,
        eligible,
        height=height,
        width=width,
        tile_size=model.tile_size,
        capacities=capacities,
    )


def _render_view(
    asset: Asset,
    light: PrefilteredLight,
    context: Context,
    world_to_camera: Float[Array, "4 4"],
    intrinsics: Float[Array, "3 3"],
    *,
    model: Model,
    capacities: Capacities,
    image_shape: tuple[int, int],
    aov_names: tuple[str, ...],
) -> tuple[Float[Array, "H W c"], Float[Array, "H W"], Usage]:
    """Cull, shade and rasterise one view; the channels are rgb and then the AOVs in order."""
    height, width = image_shape
    lists = _visible_in_view(
        asset.gaussians,
        asset.outward,
        world_to_camera,
        intrinsics,
        context.grid,
        model=model,
        capacities=capacities,
        image_shape=image_shape,
    )

    def seen(values: Float[Array, "N ..."], padding: float = 0.0) -> Float[Array, "M ..."]:
        return gather_visible(lists.index, values, padding=padding)

    gaussians = asset.gaussians
    means, normals = seen(gaussians.means), seen(gaussians.normals)
    materials = jax.tree.map(seen, asset.materials)
    rgb, diffuse, specular = _shade(
        means, normals, materials, _camera_center(world_to_camera), light, context, model=model
    )
    splats = project(
        means,
        seen(gaussians.quats),
        seen(gaussians.scales, padding=1.0),
        world_to_camera=world_to_camera,
        intrinsics=intrinsics,
        height=height,
        width=width,
        near=_near_plane(context.grid, model),
    )
    channels = {
        "albedo": materials.albedo,
        "roughness": materials.roughness[:, None],
        "metallic": materials.metallic[:, None],
        "normal": normals,
        "depth": splats.depths[:, None],
        "diffuse": diffuse,
        "specular": specular,
    }
    features = jnp.concatenate([rgb] + [channels[name] for name in aov_names], axis=-1)
    image, alpha = composite(
        splats,
        seen(gaussians.opacities),
        features,
        lists,
        height=height,
        width=width,
        tile_size=model.tile_size,
    )
    return image, alpha, lists.usage


def render_views(
    asset: Asset,
    light: EnvLight,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
    aov_names: tuple[str, ...] = (),
) -> RenderOutput:
    """Render an asset under a light from every camera.

    Visibility and depth order carry no gradient; everything else does.

    Raises
    ------
    ValueError
        If an AOV is not one of `AOV_NAMES`.
    """
    unknown = set(aov_names) - set(AOV_NAMES)
    if unknown:
        raise ValueError(f"unknown AOVs {sorted(unknown)}; expected some of {AOV_NAMES}")
    prefiltered = prefilter(light, context.operators)
    images, alphas, usages = [], [], [asset.usage]
    # Unrolled: independent views let XLA run their single-threaded sorts side by side.
    for view in range(camera.world_to_camera.shape[0]):
        image, alpha, usage = _render_view(
            asset,
            prefiltered,
            context,
            camera.world_to_camera[view],
            camera.intrinsics[view],
            model=model,
            capacities=capacities,
            image_shape=(camera.height, camera.width),
            aov_names=aov_names,
        )
        images.append(image)
        alphas.append(alpha)
        usages.append(usage)
    stacked = jnp.stack(images)
    widths = {"roughness": 1, "metallic": 1, "depth": 1}
    aovs, start = {}, 3
    for name in aov_names:
        stop = start + widths.get(name, 3)
        aovs[name] = stacked[..., start:stop]
        start = stop
    return RenderOutput(stacked[..., :3], jnp.stack(alphas), aovs, capacity_module.combine(*usages))


def render(
    params: Params,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
    sampling: str = "face",
    aov_names: tuple[str, ...] = (),
) -> RenderOutput:
    """Render parameters from every camera: `reconstruct`, then `render_views`."""
    asset = reconstruct(params, context, model=model, capacities=capacities, sampling=sampling)
    return render_views(
        asset,
        params.light,
        camera,
        context,
        model=model,
        capacities=capacities,
        aov_names=aov_names,
    )


def visibility_usage(
    params: Params,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
    sampling: str = "face",
) -> Usage:
    """Count what every buffer needs for these views, without shading or gradients.

    Cheap to compile and to run: used to choose the first capacities. Counts of later stages are
    those of the truncated surface wherever an earlier stage overflowed, so grow and call again.
    """
    surface = isosurface(params.geometry, context.grid, capacities=capacities, training=True)
    gaussians, outward = _sample(surface.mesh, context.grid, model=model, sampling=sampling)

    def one_view(pose: tuple[Float[Array, "4 4"], Float[Array, "3 3"]]) -> Usage:
        lists = _visible_in_view(
            gaussians,
            outward,
            *pose,
            context.grid,
            model=model,
            capacities=capacities,
            image_shape=(camera.height, camera.width),
        )
        return lists.usage

    views = jax.lax.map(one_view, (camera.world_to_camera, camera.intrinsics))
    return capacity_module.combine(surface.usage, jax.tree.map(jnp.max, views))
