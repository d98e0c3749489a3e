"""Settings of the surfaces: what a run starts from, and how large it may become."""

import abc
from dataclasses import replace
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from pydantic import Field

from geosplat_jax.banded import BandedFlexiCubes
from geosplat_jax.core.settings import PositiveCount, Variant, settings
from geosplat_jax.core.types import Bounds, Geometry, Grid
from geosplat_jax.geometry import (
    FlexiCubes,
    GridSurface,
    initial_geometry,
    random_sdf,
    sphere_sdf,
)
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.surface.band import REACH, Band
from geosplat_jax.surface.base import SurfaceModel
from geosplat_jax.surface.grids import closed_at_border, neutral_geometry
from geosplat_jax.surface.hollows import carve_hollows
from geosplat_jax.surface.hull import fit_grid, hull_sdf

_SPLATS_PER_CELL = 24
"""Splats per cell that the surface passes through: on average such a cell has one quad."""

_NUMBERS_PER_CELL = 25
"""Learned numbers per cell: 21 weights, and an SDF value and a deformation of one vertex."""

_FLOAT_BYTES = 4


@settings
class SurfaceSettings(Variant, abc.ABC):
    """Settings of a surface; every kind of them is a subclass."""

    @property
    @abc.abstractmethod
    def rate_groups(self) -> tuple[str, ...]:
        """Names of the learning rates of its shape (see `core.types.learned`)."""

    @property
    @abc.abstractmethod
    def penalty_names(self) -> tuple[str, ...]:
        """Names of its terms in the loss."""

    @property
    def limits(self) -> dict[str, int]:
        """Largest sensible need of a buffer, by name; beyond it the surface has exploded."""
        return {}

    @property
    def cells_along(self) -> int | None:
        """Cells along the longest side of the box; None for a surface without a grid."""
        return None

    def expected_splats(self, pixels: float) -> int:
        """Estimate the number of splats before any surface is known.

        ``pixels`` : number of pixels of a view.
        """
        del pixels
        return 60_000

    @property
    def fewest_splats(self) -> int:
        """Least number of splats that a surface has; 0 where it is not known."""
        return 0

    def parameter_bytes(self, bounds: Bounds) -> int:
        """Count the bytes of the shape that `start` makes; 0 where they are not known.

        ``bounds`` : lo (3,) and hi (3,) of the box around the object.
        """
        del bounds
        return 0

    def notes(self, dataset: Dataset) -> tuple[str, ...]:
        """Describe what the user should know about what `start` does for a scene.

        Raises
        ------
        ValueError
            For the reasons of `start`, as far as the notes need the same preparation.
        """
        del dataset
        return ()

    @abc.abstractmethod
    def start(self, dataset: Dataset, key: Key[Array, ""]) -> tuple[SurfaceModel, Any]:
        """Make the surface and its first shape for a scene.

        Parameters
        ----------
        dataset : the scene.
        key : random key of a first shape that is random.

        Returns
        -------
        model : surface model.
        shape : its parameters.

        Raises
        ------
        ValueError
            If there is nothing to start from; the message says what to change.
        """

    def restart(
        self, model: SurfaceModel, dataset: Dataset, key: Key[Array, ""]
    ) -> tuple[SurfaceModel, Any]:
        """Make the first surface and shape again, for a run whose checkpoint holds ``model``.

        By default the same as `start`.

        Raises
        ------
        ValueError
            As `start`.
        """
        del model
        return self.start(dataset, key)

    @abc.abstractmethod
    def describe(self, model: SurfaceModel) -> dict[str, Any]:
        """Return the sizes of a model that JSON can hold, for `template`."""

    @abc.abstractmethod
    def template(self, description: dict[str, Any]) -> tuple[SurfaceModel, Any]:
        """Make a model and a shape of the described sizes; their values have no meaning."""


