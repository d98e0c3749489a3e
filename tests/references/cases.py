"""The stored oracles: inputs, random cotangents, and what the references make of them.

Each case is a function without arguments that returns the arrays of one file: ``in_*`` inputs,
``out_*`` values, ``cotangent_*`` of those outputs that carry a gradient, ``grad_*`` the gradient
of their contraction with respect to the inputs, and settings under plain names. Inputs are
multiples of 1/256, which compresses well. `RandomState` has a stream that never changes.
"""

from functools import partial

import numpy as np

from references import adapter, bsdf, flexicubes, splatting
from references.lanes import contract, gradient


def coarse(values):
    return np.round(np.asarray(values) * 256) / 256


def packed(inputs, outputs, cotangents, gradients, **settings):
    """All arrays of a file under their prefixed names."""
    groups = {"in": inputs, "out": outputs, "cotangent": cotangents, "grad": gradients}
    arrays = {f"{p}_{k}": np.asarray(v) for p, group in groups.items() for k, v in group.items()}
    return arrays | {name: np.asarray(value) for name, value in settings.items()}


def unpacked(data, prefix):
    return {k[len(prefix) + 1 :]: data[k] for k in data if k.startswith(prefix + "_")}


# Isosurface


def isosurface_inputs(sdf, shape, random):
    """Random deformation and weights for an SDF that has an axis for each of z, y, x."""
    cells = int(np.prod(shape))
    return {
        "sdf": coarse(sdf).ravel() + 1 / 512,  # never zero
        "deform": coarse(random.normal(size=(sdf.size, 3))),
        "alpha": coarse(random.normal(size=(cells, 8))),
        "beta": coarse(random.normal(size=(cells, 12))),
        "gamma": coarse(random.normal(size=cells)),
        "origin": np.array([-0.75, -0.5, -1.0]),
        "cell_size": np.array(0.375),
    }


def blob_inputs():
    """A smooth blob in 5 x 4 x 6 cells that leaves the box on one side."""
    random, shape = np.random.RandomState(1), (5, 4, 6)
    z, y, x = np.indices([n + 1 for n in shape[::-1]]).astype(float)
    bumps = sum(
        0.35 * np.cos(random.uniform(0.6, 1.4, 3) @ np.array([x, y, z]).reshape(3, -1) + phase)
        for phase in random.uniform(0, 6, 4)
    ).reshape(x.shape)
    distance = np.sqrt((x - 2.3) ** 2 + (y - 2.7) ** 2 + 0.5 * (z - 3.1) ** 2)
    return isosurface_inputs(distance - 1.5 + bumps, shape, random), shape


def clash_inputs():
    """Noise in 4 x 3 x 3 cells, with two pairs of cells that clash (C16 and C19)."""
    random, shape = np.random.RandomState(41), (4, 3, 3)
    return isosurface_inputs(random.normal(size=[n + 1 for n in shape[::-1]]), shape, random), shape


def isosurface_case(make_inputs, *, training):
    inputs, shape = make_inputs()
    extract = partial(flexicubes.isosurface, shape=shape, training=training)
    outputs = extract(**inputs)
    random = np.random.RandomState(2)
    cotangents = {
        "vertices": coarse(random.normal(size=outputs["vertices"].shape)),
        "deviation": np.array(3.0),
    }
    gradients = gradient(lambda **x: contract(cotangents, extract(**x)), inputs)
    settings = {"shape": shape, "training": training, "changed": outputs.pop("changed")}
    return packed(inputs, outputs, cotangents, gradients, **settings)


# Splats


SPLAT_FRAME = {"height": 13, "width": 17}


def splat_inputs():
    """Sixteen random splats, and eight at the limits of the rules.

    The seed is one where no alpha comes within 1% of the cut, and no two depths within .003.
    """
    random = np.random.RandomState(60)
    means = random.uniform(-1, 1, (24, 3)) * [1.1, 0.8, 1.0]
    scales = np.exp(random.uniform(-3.2, -1.0, (24, 3)))
    opacities = random.uniform(0.1, 1.0, 24)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = splatting.rotation(np.array([0.9, 0.3, -0.2, 0.25]))
    world_to_camera[:3, 3] = [0.1, -0.05, 3.0]
    # The last eight in camera coordinates: so wide and opaque that alpha is clamped near a corner
    # of the image, opaque in its middle ...
    special = np.array(
        [
            [-1.9, -1.54, 5.0],
            [-0.4, 0.3, 3.5],
            # ... beyond the field of view along x, along y, and along both ...
            [-2.6, 0.2, 2.0],
            [0.3, 2.2, 2.2],
            [3.0, -2.4, 2.4],
            # ... behind the camera, before the near plane, and faint.
            [0.2, 0.1, -2.0],
            [0.0, 0.0, 0.0075],
            [0.1, -0.1, 2.0],
        ]
    )
    means[16:] = (special - world_to_camera[:3, 3]) @ world_to_camera[:3, :3]
    scales[16:18] = [[7.5, 7.7, 7.6], [0.5, 0.3, 0.2]]
    scales[18:21] = [[0.8, 0.6, 0.5], [0.5, 0.7, 0.6], [1.2, 1.0, 0.9]]
    opacities[16:18], opacities[18:21] = 1.0, 0.9
    opacities[23] = 1 / 256
    return {
        "means": coarse(means),
        "quats": coarse(random.normal(size=(24, 4))),
        "scales": coarse(scales),
        "opacities": coarse(opacities),
        "features": coarse(random.uniform(size=(24, 4))),
        "world_to_camera": world_to_camera,
        "intrinsics": np.array([[19.5, 0, 8.0], [0, 21.0, 7.0], [0, 0, 1]]),
    }


