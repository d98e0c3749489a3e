"""The composition: parameters and cameras in, images out; the only module that sees every part.

A `RenderPipeline` names the parts: a surface, splats on it, fields of attributes, a transport of
light and the domain in which it is evaluated. `RenderPipeline.reconstruct` runs what depends on
neither light nor view, `illuminate` what does not depend on the view, `render_lit` the rest;
`render` is all three.

Visibility, depth order, topology and light samples carry no gradient. By default attributes do not
pull on positions either (`MaterialSpec.position_gradient`), and the inward shift takes the normals
and areas of faces as constants; docs/gradients.md lists all such paths.
"""

import abc
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key
from pydantic import Field

from geosplat_jax.adapter import FaceSplats, SplatModel
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.settings import Positive, Variant, settings
from geosplat_jax.core.types import Camera, EnvLight, Mesh, Splats, learned
from geosplat_jax.materials import Attributes, MaterialField, MaterialSpec, attributes_at
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.splats.composite import composite_tiles, composite_tiles_forward
from geosplat_jax.splats.projection import Footprints, project
from geosplat_jax.splats.rasterize import (
    DEFAULT_TILE_SIZE,
    TileLists,
    composite,
    find_visible,
)
from geosplat_jax.surface.base import Surface, SurfaceModel
from geosplat_jax.transport.base import Illumination, Transport, Unlit

AOV_CHANNELS = {
    "albedo": 3,
    "roughness": 1,
    "metallic": 1,
    "normal": 3,
    "depth": 1,
    "diffuse": 3,
    "specular": 3,
    "specular_radiance": 3,
}
"""Extra images that can be asked for, and their channels.

``diffuse`` and ``specular`` are the light of either lobe without its colours (see `Shaded`),
``specular_radiance`` is what the specular lobe adds to the colour, ``normal`` is in world axes,
``depth`` along the camera's axis.
"""


class Params(eqx.Module):
    """Everything that is learned, and nothing else; the only differentiated argument of a loss.

    Attributes
    ----------
    geometry : shape of the surface, as its `SurfaceModel` understands it.
    material : attribute fields.
    light : environment map.
    log_exposure : () natural logarithm of the exposure before the tone map.
    splats : what the splats themselves have learned; None for those that follow the surface.
    """

    geometry: Any
    material: MaterialField
    light: EnvLight
    log_exposure: Float[Array, ""] = learned("exposure")
    splats: Any = None


@settings
class RasterSettings:
    """How splats become pixels; static and hashable."""

    cull_backfaces: bool = True
    """Leave out splats whose face looks away from the camera. Half the work on a closed surface;
    the far side no longer shines through the gaps between splats."""
    tile_size: Annotated[int, Field(ge=1, le=256)] = DEFAULT_TILE_SIZE
    """Edge of the square tiles in pixels."""
    near: Positive = 0.01
    """Near plane, in half extents of the box around the object."""

    def eligible(self, splats: Splats, camera: Camera) -> Bool[Array, " N"]:
        """Tell which splats are real and, with ``cull_backfaces``, face a single-view camera, (N,).

        The image borders and the near plane are not considered.
        """
        if not self.cull_backfaces:
            return splats.mask
        towards_camera = camera.centers - splats.means
        return splats.mask & (jnp.sum(splats.outward * towards_camera, axis=-1) > 0)


class Asset(eqx.Module):
    """The half of a render that depends neither on light nor on view.

    Attributes
    ----------
    surface : the extracted surface, with its mesh.
    splats : N splats on the surface.
    attributes : those of the N splats.
    index : the surface as rays see it; None where no rays are traced.
    usage : true needs of the buffers so far.
    """

    surface: Surface
    splats: Splats
    attributes: Attributes
    index: RayIndex | None
    usage: Usage

    @property
    def mesh(self) -> Mesh:
        """Triangles of the surface."""
        return self.surface.mesh


class RenderOutput(eqx.Module):
    """Images of V views, premultiplied by alpha.

    Attributes
    ----------
    rgb : (V, H, W, 3) linear radiance before exposure.
    alpha : (V, H, W) coverage.
    aovs : the requested extra channels by name, each (V, H, W, c), see `AOV_CHANNELS`; normals have
        unit length before they are blended.
    usage : true needs of every buffer; the images are valid only where `capacity.fits`.
    carry : what the transport keeps for the next step.
    """

    rgb: Float[Array, "V H W 3"]
    alpha: Float[Array, "V H W"]
    aovs: dict[str, Float[Array, "V H W c"]]
    usage: Usage
    carry: Any = None


