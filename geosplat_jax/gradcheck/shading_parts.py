"""Problems of the appearance: hash grid, materials, BRDF, light, split sum, Monte Carlo shading."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.gradcheck.differences import Problem, unit_box
from geosplat_jax.hashgrid import HashGridSpec, encode
from geosplat_jax.materials import MaterialField, MaterialSpec, attributes_at, init_materials
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.environment import (
    LightSpec,
    lookup,
    prefilter,
    prefilter_operators,
    prefiltered_diffuse,
    prefiltered_specular,
)
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import INDIRECT_MODELS, outgoing
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.paths import FaceTable, Leg, face_table, path_radiance
from geosplat_jax.transport.sampling import BLOCKED, SampleCounts, draw_samples
from geosplat_jax.transport.split_sum import fg_table, split_sum

_GRID = HashGridSpec(levels=3, features=2, log2_entries=6, coarsest=2, finest=11)
"""One dense level and two hashed ones."""

_LIGHT = LightSpec(height=6, width=8, roughness=(0.0, 0.3, 0.6, 1.0))


def unit_vectors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random directions, (count, 3)."""
    vectors = rng.standard_normal((count, 3))
    return vectors / np.sqrt(np.sum(vectors**2, axis=1, keepdims=True))


def hash_grid_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate encoded features in the tables and in the points."""

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        features = encode(inputs["table"], inputs["points"], spec=_GRID, position_gradient=True)
        return {"features": features}

    inputs = {
        "table": rng.uniform(-1, 1, (_GRID.total_entries, _GRID.features)),
        "points": rng.uniform(0.02, 0.98, (11, 3)),
    }
    return [Problem("hash grid", function, inputs)]


def material_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate attributes of a field in its tables, its MLPs and the points.

    Once with one encoding, and once with two.
    """
    points = rng.uniform(-0.9, 0.9, (7, 3))

    def field(shared: bool) -> Problem:
        spec = MaterialSpec(
            grid=_GRID,
            albedo_hidden=(5, 4),
            surface_hidden=(5,),
            shared=shared,
            bias=True,
            initial_roughness_logit=-0.5,
            initial_metallic_logit=0.5,
            position_gradient=True,
        )
        template = init_materials(jax.random.key(0), spec)
        leaves, structure = jax.tree.flatten(template)
        random_leaves = [rng.uniform(-1, 1, leaf.shape) for leaf in leaves]
        params = jax.tree.unflatten(structure, random_leaves)

        def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
            attributes = attributes_at(
                MaterialField(
                    albedo_table=inputs["tables"]["albedo"],
                    surface_table=inputs["tables"]["surface"],
                    albedo_head=inputs["albedo MLP"],
                    surface_head=inputs["surface MLP"],
                    shift_head=inputs["shift MLP"],
                ),
                inputs["points"],
                unit_box(inputs["points"].dtype),
                spec=spec,
            )
            materials = attributes.materials
            return {
                "albedo": materials.albedo,
                "roughness": materials.roughness,
                "metallic": materials.metallic,
                "shift": attributes.shift,
            }

        inputs = {
            "tables": {"albedo": params.albedo_table, "surface": params.surface_table},
            "albedo MLP": params.albedo_head,
            "surface MLP": params.surface_head,
            "shift MLP": params.shift_head,
            "points": points,
        }
        name = "materials, one encoding" if shared else "materials, two encodings"
        # The shift takes its points as given, as in the authors' code.
        return Problem(name, function, inputs, skip=frozenset({("shift", "points")}))

    return [field(True), field(False)]


