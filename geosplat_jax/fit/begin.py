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
    resumes : whether a run that the folder holds is continued.
    takes_over : whether the first stages come from another run.
    """

    replace: bool = False
    start: Start | None = None
    resumes: ClassVar[bool] = False
    takes_over: ClassVar[bool] = False

    def continues(self, run: RunFolder) -> bool:
        """Whether this continues a run that the folder holds; False where it holds none."""
        return self.resumes and run.exists

    def first_loop(
        self, dataset: Dataset, config: Config, run: RunFolder, devices: Devices
    ) -> Loop:
        """Build the loop of a new run, before its record is written to the folder.

        The parameters are new, except for the shape, light and exposure of ``start`` where it is
        given.

        Parameters
        ----------
        dataset : scene to train on.
        config : settings of the run.
        run : folder of the run.
        devices : devices that the run trains on.

        Raises
        ------
        RunError, TrainingError
            If there is nothing to train or to start from, or what the run begins with does not fit.
        """
        return new_loop(dataset, config, run, devices, self.start)


@dataclass(frozen=True)
class Anew(Begin):
    """Begin with a new surface and new parameters.

    Parameters
    ----------
    replace : whether a run that the folder holds is removed; otherwise such a folder is refused.
    start : shape, light and exposure of another training to begin with.
    """

    replace: bool = False
    start: Start | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Resume(Begin):
    """Continue the run that the folder holds, from its last good checkpoint.

    Begins anew where the folder holds no run, or the run has no checkpoint. On a CPU and without a
    budget, the result equals that of the uninterrupted run bit for bit.

    Parameters
    ----------
    start : shape, light and exposure that the run began with, or begins with now.
    """

    start: Start | None = field(default=None, repr=False)
    resumes: ClassVar[bool] = True


@dataclass(frozen=True)
class TakeOver(Begin):
    """Take the first stages from another run of the same scene, trained with the same settings.

    Parameters
    ----------
    source : folder of the other run.
    first_stage : name of the first stage that is not taken from it.
    replace : as for `Anew`.
    """

    source: str | Path
    first_stage: str
    replace: bool = False
    takes_over: ClassVar[bool] = True

    def first_loop(
        self, dataset: Dataset, config: Config, run: RunFolder, devices: Devices
    ) -> Loop:
        """Build the loop of a run that continues where the other run ended the stage before.

        See `Begin.first_loop`; the scene of the other run must be ``dataset``.
        """
        source_run = RunFolder(self.source)
        source_run.require_same_scene(dataset)
        return adopted_loop(dataset, config, run, source_run, self.first_stage, devices)


ANEW = Anew()
"""Begin in a folder that holds no run; a folder that holds one is refused."""
