"""Vectors whose components are arrays of their own, which XLA vectorises, unlike rows of three."""

from collections.abc import Sequence

from jaxtyping import Array, Float

Components = Sequence[Array]
"""The components x, y and z (of a quaternion w, x, y and z), whose shapes broadcast."""


def components(vectors: Float[Array, "N 3"]) -> tuple[Array, Array, Array]:
    """Take rows of three apart."""
    return vectors[:, 0], vectors[:, 1], vectors[:, 2]


def dot(a: Components, b: Components) -> Array:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Components, b: Components) -> tuple[Array, Array, Array]:
    """Cross product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
