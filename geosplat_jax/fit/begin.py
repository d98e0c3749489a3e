"""How a run begins in its folder: anew, resumed, or with stages of another run."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from geosplat_jax.fit.config import Config
from geosplat_jax.fit.devices import Devices
from geosplat_jax.fit.entering import Start
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.loop import Loop, adopted_loop, new_loop
from geosplat_jax.io.dataset import Dataset


class Begin:
    """How a run begins; every way is a subclass.

    Attributes
    ----------
    replace : whether a run that the folder holds is removed.
    start : shape, light and exposure of another training that the run begins, or began, with.
    resumes : whether a run that the folder holds goes on.
    takes_over : whether the first stages come from another run.
    """

    replace: bool = False
    start: Start | None = None
    resumes: ClassVar[bool] = False
    takes_over: ClassVar[bool] = False

    def goes_on(self, run: RunFolder) -> bool:
        """Whether this goes on with a run that the folder holds."""
        return self.resumes and run.exists

    def first_loop(
        self, dataset: Dataset, config: Config, run: RunFolder, devices: Devices
    ) -> Loop:
        """Build the loop of a new run, before its folder says that there is one.

        With new parameters, and the shape and light of ``start`` where there is one.

        Raises
        ------
        RunError, TrainingError
            If what it begins with does not fit.
        """
        return new_loop(dataset, config, run, devices, self.start)


@dataclass(frozen=True)
class Anew(Begin):
    """Begin with a first surface and new parameters.

    Parameters
    ----------
    replace : whether a run that the folder holds is removed; it is refused otherwise.
    start : shape, light and exposure of another training to begin with.
    """

    replace: bool = False
    start: Start | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Resume(Begin):
    """Go on from the last good checkpoint, or from the start where there is none.

    Equals the uninterrupted run bit for bit.

    Parameters
    ----------
    start : that the run began with, or begins with now.
    """

    start: Start | None = field(default=None, repr=False)
    resumes: ClassVar[bool] = True


@dataclass(frozen=True)
class TakeOver(Begin):
    """Take the first stages from another run, of the same scene and with the same settings of them.

    Parameters
    ----------
    source : folder of that run.
    first_stage : the first stage that is not taken from it.
    replace : as for `Anew`.
    """

    source: str | Path
    first_stage: str
    replace: bool = False
    takes_over: ClassVar[bool] = True

    def first_loop(
        self, dataset: Dataset, config: Config, run: RunFolder, devices: Devices
    ) -> Loop:
        """Build the loop of a run that stands where the other one ended the stage before."""
        other = RunFolder(self.source)
        other.require_same_scene(dataset)
        return adopted_loop(dataset, config, run, other, self.first_stage, devices)


ANEW = Anew()
"""In a folder that holds no run."""
