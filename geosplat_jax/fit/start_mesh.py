"""Settings of a surface that starts as a given mesh (appendix H)."""

from typing import Annotated, Any, Literal

from jaxtyping import Array, Key
from pydantic import Field

from geosplat_jax.adapter import SPLATS_PER_FACE
from geosplat_jax.core.settings import Positive, settings
from geosplat_jax.fit.surfaces import SurfaceSettings
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.start_mesh import StartMesh, fitted
from geosplat_jax.surface.base import SurfaceModel
from geosplat_jax.surface.triangle_mesh import PENALTIES, TriangleMesh, VertexOffsets

_FACES_PER_SQUARE = 2.5
"""Faces per square of side one mean edge length in a view. The object is taken to fill a
third of the view, and to have a surface about three times as large as its silhouette."""

_SIZES = ("home", "faces", "edges", "neighbours", "wings")
"""Arrays of a `TriangleMesh` whose numbers of rows give the sizes of all its arrays."""


@settings
class MeshSettings(SurfaceSettings, kind="mesh"):
    """A given mesh whose vertices move."""

    path: str = ""
    """File of the mesh: PLY, OBJ, GLB or any other format that trimesh reads; set by --mesh."""
    digest: str = ""
    """Digest of the file's content; set by --mesh."""
    edge_pixels: Positive = 2.0
    """Mean edge length, in pixels of the training views, to which the mesh is decimated or
    subdivided."""
    max_faces: Annotated[int, Field(ge=4, le=2_000_000)] = 150_000
    """Largest number of faces after that (about 6 KB per face)."""
    sides: Literal["auto", "one", "both"] = "auto"
    """Sides of the mesh that are surface; auto: one side of a closed mesh, both of any other mesh,
    at twice the cost. Both sides need raster.cull_backfaces."""

    @property
    def file(self) -> "MeshSettings":
        """The same file, with all other settings at their defaults."""
        return MeshSettings(path=self.path, digest=self.digest)

    @property
    def rate_groups(self) -> tuple[str, ...]:
        """Learning rate of `VertexOffsets`."""
        return ("vertices",)

    @property
    def penalty_names(self) -> tuple[str, ...]:
        """Terms of `TriangleMesh.penalties`."""
        return PENALTIES

    def expected_splats(self, pixels: float) -> int:
        """Estimate the number of splats from the pixels of a view and the edge length in pixels."""
        faces = min(_FACES_PER_SQUARE * pixels / self.edge_pixels**2, float(self.max_faces))
        return SPLATS_PER_FACE * round(faces)

    def mesh(self, dataset: Dataset) -> StartMesh:
        """Read the file and fit it to the cameras.

        Raises
        ------
        ValueError
            See `io.start_mesh`.
        """
        if not self.path:
            raise ValueError("a surface of kind mesh needs a file; give it with --mesh FILE")
        return fitted(
            self.path,
            self.digest,
            dataset.train,
            edge_pixels=self.edge_pixels,
            most_faces=self.max_faces,
        )

    def _is_sheet(self, mesh: StartMesh) -> bool:
        return self.sides == "both" or (self.sides == "auto" and not mesh.is_closed)

    def notes(self, dataset: Dataset) -> tuple[str, ...]:
        """Say what is done to the file's mesh, and whether both of its sides count."""
        mesh = self.mesh(dataset)
        sides_note = (
            "open, both sides are surface" if self._is_sheet(mesh) else "one side is surface"
        )
        return (
            *mesh.notes,
            f"start: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {sides_note}",
        )

    def start(self, dataset: Dataset, key: Key[Array, ""]) -> tuple[TriangleMesh, VertexOffsets]:
        """Make the surface of the mesh, with no vertex moved."""
        del key
        mesh = self.mesh(dataset)
        model = TriangleMesh.of(mesh.vertices, mesh.faces, is_sheet=self._is_sheet(mesh))
        return model, model.start

    def restart(
        self, model: SurfaceModel, dataset: Dataset, key: Key[Array, ""]
    ) -> tuple[TriangleMesh, VertexOffsets]:
        """Return the model of the checkpoint with no vertex moved; the file is not read again."""
        del dataset, key
        assert isinstance(model, TriangleMesh)
        return model, model.start

    def describe(self, model: SurfaceModel) -> dict[str, Any]:
        """Return the rows of the arrays, the cells for rays, and whether both sides count."""
        assert isinstance(model, TriangleMesh)
        rows = {name: len(getattr(model, name)) for name in _SIZES}
        return {**rows, "cells": list(model.cells), "is_sheet": model.is_sheet}

    def template(self, description: dict[str, Any]) -> tuple[TriangleMesh, VertexOffsets]:
        """Make a mesh of zeros."""
        rows = [description[name] for name in _SIZES]
        cells, is_sheet = tuple(description["cells"]), description["is_sheet"]
        if not all(isinstance(n, int) and n >= 0 for n in (*rows, *cells)) or len(cells) != 3:
            raise ValueError(f"{rows} and {cells} must be numbers of rows and three of cells")
        model = TriangleMesh.blank(*rows, cells=cells, is_sheet=bool(is_sheet))
        return model, model.start
