"""An isosurface whose values are stored in a band around it: cost and memory grow with its area.

The isosurface itself is that of `geometry`; only the storage of its values differs.
"""

from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from geosplat_jax.core.types import Geometry, Grid
from geosplat_jax.geometry import GridSurface
from geosplat_jax.surface.band import Band, band_from
from geosplat_jax.surface.base import Following
from geosplat_jax.surface.grids import neutral_geometry
from geosplat_jax.surface.lattice import Lattice


class BandedFlexiCubes(GridSurface):
    """The isosurface of values in a band of cells, which follows the surface.

    Attributes
    ----------
    band : cells and vertices that hold values; their rows are the rows of the shape.
    layers : static; layers of cells on each side of those that the surface passes through.
    entropy_reduction : see `GridSurface.reduction`.
    """

    band: Band
    layers: int = eqx.field(static=True, default=1)
    entropy_reduction: Literal["mean", "sum"] = eqx.field(static=True, default="mean")

    @property
    def reduction(self) -> Literal["mean", "sum"]:
        """Reduction of Eq. 14, see `GridSurface.reduction`."""
        return self.entropy_reduction

    @property
    def lattice(self) -> Lattice:
        """The band: only its cells and vertices hold values."""
        return self.band

    @classmethod
    def around(
        cls,
        sdf: Float[np.ndarray, " V"],
        grid: Grid,
        layers: int,
        entropy_reduction: Literal["mean", "sum"] = "mean",
    ) -> "tuple[BandedFlexiCubes, Geometry]":
        """Make the model and shape of a surface from values on all vertices of a grid (host side).

        There is no deformation, and weights are neutral.

        Parameters
        ----------
        sdf : (V,) signed values of the vertices, cells, x fastest.
        grid : the grid.
        layers, entropy_reduction : static; see the class.
        """
        band, values = band_from(grid, sdf, layers)
        return cls(band, layers, entropy_reduction), neutral_geometry(
            jnp.asarray(values), band.cell_rows
        )

    def following(self, shape: Geometry) -> Following | None:
        """Move the band to where the surface is now; see `Band.following`."""
        band_update = self.band.following(shape.sdf, self.layers)
        if band_update is None:
            return None
        band, move, sdf = band_update
        new_shape = replace(move.carried(shape), sdf=jnp.array(sdf))
        return Following(replace(self, band=band), new_shape, move.carried)
