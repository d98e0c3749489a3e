"""Photographs in little memory: stored as the numbers of their files, decoded view by view.

Only the rectangle of a photograph that is not empty is stored. A photograph of 8 or 16 bits that is
neither reduced nor undistorted is stored as the numbers of its file, any other as floats, so that
nothing is rounded. Once colours fill a given number of bytes, those of further views are not
stored, but read from their files again whenever they are needed; alpha is always stored.
"""

import abc
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from geosplat_jax.io.images import decoding_table

_FLOAT_BYTES = 4


@dataclass(frozen=True)
class Part:
    """The rectangle of a photograph that is not empty.

    Attributes
    ----------
    top, left : position of the rectangle in the photograph, pixels.
    color : (h, w, 3) numbers of the file (sRGB), or linear float32; zero where alpha is zero.
    alpha : (h, w) numbers of the file (linear), or float32 in [0, 1].
    """

    top: int
    left: int
    color: Shaped[np.ndarray, "h w 3"]
    alpha: Shaped[np.ndarray, "h w"]

    @classmethod
    def of(cls, color: Shaped[np.ndarray, "H W 3"], alpha: Shaped[np.ndarray, "H W"]) -> "Part":
        """Copy the rectangle around the pixels whose alpha is not zero."""
        top, bottom = _reach((alpha > 0).any(axis=1))
        left, right = _reach((alpha > 0).any(axis=0))
        window = slice(top, bottom), slice(left, right)
        crop = alpha[window]
        if crop.size and crop.min() == crop.max():
            crop = np.broadcast_to(crop.flat[0].copy(), crop.shape)  # takes no memory
        else:
            crop = crop.copy()
        return cls(top, left, color[window].copy(), crop)


def _reach(is_used: Bool[np.ndarray, " N"]) -> tuple[int, int]:
    """First used entry, and the one after the last; (0, 0) where none is."""
    if not is_used.any():
        return 0, 0
    return int(is_used.argmax()), int(is_used.size - is_used[::-1].argmax())


@dataclass(frozen=True)
class _Packed:
    """A part in memory; without ``color`` the file is read again, and alpha is compressed.

    ``numbers`` : type of the numbers of alpha.
    """

    top: int
    left: int
    shape: tuple[int, int]
    numbers: np.dtype
    color: np.ndarray | None
    alpha: np.ndarray | bytes

    @classmethod
    def of(cls, part: Part, *, keeps_color: bool) -> "_Packed":
        alpha = part.alpha
        common_fields = (part.top, part.left, alpha.shape, alpha.dtype)
        if keeps_color or not any(alpha.strides):
            return cls(*common_fields, part.color if keeps_color else None, alpha)
        return cls(*common_fields, None, zlib.compress(alpha.tobytes(), 1))

    @property
    def byte_count(self) -> int:
        """Memory that is taken, in bytes."""
        color = 0 if self.color is None else self.color.nbytes
        if isinstance(self.alpha, bytes):
            return color + len(self.alpha)
        return color + (self.alpha.nbytes if any(self.alpha.strides) else 0)

    def unpacked_alpha(self) -> np.ndarray:
        if not isinstance(self.alpha, bytes):
            return self.alpha
        return np.frombuffer(zlib.decompress(self.alpha), self.numbers).reshape(self.shape)


class PartsInMemory:
    """Collects the parts of photographs, from any thread, up to a limit on memory.

    Attributes
    ----------
    most_bytes : most memory for colours, bytes. Where the colours of a part do not fit, only its
        alpha is stored.
    """

    def __init__(self, count: int, most_bytes: int):
        self.most_bytes = most_bytes
        self._packed: list[_Packed | None] = [None] * count
        self._lock, self._taken = threading.Lock(), 0

    def add(self, index: int, part: Part) -> None:
        """Store the part of a view; thread-safe."""
        with self._lock:
            has_room = self._taken + part.color.nbytes <= self.most_bytes
            self._taken += part.color.nbytes if has_room else 0
        self._packed[index] = _Packed.of(part, keeps_color=has_room)

    def photographs(
        self, height: int, width: int, read: Callable[[int], Part], *, threads: int
    ) -> "Photographs":
        """Return the photographs once all their parts were added.

        Parameters
        ----------
        height, width : size of the photographs in pixels.
        read : function that reads the part of a view again.
        threads : most threads that do so at the same time.
        """
        packed = [part for part in self._packed if part is not None]
        count = len(self._packed)
        assert len(packed) == count, "a view was not added"
        corners = np.zeros((count, 2), int)
        return Photographs((count, height, width, 4), None, packed, read, corners, threads)


