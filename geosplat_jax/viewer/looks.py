"""Views that the viewer shows, and the quality of the next picture. No renderer, no server."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from geosplat_jax.core.types import Camera

AS_TRAINED = "as trained"
"""Name of the recovered light."""

MODES = ("render", "albedo", "roughness", "metallic", "normal", "depth")
"""What a picture can show."""


@dataclass(frozen=True)
class Level:
    """Quality of a picture.

    Attributes
    ----------
    width, height : size of the picture in pixels.
    samples : rays per splat, see `Renderer`.
    """

    width: int
    height: int
    samples: int


LEVELS = (Level(192, 128, 4), Level(384, 256, 4), Level(768, 512, 64))
"""Levels from fast to good. Every size is compiled separately, so there are few, of one aspect
ratio: pictures are stretched to the window."""


@dataclass(frozen=True)
class Look:
    """What the user wants to see: camera, mode and light.

    Attributes
    ----------
    position : position of the camera, world.
    rotation : quaternion (w, x, y, z) from OpenCV camera axes to the world.
    field_of_view : vertical field of view, radians.
    aspect : width of the window over its height.
    mode : one of `MODES`.
    light : name of the light.
    turn : rotation of the light about the vertical axis, degrees, counter-clockwise from above.
    intensity : factor on the light.
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
        """Return the camera at a level; its pixels are not square if the window is not 3 : 2."""
        w, x, y, z = self.rotation
        to_world = Rotation.from_quat((x, y, z, w)).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = to_world.T
        pose[:3, 3] = -to_world.T @ np.asarray(self.position)
        half_height = np.tan(0.5 * self.field_of_view)
        lens = np.array(
            [
                [0.5 * level.width / (half_height * self.aspect), 0.0, 0.5 * level.width],
                [0.0, 0.5 * level.height / half_height, 0.5 * level.height],
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
    """Chooses the level of the next picture: fast while the look changes, better when it does not.

    The first picture of a look has the best level that took at most ``seconds`` when it was last
    drawn. While the look does not change, the level rises to the best, one at a time; levels that
    are slower, or whose time is unknown, are only drawn after ``rest`` seconds without a change.

    Parameters
    ----------
    levels : levels from fast to good.
    seconds : longest time of a picture while the look changes.
    rest : seconds without a change after which slow pictures are drawn.
    clock : function that returns monotonic seconds.
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
            quick_levels = [number for number in range(len(self._levels)) if self._keeps_up(number)]
            self._next = max(quick_levels, default=0)
            return self._levels[self._next]
        if self._next >= len(self._levels):
            return None
        if not self._keeps_up(self._next) and self._next > 0 and now - self._since < self._rest:
            return None
        return self._levels[self._next]

    def note(self, level: Level, seconds: float) -> None:
        """Record the time of a picture.

        That of the first picture of a level is ignored, since it includes the compilation.
        """
        number = self._levels.index(level)
        if self._has_compiled[number]:
            self._paces[number] = seconds
        self._has_compiled[number] = True
        self._next = number + 1

    def forget(self) -> None:
        """Let the same look be drawn again, because the run has changed."""
        self._look = None
