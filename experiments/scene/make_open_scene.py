"""Build an open scene, three objects on a ground, rendered by Mitsuba 3 in the TensoIR layout.

    pip install 'geosplat_jax[scene]'
    python experiments/scene/make_open_scene.py --output FOLDER

writes `<output>/table/` and the environment maps beside it, as `make_scene.py` does for the duck.
The ground has no thickness, and the cameras stay above it. So the true mesh, `mesh_gt.ply`, is
open: `train --mesh` can start from it, whereas an isosurface is always closed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import make_scene
import numpy as np
import scene_duck
import trimesh

NAME = "table"
GROUND_RADIUS = 1.25
"""Radius of the round ground, whose centre is the origin; world units."""
SAVED_EDGE = 0.06
"""Longest edge of the mesh that is written, world units."""
LOWEST, HIGHEST = 0.25, 0.95
"""Sines of the elevations of training cameras."""

Array = make_scene.Array


def _ground() -> trimesh.Trimesh:
    """Make a disc of rings of triangles, upward."""
    rings, sectors = 24, 96
    angle = 2 * np.pi * np.arange(sectors) / sectors
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(sectors)], -1)
    radii = GROUND_RADIUS * np.arange(1, rings + 1) / rings
    vertices = np.concatenate([np.zeros((1, 3)), *(radius * directions for radius in radii)])
    sector = np.arange(sectors)
    next_sector = (sector + 1) % sectors
    faces = [np.stack([np.zeros(sectors, int), 1 + sector, 1 + next_sector], -1)]
    for ring in range(rings - 1):
        inner_start, outer_start = 1 + ring * sectors, 1 + (ring + 1) * sectors
        faces.append(
            np.stack([inner_start + sector, outer_start + sector, outer_start + next_sector], -1)
        )
        faces.append(
            np.stack(
                [inner_start + sector, outer_start + next_sector, inner_start + next_sector], -1
            )
        )
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def _box() -> trimesh.Trimesh:
    """Make a box on the ground, as six separate sides, so that its edges are sharp."""
    body = trimesh.creation.box(extents=(0.5, 0.4, 0.7))
    rotation = trimesh.transformations.rotation_matrix(0.5, [0, 0, 1], point=[0, 0, 0])
    body.apply_transform(rotation)
    body.apply_translation([0.45, 0.35, 0.33])
    sides = [body.submesh([facet], append=True) for facet in body.facets]
    return trimesh.util.concatenate([side.subdivide().subdivide().subdivide() for side in sides])


def _ball() -> trimesh.Trimesh:
    body = trimesh.creation.icosphere(subdivisions=4, radius=0.36)
    body.apply_translation([-0.5, 0.2, 0.34])
    return body


def _ring() -> trimesh.Trimesh:
    body = trimesh.creation.torus(0.3, 0.12, major_sections=72, minor_sections=36)
    body.apply_translation([0.1, -0.55, 0.1])
    return body


def _ground_albedo(points: Array) -> Array:
    """Return the albedo (n, 3) of a soft pattern, as fine as the vertices can resolve."""
    wave = 0.5 + 0.5 * np.sin(9.0 * points[:, :1]) * np.sin(9.0 * points[:, 1:2])
    return (wave * [0.62, 0.56, 0.45] + (1 - wave) * [0.16, 0.25, 0.30]).astype(np.float32)


def parts() -> list[tuple[trimesh.Trimesh, scene_duck.Materials]]:
    """Return every part and its materials at the vertices."""
    ground, box, ball, ring = _ground(), _box(), _ball(), _ring()
    return [
        (
            ground,
            make_scene.painted(
                ground.vertices, _ground_albedo(np.asarray(ground.vertices)), 0.6, 0.0
            ),
        ),
        (box, make_scene.painted(box.vertices, [0.55, 0.10, 0.08], 0.5, 0.0)),
        (ball, make_scene.painted(ball.vertices, [0.90, 0.72, 0.38], 0.25, 1.0)),
        (ring, make_scene.painted(ring.vertices, [0.07, 0.22, 0.55], 0.35, 0.0)),
    ]


def write_scene_mesh(path: Path) -> None:
    """Write all parts with normals and materials, for Mitsuba."""
    make_scene.write_parts(path, parts())


def write_true_mesh(path: Path) -> None:
    """Write the mesh to start from and to compare with: all parts, with short edges."""
    mesh = trimesh.util.concatenate([body for body, _ in parts()])
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, SAVED_EDGE)
    trimesh.Trimesh(vertices, faces, process=False).export(path)


def views_above(count: int, first_seed: int, name: str, turn: float) -> list[make_scene.View]:
    """Spread cameras over the part of the sphere that is above the ground."""
    golden = np.pi * (3.0 - np.sqrt(5.0))
    heights = LOWEST + (HIGHEST - LOWEST) * (np.arange(count) + 0.5) / count
    return [
        make_scene.View(
            f"{name}_{i:03d}",
            make_scene.look_at_origin(make_scene.position(golden * i + turn, h)),
            first_seed + i,
        )
        for i, h in enumerate(heights)
    ]


def build(args: argparse.Namespace) -> Path:
    """Render the whole scene and return its folder."""
    folder = args.output / NAME
    folder.mkdir(parents=True, exist_ok=True)
    lights = make_scene.write_lights(args.output)
    train = views_above(args.views, 1000, "train", 0.0)
    test = views_above(args.test_views, 2000, "test", 1.0)
    write_true_mesh(folder / "mesh_gt.ply")
    make_scene.render_all(folder, train, test, lights, args, write_scene_mesh)
    return folder


def main() -> None:
    """Parse the command line and build the scene."""
    parser = make_scene.parser(__doc__)
    parser.set_defaults(views=32, test_views=6, spp=100, output=Path("scenes"))
    make_scene.timed_build(parser.parse_args(), build)


if __name__ == "__main__":
    main()