class _Stack(abc.ABC):
    """Base of classes that act as an array of V images, each of which is computed when indexed."""

    shape: tuple[int, ...]
    dtype = np.dtype(np.float32)

    @abc.abstractmethod
    def _make(self, index: int) -> np.ndarray:
        """Compute the image of a view."""

    def _make_all(self, indices: Sequence[int]) -> list[np.ndarray]:
        return [self._make(index) for index in indices]

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __len__(self) -> int:
        """Count the views."""
        return self.shape[0]

    def __iter__(self) -> Iterator[np.ndarray]:
        """Compute one image after the other."""
        return (self._make(index) for index in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Compute all images."""
        if copy is False:
            raise ValueError("the array is made anew, so it is always a copy")
        images = self[:]
        return images if dtype is None else images.astype(dtype)

    def __getitem__(self, key: Any) -> np.ndarray:
        """Compute the images of some views, indexed as an array; further indices apply to these."""
        view_key, pixel_key = (key[0], key[1:]) if isinstance(key, tuple) and key else (key, ())
        if isinstance(view_key, int | np.integer):
            index = range(len(self))[view_key]
            return self._make(index)[pixel_key] if pixel_key else self._make(index)
        is_list = not pixel_key and view_key is not Ellipsis and np.ndim(view_key) == 1
        if isinstance(view_key, slice) or is_list:
            indices = np.arange(len(self))[view_key]
            images = self._make_all([int(index) for index in indices])
            views = np.stack(images) if images else np.empty((0, *self.shape[1:]), np.float32)
            return views[(slice(None), *pixel_key)] if pixel_key else views
        return self[:][key]


@dataclass(frozen=True, eq=False)
class Photographs(_Stack):
    """V photographs of one size, which decode to (V, H, W, 4) float32 linear RGB, straight alpha.

    Indexing with a number, a list or a slice computes the arrays of those views; `numpy.asarray`
    computes all of them.

    Attributes
    ----------
    shape : (V, H, W, 4).
    divisors : (V, 3) factors that linear colours are divided by; None for 1.
    """

    shape: tuple[int, int, int, int]
    divisors: Float[np.ndarray, "V 3"] | None
    _packed: Sequence[_Packed]
    _read: Callable[[int], Part] | None
    _corners: Int[np.ndarray, "V 2"]
    _threads: int = 1

    @classmethod
    def of(cls, images: "Images") -> "Photographs":
        """Return images as photographs; an array is not copied."""
        if isinstance(images, Photographs):
            return images
        packed = tuple(
            _Packed(0, 0, image.shape[:2], image.dtype, image[..., :3], image[..., 3])
            for image in images
        )
        shape: Any = images.shape
        return cls(shape, None, packed, None, np.zeros((len(images), 2), int))

    @property
    def nbytes(self) -> int:
        """Memory that is taken, in bytes."""
        return sum(part.byte_count for part in self._packed)

    @property
    def read_again_count(self) -> int:
        """Count the views whose colours do not stay in memory."""
        return sum(part.color is None for part in self._packed)

    @property
    def alphas(self) -> "Alphas":
        """Alpha of the views, one by one."""
        return Alphas(self)

    def windows(self, corners: Int[np.ndarray, "V 2"], height: int, width: int) -> "Photographs":
        """Return windows of the photographs, without a copy.

        Parameters
        ----------
        corners : (V, 2) row and column of the upper left pixel of each window.
        height, width : size of all windows, pixels.
        """
        shape = (len(self), height, width, 4)
        return replace(self, shape=shape, _corners=self._corners + corners)

    def divided(self, factors: Float[np.ndarray, "V 3"]) -> "Photographs":
        """Divide linear colours by a factor for every view and channel; alpha is unchanged."""
        old_divisors = 1.0 if self.divisors is None else self.divisors
        return replace(self, divisors=old_divisors * factors)

    def _placed(self, index: int, out: np.ndarray, values: np.ndarray) -> None:
        """Write values of a view's part to their place in the window ``out``."""
        packed, (row, column) = self._packed[index], self._corners[index]
        top, left = packed.top - int(row), packed.left - int(column)
        height, width = packed.shape
        rows = slice(max(top, 0), max(min(top + height, self.shape[1]), 0))
        columns = slice(max(left, 0), max(min(left + width, self.shape[2]), 0))
        part = values[
            max(rows.start - top, 0) : max(rows.stop - top, 0),
            max(columns.start - left, 0) : max(columns.stop - left, 0),
        ]
        if part.size:
            is_color = part.ndim == 3
            out[rows, columns] = values_of(part, is_srgb=is_color)

    def _make(self, index: int) -> Float[np.ndarray, "H W 4"]:
        packed = self._packed[index]
        image = np.zeros(self.shape[1:], np.float32)
        color = packed.color
        if color is None:
            assert self._read is not None
            color = self._read(index).color
        self._placed(index, image[..., :3], color)
        self._placed(index, image[..., 3], packed.unpacked_alpha())
        if self.divisors is not None:
            image[..., :3] /= self.divisors[index].astype(np.float32)
        return image

    def _make_all(self, indices: Sequence[int]) -> list[np.ndarray]:
        from_files = sum(self._packed[index].color is None for index in indices)
        if from_files < 2:
            return super()._make_all(indices)
        with ThreadPoolExecutor(max_workers=self._threads) as pool:
            return list(pool.map(self._make, indices))

    def alpha(self, index: int) -> Float[np.ndarray, "H W"]:
        """Make the alpha of one view; its file is not read again."""
        alpha = np.zeros(self.shape[1:3], np.float32)
        self._placed(index, alpha, self._packed[index].unpacked_alpha())
        return alpha


def values_of(numbers: np.ndarray, *, is_srgb: bool) -> np.ndarray:
    """Decode integers of a file to linear float32; floats are returned as they are.

    ``is_srgb`` : whether integers are colours in sRGB; otherwise they are linear.
    """
    if numbers.dtype.kind == "f":
        return numbers
    return np.take(decoding_table(numbers.dtype, is_srgb=is_srgb), numbers)


@dataclass(frozen=True, eq=False)
class Alphas(_Stack):
    """Alpha of V photographs, which decodes to (V, H, W) float32."""

    photographs: Photographs
    shape: tuple[int, int, int] = field(init=False)

    def __post_init__(self) -> None:
        """Take the shape of the photographs."""
        object.__setattr__(self, "shape", self.photographs.shape[:3])

    def _make(self, index: int) -> np.ndarray:
        return self.photographs.alpha(index)


def pack_marks(marks: Bool[np.ndarray, "H W"]) -> Shaped[np.ndarray, "H bytes"] | None:
    """Pack an image of zeros and ones into bits; None where all are one."""
    return None if marks.all() else np.packbits(marks, axis=1)


@dataclass(frozen=True, eq=False)
class Marks(_Stack):
    """V images of zeros and ones, one bit per pixel, which decode to (V, H, W) float32."""

    shape: tuple[int, int, int]
    _bits: Sequence[np.ndarray]
    _width: int
    _corners: Int[np.ndarray, "V 2"]

    @classmethod
    def of(
        cls, bits: Sequence[Shaped[np.ndarray, "H bytes"] | None], height: int, width: int
    ) -> "Marks | None":
        """Return images from results of `pack_marks`; None if all pixels of all images are one."""
        if all(image is None for image in bits):
            return None
        ones = np.broadcast_to(np.uint8(255), (height, -(-width // 8)))
        images = [ones if image is None else image for image in bits]
        corners = np.zeros((len(bits), 2), int)
        return cls((len(bits), height, width), images, width, corners)

    @classmethod
    def of_array(cls, marks: "np.ndarray | Marks") -> "Marks":
        """Pack images (V, H, W); values above zero become one."""
        if isinstance(marks, Marks):
            return marks
        bits = [np.packbits(image > 0, axis=1) for image in marks]
        return cls(marks.shape, bits, marks.shape[2], np.zeros((len(marks), 2), int))

    @property
    def nbytes(self) -> int:
        """Memory that is taken, in bytes."""
        return sum(bits.nbytes for bits in self._bits if any(bits.strides))

    def windows(self, corners: Int[np.ndarray, "V 2"], height: int, width: int) -> "Marks":
        """Return windows, which must lie inside the images; see `Photographs.windows`."""
        shape = (len(self), height, width)
        return replace(self, shape=shape, _corners=self._corners + corners)

    def _make(self, index: int) -> Float[np.ndarray, "H W"]:
        (row, column), (height, width) = self._corners[index], self.shape[1:]
        rows = self._bits[index][row : row + height]
        unpacked_rows = np.unpackbits(rows, axis=1, count=self._width)
        return unpacked_rows[:, column : column + width].astype(np.float32)


Images = np.ndarray | Photographs
"""(V, H, W, 4) linear RGB with straight alpha."""
