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
    """Of positions at the first step, in units of the cameras' extent."""
    means_last: Positive = 1.6e-6
    """Of positions at the last step; exponential between the two."""
    scales: Positive = 5e-3
    """Of logarithms of scales."""
    quats: Positive = 1e-3
    """Of quaternions."""
    opacities: Positive = 5e-2
    """Of logits of opacities."""
    base: Positive = 2.5e-3
    """Of the constant harmonic."""
    rest: Positive = 1.25e-4
    """Of the other harmonics: a twentieth of the constant one's."""


@settings
class RelocationSettings:
    """When and how strongly splats move (Kheradmand et al. 2024)."""

    every: PositiveCount = 100
    """Steps between two relocations."""
    first: Count = 500
    """Step of the first one."""
    until: Share = 5.0 / 6.0
    """Share of the steps after which there is none any more."""
    growth: Annotated[float, Field(ge=1.0, le=2.0)] = 1.05
    """Factor of the number of splats at each, up to the capacity."""
    noise: NonNegative = 5e5
    """Strength of the noise of positions, times their learning rate."""


@settings
class RadianceSettings:
    """Training of splats that carry their own colour."""

    steps: PositiveCount = 5000
    """Updates, one view each."""
    capacity: PositiveCount = 30_000
    """Most splats that there may ever be."""
    degree: Annotated[int, Field(ge=0, le=HIGHEST_DEGREE)] = HIGHEST_DEGREE
    """Highest degree of the harmonics."""
    degree_every: PositiveCount = 1000
    """Steps after which one more degree is used."""
    structure: Share = 0.2
    """Weight of the structural dissimilarity; that of L1 is the rest."""
    opacity_penalty: NonNegative = 0.01
    """Weight of the mean opacity."""
    scale_penalty: NonNegative = 0.01
    """Weight of the mean scale, in quarters of the cameras' extent."""
    first_opacity: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Of every splat."""
    first_scale: Positive = 0.1
    """Of every splat, in units of the distance to its neighbours."""
    background: Literal["view", "black"] = "view"
    """Behind both images: a random colour for every view, or black."""
    checkpoint_every: PositiveCount = 500
    """Steps between two checkpoints."""
    seed: Count = 0
    """Of every random choice."""
    rates: RadianceRates = RadianceRates()
    """Learning rates."""
    relocation: RelocationSettings = RelocationSettings()
    """How splats move."""
