"""How a run begins, and which listeners are told of it.

What is trained is tested in `test_train.py`, `test_stages.py` and `test_seams.py`.
"""

from pathlib import Path

import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.cli.arguments import command_line
from geosplat_jax.cli.training import begin_from
from geosplat_jax.fit.begin import ANEW, Anew, Resume, TakeOver
from geosplat_jax.fit.evidence import Rung
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.listener import NOBODY, Listener, Listeners, Progress
from geosplat_jax.fit.loop import Loop
from geosplat_jax.fit.train import TrainingError, fit
from geosplat_jax.fit.trained import Trained
from geosplat_jax.io.checkpoints import CheckpointError


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], Anew()),
        (["--force"], Anew(replace=True)),
        (["--resume"], Resume()),
        (["--from", "runs/a", "--stage", "refine"], TakeOver(Path("runs/a"), "refine")),
        (["--from", "a", "--stage", "b", "--force"], TakeOver(Path("a"), "b", replace=True)),
    ],
)
def test_options_say_how_a_run_begins(options, expected):
    assert begin_from(command_line().parse_args(["train", "scene", *options])) == expected


def test_only_resuming_goes_on_with_a_run_and_only_where_there_is_one(tmp_path):
    run, beginnings = RunFolder(tmp_path), (ANEW, Anew(replace=True), TakeOver("a", "b"), Resume())
    assert [beginning.continues(run) for beginning in beginnings] == [False] * 4
    (tmp_path / "run.json").write_text("{}")
    assert [beginning.continues(run) for beginning in beginnings] == [False, False, False, True]
    assert [beginning.replace for beginning in beginnings] == [False, True, False, False]
    assert [beginning.takes_over for beginning in beginnings] == [False, False, True, False]


class _FullDisk(Loop):
    """A loop whose first checkpoint cannot be written."""

    def __init__(self):
        pass

    def save_end(self):
        raise CheckpointError("cannot write: no space left")


class _TakeOverOntoAFullDisk(TakeOver):
    def first_loop(self, dataset, config, run, devices):
        return _FullDisk()


def test_a_run_that_could_not_store_what_it_took_over_leaves_its_folder_free(tmp_path):
    begin = _TakeOverOntoAFullDisk("a", "monte_carlo")
    with pytest.raises(TrainingError, match="no space left.*give the same command again"):
        fit(sphere_dataset(count=2, size=8), tiny_config(), tmp_path / "run", begin=begin)
    assert not RunFolder(tmp_path / "run").exists


EVENTS = {
    "on_step": Progress(1, 2, "split_sum", 0.5, 20.0, 6, 1.0, None),
    "on_compile": "split_sum",
    "on_preview": object.__new__(Trained),
    "on_rung": Rung("light", "fine light", 20.0, None, None, is_kept=False),
}


class _Notes(Listener):
    """Notes what it is told; has a method of its own for every event."""

    def __init__(self, told, name):
        for event in EVENTS:
            setattr(self, event, lambda argument, event=event: told.append((name, event, argument)))


def test_several_listeners_are_told_everything_in_turn():
    notes = []
    listeners = Listeners(_Notes(notes, "a"), NOBODY, _Notes(notes, "b"))
    assert {name for name in vars(Listener) if name.startswith("on_")} == set(EVENTS)
    for event, argument in EVENTS.items():
        getattr(listeners, event)(argument)
    assert notes == [(name, event, argument) for event, argument in EVENTS.items() for name in "ab"]
