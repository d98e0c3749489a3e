"""The interface of a surface: a mesh, its penalties, and an index for rays."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.types import Box, Mesh
from geosplat_jax.rays.base import RayIndex


class Surface(eqx.Module):
    """An extracted surface.

    Attributes
    ----------
    mesh : triangles that face outwards; a face is identified by its row.
    usage : true needs of the buffers. Where they exceed their capacities the mesh is wrong and must
        be discarded.
    """

    mesh: Mesh
    usage: Usage


class Following(NamedTuple):
    """The successor of a surface model and of its shape; see `SurfaceModel.following`.

    Attributes
    ----------
    model, shape : the model that replaces the old one, and its parameters.
    carried : function that brings a pytree laid out like the old shape, such as an optimiser's
        moments, into the layout of the new shape; rows that are new become 0.
    """

    model: "SurfaceModel"
    shape: Any
    carried: Callable[[Any], Any]


class SurfaceModel(eqx.Module):
    """A representation of a surface, which turns learned parameters into a mesh.

    These parameters (`Params.geometry`) are called its *shape*, not to be confused with
    `Grid.shape`; they are a pytree of any structure.
    """

    @property
    @abc.abstractmethod
    def box(self) -> Box:
        """The cube around the surface that fields are defined on."""

    @property
    def is_two_sided(self) -> bool:
        """Whether fronts and backs are two surfaces at the same place (static)."""
        return False

    @abc.abstractmethod
    def extract(self, shape: Any, *, capacities: Capacities, final: bool = False) -> Surface:
        """Build the mesh of a shape; its vertices are differentiable in the shape.

        Parameters
        ----------
        shape : learned parameters of the surface.
        capacities : static sizes of buffers.
        final : static; whether to build the mesh that is exported, where that differs from the one
            that is trained.
        """

    @abc.abstractmethod
    def penalties(self, shape: Any, surface: Any) -> dict[str, Float[Array, ""]]:
        """Evaluate the surface's own terms of the loss; differentiable in the shape.

        Parameters
        ----------
        shape : learned parameters of the surface.
        surface : what `extract` returned for them.

        Returns
        -------
        () unweighted value of every term, by the name of its weight.
        """

    @abc.abstractmethod
    def ray_index(self, surface: Any, *, capacities: Capacities) -> RayIndex:
        """Build the structure that rays are traced against, from a surface of `extract`.

        Not differentiable. Its ``usage`` tells whether its buffers fit the static ``capacities``.
        """

    @abc.abstractmethod
    def nearby_points(self, shape: Any) -> tuple[Float[Array, "N 3"], Float[Array, " N"]]:
        """Return points (N, 3), world, and weights (N,): zero for points not near the surface."""

    @abc.abstractmethod
    def first_capacities(self, shape: Any) -> Capacities:
        """Guess the sizes of the surface's own buffers (host side)."""

    def following(self, shape: Any) -> Following | None:
        """Return the model that must replace this one now that the surface has moved (host side).

        None, the default, where this model can still represent the surface. Deterministic: depends
        on model and shape alone. `banded.BandedFlexiCubes` is a model that is replaced.
        """
        del shape
        return None
