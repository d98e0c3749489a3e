"""Problems of a surface whose parameters are the vertices of a mesh."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh

from geosplat_jax.adapter import CODE, face_splats
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.gradcheck.differences import Problem
from geosplat_jax.surface.triangle_mesh import TriangleMesh, VertexOffsets


def mesh_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate positions, normals, splats and penalties in the offsets of vertices.

    Of a closed mesh, and of an open one that is seen from both sides.
    """
    ball = trimesh.creation.icosahedron()
    vertices, faces = np.array(ball.vertices), np.asarray(ball.faces, np.int32)
    vertices = vertices * rng.uniform(0.8, 1.2, (len(vertices), 1))
    # A bowl, one of whose faces is wound against the others.
    bowl = faces[np.all(vertices[faces][..., 2] < 0.7, axis=1)]
    old_indices, new_indices = np.unique(bowl, return_inverse=True)
    bowl = new_indices.reshape(-1, 3).astype(np.int32)
    bowl[0] = bowl[0, ::-1]

    def problem(name: str, vertices: np.ndarray, faces: np.ndarray, is_sheet: bool) -> Problem:
        model = TriangleMesh.of(vertices, faces, is_sheet=is_sheet, dtype=jnp.float64)

        def function(inputs: dict[str, Any], model: TriangleMesh) -> dict[str, Any]:
            shape = VertexOffsets(inputs["offsets"])
            surface = model.extract(shape, capacities=Capacities())
            normals = vertex_normals(surface.mesh)
            splats = face_splats(surface.mesh, normals, constants=CODE)
            return {
                "vertices": surface.mesh.vertices,
                "normals": normals,
                "means": splats.means,
                "scales": splats.scales,
                "quats": splats.quats,
                **model.penalties(shape, surface),
            }

        inputs = {"offsets": rng.uniform(-0.15, 0.15, vertices.shape)}
        return Problem(name, function, inputs, model)

    return [
        problem("mesh, closed", vertices, faces, False),
        problem("mesh, open, both sides", vertices[old_indices], bowl, True),
    ]
