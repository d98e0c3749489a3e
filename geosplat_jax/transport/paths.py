"""Indirect light by path tracing over any number of bounces (appendix I).

`monte_carlo` samples the light that arrives at a point. Here a ray that hits the surface is
continued to a path. At every later vertex two directions are drawn: one towards the environment,
and one by the reflectance of the face that was hit. Where they reach the environment, they are
combined by the balance heuristic; where the second one hits the surface, the path continues, over
at most `PathSettings.bounce_count` surfaces. There is no Russian roulette, so that the number of
vertices is static. The first vertex is that of `monte_carlo`: points may be splats or pixels, and
all views share what does not depend on the viewer.

A later vertex has the mean material and normal of the points that belong to its face
(`FaceTable`), at the exact position of the hit. Faces without points are black, and so is all
indirect light between splats that belong to no face.

Gradient semantics. Samples, densities, hits and visibility are constants of a step, as in
`monte_carlo`. At the first vertex light, reflectance and normals are differentiated. What is
differentiated at later vertices is `PathSettings.later_gradient`: nothing, the light that they
reflect, or that light and their materials and normals.

Unbiased where every face has one material and the light is bounded. Only rays that hit the surface
are followed further; their list has room for all rays, so that it cannot overflow.
"""

from dataclasses import replace
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key
from pydantic import Field

from geosplat_jax.core.capacity import bit_set
from geosplat_jax.core.numerics import safe_divide, safe_normalize
from geosplat_jax.core.settings import settings
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.base import Shaded, TransportSettings
from geosplat_jax.transport.environment import LightSpec, lookup
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import (
    NO_INDIRECT,
    IndirectSource,
    KnownIndirect,
    mean_over_faces,
)
from geosplat_jax.transport.light_sampling import (
    LightSampler,
    light_density,
    light_sampler,
    sample_light,
)
from geosplat_jax.transport.sampled import (
    SampleCount,
    SampledIllumination,
    SampledSettings,
    SampledTransport,
)
from geosplat_jax.transport.sampling import draw_samples, in_chunks

LaterGradient = Literal["none", "light", "all"]

_ROWS_AT_ONCE = 65_536
"""Paths that are followed together; chunks beyond the last path cost nothing."""

_NUMBERS = 5
"""Random numbers of a vertex: two for the light's direction, three for the reflectance's."""


class FaceTable(eqx.Module):
    """What a ray finds where it hits one of F faces.

    Attributes
    ----------
    materials : mean of the points of each face.
    normals, outward : (F, 3) unit, mean shading and geometric normals; zero without points.
    """

    materials: Materials
    normals: Float[Array, "F 3"]
    outward: Float[Array, "F 3"]


def face_table(points: SurfacePoints, materials: Materials, face_count: int) -> FaceTable:
    """Average points and their materials over the faces that they belong to.

    Faces without points are black. Differentiable in materials and shading normals.

    Parameters
    ----------
    points, materials : N rows; those that the mask leaves out do not count.
    face_count : static; rows to return.
    """
    shine = jnp.stack([materials.roughness, materials.metallic], axis=1)
    outward = jax.lax.stop_gradient(points.outward)
    values = jnp.concatenate([materials.albedo, shine, points.normals, outward], axis=1)
    mean = mean_over_faces(points, values, face_count)
    return FaceTable(
        replace(materials, albedo=mean[:, :3], roughness=mean[:, 3], metallic=mean[:, 4]),
        safe_normalize(mean[:, 5:8]),
        safe_normalize(mean[:, 8:11]),
    )


