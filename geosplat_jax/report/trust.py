"""Confidence in parts of a surface: the number of training views that see each vertex."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from geosplat_jax.core.types import Camera
from geosplat_jax.io.meshes import first_hits
from geosplat_jax.io.views import Views, in_image, project
from geosplat_jax.report.consistency import resized
from geosplat_jax.report.scales import SEEN

LARGEST_COUNT = 64
"""Most views that are checked; they are spread evenly over all."""

_SIZE = 160
"""Pixels along the longer side of the depth buffers."""

_SLACK = 0.02
"""Share of the surface's extent by which a visible vertex may lie behind the depth of its pixel."""


@dataclass(frozen=True)
class Sightings:
    """How many training views see each vertex of a mesh.

    Attributes
    ----------
    vertices : (V, 3) world.
    faces : (F, 3) rows of the vertices.
    counts : (V,) number of views that see a vertex. A view sees it if it lies inside the image, no
        other surface hides it, its normal faces the camera or both sides are surface, and its pixel
        counts.
    asked : number of views that were checked.
    available : number of training views.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    counts: Int[np.ndarray, " V"]
    asked: int
    available: int

    @cached_property
    def _areas(self) -> Float[np.ndarray, " V"]:
        """Area that belongs to each vertex: a third of its faces."""
        a, b, c = np.moveaxis(np.asarray(self.vertices, np.float64)[self.faces], 1, 0)
        area = np.sqrt((np.cross(b - a, c - a) ** 2).sum(-1)) / 6.0
        vertex_areas = np.bincount(
            self.faces.ravel(), np.repeat(area, 3), minlength=len(self.vertices)
        )
        return vertex_areas.astype(np.float64)

    def shares(self) -> list[dict[str, float | str]]:
        """Return the shares of the area seen by no view, 1 or 2, 3 to 7, and 8 or more views.

        The list is empty for an empty surface.
        """
        total = self._areas.sum()
        if total <= 0:
            return []
        limits = [("none", 0, 0), ("1 or 2", 1, 2), ("3 to 7", 3, 7), ("8 and more", 8, np.inf)]
        return [
            {
                "views": text,
                "share": float(
                    self._areas[(self.counts >= low) & (self.counts <= high)].sum() / total
                ),
            }
            for text, low, high in limits
        ]

    def described(self) -> dict[str, Any]:
        """Return the entry of ``metrics.json``."""
        return {"asked": self.asked, "available": self.available, "shares": self.shares()}

    def picture(self, camera: Camera) -> Float[np.ndarray, "H W 3"]:
        """Show the counts as one view sees them, in the colours of `scales.SEEN`."""
        face_rows, weights = first_hits(self.vertices, self.faces, camera)
        is_hit = face_rows >= 0
        image = np.zeros(face_rows.shape)
        barycentrics = weights[is_hit] / weights[is_hit].sum(axis=-1, keepdims=True)
        image[is_hit] = (barycentrics * self.counts[self.faces[face_rows[is_hit]]]).sum(axis=-1)
        colors = SEEN.picture(image)
        return np.where(is_hit[..., None], colors, np.float32(1.0))


def _sees(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"],
    camera: Camera,
    valid: Float[np.ndarray, "h w"] | None,
    is_two_sided: bool,
) -> np.ndarray:
    """Which vertices a single view sees, (V,) bool."""
    _, weights = first_hits(vertices, faces, camera)
    inverse_depth = weights.sum(axis=-1)
    is_hit = inverse_depth > 0
    depth = np.where(is_hit, 1.0 / np.where(is_hit, inverse_depth, 1.0), np.inf)
    # The largest depth in 3 x 3 pixels: on steep parts of a surface, depth varies within a pixel.
    depth = ndimage.maximum_filter(depth, size=3)
    pose = np.asarray(camera.world_to_camera[0], np.float64)
    pixels, points = project(vertices, pose, np.asarray(camera.intrinsics[0], np.float64))
    is_inside = in_image(pixels, height=camera.height, width=camera.width)
    column, row = np.where(is_inside[:, None], pixels, 0).astype(np.int64).T
    extent = float(np.max(np.ptp(vertices, axis=0)))
    faces_camera = is_two_sided | (np.einsum("nd,nd->n", normals @ pose[:3, :3].T, points) < 0)
    is_nearest = points[:, 2] <= depth[row, column] + _SLACK * extent
    is_seen = is_inside & faces_camera & is_nearest
    if valid is not None:
        rows = row * valid.shape[0] // camera.height
        columns = column * valid.shape[1] // camera.width
        is_seen &= valid[rows, columns] > 0
    return is_seen


def sightings(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"],
    views: Views,
    *,
    is_two_sided: bool = False,
) -> Sightings:
    """Count the training views that see each vertex, on the host.

    Parameters
    ----------
    vertices, normals : (V, 3) world.
    faces : (F, 3) rows of the vertices.
    views : training views. Only `LARGEST_COUNT` are checked if there are more, which `Sightings`
        records.
    is_two_sided : whether both sides of a face are surface, either of which may be seen.
    """
    vertices, normals = np.asarray(vertices, np.float64), np.asarray(normals, np.float64)
    count = min(len(views), LARGEST_COUNT)
    view_indices = (
        np.unique(np.linspace(0, len(views) - 1, count).round().astype(int)) if count else []
    )
    counts = np.zeros(len(vertices), np.int64)
    for view_index in view_indices if len(faces) else ():
        camera = views.camera(np.array([view_index]))
        if max(camera.height, camera.width) > _SIZE:
            camera = resized(camera, _SIZE)
        valid = None if views.valid is None else views.valid[view_index]
        counts += _sees(vertices, faces, normals, camera, valid, is_two_sided)
    return Sightings(vertices, faces, counts, len(view_indices), len(views))
