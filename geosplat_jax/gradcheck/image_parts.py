"""Problems of the image: projection, rasteriser, denoiser and the terms of the loss on images."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.color import linear_to_srgb, tone_map
from geosplat_jax.gradcheck.differences import Problem
from geosplat_jax.losses import (
    edge_aware_smoothness,
    image_dissimilarity,
    image_l1,
    light_cast,
    light_error,
    light_smoothness,
    light_tint,
    mask_error,
    over_background,
    white_balance,
)
from geosplat_jax.splats.projection import project
from geosplat_jax.splats.rasterize import rasterize
from geosplat_jax.transport.denoise import DenoiseSpec, denoise

_HEIGHT, _WIDTH = 9, 11
_CAPACITIES = Capacities(visible=128, hits=512, chunks=128)


def _camera() -> tuple[np.ndarray, np.ndarray]:
    """Pose and intrinsics of a camera that looks at the origin, slightly turned."""
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    pose[:3, 3] = [0.05, -0.02, 2.0]
    intrinsics = np.array([[14.0, 0, 5.4], [0, 13.0, 4.6], [0, 0, 1]])
    return pose, intrinsics


def _splats(rng: np.random.Generator, count: int) -> dict[str, Any]:
    """Gaussians of a few pixels, in front of the camera and at different depths."""
    pose, intrinsics = _camera()
    return {
        "means": np.stack([*rng.uniform(-0.6, 0.6, (2, count)), np.linspace(-0.5, 0.5, count)], 1),
        "quats": rng.standard_normal((count, 4)),
        "scales": rng.uniform(0.03, 0.25, (count, 3)),
        "world_to_camera": pose,
        "intrinsics": intrinsics,
    }


def projection_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate footprints in Gaussians and camera.

    Inside the image, and far outside of it, where slopes are clamped.
    """

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        splats = project(
            inputs["means"],
            inputs["quats"],
            inputs["scales"],
            world_to_camera=inputs["world_to_camera"],
            intrinsics=inputs["intrinsics"],
            height=_HEIGHT,
            width=_WIDTH,
        )
        return {
            "means2d": splats.means2d,
            "covariances2d": splats.covariances2d,
            "conics": splats.conics,
            "depths": splats.depths,
            "compensation": splats.compensation,
        }

    inside, outside = _splats(rng, 8), _splats(rng, 8)
    outside["means"] = outside["means"] + np.array([2.5, 1.9, 0.0])
    return [
        Problem("projection", function, inside),
        Problem("projection, outside", function, outside),
    ]


def rasteriser_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate a composited image in all its inputs, including background and camera."""
    count = 16
    inputs = _splats(rng, count)
    inputs["opacities"] = rng.uniform(0.3, 0.95, count)
    inputs["features"] = rng.uniform(0.0, 1.0, (count, 3))
    inputs["background"] = rng.uniform(0.0, 1.0, (_HEIGHT, _WIDTH, 3))

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        image, alpha, _ = rasterize(
            inputs["means"],
            inputs["quats"],
            inputs["scales"],
            inputs["opacities"],
            inputs["features"],
            jnp.ones((count,), bool),
            world_to_camera=inputs["world_to_camera"],
            intrinsics=inputs["intrinsics"],
            height=_HEIGHT,
            width=_WIDTH,
            capacities=_CAPACITIES,
        )
        return {"image": image + (1 - alpha)[..., None] * inputs["background"], "alpha": alpha}

    return [Problem("rasteriser", function, inputs)]


def denoiser_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate filtered light in the light and in the coverage.

    Depth and albedo are multiplied by the coverage, so that the filter's weights, which are
    constants by contract, do not change with it. The normals differ enough for weights of all
    sizes.
    """
    shape = (_HEIGHT, _WIDTH)
    spec = DenoiseSpec(iterations=2)
    normals = rng.uniform(-0.3, 0.3, (*shape, 3)) + np.array([0.0, 0.0, 1.0])

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        normals, depth, albedo = constants
        alpha = inputs["alpha"]
        filtered = denoise(
            inputs["light"], alpha, normals, alpha * depth, alpha[..., None] * albedo, spec=spec
        )
        return {"filtered light": filtered}

    inputs = {"light": rng.uniform(0.1, 2.0, (*shape, 3)), "alpha": rng.uniform(0.3, 1.0, shape)}
    constants = (normals, rng.uniform(2.0, 2.2, shape), rng.uniform(0.4, 0.6, (*shape, 3)))
    arrays = tuple(jnp.asarray(x, jnp.zeros(0).dtype) for x in constants)
    return [Problem("denoiser", function, inputs, arrays)]


def loss_term_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate terms of the loss on images, normals, albedo and light, and colour curves."""
    shape = (1, 13, 14)
    image = rng.uniform(0.05, 0.95, (*shape, 4))

    def photometric(srgb: bool) -> Problem:
        def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
            rgb = tone_map(inputs["rgb"], inputs["log_exposure"])
            images = over_background(
                rgb, inputs["alpha"], constants["image"], inputs["background"], None, srgb=srgb
            )
            return {
                "l1": image_l1(images),
                "ssim": image_dissimilarity(images),
                "mask": mask_error(images),
                "mse": images.mse,
            }

        inputs = {
            "rgb": rng.uniform(0.05, 1.1, (*shape, 3)),
            "alpha": rng.uniform(0.05, 0.95, shape),
            "background": rng.uniform(0.0, 1.0, (*shape, 3)),
            "log_exposure": np.array(0.1),
        }
        name = "photometric terms, sRGB" if srgb else "photometric terms"
        return Problem(name, function, inputs, {"image": image})

    def light(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        return {"light term": light_error(**inputs, image=constants["image"])}

    def others(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        return {
            "white balance": white_balance(inputs["radiance"]),
            "tint of the light": light_tint(inputs["radiance"]),
            "cast of the light": light_cast(inputs["radiance"]),
            "smoothness of the light": light_smoothness(inputs["radiance"]),
            "normal smoothness": edge_aware_smoothness(inputs["normals"], constants["image"]),
            "relative smoothness": edge_aware_smoothness(
                inputs["albedo"], constants["image"], relative=0.5
            ),
        }

    def curves(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        batched_tone_map = jax.vmap(lambda rgb, exposure: tone_map(rgb, exposure))
        return {
            "tone map": batched_tone_map(inputs["rgb"], inputs["log_exposure"]),
            "sRGB": linear_to_srgb(inputs["rgb"]),
        }

    return [
        photometric(False),
        photometric(True),
        Problem(
            "light term",
            light,
            {
                "diffuse": rng.uniform(0, 1, (*shape, 3)),
                "specular_radiance": rng.uniform(0, 0.3, (*shape, 3)),
                "log_exposure": np.array(-0.2),
            },
            {"image": image},
        ),
        Problem(
            "priors on light, normals and albedo",
            others,
            {
                "radiance": rng.uniform(0, 1, (4, 8, 3)),
                "normals": rng.uniform(-1, 1, (*shape, 3)),
                "albedo": rng.uniform(0.1, 0.9, (*shape, 3)),
            },
            {"image": image},
        ),
        Problem(
            "colour curves",
            curves,
            {"rgb": rng.uniform(0.0, 1.5, (12, 3)), "log_exposure": rng.uniform(-0.5, 0.5, 12)},
        ),
    ]
