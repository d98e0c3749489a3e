"""Build two scenes with much indirect light, in the TensoIR layout.

    pip install 'geosplat_jax[scene]'
    python experiments/scene/make_bounce_scenes.py --output FOLDER [--only bowl]

``bowl`` is white outside and coloured inside, so that parts of its inner wall light each other with
their colours. ``pair`` is a white ball between a red and a green slab at right angles, with gaps of
a twentieth of its diameter. Rendered by Mitsuba 3 as `make_scene.py` renders the duck.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import make_scene
import numpy as np
import scene_duck
import trimesh

RADIUS, THICKNESS = 1.0, 0.12
"""Outer radius of the bowl, and thickness of its wall; world units."""
OPENING = 0.15
"""Height of the bowl's rim above its centre."""
SECTIONS = 256
SAVED_SECTIONS = 64
"""Segments around the bowl, of the mesh that is rendered, and of the one that is written."""

Array = make_scene.Array
Part = tuple[trimesh.Trimesh, scene_duck.Materials]


def _bowl_body(sections: int) -> trimesh.Trimesh:
    """Revolve the profile of a wall with a round lip about the z axis; closed, faces outward."""
    inner = RADIUS - THICKNESS
    middle = 0.5 * (RADIUS + inner)
    lip = np.arcsin(OPENING / middle)
    steps = sections // 3
    latitudes = np.linspace(-np.pi / 2, lip, steps)
    outside = RADIUS * np.stack([np.cos(latitudes), np.sin(latitudes)], -1)
    inside = inner * np.stack([np.cos(latitudes[::-1]), np.sin(latitudes[::-1])], -1)
    rim_angles = lip + np.linspace(0, np.pi, max(steps // 8, 4))[1:-1]
    top = middle * np.array([np.cos(lip), np.sin(lip)])
    rim = top + 0.5 * THICKNESS * np.stack([np.cos(rim_angles), np.sin(rim_angles)], -1)
    profile = np.concatenate([outside, rim, inside])
    profile[[0, -1], 0] = 0.0  # exactly on the axis
    body = trimesh.creation.revolve(profile, sections=sections)
    body.apply_translation([0, 0, 0.5 * (RADIUS - OPENING)])
    return body


def _bowl_materials(body: trimesh.Trimesh) -> scene_duck.Materials:
    """Paint the bowl white outside, and red, yellow, green and blue around the axis inside."""
    points = np.asarray(body.vertices) - [0, 0, 0.5 * (RADIUS - OPENING)]
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    colours = np.array([[0.75, 0.08, 0.06], [0.75, 0.6, 0.08], [0.08, 0.5, 0.12], [0.08, 0.2, 0.7]])
    centres = np.arange(4) * np.pi / 2
    share = np.exp(4.0 * np.cos(azimuth[:, None] - centres))
    inside = (share / share.sum(axis=1, keepdims=True)) @ colours
    depth = RADIUS - 0.5 * THICKNESS - np.linalg.norm(points, axis=1)
    blend = np.clip(0.5 + depth / (0.5 * THICKNESS), 0.0, 1.0)[:, None]
    albedo = blend * inside + (1 - blend) * 0.8
    return make_scene.painted(points, albedo, 0.6)


def bowl(*, is_saved: bool = False) -> list[Part]:
    """Return the bowl; with ``is_saved`` in the coarser mesh that is written."""
    body = _bowl_body(SAVED_SECTIONS if is_saved else SECTIONS)
    return [(body, _bowl_materials(body))]


def _slab(extents: tuple[float, float, float], centre: tuple[float, float, float]):
    """Make a slab as six separate sides, so that its edges are sharp."""
    body = trimesh.creation.box(extents=extents)
    body.apply_translation(centre)
    return [body.submesh([facet], append=True).subdivide().subdivide() for facet in body.facets]


def pair(*, is_saved: bool = False) -> list[Part]:
    """Return the ball and the slabs; with ``is_saved`` in the coarser mesh that is written."""
    ball = trimesh.creation.icosphere(subdivisions=4 if is_saved else 6, radius=0.5)
    parts = [(ball, make_scene.painted(ball.vertices, [0.8, 0.8, 0.8], 0.5))]
    slabs = (
        ((0.14, 1.2, 1.2), (-0.62, 0.0, 0.0), [0.7, 0.06, 0.05]),
        ((1.2, 0.14, 1.2), (0.1, 0.62, 0.0), [0.06, 0.5, 0.1]),
    )
    for extents, centre, albedo in slabs:
        for side in _slab(extents, centre):
            parts.append((side, make_scene.painted(side.vertices, albedo, 0.6)))
    return parts


SCENES = {"bowl": bowl, "pair": pair}


def build(name: str, args: argparse.Namespace) -> Path:
    """Render one of the scenes and return its folder."""
    folder = args.output / name
    folder.mkdir(parents=True, exist_ok=True)
    lights = make_scene.write_lights(args.output)
    mesh = trimesh.util.concatenate([body for body, _ in SCENES[name](is_saved=True)])
    mesh.merge_vertices()
    if not mesh.is_volume:
        raise RuntimeError(f"the mesh of {name} is not closed and outward")
    mesh.export(folder / "mesh_gt.ply")
    train, test = make_scene.train_views(args.views), make_scene.test_views(args.test_views)
    make_scene.render_all(
        folder, train, test, lights, args, lambda path: make_scene.write_parts(path, SCENES[name]())
    )
    return folder


def main() -> None:
    """Parse the command line and build the scenes."""
    parser = make_scene.parser(__doc__)
    parser.add_argument("--only", choices=tuple(SCENES), help="one of the scenes")
    parser.set_defaults(views=48, spp=256, output=Path("scenes"))
    args = parser.parse_args()
    for name in SCENES if args.only is None else (args.only,):
        make_scene.timed_build(args, partial(build, name))


if __name__ == "__main__":
    main()
