"""The composition: parameters and cameras in, images out; the only module that sees every stage.

`reconstruct` runs what depends neither on the light nor on the view (isosurface, adapter,
materials), `illuminate_asset` what does not depend on the view, `render_lit` the rest (visibility,
shading, rasterisation). `render_views` is the last two in a row, `render` all three.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from geosplat_jax.adapter import (
    GAUSSIANS_PER_FACE,
    face_gaussians,
    shift_inwards,
    vertex_gaussians,
)
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Camera, EnvLight, Gaussians, Grid, Materials, Mesh
from geosplat_jax.geometry import face_normals_and_areas, isosurface, vertex_normals
from geosplat_jax.materials import attributes_at, indirect_logits
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.rays.grid_index import Accelerator, build_accelerator
from geosplat_jax.splats.projection import project
from geosplat_jax.splats.rasterize import (
    TileLists,
    composite,
    find_visible,
    gather_visible,
)
from geosplat_jax.transport.base import (
    DENOISER_INPUTS,
    Illumination,
    Receivers,
    denoised,
    illuminate,
    shade_rows,
)
from geosplat_jax.transport.split_sum import Shaded

AOV_NAMES = (
    "albedo",
    "roughness",
    "metallic",
    "normal",
    "depth",
    "diffuse",
    "specular",
    "specular_radiance",
)


class Asset(eqx.Module):
    """The view-independent half of a render: surface, splats and their materials.

    Attributes
    ----------
    mesh : the isosurface.
    gaussians : N splats that sit on it.
    outward : (N, 3) geometric normal behind each splat, for culling.
    materials : attributes of the N splats.
    deviation : () mean L_dev of the isosurface, in half the longest side of the grid's box.
    usage : true needs of the buffers so far.
    anchors : (N, 3) where the splats' rays start, on the faces; None for the means.
    accelerator : what rays are traced against; None where none are.
    coefficients : (N, c) learned indirect light, or None.
    """

    mesh: Mesh
    gaussians: Gaussians
    outward: Float[Array, "N 3"]
    materials: Materials
    deviation: Float[Array, ""]
    usage: Usage
    anchors: Float[Array, "N 3"] | None = None
    accelerator: Accelerator | None = None
    coefficients: Float[Array, "N c"] | None = None

    def receivers(self, mask: Bool[Array, " N"] | None = None) -> Receivers:
        """Return the splats as light sees them: all, or those of a mask."""
        return Receivers(
            anchors=self.gaussians.means if self.anchors is None else self.anchors,
            normals=self.gaussians.normals,
            outward=self.outward,
            mask=self.gaussians.mask if mask is None else self.gaussians.mask & mask,
            materials=self.materials,
            coefficients=self.coefficients,
            accelerator=self.accelerator,
        )


class RenderOutput(eqx.Module):
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
        If ``sampling`` is neither, or vertices are to be shaded by Monte Carlo.
    """
    if sampling not in ("face", "vertex"):
        raise ValueError(f'sampling must be "face" or "vertex", got {sampling!r}')
    if sampling == "vertex" and model.transport.method != "split_sum":
        raise ValueError("Monte Carlo shading needs face sampling, whose splats lie on a face")
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
    anchors, coefficients = jax.lax.stop_gradient(gaussians.means), None
    if model.transport.method == "monte_carlo" and model.material.indirect_outputs:
        coefficients = indirect_logits(
            params.material,
            anchors,
            spec=model.material,
            center=center,
            half_extent=half_extent,
        )
    if shift is not None and sampling == "face":
        gaussians = shift_inwards(gaussians, *face_normals_and_areas(mesh), shift)
    needed, accelerator = surface.usage, None
    if model.transport.is_traced:
        accelerator = build_accelerator(surface, context.grid, capacities=capacities)
        needed = capacity_module.combine(needed, accelerator.usage)
    return Asset(
        mesh=mesh,
        gaussians=gaussians,
        outward=outward,
        materials=materials,
        deviation=surface.deviation / half_extent,
        usage=needed,
        anchors=anchors,
        accelerator=accelerator,
        coefficients=coefficients,
    )


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


