"""Our paths over two surfaces equal those of Mitsuba 3, and paths over one are too dark."""

import pytest

pytest.importorskip("mitsuba")

import against_mitsuba as against  # noqa: E402
import paths_against_mitsuba as paths  # noqa: E402

from geosplat_jax.transport.sampling import SampleCounts  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.computes]

SETTINGS = against.Settings(
    size=32,
    resolution=20,
    strata=4,
    counts=SampleCounts(6, 6, 6),
    mitsuba_samples=256,
    mitsuba_passes=2,
)

# See `test_against_mitsuba`; the mean normals of faces add less than noise at this size.
NOISE_MARGIN = 1.5
BIAS = 0.004


def test_light_by_way_of_another_surface_equals_that_of_mitsuba():
    against.choose_variant()
    scene = against.make_scene(SETTINGS.resolution, paths.bowl_distances, paths.EYE)
    light = against.make_lights()["sky"]
    hits = against.all_passes(scene, SETTINGS)
    reference = paths.mitsuba_image(scene, light, SETTINGS, material="diffuse", segments=3)
    ours = paths.our_image(scene, hits, light, SETTINGS, material="diffuse", segments=3)
    agreement = against.compare(ours, reference)
    assert agreement.object_psnr >= agreement.noise_psnr - NOISE_MARGIN, agreement
    assert abs(agreement.bias) <= 4 * agreement.bias_error + BIAS, agreement
    direct = paths.our_image(scene, hits, light, SETTINGS, material="diffuse", segments=2)
    assert against.compare(direct, reference).bias < -10 * BIAS
