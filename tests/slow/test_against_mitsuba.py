"""Our direct light equals that of Mitsuba 3, and the comparison would notice if it did not."""

from dataclasses import replace

import jax.numpy as jnp
import pytest

pytest.importorskip("mitsuba")

import against_mitsuba as against  # noqa: E402

from geosplat_jax.core.types import EnvLight  # noqa: E402

# The tests share images: in one group, a single process renders them once.
pytestmark = [pytest.mark.slow, pytest.mark.computes, pytest.mark.xdist_group("mitsuba")]

SETTINGS = against.Settings(size=48, resolution=24)
COARSE = replace(SETTINGS, strata=4, mitsuba_passes=2)

# Required decibels over the object's pixels, a stricter measure than over the whole image.
MARKS = {"diffuse": 42.0, "metal": 30.0}

# The agreement may be this many decibels below that of noise alone. Under the sky, systematic
# errors are then below two thirds of the noise (10^(1.5 / 10) = 1.41), whatever the marks;
# Mitsuba's separable masking costs less than that at this roughness. The small sun is seen in few
# pixels, where the noise itself is known to about two decibels only: three seeds gave -1.9, +1.2
# and -0.3.
NOISE_MARGIN = {"sky": 1.5, "sun": 3.0}

# A wrong light, visibility or material costs at least this many decibels more than noise.
ERROR_MARGIN = 4.0


@pytest.fixture(scope="module")
def scene():
    against.choose_variant()
    return against.make_scene(SETTINGS.resolution)


@pytest.fixture(scope="module")
def comparisons(scene):
    passes = against.all_passes(scene, SETTINGS)
    return {
        comparison.name: comparison for comparison in against.comparisons(scene, passes, SETTINGS)
    }


@pytest.mark.parametrize("light", ["sky", "sun"])
@pytest.mark.parametrize("material", ["diffuse", "metal"])
def test_our_image_equals_that_of_mitsuba(comparisons, light, material):
    comparison = comparisons[f"{light}_{material}"]
    agreement = comparison.agreement
    assert agreement.object_psnr >= MARKS[material], comparison
    assert agreement.object_psnr >= agreement.noise_psnr - NOISE_MARGIN[light], comparison
    # Separable masking leaves Mitsuba's metal a tenth of a percent darker.
    assert abs(agreement.bias) <= 4 * agreement.bias_error + 0.002, comparison
    assert abs(comparison.ours.coverage - comparison.reference.coverage).mean() < 2e-3


def test_the_light_is_the_same_function_of_direction_and_its_mirror_image_is_not(scene):
    for light in against.make_lights().values():
        emitter = against.mitsuba_light(light)
        assert against.light_error(emitter, light) < 1e-3
        assert against.light_error(emitter, EnvLight(light.radiance[:, ::-1])) > 0.05


@pytest.mark.parametrize("fault", ["mirrored light", "no occlusion", "rougher metal"])
def test_a_fault_shows(scene, fault):
    light, material = against.make_lights()["sky"], "diffuse"
    our_light, settings, occlusion = light, COARSE, True
    if fault == "mirrored light":
        our_light = EnvLight(jnp.flip(light.radiance, axis=1))
    elif fault == "no occlusion":
        occlusion = False
    else:
        material, settings = "metal", replace(COARSE, roughness=1.1 * COARSE.roughness)
    passes = against.all_passes(scene, COARSE)
    ours = against.our_image(
        scene, passes, our_light, settings, material=material, occlusion=occlusion
    )
    reference = against.mitsuba_image(scene, light, COARSE, material=material)
    agreement = against.compare(ours, reference)
    assert agreement.object_psnr < MARKS[material] or material == "metal", agreement
    assert agreement.object_psnr < agreement.noise_psnr - ERROR_MARGIN, agreement