def _lists_of_views(
    asset: Asset, camera: Camera, context: Context, *, model: Model, capacities: Capacities
) -> list[TileLists]:
    """List what every view can see."""
    # Unrolled: independent views let XLA run their single-threaded sorts side by side.
    return [
        _visible_in_view(
            asset.gaussians,
            asset.outward,
            camera.world_to_camera[view],
            camera.intrinsics[view],
            context.grid,
            model=model,
            capacities=capacities,
            image_shape=(camera.height, camera.width),
        )
        for view in range(camera.world_to_camera.shape[0])
    ]


def _shade_views(
    key: Key[Array, ""] | None,
    asset: Asset,
    illumination: Illumination,
    lists: list[TileLists],
    camera: Camera,
    context: Context,
    *,
    model: Model,
) -> list[Shaded]:
    """Shade the visible splats of all views in one go."""
    index = jnp.concatenate([view.index for view in lists])
    sizes = [view.index.shape[0] for view in lists]
    centers = jnp.concatenate(
        [
            jnp.broadcast_to(_camera_center(pose)[None, :], (size, 3))
            for pose, size in zip(camera.world_to_camera, sizes, strict=True)
        ]
    )
    means = gather_visible(index, asset.gaussians.means)
    shaded = shade_rows(
        key,
        asset.receivers(),
        index,
        safe_normalize(centers - means),
        jax.tree.map(lambda x: gather_visible(index, x), asset.materials),
        illumination,
        context.fg_table,
        transport=model.transport,
        baked_diffuse=model.baked_diffuse,
    )
    starts = [sum(sizes[:view]) for view in range(len(sizes))]
    return [
        jax.tree.map(lambda x, a=start, n=size: x[a : a + n], shaded)
        for start, size in zip(starts, sizes, strict=True)
    ]


def _composite_view(
    asset: Asset,
    shaded: Shaded,
    lists: TileLists,
    world_to_camera: Float[Array, "4 4"],
    intrinsics: Float[Array, "3 3"],
    context: Context,
    *,
    model: Model,
    image_shape: tuple[int, int],
    aov_names: tuple[str, ...],
) -> tuple[Float[Array, "H W c"], Float[Array, "H W"]]:
    """Rasterise one view; the channels are rgb and then the AOVs in order."""
    height, width = image_shape

    def seen(values: Float[Array, "N ..."], padding: float = 0.0) -> Float[Array, "M ..."]:
        return gather_visible(lists.index, values, padding=padding)

    gaussians = asset.gaussians
    splats = project(
        seen(gaussians.means),
        seen(gaussians.quats),
        seen(gaussians.scales, padding=1.0),
        world_to_camera=world_to_camera,
        intrinsics=intrinsics,
        height=height,
        width=width,
        near=_near_plane(context.grid, model),
    )
    channels = {
        "albedo": lambda: seen(asset.materials.albedo),
        "roughness": lambda: seen(asset.materials.roughness)[:, None],
        "metallic": lambda: seen(asset.materials.metallic)[:, None],
        "normal": lambda: seen(gaussians.normals),
        "depth": lambda: splats.depths[:, None],
        "diffuse": lambda: shaded.diffuse_light,
        "specular": lambda: shaded.specular_light,
        "specular_radiance": lambda: shaded.specular,
    }
    features = jnp.concatenate([shaded.rgb] + [channels[name]() for name in aov_names], axis=-1)
    return composite(
        splats,
        seen(gaussians.opacities),
        features,
        lists,
        height=height,
        width=width,
        tile_size=model.tile_size,
    )


def _named(stacked: Float[Array, "... c"], aov_names: tuple[str, ...]) -> dict[str, jax.Array]:
    """Cut the channels after rgb into AOVs."""
    widths = {"roughness": 1, "metallic": 1, "depth": 1}
    aovs, start = {}, 3
    for name in aov_names:
        stop = start + widths.get(name, 3)
        aovs[name] = stacked[..., start:stop]
        start = stop
    return aovs