def splat_case():
    inputs = splat_inputs()
    draw = partial(splatting.render, **SPLAT_FRAME)
    outputs = draw(**inputs)
    random = np.random.RandomState(4)
    cotangents = {k: coarse(random.normal(size=outputs[k].shape)) for k in ("image", "alpha")}
    gradients = gradient(lambda **x: contract(cotangents, draw(**x)), inputs)
    visible_rows = sorted(outputs["footprints"])
    footprints = {
        name: np.array([outputs["footprints"][n][name] for n in visible_rows])
        for name in ("means2d", "conics", "depths", "compensation", "clamped_axes")
    }
    values = {k: outputs[k] for k in ("image", "alpha")} | footprints
    return packed(inputs, values, cotangents, gradients, visible=visible_rows, **outputs["events"])


# Adapter


FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2], [2, 3, 4]])


def adapter_inputs():
    """An irregular tetrahedron with a flap, and unit normals that are not its own."""
    random = np.random.RandomState(5)
    vertices = np.array([[0, 0, 1], [1, -0.5, 0], [-0.2, 1, 0.1], [-1, -0.6, -0.2], [-1, 1, 0.5]])
    normals = vertices + random.normal(size=(5, 3)) * 0.2
    return {
        "vertices": coarse(vertices + random.normal(size=(5, 3)) * 0.1),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
    }


def adapter_outputs(vertices, normals):
    """Splats of both presets, the radii of Eq. 12 and the normals of the mesh itself."""
    outputs = {
        f"{preset}_{name}": value
        for preset in adapter.RINGS
        for name, value in adapter.mesh_splats(
            vertices, normals, faces=FACES, preset=preset
        ).items()
    }
    outputs["vertex_radii"] = adapter.vertex_radii(vertices, normals, faces=FACES)
    outputs["vertex_normals"] = adapter.vertex_normals(vertices, faces=FACES)
    return outputs


def adapter_case():
    inputs = adapter_inputs()
    outputs = adapter_outputs(**inputs)
    random = np.random.RandomState(6)
    cotangents = {k: coarse(random.normal(size=v.shape)) for k, v in outputs.items()}
    gradients = gradient(lambda **x: contract(cotangents, adapter_outputs(**x)), inputs)
    return packed(inputs, outputs, cotangents, gradients, faces=FACES)


# Reflectance


def bsdf_inputs():
    """64 points: rough and mirror-like, head-on, grazing and from below, metals and not."""
    random = np.random.RandomState(7)
    normals = random.normal(size=(64, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wi, wo = (normals * 0.8 + random.normal(size=(64, 3)) * 0.6 for _ in range(2))
    # Half of the pairs lie near the mirror direction, where the smooth ones are bright.
    mirrored = 2 * np.sum(wi * normals, 1, keepdims=True) * normals - wi
    wo[::2] = mirrored[::2] + 0.03 * random.normal(size=(32, 3))
    # Grazing at a fraction of a degree.
    tangent = np.cross(normals, random.normal(size=(64, 3)))
    wi[:6] = tangent[:6] + 0.005 * normals[:6]
    wo[2:6] = -tangent[2:6] + 0.02 * normals[2:6]
    roughness = random.uniform(0.1, 1.0, 64)
    roughness[::5], roughness[1::10] = 0.125, 0.05  # below the floor
    metallic = random.uniform(size=64)
    metallic[::4], metallic[1::4] = 0.0, 1.0
    return {
        "albedo": coarse(random.uniform(size=(64, 3))),
        "roughness": coarse(roughness),
        "metallic": coarse(metallic),
        "normals": normals,
        "wi": wi,
        "wo": wo,
    }


def bsdf_case():
    inputs = bsdf_inputs()
    outputs = bsdf.evaluate_rows(**inputs)
    random = np.random.RandomState(8)
    cotangents = {k: coarse(random.normal(size=v.shape)) for k, v in outputs.items()}
    row_gradients = []
    for n in range(64):  # the rows are independent of each other
        row = {k: v[n : n + 1] for k, v in inputs.items()}
        weight = {k: v[n : n + 1] for k, v in cotangents.items()}
        row_gradients.append(
            gradient(lambda weight=weight, **x: contract(weight, bsdf.evaluate_rows(**x)), row)
        )
    gradients = {
        name: np.concatenate([row_gradient[name] for row_gradient in row_gradients])
        for name in inputs
    }
    return packed(inputs, outputs, cotangents, gradients)


CASES = {
    "isosurface_blob": partial(isosurface_case, blob_inputs, training=True),
    "isosurface_blob_eval": partial(isosurface_case, blob_inputs, training=False),
    "isosurface_clash": partial(isosurface_case, clash_inputs, training=True),
    "splats_small": splat_case,
    "adapter_faces": adapter_case,
    "bsdf_rows": bsdf_case,
}
