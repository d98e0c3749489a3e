"""Mitsuba reads the exported materials from a GLB, at the right places of the world."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mitsuba")

import against_mitsuba as against  # noqa: E402
import elsewhere  # noqa: E402
from test_export import materials, sphere  # noqa: E402

from geosplat_jax.io.export import export_mesh_glb  # noqa: E402
from geosplat_jax.io.images import decode_srgb  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.computes]

# Errors of eight bits of sRGB, and of a texel of the 256 x 256 texture of a ball.
TOLERANCE = 0.02


@pytest.fixture(scope="module")
def asset(tmp_path_factory):
    against.choose_variant()
    path = tmp_path_factory.mktemp("glb") / "mesh.glb"
    export_mesh_glb(path, *sphere(), materials, texture_size=256)
    return elsewhere.read_glb(path)


def read_at_hits(asset):
    """Return points of the world that rays from all sides hit, and what materials Mitsuba finds."""
    import mitsuba as mi

    rng = np.random.default_rng(0)
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scene = mi.load_dict({"type": "scene", "mesh": elsewhere.mitsuba_mesh(asset)})
    grey = np.repeat(asset.orm[..., 1:2], 3, axis=-1), np.repeat(asset.orm[..., 2:], 3, axis=-1)
    color = mi.load_dict(elsewhere._texture(asset.base_color, raw=False))
    rough, metal = (mi.load_dict(elsewhere._texture(pixels, raw=True)) for pixels in grey)
    points, samples = [], []
    for direction in directions:
        origin = mi.Point3f(*map(float, 3 * direction))
        ray_direction = mi.Vector3f(*map(float, -direction))
        hit = scene.ray_intersect(mi.Ray3f(origin, ray_direction))
        points.append(np.array(hit.p).ravel())
        values = [np.array(color.eval(hit)).ravel()]
        values += [np.array(texture.eval(hit)).ravel()[:1] for texture in (rough, metal)]
        samples.append(np.concatenate(values))
    return np.array(points), np.array(samples)


def error(asset):
    points, samples = read_at_hits(asset)
    albedo, roughness, metallic = materials(points)
    expected = np.concatenate([albedo, roughness[:, None], metallic[:, None]], axis=-1)
    return np.median(np.abs(samples - np.clip(expected, 0, 1)), axis=0)


def test_mitsuba_reads_the_materials_that_were_exported(asset):
    assert error(asset).max() < TOLERANCE


@pytest.mark.parametrize("what", ["upside down", "swapped", "decoded twice", "y up"])
def test_a_convention_that_is_misread_would_be_noticed(asset, what):
    changes = {
        "upside down": {"uv": asset.uv * [1, -1] + [0, 1]},
        "swapped": {"orm": asset.orm[..., [0, 2, 1]]},
        "decoded twice": {
            "base_color": np.round(255 * decode_srgb(asset.base_color / 255)).astype(np.uint8)
        },
        "y up": {"vertices": asset.vertices[:, [0, 2, 1]] * [1, 1, -1]},
    }[what]
    assert error(replace(asset, **changes)).max() > 3 * TOLERANCE
