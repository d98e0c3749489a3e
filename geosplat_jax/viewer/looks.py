"""What the viewer shows, and how good its next picture should be. No renderer, no server."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from geosplat_jax.core.types import Camera

AS_TRAINED = "as trained"
"""Name of the light that was found."""

MODES = ("render", "albedo", "roughness", "metallic", "normal", "depth")
"""What a picture can show."""


@dataclass(frozen=True)
class Level:
    """How good a picture is.

    Attributes
    ----------
    width, height : pixels. samples : rays per splat, see `Renderer`.
    """

    width: int
    height: int
    samples: int


LEVELS = (Level(192, 128, 4), Level(384, 256, 4), Level(768, 512, 64))
"""From quick to good. Every size is a program of its own, so there are few, of one shape: pixels
are stretched to the shape of the window."""


@dataclass(frozen=True)
class Look:
    """What somebody wants to see.

    Attributes
    ----------
    position : of the camera in the world.
    rotation : quaternion (w, x, y, z) from OpenCV camera axes to the world.
    field_of_view : vertical, radians.
    aspect : width of the window over its height.
    mode : one of `MODES`.
    light : name of a light; turn : degrees that it is turned by about the vertical axis,
        counter-clockwise seen from above; intensity : factor of it.
    background : one of `relight.BACKGROUNDS`.
    """

    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    field_of_view: float
    aspect: float
    mode: str = "render"
    light: str = AS_TRAINED
    turn: float = 0.0
    intensity: float = 1.0
    background: str = "white"

    def camera(self, level: Level) -> Camera:
        """Return the camera, whose pixels have the shape that fills the window."""
        w, x, y, z = self.rotation
        to_world = Rotation.from_quat((x, y, z, w)).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = to_world.T
        pose[:3, 3] = -to_world.T @ np.asarray(self.position)
        half = np.tan(0.5 * self.field_of_view)
        lens = np.array(
            [
                [0.5 * level.width / (half * self.aspect), 0.0, 0.5 * level.width],
                [0.0, 0.5 * level.height / half, 0.5 * level.height],
                [0.0, 0.0, 1.0],
            ]
        )
        return Camera(
            jnp.asarray(pose[None], jnp.float32),
            jnp.asarray(lens[None], jnp.float32),
            level.height,
            level.width,
        )


class Ladder:
    """Chooses the level of the next picture: quick while things move, better when they rest.

    The first picture of a look has the best level that took less than ``seconds`` when it was last
    drawn. A look that stays climbs to the best level, one at a time; levels that are slower, or
    that nobody has drawn yet, wait until it has stayed for ``rest``.

    Parameters
    ----------
    levels : from quick to good.
    seconds : that a picture may take while things move.
    rest : seconds without a change after which slow pictures are drawn.
    clock : seconds, monotonic.
    """

    def __init__(
        self,
        levels: Sequence[Level] = LEVELS,
        *,
        seconds: float = 0.25,
        rest: float = 0.4,
        clock: Callable[[], float],
    ) -> None:
        self._levels = tuple(levels)
        self._limit, self._rest, self._clock = seconds, rest, clock
        self._paces: list[float | None] = [None] * len(self._levels)
        self._has_compiled = [False] * len(self._levels)
        self._look: Look | None = None
        self._since = 0.0
        self._next = 0

    def _keeps_up(self, number: int) -> bool:
        pace = self._paces[number]
        return pace is not None and pace <= self._limit

    def next(self, look: Look) -> Level | None:
        """Return the level to draw a look at now; None where there is nothing to do yet."""
        now = self._clock()
        if look != self._look:
            self._look, self._since = look, now
            quick = [number for number in range(len(self._levels)) if self._keeps_up(number)]
            self._next = max(quick, default=0)
            return self._levels[self._next]
        if self._next >= len(self._levels):
            return None
        if not self._keeps_up(self._next) and self._next > 0 and now - self._since < self._rest:
            return None
        return self._levels[self._next]

    def note(self, level: Level, seconds: float) -> None:
        """Learn what a picture took; the first one of a level also waited for its compilation."""
        number = self._levels.index(level)
        if self._has_compiled[number]:
            self._paces[number] = seconds
        self._has_compiled[number] = True
        self._next = number + 1

    def forget(self) -> None:
        """Draw the same look anew, since what is looked at has changed."""
        self._look = None
