"""Deferred shading: attributes of splats are blended first, then every covered pixel is shaded.

The attributes of the visible splats are rasterised and divided by their coverage (Eq. 21), and the
rendering equation is evaluated once for every pixel with the result (Eq. 22). Any
`transport.base.Transport` can be used, since a pixel is a surface point like any other.

The samples of light, what they hit, and the points where rays through pixels hit the mesh carry no
gradient.
"""

from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.core.mesh import face_normals_and_areas
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.settings import NonNegative, settings
from geosplat_jax.core.types import Camera, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.render import AOV_CHANNELS, Asset, RenderPipeline, ShadingDomain
from geosplat_jax.splats.rasterize import TileLists
from geosplat_jax.transport.base import Illumination, Transport

_THINNEST = 1e-6
"""Least coverage that attributes are divided by; a pixel with a visible splat has 1/255 or more."""

_SHADED = ("rgb", "diffuse", "specular", "specular_radiance")
"""Images that come from light; all others are blended from the splats."""


@settings
class PerPixel(ShadingDomain, kind="per_pixel"):
    """Attributes are blended, and every pixel is shaded (Eq. 21-22)."""

    points: Literal["splats", "mesh"] = "splats"
    """Where rays start: at the blended positions of the splats (the paper), or where the mesh is
    first hit (the authors' code). Pixels whose ray misses the mesh take the blended position."""
    ray_offset: NonNegative = 1e-3
    """How far above its point a ray starts, in half extents of the box. Rays from the
    mesh start on their face, which they never hit, and need no offset."""
    detach_coverage: bool = True
    """Attributes and colours take the coverage as a constant, as in the authors' code: opacities
    and shapes then learn from what is blended and from the mask, not from the division."""

    @property
    def uses_rays(self) -> bool:
        """Whether points lie on the mesh, where rays through the pixels hit it."""
        return self.points == "mesh"

    def without_rays(self) -> "PerPixel":
        """Return the domain whose points are blended from the positions of the splats."""
        return replace(self, points="splats")

    @property
    def shades_splats(self) -> bool:
        """False: the points are the pixels of a view."""
        return False

    def adapted(self, transport: Transport) -> Transport:
        """Return the transport that draws samples in every view: views share no point."""
        return transport.for_each_view()

    def images(
        self,
        pipeline: RenderPipeline,
        key: Key[Array, ""] | None,
        asset: Asset,
        illumination: Illumination,
        lists: TileLists,
        camera: Camera,
        names: tuple[str, ...],
    ) -> tuple[dict[str, Float[Array, "H W c"]], Float[Array, "H W"]]:
        """Blend attributes, divide by coverage, shade every covered pixel."""
        images, alpha = self._blended(pipeline, asset, lists, camera)
        height, width = alpha.shape
        coverage = jax.lax.stop_gradient(alpha) if self.detach_coverage else alpha
        share = jnp.maximum(coverage, _THINNEST).reshape(-1, 1)
        # Eq. 21: blended attributes over coverage.
        straight_values = {n: x.reshape(height * width, -1) / share for n, x in images.items()}
        materials = replace(
            asset.attributes.materials,
            albedo=straight_values["albedo"],
            roughness=straight_values["roughness"][:, 0],
            metallic=straight_values["metallic"][:, 0],
        )
        points = self._points(pipeline, asset, straight_values, alpha.reshape(-1) > 0, camera)
        shaded = self.adapted(pipeline.transport).shade(  # Eq. 22
            key,
            points,
            Attributes(materials, None, straight_values.get("indirect")),
            safe_normalize(camera.centers - straight_values["position"]),
            illumination,
            asset.index,
        )
        light = {
            "rgb": shaded.rgb,
            "diffuse": shaded.diffuse_light,
            "specular": shaded.specular_light,
            "specular_radiance": shaded.specular,
        }
        outputs = {}
        for name in ("rgb", *names):
            if name in _SHADED:
                outputs[name] = light[name].reshape(height, width, -1) * coverage[..., None]
            else:
                outputs[name] = images[name]
        return outputs, alpha

    def _blended(
        self, pipeline: RenderPipeline, asset: Asset, lists: TileLists, camera: Camera
    ) -> tuple[dict[str, Float[Array, "H W c"]], Float[Array, "H W"]]:
        """Rasterise the attributes, premultiplied (Eq. 21)."""
        splats, gather = asset.splats, lists.gather
        attributes = jax.tree.map(gather, asset.attributes)
        materials = attributes.materials
        footprints = pipeline.project(
            gather(splats.means), gather(splats.quats), gather(splats.scales), camera
        )
        channels = {
            "normal": gather(splats.normals),
            "albedo": materials.albedo,
            "roughness": materials.roughness[:, None],
            "metallic": materials.metallic[:, None],
            "position": gather(splats.anchors),
            "depth": footprints.depths[:, None],
        }
        if attributes.indirect is not None:
            channels["indirect"] = attributes.indirect
        assert {name for name in AOV_CHANNELS if name not in _SHADED} <= set(channels)
        return pipeline.blend(footprints, gather(splats.opacities), channels, lists, camera)

    def _points(
        self,
        pipeline: RenderPipeline,
        asset: Asset,
        straight_values: dict[str, Float[Array, "P c"]],
        mask: Bool[Array, " P"],
        camera: Camera,
    ) -> SurfacePoints:
        """Build the points at which pixels are shaded, where rays towards the light start."""
        normals, positions = safe_normalize(straight_values["normal"]), straight_values["position"]
        offset = self.ray_offset * pipeline.surface.box.half_extent
        starts, outward = positions + offset * normals, normals
        faces = jnp.full(mask.shape, -1, jnp.int32)
        if self.points == "mesh" and asset.index is not None:
            hits, faces = first_surface(asset.index, mask, camera)
            is_hit = (faces >= 0)[:, None]
            starts = jnp.where(is_hit, hits, starts)
            normals_of_faces, _ = face_normals_and_areas(asset.mesh)
            outward = jnp.where(is_hit, normals_of_faces.at[faces].get(mode="clip"), outward)
        starts, outward = jax.lax.stop_gradient((starts, outward))
        return SurfacePoints(starts, normals, outward, faces, mask)