class _Vertex(eqx.Module):
    """One vertex of n paths: the surface there, and the direction ``wo`` to the vertex before.

    ``is_known`` : (n,) false where a path has ended, or hit a back or a face without points; such a
    vertex is black.
    """

    materials: Materials
    normals: Float[Array, "n 3"]
    outward: Float[Array, "n 3"]
    wo: Float[Array, "n 3"]
    is_known: Bool[Array, " n"]

    def reflected(self, wi: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Reflectance times the cosine."""
        cosine = jnp.maximum(jnp.sum(self.normals * wi, axis=-1), 0.0)
        value = bsdf.evaluate(self.materials, self.normals, wi, self.wo)
        return jnp.where(self.is_known[:, None], value * cosine[:, None], 0.0)

    def is_above(self, wi: Float[Array, "n 3"]) -> Bool[Array, " n"]:
        """Tell which directions leave the face."""
        return jnp.sum(self.outward * wi, axis=-1) > 0


def _vertex(table: FaceTable, faces: Int[Array, " n"], wo: Float[Array, "n 3"]) -> _Vertex:
    """Look up the faces that were hit; the face's normal replaces a shading normal facing away."""

    def rows(values: Array) -> Array:
        return values.at[jnp.maximum(faces, 0)].get(mode="clip")

    outward, normals = rows(table.outward), rows(table.normals)
    is_seen = jnp.sum(normals * wo, axis=-1, keepdims=True) > 0
    return _Vertex(
        materials=jax.tree.map(rows, table.materials),
        normals=jnp.where(is_seen, normals, outward),
        outward=outward,
        wo=wo,
        is_known=(faces >= 0) & (jnp.sum(outward * wo, axis=-1) > 0),
    )


class Leg(eqx.Module):
    """The two directions that n paths take at one vertex; constants of a step.

    Attributes
    ----------
    faces : (n,) face of the vertex; -1 for a path that has ended.
    to_light : (n, 3) unit direction drawn from the light.
    light_weight : (n,) one over the sum of both techniques' densities; 0 where the surface blocks
        the direction.
    onward : (n, 3) unit direction drawn by the reflectance.
    open_weight : (n,) one over the sum of both densities where ``onward`` reaches the environment,
        else 0.
    onward_weight : (n,) one over the density of ``onward`` itself where it hits the surface, else
        0.
    """

    faces: Int[Array, " n"]
    to_light: Float[Array, "n 3"]
    light_weight: Float[Array, " n"]
    onward: Float[Array, "n 3"]
    open_weight: Float[Array, " n"]
    onward_weight: Float[Array, " n"]


def _step(
    uniforms: Float[Array, "n k"],
    origins: Float[Array, "n 3"],
    faces: Int[Array, " n"],
    wo: Float[Array, "n 3"],
    table: FaceTable,
    sampler: LightSampler,
    index: RayIndex,
    *,
    is_last: bool,
) -> tuple[Leg, Float[Array, "n 3"], Int[Array, " n"]]:
    """Draw and trace both directions of one vertex; also return the next vertices and faces."""
    vertex = _vertex(table, faces, wo)
    to_light, _ = sample_light(sampler, uniforms[:, :2])
    onward = bsdf.sample(vertex.materials, vertex.normals, wo, uniforms[:, 2:5])

    def densities(wi: Float[Array, "n 3"]) -> tuple[Array, Array]:
        return light_density(sampler, wi), bsdf.pdf(vertex.materials, vertex.normals, wi, wo)

    light_part, reflected_part = densities(to_light)
    weight = safe_divide(jnp.ones_like(light_part), light_part + reflected_part)
    is_lit = vertex.is_known & vertex.is_above(to_light)
    is_lit = is_lit & ~index.occluded(origins, to_light, faces, is_lit)
    light_part, onward_density = densities(onward)
    balance_weight = safe_divide(jnp.ones_like(onward_density), light_part + onward_density)
    is_going = vertex.is_known & vertex.is_above(onward) & (onward_density > 0)
    if is_last:
        is_hit = index.occluded(origins, onward, faces, is_going)
        distance, next_faces = jnp.zeros_like(onward_density), jnp.full_like(faces, -1)
    else:
        distance, next_faces = index.nearest(origins, onward, faces, is_going)
        is_hit = next_faces >= 0
    is_continued = is_going & is_hit
    leg = Leg(
        faces=jnp.where(vertex.is_known, faces, -1),
        to_light=to_light,
        light_weight=jnp.where(is_lit, weight, 0.0),
        onward=onward,
        open_weight=jnp.where(is_going & ~is_hit, balance_weight, 0.0),
        onward_weight=jnp.where(
            is_continued, safe_divide(jnp.ones_like(onward_density), onward_density), 0.0
        ),
    )
    hit_distance = jnp.where(is_continued, distance, 0.0)
    ends = origins + hit_distance[:, None] * onward
    return leg, ends, jnp.where(is_continued, next_faces, -1)


def path_radiance(
    legs: tuple[Leg, ...], wo: Float[Array, "n 3"], table: FaceTable, light: EnvLight
) -> Float[Array, "n 3"]:
    """Sum the light that n paths collect at all vertices and send from the first along ``wo``.

    Differentiable in table and light; the legs are constants.

    Parameters
    ----------
    legs : vertices of the paths, in their order.
    wo : (n, 3) unit, from the first vertex.
    table, light : the surface and the environment.

    Returns
    -------
    (n, 3) linear radiance.
    """
    total, throughput = jnp.zeros_like(wo), jnp.ones_like(wo)
    for leg in legs:
        vertex = _vertex(table, leg.faces, wo)
        direct = vertex.reflected(leg.to_light) * leg.light_weight[:, None]
        onward = vertex.reflected(leg.onward)
        radiance = direct * lookup(light.radiance, leg.to_light)
        radiance = radiance + onward * leg.open_weight[:, None] * lookup(light.radiance, leg.onward)
        total = total + throughput * radiance
        throughput = throughput * onward * leg.onward_weight[:, None]
        wo = -leg.onward
    return total


class PathTracer(IndirectSource):
    """A source of indirect light that continues blocked rays to paths.

    Attributes
    ----------
    key : random key of all samples.
    table : what paths find on the surface.
    light, sampler, index : the environment, its tables, and the surface.
    vertex_count : static; most vertices of a path after its first.
    gradient : static; see `PathSettings.later_gradient`.
    """

    key: Key[Array, ""]
    table: FaceTable
    light: EnvLight
    sampler: LightSampler
    index: RayIndex
    vertex_count: int = eqx.field(static=True)
    gradient: LaterGradient = eqx.field(static=True, default="light")

    def followed(
        self,
        points: SurfacePoints,
        directions: Float[Array, "N S 3"],
        hits: Int[Array, "N S"],
        distances: Float[Array, "N S"] | None,
    ) -> KnownIndirect:
        """Follow every ray that hit a face.

        Raises
        ------
        ValueError
            Without distances, which are missing if rays were only tested for being blocked.
        """
        if distances is None:
            raise ValueError(
                "paths need the distances of the nearest hits, got none; draw the samples with "
                "finds_nearest=True"
            )
        count, samples = hits.shape
        total = count * samples
        if total == 0:
            return KnownIndirect(jnp.zeros_like(directions))
        hits, wi = hits.reshape(-1), directions.reshape(-1, 3)
        starts = jnp.repeat(points.positions, samples, axis=0)
        # Chunks that were skipped hold zeros, as if their rays had hit face 0: the mask leaves
        # them out.
        active_set = bit_set((hits >= 0) & jnp.repeat(points.mask, samples))
        ray = active_set.first(capacity=total)
        is_real = jnp.arange(total, dtype=jnp.int32) < active_set.count

        def rows(values: Array) -> Array:
            return values.at[ray].get(mode="promise_in_bounds")

        wo, faces = -rows(wi), jnp.where(is_real, rows(hits), -1)
        hit_distance = jnp.where(is_real, rows(distances.reshape(-1)), 0.0)
        origins = jax.lax.stop_gradient(rows(starts) - hit_distance[:, None] * wo)
        legs = self.draw(origins, faces, wo, is_real)
        radiance = self.evaluate(legs, wo, is_real)
        target = jnp.where(is_real, ray, total)
        # Every ray has a row of its own; rays that are not followed bring no light.
        ray_radiance = jnp.zeros_like(radiance).at[target].set(radiance, mode="drop")
        return KnownIndirect(ray_radiance.reshape(count, samples, 3))

    def draw(
        self,
        origins: Float[Array, "n 3"],
        faces: Int[Array, " n"],
        wo: Float[Array, "n 3"],
        is_real: Bool[Array, " n"],
    ) -> tuple[Leg, ...]:
        """Draw and trace all later vertices; no gradients.

        Random numbers and legs of all rays are in memory at once, for every vertex.
        """
        table, sampler = jax.lax.stop_gradient((self.table, self.sampler))
        width = self.vertex_count * _NUMBERS
        # In float32 at any precision, so that a run in float64 sees the same numbers.
        numbers = jax.random.uniform(self.key, (wo.shape[0], width), jnp.float32).astype(wo.dtype)

        def one_chunk(inputs: tuple[Array, Array, Array, Array]) -> tuple[Leg, ...]:
            origins, faces, wo, numbers = inputs
            legs = []
            for vertex in range(self.vertex_count):
                leg, origins, faces = _step(
                    numbers[:, vertex * _NUMBERS : (vertex + 1) * _NUMBERS],
                    origins,
                    faces,
                    wo,
                    table,
                    sampler,
                    self.index,
                    is_last=vertex == self.vertex_count - 1,
                )
                legs.append(leg)
                wo = -leg.onward
            return tuple(legs)

        arguments = jax.lax.stop_gradient((origins, faces, wo, numbers))
        return in_chunks(
            one_chunk, arguments, is_real, rows_at_once=_ROWS_AT_ONCE, has_gradient=False
        )

    def evaluate(
        self, legs: tuple[Leg, ...], wo: Float[Array, "n 3"], is_real: Bool[Array, " n"]
    ) -> Float[Array, "n 3"]:
        """Sum the light that the paths bring; what is differentiated is set by ``gradient``."""
        table, light = self.table, self.light
        if self.gradient != "all":
            table = jax.lax.stop_gradient(table)
        if self.gradient == "none":
            light = jax.lax.stop_gradient(light)

        def one_chunk(inputs: tuple[tuple[Leg, ...], Array]) -> Array:
            return path_radiance(*inputs, table, light)

        return in_chunks(
            one_chunk,
            (legs, wo),
            is_real,
            rows_at_once=_ROWS_AT_ONCE,
            has_gradient=self.gradient != "none",
        )


class PathIllumination(SampledIllumination):
    """What `Paths` prepares for N points.

    Attributes
    ----------
    table : what paths find on the surface; None where nothing blocks rays.
    """

    table: FaceTable | None = None


@settings
class PathSettings(SampledSettings, TransportSettings, kind="paths"):
    """Paths over several surfaces: the light of other surfaces is traced, not learned."""

    residual_count: SampleCount = 2
    """Samples of each kind of a second image, from which Eq. 13 takes its residual; with 0 it takes
    that of the image that it differentiates, which biases the gradient."""
    bounce_count: Annotated[int, Field(ge=2, le=64)] = 2
    """Most surfaces on a path of light, including the one that is seen: 2 adds light that arrives
    by way of one other surface. There is no Russian roulette."""
    later_gradient: LaterGradient = "none"
    """What is differentiated at the vertices of a path after the first: nothing (none), the light
    that they reflect (light), or that light and their materials and normals (all)."""

    @property
    def reads_faces(self) -> bool:
        """True: a path continues from the face that it hits."""
        return True

    @property
    def blocked_light(self) -> str:
        """The kind of transport: blocked directions bring what paths collect."""
        return "kind=paths"

    @property
    def relative_cost(self) -> float:
        """As with one bounce, but every further surface adds half the cost of the rays."""
        sample_count = self.light_count + self.diffuse_count + self.specular_count
        bounce_factor = 1.0 + 0.5 * (self.bounce_count - 1)
        return 1.0 + 0.2 * bounce_factor * (sample_count + 3 * self.residual_count)

    def build(self, light: LightSpec) -> "Paths":
        """Make the transport; it has no constants."""
        del light
        return Paths(self)


class Paths(SampledTransport):
    """Many bounces by path tracing, the first as in `monte_carlo`."""

    settings: PathSettings = eqx.field(static=True)

    @property
    def uses_rays(self) -> bool:
        """Always."""
        return True

    @property
    def needs_every_point(self) -> bool:
        """Paths meet faces that no view sees."""
        return True

    def _tracer(
        self,
        key: Key[Array, ""],
        light: EnvLight,
        sampler: LightSampler,
        table: FaceTable | None,
        index: RayIndex | None,
    ) -> IndirectSource:
        """Return the paths' indirect light for `gather` and `reflect`; black without rays."""
        if index is None or table is None:
            return NO_INDIRECT
        count = self.settings.bounce_count - 1
        gradient = self.settings.later_gradient
        return PathTracer(key, table, light, sampler, index, count, gradient)

    def prepare(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        light: EnvLight,
        index: RayIndex | None,
        carry: Any = None,
    ) -> tuple[PathIllumination, Any]:
        """Tabulate faces, follow the samples that views share, and sum their diffuse light.

        Raises
        ------
        ValueError
            Without a key.
        """
        if key is None:
            raise ValueError("path tracing needs a key for its samples")
        sampler = light_sampler(light)
        table, gathered = None, None
        if index is not None:
            table = face_table(points, attributes.materials, index.face_capacity)
        if self.settings.shares_views:
            first_key, later_key = jax.random.split(key)
            samples, carry = self._draw_shared(
                first_key, points, light, sampler, index, carry, finds_nearest=True
            )
            indirect = self._tracer(later_key, light, sampler, table, index)
            has_specular = attributes.materials.has_specular
            gathered = gather(points, samples, light, indirect, has_specular=has_specular)
        return PathIllumination(light, sampler, None, gathered, table), carry

    def shade(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        wo: Float[Array, "M 3"],
        illumination: PathIllumination,
        index: RayIndex | None,
    ) -> Shaded:
        """Compute the light that points send to their viewers; see `estimators.reflect`."""
        assert key is not None
        light, sampler, gathered = illumination.light, illumination.sampler, illumination.gathered
        light_key, light_path_key, lobe_path_key, lobe_key = jax.random.split(key, 4)
        table = illumination.table
        options = {"counts": self._counts, "finds_nearest": True}
        open_only = self._open_only and gathered is not None
        if gathered is None:
            samples = draw_samples(light_key, points, sampler, index, **options)
            indirect = self._tracer(light_path_key, light, sampler, table, index)
            has_specular = attributes.materials.has_specular
            gathered = gather(points, samples, light, indirect, has_specular=has_specular)
        return reflect(
            lobe_key,
            points,
            attributes.materials,
            wo,
            gathered,
            light,
            sampler,
            index,
            self._tracer(lobe_path_key, light, sampler, table, index),
            open_only=open_only,
            **options,
        )

    def for_images(self, sample_count: int) -> "SampledTransport":
        """Return a transport as `SampledTransport` does, without gradients at later vertices."""
        transport = super().for_images(sample_count)
        return replace(transport, settings=replace(transport.settings, later_gradient="none"))
