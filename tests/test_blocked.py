"""The share of light that a surface blocks from itself, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.fit.blocked import blocked_share
from geosplat_jax.geometry import FlexiCubes, initial_geometry
from geosplat_jax.surface.grids import grid_vertices
from geosplat_jax.surface.hull import fit_grid

MIDDLE, WALL = 0.4, 0.06
"""Radius of the middle of a bowl's wall, and half the thickness of the wall."""


def ball(x, y, z):
    return np.sqrt(x**2 + y**2 + z**2) - MIDDLE


def bowl(x, y, z):
    """The lower half of a thick shell."""
    return np.maximum(np.abs(ball(x, y, z)) - WALL, z)


def bowl_share():
    """Return the closed form for `bowl`, as a share of its whole area.

    Half of the light for the inside of a hemisphere is blocked by the hemisphere itself, and none
    for its outside and its rim.
    """
    inner_area, outer_area = 2 * np.pi * (MIDDLE - WALL) ** 2, 2 * np.pi * (MIDDLE + WALL) ** 2
    rim_area = 0.5 * (outer_area - inner_area)
    return 0.5 * inner_area / (inner_area + outer_area + rim_area)


def surface(distance):
    grid = fit_grid((np.full(3, -0.52), np.full(3, 0.52)), 40)
    values = distance(*np.asarray(grid_vertices(grid), np.float64).T) / float(grid.cell_size)
    return FlexiCubes(grid), initial_geometry(grid, jnp.asarray(values, jnp.float32))


@pytest.mark.parametrize(
    ("distance", "share", "tolerance"), [(ball, 0.0, 0.002), (bowl, bowl_share(), 0.006)]
)
def test_a_surface_blocks_what_a_closed_form_says(distance, share, tolerance):
    model, bowl_geometry = surface(bowl)
    # With the capacities of the bowl, one program serves both surfaces.
    capacities = model.first_capacities(bowl_geometry)
    assert blocked_share(*surface(distance), capacities) == pytest.approx(share, abs=tolerance)
