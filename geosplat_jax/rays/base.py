"""The interface of ray queries on a surface: occlusion, and the nearest hit."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.capacity import Usage


class RayIndex(eqx.Module):
    """An acceleration structure for rays against a surface (elsewhere often a BVH, here a grid).

    Exact, and without gradients.

    Attributes
    ----------
    usage : true needs of its buffers. Where they exceed their capacities, answers are wrong and
        must be discarded.
    """

    usage: eqx.AbstractVar[Usage]

    @property
    @abc.abstractmethod
    def face_capacity(self) -> int:
        """Rows of faces in the mesh, padding included."""

    @property
    def place_size(self) -> Float[Array, ""]:
        """How far a point may move and still be at its place, in world units; see `places`.

        Infinite unless an index says otherwise.
        """
        return jnp.asarray(jnp.inf)

    def places(self, positions: Float[Array, "N 3"], faces: Int[Array, " N"]) -> Int[Array, " N"]:
        """Return the number of the place that each point lies on: here the row of its face.

        A place keeps its number from one training step to the next.

        Parameters
        ----------
        positions : (N, 3) world, on the surface.
        faces : (N,) face that each point lies on; -1 for none.

        Returns
        -------
        (N,) number of the place, at least 0; -1 for a point without a place.
        """
        del positions
        return faces

    @abc.abstractmethod
    def occluded(
        self,
        origins: Float[Array, "N 3"],
        directions: Float[Array, "N 3"],
        source: Int[Array, " N"],
        mask: Bool[Array, " N"],
        *,
        two_sided: bool = False,
    ) -> Bool[Array, " N"]:
        """Tell which rays hit the surface anywhere.

        Parameters
        ----------
        origins, directions : (N, 3) world; directions are unit.
        source : (N,) face that a ray starts on and never hits; -1 for none.
        mask : (N,) rays to trace; the others are not occluded, and cost little.
        two_sided : static; whether back faces count.

        Returns
        -------
        (N,) True for rays that hit the surface.
        """

    @abc.abstractmethod
    def nearest(
        self,
        origins: Float[Array, "N 3"],
        directions: Float[Array, "N 3"],
        source: Int[Array, " N"],
        mask: Bool[Array, " N"],
        *,
        two_sided: bool = False,
    ) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
        """Find the first hit of every ray; arguments as for `occluded`.

        Returns
        -------
        distance : (N,) world units, infinite where nothing is hit.
        face : (N,) face of the surface's mesh, -1 where nothing is hit.
        """
