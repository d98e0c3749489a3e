"""EWA projection of splats and their dense compositing, one pixel after the other.

Zwicker et al., "EWA splatting", 2002; the conventions are gsplat's: OpenCV camera axes,
quaternions (w, x, y, z) of any length, pixel centres at integers + 0.5.
"""

import numpy as np

from references.lanes import real

LOW_PASS = 0.3  # square pixels
FIELD_OF_VIEW = 1.3  # the Jacobian is taken inside this many half fields of view
CUT = 1 / 255
CLAMP = 0.999


def product(a, b):
    """Matrix product over the two leading axes."""
    inner, columns = range(b.shape[0]), range(b.shape[1])
    return np.array([[sum(row[n] * b[n, j] for n in inner) for j in columns] for row in a])


def transpose(a):
    return np.array([[a[j, i] for j in range(a.shape[0])] for i in range(a.shape[1])])


def rotation(quat):
    w, x, y, z = quat / np.sqrt(sum(q * q for q in quat))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def clamp(x, low, high):
    return low if real(x) < real(low) else high if real(x) > real(high) else x


def project(mean, quat, scale, world_to_camera, intrinsics, *, height, width):
    """Footprint of one splat: means2d, conics (xx, xy, yy), depths, compensation."""
    camera_rotation = world_to_camera[:3, :3]
    x, y, z = (
        sum(camera_rotation[i, j] * mean[j] for j in range(3)) + world_to_camera[i, 3]
        for i in range(3)
    )
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]

    # The Jacobian of (x/z, y/z), at a point moved to within 1.3 times the field of view.
    margin_x = (FIELD_OF_VIEW - 1) * 0.5 * width / fx
    margin_y = (FIELD_OF_VIEW - 1) * 0.5 * height / fy
    plain_x, plain_y = x / z, y / z
    slope_x = clamp(plain_x, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    slope_y = clamp(plain_y, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = 0 * z
    jacobian = np.array([[fx / z, zero, -fx * slope_x / z], [zero, fy / z, -fy * slope_y / z]])

    axes = product(camera_rotation, rotation(quat))
    axes = np.array([[axes[i, j] * scale[j] for j in range(3)] for i in range(3)])
    covariance = product(axes, transpose(axes))
    image = product(product(jacobian, covariance), transpose(jacobian))

    sharp = image[0, 0] * image[1, 1] - image[0, 1] * image[1, 0]
    xx, xy, yy = image[0, 0] + LOW_PASS, image[0, 1], image[1, 1] + LOW_PASS
    determinant = xx * yy - xy * xy
    return {
        "means2d": np.array([fx * plain_x + cx, fy * plain_y + cy]),
        "conics": np.array([yy / determinant, -xy / determinant, xx / determinant]),
        "depths": z,
        "compensation": np.sqrt(sharp / determinant),
        "clamped_axes": (slope_x is not plain_x) + (slope_y is not plain_y),
    }


def render(
    means,
    quats,
    scales,
    opacities,
    features,
    world_to_camera,
    intrinsics,
    *,
    height,
    width,
    near=0.01,
):
    """Composite every splat in front of the near plane in every pixel, nearest first.

    Equal depths stay in the order of their rows. Returns image (H, W, C), premultiplied; alpha
    (H, W); the footprints of the visible rows; how often the thresholds acted on a pair of a
    splat and a pixel, and the smallest relative distance to them.
    """
    depth_axis, depth_offset = world_to_camera[2, :3], world_to_camera[2, 3]
    depths = [real(sum(depth_axis[j] * mean[j] for j in range(3)) + depth_offset) for mean in means]
    order = [n for n in np.argsort(depths, kind="stable") if depths[n] > near]
    frame = {"height": height, "width": width}
    footprints = {
        n: project(means[n], quats[n], scales[n], world_to_camera, intrinsics, **frame)
        for n in order
    }
    image, coverage = [], []
    events = {"kept": 0, "cut": 0, "clamped": 0, "gap_cut": np.inf, "gap_clamp": np.inf}
    for row in range(height):
        for column in range(width):
            light, transmittance = 0.0, 1.0
            for n in order:
                splat = footprints[n]
                dx = column + 0.5 - splat["means2d"][0]
                dy = row + 0.5 - splat["means2d"][1]
                xx, xy, yy = splat["conics"]
                sigma = 0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy)
                alpha = opacities[n] * splat["compensation"] * np.exp(-sigma)
                for name, limit in (("gap_cut", CUT), ("gap_clamp", CLAMP)):
                    events[name] = min(events[name], abs(real(alpha) / limit - 1))
                if real(alpha) < CUT:
                    events["cut"] += 1
                    continue
                if real(alpha) > CLAMP:
                    events["clamped"] += 1
                    alpha = CLAMP
                events["kept"] += 1
                light = light + alpha * transmittance * features[n]
                transmittance = transmittance * (1 - alpha)
            image.append(light + 0 * features[0])
            coverage.append(1 - transmittance + 0 * opacities[0])
    image, coverage = np.array(image), np.array(coverage)
    return {
        "image": image.reshape(height, width, *image.shape[1:]),
        "alpha": coverage.reshape(height, width, *coverage.shape[1:]),
        "footprints": footprints,
        "events": events,
    }