@settings
class ShadingDomain(Variant, abc.ABC):
    """Where light transport is evaluated; static and hashable."""

    @property
    def uses_rays(self) -> bool:
        """Whether it traces rays of its own against the surface."""
        return False

    def without_rays(self) -> "ShadingDomain":
        """Return the same domain with points that need no rays."""
        return self

    @property
    def shades_splats(self) -> bool:
        """Whether its points are the splats, whose light serves every view."""
        return True

    def adapted(self, transport: Transport) -> Transport:
        """Return the transport as this domain evaluates it."""
        return transport

    @abc.abstractmethod
    def images(
        self,
        pipeline: "RenderPipeline",
        key: Key[Array, ""] | None,
        asset: Asset,
        illumination: Illumination,
        lists: TileLists,
        camera: Camera,
        names: tuple[str, ...],
    ) -> tuple[dict[str, Float[Array, "H W c"]], Float[Array, "H W"]]:
        """Make ``rgb`` and the named images of one view, premultiplied, and its coverage.

        Parameters
        ----------
        pipeline : whose transport, projection and blending are used.
        key : random key of the samples that depend on the viewer; None for a transport that draws
            none.
        asset, illumination : the asset, and its light as `Transport.prepare` returned it.
        lists, camera : what the view can see, and its camera.
        names : static; names of extra images, some of `AOV_CHANNELS`.

        Returns
        -------
        images : (H, W, c) each, by name, premultiplied.
        alpha : (H, W) coverage.
        """


@settings
class PerSplat(ShadingDomain, kind="per_splat"):
    """Splats are shaded, and their colours blended (Eq. 20)."""

    def images(
        self,
        pipeline: "RenderPipeline",
        key: Key[Array, ""] | None,
        asset: Asset,
        illumination: Illumination,
        lists: TileLists,
        camera: Camera,
        names: tuple[str, ...],
    ) -> tuple[dict[str, Float[Array, "H W c"]], Float[Array, "H W"]]:
        """Shade the visible splats towards the camera, then blend colours and attributes."""
        splats, gather = asset.splats, lists.gather
        means, normals = gather(splats.means), gather(splats.normals)
        attributes = jax.tree.map(gather, asset.attributes)
        materials = attributes.materials
        shaded = pipeline.transport.shade(
            key,
            jax.tree.map(gather, splats.points()),
            attributes,
            safe_normalize(camera.centers - means),
            illumination.take(lists.index),
            asset.index,
        )
        footprints = pipeline.project(means, gather(splats.quats), gather(splats.scales), camera)
        channels = {
            "rgb": shaded.rgb,
            "albedo": materials.albedo,
            "roughness": materials.roughness[:, None],
            "metallic": materials.metallic[:, None],
            "normal": normals,
            "depth": footprints.depths[:, None],
            "diffuse": shaded.diffuse_light,
            "specular": shaded.specular_light,
            "specular_radiance": shaded.specular,
        }
        channels = {name: channels[name] for name in ("rgb", *names)}
        return pipeline.blend(footprints, gather(splats.opacities), channels, lists, camera)