def first_surface(
    index: RayIndex, mask: Bool[Array, " P"], camera: Camera
) -> tuple[Float[Array, "P 3"], Int[Array, " P"]]:
    """Find where the rays through the pixel centres of a single view first meet the mesh.

    Not differentiable.

    Parameters
    ----------
    index : the mesh.
    mask : (P,) pixels whose rays are traced, of all H W pixels, row by row; the others hit nothing.
    camera : of a single view.

    Returns
    -------
    positions : (P, 3) world; the camera's centre where nothing is hit.
    faces : (P,) face that is hit; -1 for none.
    """
    camera = jax.lax.stop_gradient(camera)
    rotation, intrinsics = camera.world_to_camera[0, :3, :3], camera.intrinsics[0]
    dtype = rotation.dtype
    x, y = jnp.meshgrid(*(jnp.arange(n, dtype=dtype) + 0.5 for n in (camera.width, camera.height)))
    slope_x = (x - intrinsics[0, 2]) / intrinsics[0, 0]
    slope_y = (y - intrinsics[1, 2]) / intrinsics[1, 1]
    local = jnp.stack([slope_x, slope_y, jnp.ones_like(slope_x)], axis=-1).reshape(-1, 3)
    directions = safe_normalize(jnp.einsum("pk,kc->pc", local, rotation, precision="highest"))
    origins = jnp.broadcast_to(camera.centers, directions.shape)
    no_faces = jnp.full(mask.shape, -1, jnp.int32)
    distance, faces = index.nearest(origins, directions, no_faces, mask)
    hit_distance = jnp.where(faces >= 0, distance, 0.0)
    return origins + hit_distance[:, None] * directions, faces