def model_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate shaded points in all inputs, for every model of the material."""
    count, operators = 7, prefilter_operators(_LIGHT)
    points, table = rng.uniform(-0.9, 0.9, (count, 3)), fg_table(cosines=9, roughnesses=7)
    surface_inputs = _surface_points(rng, count)
    texels = rng.uniform(0.1, 2.0, (_LIGHT.height, _LIGHT.width, 3))

    def model(name: str, **kind: Any) -> Problem:
        spec = MaterialSpec(grid=_GRID, albedo_hidden=(5,), surface_hidden=(5,), bias=True, **kind)
        leaves, structure = jax.tree.flatten(init_materials(jax.random.key(0), spec))
        random_leaves = [rng.uniform(-1, 1, leaf.shape) for leaf in leaves]

        def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
            operators, table, points = constants
            field = inputs["parameters"]
            box = unit_box(points.dtype)
            materials = attributes_at(field, points, box, spec=spec).materials
            light = prefilter(
                EnvLight(inputs["texels"]), operators, diffuse_only=not materials.has_specular
            )
            shaded = split_sum(materials, inputs["normals"], inputs["wo"], light, table)
            return {"rgb": shaded.rgb}

        inputs = {
            "parameters": jax.tree.unflatten(structure, random_leaves),
            "normals": surface_inputs["normals"],
            "wo": surface_inputs["wo"],
            "texels": texels,
        }
        return Problem(f"model, {name}", function, inputs, (operators, table, points))

    return [
        model("Lambertian", specular="none", has_shift=False),
        model("one roughness", specular="uniform", has_metallic=False, has_shift=False),
        model("one roughness and metallic", specular="uniform", has_shift=False),
        model("roughness field", has_metallic=False, has_shift=False),
    ]


def _surface_points(rng: np.random.Generator, count: int) -> dict[str, Any]:
    """Materials, normals and a viewer in front of them."""
    normals, wo = unit_vectors(rng, count), unit_vectors(rng, count)
    wo = np.where(np.sum(normals * wo, axis=1, keepdims=True) < 0, -wo, wo)
    return {
        "albedo": rng.uniform(0.1, 0.9, (count, 3)),
        "roughness": rng.uniform(0.15, 0.9, count),
        "metallic": rng.uniform(0.1, 0.9, count),
        "normals": normals,
        "wo": wo,
    }


def _materials(inputs: dict[str, Any]) -> Materials:
    return Materials(inputs["albedo"], inputs["roughness"], inputs["metallic"])


def bsdf_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate both lobes of the reflectance and the density of samples in every argument."""
    inputs = _surface_points(rng, 9)
    wi = unit_vectors(rng, 9)
    inputs["wi"] = np.where(np.sum(inputs["normals"] * wi, axis=1, keepdims=True) < 0, -wi, wi)

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        arguments = (_materials(inputs), inputs["normals"], inputs["wi"], inputs["wo"])
        diffuse, specular = bsdf.evaluate_lobes(*arguments)
        return {"diffuse": diffuse, "specular": specular, "density": bsdf.pdf(*arguments)}

    return [Problem("BRDF", function, inputs)]


def light_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate plain and prefiltered lookups in texels, directions and roughness."""
    operators = prefilter_operators(_LIGHT)

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        light = prefilter(EnvLight(inputs["texels"]), constants)
        return {
            "lookup": lookup(inputs["texels"], inputs["directions"]),
            "diffuse": prefiltered_diffuse(light, inputs["directions"]),
            "specular": prefiltered_specular(light, inputs["directions"], inputs["roughness"]),
        }

    inputs = {
        "texels": rng.uniform(0.1, 2.0, (_LIGHT.height, _LIGHT.width, 3)),
        "directions": unit_vectors(rng, 9),
        "roughness": rng.uniform(0.05, 0.95, 9),
    }
    return [Problem("environment light", function, inputs, operators)]


def split_sum_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate outgoing radiance in materials, normals, view directions and texels."""
    constants = (prefilter_operators(_LIGHT), fg_table(cosines=9, roughnesses=9))

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        operators, table = constants
        light = prefilter(EnvLight(inputs["texels"]), operators)
        shaded = split_sum(_materials(inputs), inputs["normals"], inputs["wo"], light, table)
        return {
            "rgb": shaded.rgb,
            "diffuse light": shaded.diffuse_light,
            "specular light": shaded.specular_light,
        }

    inputs = _surface_points(rng, 9)
    inputs["texels"] = rng.uniform(0.1, 2.0, (_LIGHT.height, _LIGHT.width, 3))
    return [Problem("split sum", function, inputs, constants)]


