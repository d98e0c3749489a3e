"""Views in memory: images, cameras, and the pixels that count.

Colour is linear with straight alpha, alpha is the mask, poses are camera-to-world with Blender
axes in float64. Photographs are stored as `Photographs` describes. Ground truth and relit images
are read when they are first needed (`truth`): they are many, and training does not use them.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from geosplat_jax.core.types import Camera
from geosplat_jax.io.images import downscale
from geosplat_jax.io.photographs import Images, Marks, Photographs

COVERED = 0.5
"""A pixel belongs to the object where its alpha exceeds this."""

OPAQUE = 0.95
"""If no mask reaches this alpha anywhere, the masks are taken for a mistake."""

_BLENDER_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class ViewLight(NamedTuple):
    """The environment light of one view, in the frame of its camera.

    Attributes
    ----------
    path : lat-long map in the camera's OpenGL axes (x right, y up, z backwards), y up:
        ``u = 0.5 + atan2(x, -z) / (2 pi)``, ``v = acos(y) / pi``.
    camera_to_world : (4, 4) pose of the camera, whose rotation takes the map into the world.
    """

    path: Path
    camera_to_world: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Views:
    """V views of one size; see the module for conventions.

    Photographs of several sizes are placed in the upper left corner of images as large as the
    largest; pixels of the padding do not count.

    Attributes
    ----------
    names : one name per view.
    camera_to_world : (V, 4, 4) float64, rigid, OpenGL/Blender axes.
    intrinsics : (V, 3, 3) pixels.
    images : (V, H, W, 4) float32 linear RGB, straight alpha; colour is zero where alpha is zero.
        An array, or `Photographs`, which decode the views that they are indexed with.
    truth : (V, H, W, C) ground truth by ``albedo`` (linear), ``normal`` (unit, world),
        ``roughness`` and ``metallic``; zero on the background.
    relight : (V, H, W, 4) linear, by light; read from files at every lookup, since they are large.
    valid : (V, H, W) float32, 1 for pixels that count and 0 for others, an array or `Marks`; None
        where all count. Pixels that do not count are zero in all images.
    has_masks : False where neither alpha nor masks separate the object; alpha is then one.
    lights : environment maps of single views, by the names of the views.
    exposure : (V,) factors that linear colours were divided by; None where they were not.
    white_balance : (V, 3) further factors, by channel, that they were divided by, or None.
    """

    names: tuple[str, ...]
    camera_to_world: Float[np.ndarray, "V 4 4"]
    intrinsics: Float[np.ndarray, "V 3 3"]
    images: Images
    truth: Mapping[str, Any] = field(default_factory=dict)
    relight: Mapping[str, Any] = field(default_factory=dict)
    valid: Float[np.ndarray, "V H W"] | Marks | None = None
    exposure: Float[np.ndarray, " V"] | None = None
    white_balance: Float[np.ndarray, "V 3"] | None = None
    has_masks: bool = True
    lights: Mapping[str, ViewLight] = field(default_factory=dict)

    def __len__(self) -> int:
        """Count the views."""
        return len(self.names)

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return self.images.shape[2]

    @property
    def alphas(self) -> Any:
        """Alpha of the views, (V, H, W), an array or `Alphas`; no file is read for it."""
        return self.images.alphas if isinstance(self.images, Photographs) else self.images[..., 3]

    def clipped(self, indices: Sequence[int] | np.ndarray) -> Float[np.ndarray, "K H W 4"]:
        """Return the photographs of some views, clipped at white as tone-mapped renders are.

        Only photographs from float files, or after a correction of exposure, exceed white.
        """
        return np.minimum(self.images[np.asarray(indices, int)], np.float32(1.0))

    def mask(self, index: int) -> Bool[np.ndarray, "H W"]:
        """Pixels of the object in one view."""
        return self.alphas[index] > COVERED

    @property
    def masks(self) -> Bool[np.ndarray, "V H W"]:
        """Pixels of the object in all views; `mask` takes less memory for many photographs."""
        return np.stack([self.mask(index) for index in range(len(self))])

    @cached_property
    def coverage(self) -> Float[np.ndarray, " V"]:
        """Share of the pixels of each view, among those that count, that the object covers."""
        pixel_counts = [np.count_nonzero(self.mask(index)) for index in range(len(self))]
        return np.array(pixel_counts) / np.maximum(self.valid_counts, 1.0)

    @cached_property
    def mean_colors(self) -> Float[np.ndarray, "V 3"]:
        """Mean linear colour of each view; detects photographs that changed under their names."""
        stride, colors = max(1, max(self.height, self.width) // 512), np.zeros((len(self), 3))
        for start in range(0, len(self), 4):
            rows = np.arange(start, min(start + 4, len(self)))
            pixels = np.asarray(self.images[rows])[:, ::stride, ::stride, :3]
            colors[rows] = pixels.mean((1, 2), dtype=np.float64)
        return np.round(colors, 4)

    @property
    def has_opaque_pixel(self) -> bool:
        """Whether alpha reaches `OPAQUE` in any view."""
        return any(np.max(alpha, initial=0.0) >= OPAQUE for alpha in self.alphas)

    @cached_property
    def valid_counts(self) -> Float[np.ndarray, " V"]:
        """Number of valid pixels of each view."""
        if self.valid is None:
            return np.full(len(self), float(self.height * self.width))
        return np.array([float(np.count_nonzero(valid)) for valid in self.valid])

    @property
    def sizes(self) -> Float[np.ndarray, "V 2"]:
        """Height and width up to the last pixel of each view that counts, (V, 2)."""
        if self.valid is None:
            return np.tile(np.array([self.height, self.width], float), (len(self), 1))

        def size(is_counted: np.ndarray) -> list[int]:
            """Return where the last row and the last column with such a pixel end."""
            ends = (np.flatnonzero(is_counted.any(axis)).max(initial=-1) + 1 for axis in (1, 0))
            return [int(end) for end in ends]

        return np.array([size(np.asarray(valid) > 0) for valid in self.valid], float)

    @property
    def world_to_camera(self) -> Float[np.ndarray, "V 4 4"]:
        """Rigid transforms to OpenCV camera axes, (V, 4, 4) float64."""
        # Multiplied from the right, which changes the axes of the camera and not of the world.
        return _rigid_inverse(self.camera_to_world @ _BLENDER_TO_OPENCV)

    def fingerprint(self) -> str:
        """Return a short digest of the views' names, cameras and size."""
        digest = hashlib.sha256(repr((self.names, self.height, self.width)).encode())
        for array in (self.camera_to_world, self.intrinsics):
            digest.update(np.ascontiguousarray(array, np.float64).tobytes())
        return digest.hexdigest()[:16]

    def camera(self, indices: Sequence[int] | np.ndarray | None = None) -> Camera:
        """Cameras of all or some views for the renderer, float32 and OpenCV axes."""
        rows = np.arange(len(self)) if indices is None else np.asarray(indices, int).reshape(-1)
        return Camera(
            jnp.asarray(self.world_to_camera[rows], jnp.float32),
            jnp.asarray(self.intrinsics[rows], jnp.float32),
            height=self.height,
            width=self.width,
        )