@settings
class FlexiCubesSettings(SurfaceSettings, kind="flexicubes"):
    """An isosurface on a grid of cubic cells."""

    resolution: Annotated[int, Field(ge=5, le=512)] = 48
    """Cells along the longest side of the box around the object."""
    initial: Literal["hull", "sphere", "random"] = "hull"
    """First surface: visual hull of the masks, a sphere, or noise (the paper)."""
    hollows: bool = True
    """Carve hollows that no mask can show, such as the inside of a bowl, out of the visual hull,
    where the photographs agree much better on the colours behind its surface than on it."""
    band: Literal[0, 3, 5, 7] = 0
    """Thickness, in cells, of a band around the surface. Only its cells hold values, and it follows
    the surface, so that memory and time grow with the surface's area. 0: all cells of the box."""
    cubic: bool = False
    """Use equally many cells along every side, as the authors do, and not only as many as the box
    needs."""
    reach: Annotated[float, Field(ge=0, le=0.5)] = 0.5
    """A grid vertex moves by at most this share of a cell (the authors: 1/4)."""
    entropy_reduction: Literal["mean", "sum"] = "mean"
    """Reduction of Eq. 14 over sign-changing edges: the mean, or the sum as printed in the paper,
    which soon outweighs the images and empties the surface."""
    max_quads: PositiveCount = 400_000
    """A surface with more quads than this is taken to have exploded (about 25 KB per quad)."""

    @property
    def rate_groups(self) -> tuple[str, ...]:
        """Learning rates of `Geometry`."""
        return ("sdf", "deform", "weights")

    @property
    def penalty_names(self) -> tuple[str, ...]:
        """Terms of `GridSurface.penalties`."""
        return ("entropy", "deviation", "weights")

    @property
    def limits(self) -> dict[str, int]:
        """At most ``max_quads`` quads."""
        return {"quads": self.max_quads}

    @property
    def cells_along(self) -> int:
        """Cells along the longest side of the box."""
        return self.resolution

    def expected_splats(self, pixels: float) -> int:
        """Estimate the splats: 50 times the squared resolution; a bottle has 30, a duck 60."""
        del pixels
        return 50 * self.resolution**2

    def start(self, dataset: Dataset, key: Key[Array, ""]) -> tuple[GridSurface, Geometry]:
        """Fit a grid to the object and fill it with a first surface."""
        grid = self._grid(dataset.bounds)
        sdf = self._sdf(grid, dataset, key)
        if not bool(jnp.any(sdf < 0)) or not bool(jnp.any(sdf >= 0)):
            raise ValueError(
                f"the first surface (geometry.initial = {self.initial}) is empty: the masks and "
                "cameras agree on no point inside the bounds. Check poses and masks with "
                "geosplat-jax info, give --bounds, or start from geometry.initial=sphere."
            )
        grid = self._reaching(grid)
        if self.band:
            return BandedFlexiCubes.around(
                np.asarray(sdf), grid, self.layers, self.entropy_reduction
            )
        return FlexiCubes(grid, self.entropy_reduction), initial_geometry(grid, sdf)

    @property
    def layers(self) -> int:
        """Layers of cells in the band on each side of those that the surface passes through."""
        return self.band // 2

    @property
    def fewest_splats(self) -> int:
        """A third of a bottle's splats; an object with fewer is not worth this resolution."""
        return 10 * self.resolution**2

    def parameter_bytes(self, bounds: Bounds) -> int:
        """Count the bytes of the values of the whole grid, or the least that a band may have."""
        if self.band:
            # One vertex per cell. In a thin object only the layers outside of it are certain.
            cells = (1 + self.layers) * self.fewest_splats // _SPLATS_PER_CELL
            return cells * _NUMBERS_PER_CELL * _FLOAT_BYTES
        grid = self._grid(bounds)
        shape = jax.eval_shape(lambda: initial_geometry(grid, jnp.zeros(grid.vertex_count)))
        return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shape))

    def _grid(self, bounds: Bounds) -> Grid:
        """Lay the grid around the object."""
        lo, hi = (np.asarray(corner) for corner in bounds)
        if self.cubic:
            middle, half = 0.5 * (lo + hi), 0.5 * np.max(hi - lo)
            lo, hi = middle - half, middle + half
        return fit_grid((lo, hi), self.resolution)

    def _sdf(self, grid: Grid, dataset: Dataset, key: Key[Array, ""]) -> Float[Array, " G"]:
        """Return the first signed values on the grid, negative inside the object."""
        if self.initial == "random":
            return closed_at_border(random_sdf(key, grid), grid)
        if self.initial == "sphere":
            radius = 0.35 * float(grid.cell_size) * max(grid.shape)
            return closed_at_border(sphere_sdf(grid, radius=radius), grid)
        views = dataset.train
        cameras = views.world_to_camera, np.asarray(views.intrinsics, np.float64)
        sdf = hull_sdf(*cameras, views.alphas, grid, valid=views.valid)
        if self.hollows:
            sdf = carve_hollows(*cameras, views.images, sdf, grid, valid=views.valid)
        return jnp.clip(jnp.asarray(sdf), -REACH, REACH)

    def _reaching(self, grid: Grid) -> Grid:
        """Set how far the vertices of a grid move."""
        return replace(grid, reach=self.reach)

    def describe(self, model: SurfaceModel) -> dict[str, Any]:
        """Return the cells along each axis, and the rows of a band."""
        if isinstance(model, BandedFlexiCubes):
            band = model.band
            rows = {"cell_rows": band.cell_rows, "vertex_rows": band.vertex_rows}
            return {"grid_shape": list(band.grid.shape), **rows}
        assert isinstance(model, FlexiCubes)
        return {"grid_shape": list(model.grid.shape)}

    def template(self, description: dict[str, Any]) -> tuple[GridSurface, Geometry]:
        """Make an empty grid, or an empty band."""
        nx, ny, nz = description["grid_shape"]
        if not all(isinstance(n, int) and n > 0 for n in (nx, ny, nz)):
            raise ValueError(f"grid_shape must be three numbers of cells, got {(nx, ny, nz)}")
        grid = self._reaching(Grid(jnp.zeros(3), jnp.ones(()), (nx, ny, nz)))
        if not self.band:
            shape = initial_geometry(grid, jnp.zeros(grid.vertex_count))
            return FlexiCubes(grid, self.entropy_reduction), shape
        rows = description["cell_rows"], description["vertex_rows"]
        if not all(isinstance(n, int) and n > 0 for n in rows):
            raise ValueError(f"cell_rows and vertex_rows must be numbers of rows, got {rows}")
        cell_rows, vertex_rows = rows
        band = Band.blank(grid, cell_rows, vertex_rows)
        shape = neutral_geometry(jnp.zeros(vertex_rows), cell_rows)
        return BandedFlexiCubes(band, self.layers, self.entropy_reduction), shape
