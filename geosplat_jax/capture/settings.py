"""Settings of splats that carry their own colour, and of their training."""

from typing import Annotated, Literal

from pydantic import Field

from geosplat_jax.core.harmonics import HIGHEST_DEGREE
from geosplat_jax.core.settings import (
    Count,
    NonNegative,
    Positive,
    PositiveCount,
    Share,
    settings,
)


@settings
class RadianceRates:
    """Learning rates of Adam, as in the code of Kerbl et al. 2023."""

    means: Positive = 1.6e-4
    """Rate of positions at the first step, in units of the cameras' extent."""
    means_last: Positive = 1.6e-6
    """Rate of positions at the last step; it decays exponentially between the two."""
    scales: Positive = 5e-3
    """Rate of the logarithms of scales."""
    quats: Positive = 1e-3
    """Rate of quaternions."""
    opacities: Positive = 5e-2
    """Rate of the logits of opacities."""
    base: Positive = 2.5e-3
    """Rate of the constant harmonic."""
    rest: Positive = 1.25e-4
    """Rate of the other harmonics: a twentieth of the constant one's."""


@settings
class RelocationSettings:
    """When splats are relocated, and how noisy positions are (Kheradmand et al. 2024)."""

    every: PositiveCount = 100
    """Steps between two relocations."""
    first: Count = 500
    """Number of steps before the first relocation."""
    until: Share = 5.0 / 6.0
    """Share of the steps after which splats are not relocated any more."""
    growth: Annotated[float, Field(ge=1.0, le=2.0)] = 1.05
    """Factor by which the number of splats grows at each relocation, up to the capacity."""
    noise: NonNegative = 5e5
    """Strength of the noise on positions, in units of their learning rate."""


@settings
class RadianceSettings:
    """Training of splats that carry their own colour."""

    steps: PositiveCount = 5000
    """Updates, one view each."""
    capacity: PositiveCount = 30_000
    """Largest number of splats."""
    degree: Annotated[int, Field(ge=0, le=HIGHEST_DEGREE)] = HIGHEST_DEGREE
    """Highest degree of the harmonics."""
    degree_every: PositiveCount = 1000
    """Steps after which one more degree is used."""
    structure: Share = 0.2
    """Weight of the structural dissimilarity; L1 has one minus this weight."""
    opacity_penalty: NonNegative = 0.01
    """Weight of the mean opacity."""
    scale_penalty: NonNegative = 0.01
    """Weight of the mean scale, in quarters of the cameras' extent."""
    first_opacity: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Opacity of every splat at the start."""
    first_scale: Positive = 0.1
    """Scale of every splat at the start, in units of the distance to its neighbours."""
    background: Literal["view", "black"] = "view"
    """Background of render and photograph: a random colour for every view, or black."""
    checkpoint_every: PositiveCount = 500
    """Steps between two checkpoints."""
    seed: Count = 0
    """Seed of every random choice."""
    rates: RadianceRates = RadianceRates()
    """Learning rates."""
    relocation: RelocationSettings = RelocationSettings()
    """How splats move."""