def transport_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate Monte Carlo shading over fixed samples, by kind of indirect light.

    Samples are drawn from the light and the cosine, and some are blocked. There are none from the
    microfacets: their directions follow the roughness and are constants of a step by contract.
    """
    count, faces, counts = 7, 4, SampleCounts(light=5, diffuse=4, specular=0)
    dtype = jnp.zeros(0).dtype
    inputs = _surface_points(rng, count)
    inputs["texels"] = rng.uniform(0.1, 2.0, (_LIGHT.height, _LIGHT.width, 3))
    normals = jnp.asarray(inputs["normals"], dtype)
    no_faces, all_points = jnp.full(count, -1, jnp.int32), jnp.ones(count, bool)
    points = SurfacePoints(jnp.zeros_like(normals), normals, normals, no_faces, all_points)
    sampler = light_sampler(EnvLight(jnp.asarray(inputs["texels"], dtype)))
    base_samples = draw_samples(jax.random.key(0), points, sampler, None, counts=counts)
    hits = rng.integers(BLOCKED, faces, base_samples.hits.shape)
    samples = replace(base_samples, hits=jnp.asarray(hits, jnp.int32))

    def problem(kind: str) -> Problem:
        def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
            points, samples, sampler = constants
            points = replace(points, normals=inputs["normals"])
            light = EnvLight(inputs["texels"])
            indirect = INDIRECT_MODELS[kind](inputs["indirect"])
            shaded = reflect(
                jax.random.key(1),
                points,
                _materials(inputs),
                inputs["wo"],
                gather(points, samples, light, indirect),
                light,
                sampler,
                None,
                indirect,
                counts=counts,
            )
            return {
                "rgb": shaded.rgb,
                "diffuse light": shaded.diffuse_light,
                "specular light": shaded.specular_light,
            }

        model = INDIRECT_MODELS[kind]
        shape = (faces if model.reads_faces else count, model.outputs or 3)
        problem_inputs = {**inputs, "indirect": rng.uniform(0.2, 1.0, shape)}
        return Problem(
            f"transport, indirect {kind}", function, problem_inputs, (points, samples, sampler)
        )

    return [problem(kind) for kind in ("constant", "harmonics", "traced", "radiometric")]


def face_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate what the points of a face give to it: sent light, materials and normals.

    One of the faces has no points, one point has no face, and one is padding.
    """
    count, faces = 9, 4
    inputs = _surface_points(rng, count)
    inputs["light"] = rng.uniform(0.1, 2.0, (count, 3))
    outward = jnp.asarray(inputs["normals"])
    rows = jnp.asarray([-1, *rng.integers(0, faces - 1, count - 1)], jnp.int32)
    mask = jnp.arange(count) < count - 1
    points = SurfacePoints(jnp.zeros_like(outward), outward, outward, rows, mask)
    del inputs["wo"]

    def function(inputs: dict[str, Any], constants: SurfacePoints) -> dict[str, Any]:
        points = replace(constants, normals=inputs["normals"])
        table = face_table(points, _materials(inputs), faces)
        shine = jnp.stack([table.materials.roughness, table.materials.metallic], axis=1)
        return {
            "sent light": outgoing(_materials(inputs), inputs["light"], points, faces),
            "table": jnp.concatenate([table.materials.albedo, shine, table.normals], axis=1),
        }

    return [Problem("means over faces", function, inputs, points)]


def path_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate the radiance of fixed paths in the faces' materials and normals and the light.

    Paths have two vertices. Faces, directions and weights are random; a third of the paths end
    early.
    """
    count, faces, vertices = 6, 4, 2
    dtype = jnp.zeros(0).dtype
    inputs = _surface_points(rng, faces)
    inputs["texels"] = rng.uniform(0.1, 2.0, (_LIGHT.height, _LIGHT.width, 3))
    outward = inputs["normals"]
    view_directions = inputs.pop("wo")
    hit = rng.integers(0, faces, (vertices, count))
    hit[1:, ::3] = -1

    def away(rows: np.ndarray) -> np.ndarray:
        """Directions that leave the faces."""
        directions = unit_vectors(rng, count)
        is_below = np.sum(directions * outward[rows], axis=1, keepdims=True) < 0
        return np.where(is_below, -directions, directions)

    legs, wo = [], view_directions[hit[0]]
    for k in range(vertices):
        # The next vertex must see this one: its face is turned towards where the path comes from.
        next_directions = away(hit[k])
        if k + 1 < vertices:
            next_directions = -away(hit[k + 1])
        weights = rng.uniform(0.5, 2.0, (3, count))
        leg_arrays = (away(hit[k]), weights[0], next_directions, weights[1], weights[2])
        legs.append(
            Leg(jnp.asarray(hit[k], jnp.int32), *(jnp.asarray(x, dtype) for x in leg_arrays))
        )

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        legs, wo, outward = constants
        table = FaceTable(_materials(inputs), inputs["normals"], outward)
        return {"radiance": path_radiance(legs, wo, table, EnvLight(inputs["texels"]))}

    constants = (tuple(legs), jnp.asarray(wo, dtype), jnp.asarray(outward, dtype))
    return [Problem("paths", function, inputs, constants)]