def illuminate_asset(
    asset: Asset,
    light: EnvLight,
    context: Context,
    *,
    model: Model,
    key: Key[Array, ""] | None = None,
    mask: Bool[Array, " N"] | None = None,
) -> Illumination:
    """Prepare a light for all views of an asset; Monte Carlo needs a key (see `illuminate`).

    Parameters
    ----------
    mask : (N,) splats that some view will see; all by default.
    """
    receivers = asset.receivers(mask)
    return illuminate(key, receivers, light, context.operators, transport=model.transport)


def _render_listed(
    asset: Asset,
    illumination: Illumination,
    lists: list[TileLists],
    camera: Camera,
    context: Context,
    *,
    model: Model,
    aov_names: tuple[str, ...],
    key: Key[Array, ""] | None,
) -> RenderOutput:
    """Shade and composite what the lists hold."""
    shaded = _shade_views(key, asset, illumination, lists, camera, context, model=model)
    transport, asked = model.transport, aov_names
    if transport.is_denoised:
        aov_names = tuple(dict.fromkeys(asked + DENOISER_INPUTS))
    views, alphas = [], []
    for view, (parts, listed) in enumerate(zip(shaded, lists, strict=True)):
        image, alpha = _composite_view(
            asset,
            parts,
            listed,
            camera.world_to_camera[view],
            camera.intrinsics[view],
            context,
            model=model,
            image_shape=(camera.height, camera.width),
            aov_names=aov_names,
        )
        images = {"rgb": image[..., :3], **_named(image, aov_names)}
        if transport.is_denoised:
            focal = camera.intrinsics[view, 0, 0]
            images = denoised(images, alpha, spec=transport.denoise, focal=focal)
        views.append({name: images[name] for name in ("rgb", *asked)})
        alphas.append(alpha)
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *views)
    usage = capacity_module.combine(asset.usage, *(listed.usage for listed in lists))
    return RenderOutput(stacked.pop("rgb"), jnp.stack(alphas), stacked, usage)


def _require_known(aov_names: tuple[str, ...]) -> None:
    """Refuse unknown AOVs."""
    unknown = set(aov_names) - set(AOV_NAMES)
    if unknown:
        raise ValueError(f"unknown AOVs {sorted(unknown)}; expected some of {AOV_NAMES}")


def render_lit(
    asset: Asset,
    illumination: Illumination,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
    aov_names: tuple[str, ...] = (),
    key: Key[Array, ""] | None = None,
) -> RenderOutput:
    """Render an asset under a prepared light from every camera; see `render_views`."""
    _require_known(aov_names)
    lists = _lists_of_views(asset, camera, context, model=model, capacities=capacities)
    return _render_listed(
        asset, illumination, lists, camera, context, model=model, aov_names=aov_names, key=key
    )


def render_views(
    asset: Asset,
    light: EnvLight,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
    aov_names: tuple[str, ...] = (),
    key: Key[Array, ""] | None = None,
) -> RenderOutput:
    """Render an asset under a light from every camera.

    Visibility, depth order and samples carry no gradient; everything else does.

    Parameters
    ----------
    key : of all samples; the split sum needs none.

    Raises
    ------
    ValueError
        If an AOV is not one of `AOV_NAMES`, or Monte Carlo gets no key.
    """
    _require_known(aov_names)
    lists = _lists_of_views(asset, camera, context, model=model, capacities=capacities)
    light_key, view_key = (None, None) if key is None else jax.random.split(key)
    # What no view of the batch sees needs no light of its own.
    seen = jnp.zeros((asset.outward.shape[0],), bool)
    for listed in lists:
        seen = seen.at[listed.index].set(True, mode="drop")
    # Traced indirect light comes from splats that no view sees, too.
    mask = None if model.transport.finds_nearest else seen
    illumination = illuminate_asset(asset, light, context, model=model, key=light_key, mask=mask)
    return _render_listed(
        asset, illumination, lists, camera, context, model=model, aov_names=aov_names, key=view_key
    )


def render(
    params: Params,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
    sampling: str = "face",
    aov_names: tuple[str, ...] = (),
    key: Key[Array, ""] | None = None,
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
        key=key,
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
    parts = [surface.usage, jax.tree.map(jnp.max, views)]
    if model.transport.is_traced:
        parts.append(build_accelerator(surface, context.grid, capacities=capacities).usage)
    return capacity_module.combine(*parts)