def camera_to_world_of(
    world_to_camera: Float[np.ndarray, "V 4 4"],
) -> Float[np.ndarray, "V 4 4"]:
    """Invert `Views.world_to_camera`."""
    return _rigid_inverse(world_to_camera) @ _BLENDER_TO_OPENCV


def no_views(like: Views) -> Views:
    """Return a split without views, of the same image size."""
    return Views((), like.camera_to_world[:0], like.intrinsics[:0], like.images[:0])


def some_views(views: Views, chosen: Sequence[int] | np.ndarray, *, factor: int = 1) -> Views:
    """Return some of the views, reduced by an integer factor, without ground truth and lights.

    Raises
    ------
    SceneError
        See `images.downscale`.
    """
    chosen = np.asarray(chosen, int)
    full_mask = np.ones((views.height, views.width), bool)
    pairs = [
        _reduced(views.images[k], full_mask if views.valid is None else views.valid[k] > 0, factor)
        for k in chosen
    ]
    intrinsics = views.intrinsics[chosen].copy()
    intrinsics[:, :2] /= factor
    return replace(
        views,
        names=tuple(views.names[k] for k in chosen),
        camera_to_world=views.camera_to_world[chosen],
        intrinsics=intrinsics,
        images=np.stack([rgba for rgba, _ in pairs]).astype(np.float32),
        valid=None if views.valid is None else np.stack([v for _, v in pairs]).astype(np.float32),
        exposure=None if views.exposure is None else views.exposure[chosen],
        white_balance=None if views.white_balance is None else views.white_balance[chosen],
        truth={},
        relight={},
        lights={},
    )


def project(
    points: Float[np.ndarray, "N 3"],
    world_to_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 3"]]:
    """Project world points into the image of one camera, on the host.

    Parameters
    ----------
    points : (N, 3) world.
    world_to_camera : (4, 4) pose of the camera, OpenCV axes.
    intrinsics : (3, 3) pinhole camera matrix, pixels.

    Returns
    -------
    pixels : (N, 2) column and row; both are -1, outside of every image, for a point that is not in
        front of the camera.
    camera_points : (N, 3) the points in the frame of the camera; the last coordinate is the depth.
    """
    camera_points = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    is_ahead = camera_points[:, 2:] > 0.0
    pixels = (camera_points @ intrinsics.T)[:, :2] / np.where(is_ahead, camera_points[:, 2:], 1.0)
    return np.where(is_ahead, pixels, -1.0), camera_points


def in_image(
    pixels: Float[np.ndarray, "N 2"], *, height: int, width: int
) -> Bool[np.ndarray, " N"]:
    """Tell which positions (column, row) lie inside an image of ``height`` x ``width`` pixels."""
    return (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)


def point_text(point: Iterable[float]) -> str:
    """Format a point or a size in the world as text, with four significant digits."""
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"


def _reduced(
    rgba: Float[np.ndarray, "H W 4"], valid: Bool[np.ndarray, "H W"], factor: int
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce an image; a pixel of the result counts if all pixels that it is the mean of count."""
    reduced_rgba = downscale(rgba, factor)
    if valid.all():
        return reduced_rgba, np.ones(reduced_rgba.shape[:2], bool)
    is_whole = downscale(valid[..., None].astype(np.float32), factor)[..., 0] == 1.0
    return np.where(is_whole[..., None], reduced_rgba, 0.0), is_whole


def _rigid_inverse(matrices: np.ndarray) -> np.ndarray:
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    inverse = np.zeros_like(matrices)
    inverse[:, :3, :3] = rotation.transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("vji,vj->vi", rotation, position)
    inverse[:, 3, 3] = 1.0
    return inverse
