"""Frozen dataclasses as pytrees whose reconstruction skips ``__init__``.

JAX rebuilds a tree with leaves that are not arrays (labels, shapes, masks, ``None``). Rebuilding
must therefore not run the checks that construction by a user runs.
"""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, TypeVar

import jax

_Class = TypeVar("_Class")


def register_pytree(kind: type[_Class]) -> type[_Class]:
    """Register a frozen dataclass: fields with metadata ``static=True`` belong to the structure."""
    dynamic = tuple(f.name for f in fields(kind) if not f.metadata.get("static", False))  # pyright: ignore[reportArgumentType]
    static = tuple(f.name for f in fields(kind) if f.metadata.get("static", False))  # pyright: ignore[reportArgumentType]

    def flatten_with_keys(tree: _Class) -> tuple[Iterable[tuple[Any, Any]], Any]:
        children = [(jax.tree_util.GetAttrKey(name), getattr(tree, name)) for name in dynamic]
        return children, tuple(getattr(tree, name) for name in static)

    def flatten(tree: _Class) -> tuple[Iterable[Any], Any]:
        children = [getattr(tree, name) for name in dynamic]
        return children, tuple(getattr(tree, name) for name in static)

    def unflatten(structure: Any, children: Iterable[Any]) -> _Class:
        tree = object.__new__(kind)
        for name, value in zip(dynamic + static, (*children, *structure), strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(kind, flatten_with_keys, unflatten, flatten)
    return kind