class RenderPipeline(eqx.Module):
    """How parameters become images: one choice for each part of the method, and constant arrays.

    Attributes
    ----------
    surface : what is extracted from ``params.geometry``.
    transport : how light arrives.
    fields : static shape of the attribute fields.
    splats : static; what is put on the surface.
    domain : static; where light transport is evaluated.
    raster : static settings of rasterisation.
    capacities : static sizes of every buffer.
    compositor : static; how tiles are blended, and in which mode that is differentiated: see
        `forward_mode`.
    """

    surface: SurfaceModel
    transport: Transport
    fields: MaterialSpec = eqx.field(static=True)
    splats: SplatModel = eqx.field(static=True, default=FaceSplats())
    domain: ShadingDomain = eqx.field(static=True, default=PerSplat())
    raster: RasterSettings = eqx.field(static=True, default=RasterSettings())
    capacities: Capacities = eqx.field(static=True, default=Capacities())
    compositor: Callable[..., Array] = eqx.field(static=True, default=composite_tiles)

    def forward_mode(self) -> "RenderPipeline":
        """Return the pipeline whose images can be differentiated in forward mode only.

        For derivatives in few numbers, such as the pose of a camera, with the asset held fixed:
        `reconstruct` has no forward mode (see `hashgrid.encode`).
        """
        return replace(self, compositor=composite_tiles_forward)

    def unlit(self) -> "RenderPipeline":
        """Return the pipeline without its light transport; it builds the same assets and lists."""
        return replace(self, transport=Unlit(self.transport.uses_rays))

    @property
    def uses_rays(self) -> bool:
        """Whether rays are traced against the surface."""
        return self.transport.uses_rays or self.domain.uses_rays

    def reconstruct(self, params: Params) -> Asset:
        """Build surface, splats and attributes: all that depends on neither light nor view."""
        surface = self.surface.extract(params.geometry, capacities=self.capacities)
        splats = self.splats.place(surface, params.splats, self.surface.box)
        # Attributes are looked up on the surface, where a baked texture will be, and not at the
        # splat below it.
        attributes = attributes_at(
            params.material, splats.anchors, self.surface.box, spec=self.fields
        )
        attributes = self.splats.dress(attributes, params.splats)
        splats = self.splats.settle(splats, surface, attributes)
        usage, index = surface.usage, None
        if self.uses_rays:
            index = self.surface.ray_index(surface, capacities=self.capacities)
            usage = capacity_module.combine(usage, index.usage)
        return Asset(surface, splats, attributes, index, usage)

    def project(
        self,
        means: Float[Array, "M 3"],
        quats: Float[Array, "M 4"],
        scales: Float[Array, "M 3"],
        camera: Camera,
    ) -> Footprints:
        """Project splats to the image of a camera with a single view."""
        return project(
            means,
            quats,
            scales,
            world_to_camera=camera.world_to_camera[0],
            intrinsics=camera.intrinsics[0],
            height=camera.height,
            width=camera.width,
            near=self.raster.near * self.surface.box.half_extent,
        )

    def blend(
        self,
        footprints: Footprints,
        opacities: Float[Array, " M"],
        channels: dict[str, Float[Array, "M c"]],
        lists: TileLists,
        camera: Camera,
    ) -> tuple[dict[str, Float[Array, "H W c"]], Float[Array, "H W"]]:
        """Blend named values of the visible splats front to back, and return their coverage.

        Parameters
        ----------
        footprints, opacities, channels : of the M rows of the lists.
        lists, camera : what the view can see, and its camera.
        """
        image, alpha = composite(
            footprints,
            opacities,
            jnp.concatenate(list(channels.values()), axis=-1),
            lists,
            height=camera.height,
            width=camera.width,
            tile_size=self.raster.tile_size,
            compositor=self.compositor,
        )
        widths = [values.shape[-1] for values in channels.values()]
        images = jnp.split(image, np.cumsum(widths)[:-1], axis=-1)
        return dict(zip(channels, images, strict=True)), alpha

    def visible(self, splats: Splats, camera: Camera) -> TileLists:
        """List what a camera with a single view can see; no gradients."""
        splats, camera = jax.lax.stop_gradient((splats, camera))
        return find_visible(
            self.project(splats.means, splats.quats, splats.scales, camera),
            splats.opacities,
            self.raster.eligible(splats, camera),
            height=camera.height,
            width=camera.width,
            tile_size=self.raster.tile_size,
            capacities=self.capacities,
        )

    def illuminate(
        self,
        asset: Asset,
        light: EnvLight,
        *,
        key: Key[Array, ""] | None = None,
        mask: Bool[Array, " N"] | None = None,
        carry: Any = None,
    ) -> tuple[Illumination, Any]:
        """Prepare a light for all views of an asset; see `Transport.prepare`.

        ``mask`` : (N,) splats that some view will see; all by default.
        """
        points = asset.splats.points(mask)
        transport = self.domain.adapted(self.transport)
        return transport.prepare(key, points, asset.attributes, light, asset.index, carry)

    def render_view(
        self,
        asset: Asset,
        illumination: Illumination,
        lists: TileLists,
        camera: Camera,
        *,
        aov_names: tuple[str, ...] = (),
        key: Key[Array, ""] | None = None,
    ) -> RenderOutput:
        """Render an asset under a prepared light from one camera; see `visible`, `render_views`."""
        _require_known(aov_names)
        names = tuple(dict.fromkeys(aov_names + self.transport.filter_inputs))
        images, alpha = self.domain.images(self, key, asset, illumination, lists, camera, names)
        images = self.transport.filtered(images, alpha, camera.intrinsics[0, 0, 0])
        usage = capacity_module.combine(asset.usage, lists.usage)
        aovs = {name: images[name][None] for name in aov_names}
        return RenderOutput(images["rgb"][None], alpha[None], aovs, usage)

    def render_lit(
        self,
        asset: Asset,
        illumination: Illumination,
        camera: Camera,
        *,
        aov_names: tuple[str, ...] = (),
        key: Key[Array, ""] | None = None,
    ) -> RenderOutput:
        """Render an asset under a prepared light from every camera; see `render_views`."""
        _require_known(aov_names)
        lists = self._lists(asset, camera)
        return self._render_listed(key, asset, illumination, lists, camera, aov_names)

    def render_views(
        self,
        asset: Asset,
        light: EnvLight,
        camera: Camera,
        *,
        aov_names: tuple[str, ...] = (),
        key: Key[Array, ""] | None = None,
        carry: Any = None,
    ) -> RenderOutput:
        """Render an asset under a light from every camera.

        Parameters
        ----------
        asset : from `reconstruct`.
        light : the environment.
        camera : V views.
        aov_names : static; some of `AOV_CHANNELS`.
        key : random key of all samples; None for a transport that draws none.
        carry : state that the transport returned in the step before, or None.

        Returns
        -------
        `RenderOutput` of the V views.

        Raises
        ------
        ValueError
            If an AOV is unknown, or samples get no key.
        """
        _require_known(aov_names)
        lists = self._lists(asset, camera)
        light_key, view_key = (None, None) if key is None else jax.random.split(key)
        mask = self.points_seen(asset, lists)
        illumination, carry = self.illuminate(asset, light, key=light_key, mask=mask, carry=carry)
        output = self._render_listed(view_key, asset, illumination, lists, camera, aov_names)
        return eqx.tree_at(lambda o: o.carry, output, carry, is_leaf=lambda x: x is None)

    def render(
        self,
        params: Params,
        camera: Camera,
        *,
        aov_names: tuple[str, ...] = (),
        key: Key[Array, ""] | None = None,
    ) -> RenderOutput:
        """Render parameters from every camera: `reconstruct`, then `render_views`."""
        _require_known(aov_names)
        asset = self.reconstruct(params)
        return self.render_views(asset, params.light, camera, aov_names=aov_names, key=key)

    def needs(self, params: Params, camera: Camera) -> Usage:
        """Count what every buffer needs for these views, without shading or gradients.

        Cheap to compile and to run: used to choose the first capacities. Counts of later buffers
        are those of the truncated surface wherever an earlier one overflowed, so grow and call
        again.
        """
        surface = self.surface.extract(params.geometry, capacities=self.capacities)
        splats = self.splats.place(surface, params.splats, self.surface.box)

        def one_view(matrices: tuple[Float[Array, "4 4"], Float[Array, "3 3"]]) -> Usage:
            pose, intrinsics = (matrix[None] for matrix in matrices)
            return self.visible(splats, Camera(pose, intrinsics, camera.height, camera.width)).usage

        views = jax.lax.map(one_view, (camera.world_to_camera, camera.intrinsics))
        usages = [surface.usage, jax.tree.map(jnp.max, views)]
        if self.uses_rays:
            usages.append(self.surface.ray_index(surface, capacities=self.capacities).usage)
        return capacity_module.combine(*usages)

    def points_seen(self, asset: Asset, lists: list[TileLists]) -> Bool[Array, " N"] | None:
        """Tell which splats some view sees; None where the transport needs the others as well."""
        if self.transport.needs_every_point:
            return None
        is_seen = jnp.zeros(asset.splats.opacities.shape, bool)
        for view_lists in lists:
            is_seen = is_seen.at[view_lists.index].set(True, mode="drop")
        return is_seen

    def _lists(self, asset: Asset, camera: Camera) -> list[TileLists]:
        """List what every view can see."""
        # Unrolled: independent views let XLA run their single-threaded sorts side by side.
        return [self.visible(asset.splats, camera.view(view)) for view in range(camera.count)]

    def _render_listed(
        self,
        key: Key[Array, ""] | None,
        asset: Asset,
        illumination: Illumination,
        lists: list[TileLists],
        camera: Camera,
        aov_names: tuple[str, ...],
    ) -> RenderOutput:
        """Render the views of some lists, each with samples of its own."""
        views = [
            self.render_view(
                asset,
                illumination,
                view_lists,
                camera.view(view),
                aov_names=aov_names,
                key=None if key is None else jax.random.fold_in(key, view),
            )
            for view, view_lists in enumerate(lists)
        ]
        usage = capacity_module.combine(*(view.usage for view in views))
        images = [(view.rgb, view.alpha, view.aovs) for view in views]
        rgb, alpha, aovs = jax.tree.map(lambda *parts: jnp.concatenate(parts), *images)
        return RenderOutput(rgb, alpha, aovs, usage)


def _require_known(aov_names: tuple[str, ...]) -> None:
    """Refuse unknown AOVs."""
    unknown = set(aov_names) - set(AOV_CHANNELS)
    if unknown:
        raise ValueError(f"unknown AOVs {sorted(unknown)}; expected some of {list(AOV_CHANNELS)}")
