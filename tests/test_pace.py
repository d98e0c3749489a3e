"""Progress: an estimate of the time left without compilation, and lines fit for a log file."""

import csv
import json

import pytest

from geosplat_jax.cli import display
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.report.pace import TimeLeft, counted, duration


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def paced(seconds, total):
    """Estimates of the time left, before and after each of some items that took ``seconds``."""
    clock = Clock()
    pace = TimeLeft(clock)
    estimates = [pace.left(0, total)]
    for done_count, length in enumerate(seconds, 1):
        clock.now += length
        estimates.append(pace.left(done_count, total))
    return estimates


def test_the_first_item_which_compiles_says_nothing_of_the_others():
    assert paced([40.0, 2.0, 2.0], 10) == [None, None, 16.0, 14.0]
    assert paced([40.0], 1) == [None, 0.0]


def test_one_slow_item_does_not_change_the_estimate_much():
    assert paced([40.0, 2.0, 2.0, 30.0, 2.0], 10)[-1] == pytest.approx(10.0)


def test_items_that_are_told_together_share_their_time():
    clock = Clock()
    pace = TimeLeft(clock)
    pace.left(1, 9)
    clock.now = 8.0
    assert pace.left(5, 9) == pytest.approx(8.0)
    # Reporting the same count twice changes nothing.
    assert pace.left(5, 9) == pytest.approx(8.0)


def test_counting_goes_from_nothing_to_all():
    calls = []
    items = list(counted("abc", "letters", lambda *words: calls.append(words)))
    assert items == ["a", "b", "c"]
    assert calls == [("letters", done_count, 3) for done_count in range(4)]
    assert list(counted("abc", "letters", None)) == items


@pytest.mark.parametrize(
    ("seconds", "text"), [(3.4, "3 s"), (89.0, "89 s"), (91.0, "2 min"), (4000.0, "67 min")]
)
def test_times_are_short(seconds, text):
    assert duration(seconds) == text
    assert duration(7300.0) == "2 h 2 min"


def test_a_log_file_gets_the_beginning_the_end_and_a_line_now_and_then(capsys, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(display.time, "perf_counter", clock)
    with display.WorkDisplay(bars=False) as show:
        for done_count in range(8):
            show("views", done_count, 7)
            clock.now += 4.0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "views: 0 of 7, the first one compiles"
    assert lines[-1] == "views: 7 of 7, done"
    assert len(lines) == 4
    assert lines[1] == "views: 3 of 7, 16 s left"


def test_a_terminal_shows_a_bar_for_each_part(capsys):
    with display.WorkDisplay(bars=True) as show:
        show("views", 0, 2)
        show("views", 2, 2)
        show("mesh", 1, 1)
    output = capsys.readouterr().err
    assert "views" in output
    assert "2/2" in output
    assert "mesh" in output


def test_a_compilation_is_announced_with_its_usual_time_and_then_with_the_last(capsys, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(display.time, "perf_counter", clock)
    progress = display.StepProgress(
        step=1,
        steps=9,
        stage="split_sum",
        total=1.0,
        psnr=20.0,
        splat_count=5,
        seconds=1.0,
        seconds_left=None,
    )
    with display.ProgressDisplay(9) as show:
        show.on_compile("split_sum")
        clock.now += 33.0
        show.on_step(progress)
        show.on_compile("monte_carlo")
    output = capsys.readouterr().err
    assert "compiling stage split_sum, usually" in output
    assert "measuring the pace" in output
    assert "compiling stage monte_carlo, the last took 33 s" in output


def test_the_steps_become_a_table_in_which_nothing_is_lost(tmp_path):
    lines = [
        {"step": 0, "stage": "a,b", "loss": 0.5, "usage": {"quads": 3}},
        {"step": 1, "stage": 'c"', "loss": 0.25, "term.l1": 0.125, "usage": {"quads": 4}},
    ]
    folder = RunFolder(tmp_path)
    folder.metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
    folder.write_csv(tmp_path / "steps.csv")
    with (tmp_path / "steps.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert first == {"step": "0", "stage": "a,b", "loss": "0.5", "usage.quads": "3", "term.l1": ""}
    assert (second["stage"], second["term.l1"], second["usage.quads"]) == ('c"', "0.125", "4")
