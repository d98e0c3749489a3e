"""Colour scales for numbers: errors, roughness, counts of views."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_GREY = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
# From black through purple, red and orange to pale yellow, with increasing lightness.
_HEAT = (
    (0.00, 0.00, 0.02),
    (0.23, 0.06, 0.44),
    (0.55, 0.16, 0.50),
    (0.87, 0.29, 0.41),
    (0.99, 0.62, 0.43),
    (0.99, 0.99, 0.75),
)
# From red for none through yellow to blue, so that places which few views see stand out.
_TRUST = ((0.70, 0.09, 0.17), (0.96, 0.60, 0.35), (0.99, 0.95, 0.70), (0.45, 0.72, 0.78))
_TRUST = (*_TRUST, (0.15, 0.36, 0.60))

DISTANCE_COLORS = _HEAT[::-1]
"""Colours of depths; near points are bright."""

LARGEST_ERROR = 0.2
"""Upper end of the scale of errors, a difference of sRGB values."""


@dataclass(frozen=True)
class Scale:
    """A colour scale: the map from numbers to colours.

    Attributes
    ----------
    name : name of the quantity.
    low, high : ends of the scale; numbers beyond have the colours of the ends.
    colors : colours at equal distances from low to high, sRGB in [0, 1].
    unit : unit of the numbers, or a word after the upper end.
    """

    name: str
    low: float
    high: float
    colors: tuple[tuple[float, float, float], ...]
    unit: str = ""

    def picture(self, values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 3"]:
        """Return the colours of numbers, sRGB float32."""
        share = np.clip((values - self.low) / (self.high - self.low), 0.0, 1.0)
        stops = np.linspace(0.0, 1.0, len(self.colors))
        channels = [np.interp(share, stops, channel) for channel in np.transpose(self.colors)]
        return np.stack(channels, axis=-1).astype(np.float32)

    def bar(self, height: int, width: int) -> Float[np.ndarray, "H W 3"]:
        """Draw the scale from left to right."""
        steps = np.linspace(self.low, self.high, width)
        return self.picture(np.broadcast_to(steps, (height, width)))

    @property
    def ends(self) -> tuple[str, str]:
        """Texts for both ends."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.low:g}", f"{self.high:g}{unit}"

    def described(self) -> dict[str, object]:
        """Return name, texts of the ends and hexadecimal colours, for JSON and a style sheet."""
        hexes = [
            "#" + "".join(f"{round(255 * channel):02x}" for channel in color)
            for color in self.colors
        ]
        return {"name": self.name, "ends": self.ends, "colors": hexes}


ERROR = Scale("error: mean difference of sRGB values", 0.0, LARGEST_ERROR, _HEAT)
ROUGHNESS = Scale("roughness", 0.0, 1.0, _GREY)
METALLIC = Scale("metallic", 0.0, 1.0, _GREY)
SEEN = Scale("training views that see the place", 0.0, 16.0, _TRUST, "or more")


def error_map(
    first: Float[np.ndarray, "H W 3"], second: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "H W 3"]:
    """Show the absolute difference of two sRGB pictures, mean over channels, on scale `ERROR`."""
    return ERROR.picture(np.abs(first - second).mean(axis=-1))
