"""Kill commands at random moments, and check their files and that the next call continues.

    python experiments/studies/kills.py --output FOLDER [--kills 100] [--seed 0] [--json FILE]

Trains a very small run of the bundled scene without disturbance, and then repeatedly with signals
2 (Ctrl-C), 9 and 15. A signal is sent at a random time within the duration of the command, as soon
as a file appears in its folder (a checkpoint, the end of a stage, a line of ``metrics.jsonl``), or
while it compiles with an empty cache. A run is resumed, and often killed again, until it is
complete; its arrays and its ``metrics.jsonl`` must then equal those of the first run to the bit.
``evaluate``, ``export``, ``render`` and ``relight`` of the finished run are killed in the same way:
no file with a final name may be incomplete, and the next call must succeed.

A command that receives Ctrl-C must say so in at most three lines, and end with status 130. Prints
the outcomes by moment and signal, and every fault; the exit status is 1 if there is one.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.io.checkpoints import latest_checkpoint
from geosplat_jax.io.images import read_image

PACKAGE = "geosplat_jax"
SCENE = Path(__file__).resolve().parents[2] / "examples" / "duck"
SETTINGS = (
    "geometry.resolution=8",
    "stages.split_sum.steps=12",
    "stages.split_sum.batch_views=1",
    "stages.monte_carlo.steps=6",
    "stages.monte_carlo.batch_views=1",
    "stages.monte_carlo.transport.kind=split_sum",
    "stages.refine.steps=0",
    "run.checkpoint_every=2",
    "run.preview_every=0",
    "material.grid.levels=2",
    "material.grid.log2_entries=10",
    "material.grid.finest=24",
    "material.albedo_hidden=[8, 8]",
    "material.surface_hidden=[8]",
    "light.height=8",
    "light.width=16",
    "objective.smoothness_samples=64",
)
"""Both stages have the same light transport, so that the second one has little to compile."""

FAST_COMPILER = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
"""Compiler flags of the tests: most of the time of so small a run is compilation."""

SIGNALS = (signal.SIGINT, signal.SIGKILL, signal.SIGTERM)
MOST_KILLS = 4
"""Most kills of one training or one output, before it is left to end."""
MOST_LINES = 3
"""Most lines that a command may print after Ctrl-C."""
PATIENCE = 900.0
"""Seconds after a signal, after which the process counts as having ignored it."""
LAST_WORDS = "trained in"
"""Text that a training prints when all its files are written."""
LEAD = 0.03
"""Largest delay, in seconds, from the appearance of a file to the signal."""
PROGRESS = re.compile(r", step \d+/|: \d+ of \d+|^compiling|^warning|^\W*$|slow compile| views, ")
"""Lines of progress, which have nothing to do with a signal."""
UNMEASURED = ("seconds", "peak_memory_mb")
"""Entries of a step that differ between equal runs."""
READERS = {
    "evaluate": ("--samples", "1"),
    "export": ("--texture-size", "64"),
    "render": ("--samples", "1"),
    "relight": (str(SCENE.parent / "sunset.hdr"), "--samples", "1"),
}
"""Commands on a finished run, with their options."""


@dataclass
class Kill:
    """A signal that was sent, and its outcome.

    Attributes
    ----------
    command, moment, number : name of the command, moment of the signal, and its number.
    outcome : outcome in a word or two.
    seconds : time from the signal to the end of the process.
    status : exit status of the process; None if it ignored the signal.
    lines : lines that it printed after the signal.
    faults : deviations from what is required.
    """

    command: str
    moment: str
    number: int
    outcome: str = ""
    seconds: float = 0.0
    status: int | None = None
    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


class Process:
    """A command of geosplat-jax in another process, whose output goes to a file."""

    def __init__(self, arguments: Sequence[str], log: Path, cache: Path) -> None:
        self.log = log
        environment = {
            **os.environ,
            "XDG_CACHE_HOME": str(cache),
            "XLA_FLAGS": os.environ.get("XLA_FLAGS", FAST_COMPILER),
        }
        with log.open("wb") as log_file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "geosplat_jax", *arguments],
                stdout=log_file,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    def words(self) -> str:
        """Return what was printed so far."""
        return self.log.read_text(errors="replace")

    def send(self, number: int) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def wait(self, seconds: float | None = None) -> int | None:
        """Wait for the end and return the status; None where it did not come in time."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None


def small_scene(folder: Path) -> Path:
    """Copy a few views of the bundled scene."""
    root = folder / "scene" / "duck"
    if not root.exists():
        for view in sorted(SCENE.glob("train_*"))[::4] + sorted(SCENE.glob("test_*"))[:2]:
            shutil.copytree(view, root / view.name)
        shutil.copy(SCENE / "scene.json", root)
    return root


def seen_files(folder: Path) -> Counter:
    """Return sizes plus one of all files below a folder, by path, also of incomplete ones."""
    sizes = Counter()
    for root, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(root, name)
            try:
                sizes[path] = os.stat(path).st_size + 1
            except OSError:  # renamed in between
                continue
    return sizes


def wait_for_file(process: Process, folder: Path, wanted: Callable[[str], bool], skip: int) -> bool:
    """Wait until a wanted file has changed ``skip + 1`` times; False if the process ends before."""
    previous_sizes = seen_files(folder)
    while not process.has_ended:
        current_sizes = seen_files(folder)
        if any(
            wanted(path) and current_sizes[path] != previous_sizes[path] for path in current_sizes
        ):
            if not skip:
                return True
            skip -= 1
        previous_sizes = current_sizes
        time.sleep(0.001)
    return False


def wait_for_words(process: Process, words: str) -> bool:
    """Wait until a text was printed; False if the process ends before."""
    while not process.has_ended:
        if words in process.words():
            return True
        time.sleep(0.01)
    return False


WATCHED = {
    "checkpoint": lambda path: "checkpoint_" in path and f"{os.sep}stages{os.sep}" not in path,
    "end of stage": lambda path: f"{os.sep}stages{os.sep}" in path,
    "step": lambda path: path.endswith("metrics.jsonl"),
    "file": lambda path: True,
}
"""Moments that are recognised by changes of files, with tests of their paths."""
SEEN = {"checkpoint": 12, "end of stage": 2, "step": 12, "file": 6}
"""Number of changes that certainly happen, by moment; one of them is drawn."""


def killed(
    name: str,
    process: Process,
    folder: Path,
    moment: str,
    duration: float,
    draw: random.Random,
) -> Kill | None:
    """Wait for a moment, send a signal, and wait for the end; None if the process ended before."""
    number = draw.choice(SIGNALS)
    if moment == "anywhere":
        deadline = time.monotonic() + draw.uniform(0.0, duration)
        while time.monotonic() < deadline and not process.has_ended:
            time.sleep(0.005)
    elif moment == "compilation":
        if wait_for_words(process, "compiling stage"):
            time.sleep(draw.uniform(0.0, duration))
    elif wait_for_file(process, folder, WATCHED[moment], draw.randrange(SEEN[moment])):
        time.sleep(draw.uniform(0.0, LEAD))
    if process.has_ended:
        return None
    kill = Kill(name, moment, int(number))
    printed_length, began = len(process.words()), time.monotonic()
    process.send(number)
    kill.status = process.wait(PATIENCE)
    kill.seconds = time.monotonic() - began
    kill.lines = [line for line in process.words()[printed_length:].splitlines() if line.strip()]
    judge(kill, process)
    return kill


def judge(kill: Kill, process: Process) -> None:
    """Record the outcome of a signal, and its faults."""
    text = process.words()
    if kill.status is None:
        kill.outcome = "swallowed"
        kill.faults.append(f"still there {PATIENCE:.0f} s after signal {kill.number}")
        process.send(signal.SIGKILL)
        process.wait()
        return
    kill.outcome = {0: "had ended", 130: "stopped", -9: "died", -15: "died"}.get(
        kill.status, f"status {kill.status}"
    )
    # Until the package is imported, nothing handles the signal.
    has_begun = PACKAGE in text or bool(text.strip()) and "Traceback" not in text
    if kill.number == signal.SIGINT and kill.status == -signal.SIGINT and not has_begun:
        kill.outcome = "not begun"
        return
    # While Python cleans up after a command, the system handles Ctrl-C; shells then show 130.
    if kill.status == -signal.SIGINT and LAST_WORDS in text and "Traceback" not in text:
        kill.outcome = "had ended"
        return
    allowed_statuses = {
        signal.SIGINT: (0, 130),
        signal.SIGKILL: (0, -9),
        signal.SIGTERM: (0, 130, -15),
    }[signal.Signals(kill.number)]
    if kill.status not in allowed_statuses:
        kill.faults.append(f"status {kill.status} after signal {kill.number}")
    if "Traceback" in text:
        kill.faults.append("a traceback")
    # Only lines about the signal count, and not progress that was printed at the same time.
    signal_lines = [line for line in kill.lines if not PROGRESS.search(line)]
    if kill.status == 130 and not 1 <= len(signal_lines) <= MOST_LINES:
        kill.faults.append(f"{len(signal_lines)} lines after Ctrl-C")


def differences(run: Path, reference: Path) -> list[str]:
    """Compare two finished runs to the bit: checkpoints of two stages, and every step."""
    mismatches = []
    for subfolder in ("checkpoints", "stages/split_sum"):
        run_checkpoint, reference_checkpoint = (
            latest_checkpoint(root / subfolder) for root in (run, reference)
        )
        if (
            run_checkpoint is None
            or reference_checkpoint is None
            or run_checkpoint.name != reference_checkpoint.name
        ):
            mismatches.append(f"{subfolder}: {run_checkpoint}, not {reference_checkpoint}")
            continue
        with zipfile.ZipFile(run_checkpoint) as a, zipfile.ZipFile(reference_checkpoint) as b:
            if set(a.namelist()) != set(b.namelist()):
                mismatches.append(f"{subfolder}: other arrays")
                continue
            mismatches += [f"{subfolder}: {n}" for n in a.namelist() if a.read(n) != b.read(n)]
    steps = [
        [{k: v for k, v in line.items() if k not in UNMEASURED} for line in lines]
        for lines in (RunFolder(root).metric_lines() for root in (run, reference))
    ]
    if len(steps[0]) != len(steps[1]):
        mismatches.append(f"{len(steps[0])} steps are written down, not {len(steps[1])}")
    changed_steps = [a["step"] for a, b in zip(*steps, strict=False) if a != b]
    return mismatches + ([f"steps {changed_steps}"] if changed_steps else [])


def is_whole(path: Path) -> bool:
    """Whether a file is complete, as far as its format tells."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix in (".png", ".exr", ".hdr"):
            read_image(path)
        elif path.suffix == ".glb":
            data = path.read_bytes()
            return int.from_bytes(data[8:12], "little") == len(data)
        elif path.suffix == ".html":
            return path.read_text().rstrip().endswith("</html>")
        elif path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                return archive.testzip() is None
    except (OSError, ValueError, zipfile.BadZipFile):
        return False
    return path.stat().st_size > 0


def half_files(folder: Path) -> list[str]:
    """Return incomplete files below a folder, except temporary ones."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    final = (p for p in paths if ".partial" not in p.name and p.name != ".lock")
    # The last line of the steps may be incomplete: readers leave it out.
    return [str(p.relative_to(folder)) for p in final if p.suffix != ".jsonl" and not is_whole(p)]


class Study:
    """Trials in one output folder, and their results."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.draw = folder, random.Random(seed)
        folder.mkdir(parents=True, exist_ok=True)
        self.scene, self.cache = small_scene(folder), folder / "cache"
        self.reference = folder / "reference"
        self.kills: list[Kill] = []
        self.other_faults = 0
        self.finished = 0
        self.seconds: dict[str, float] = {}

    def process(self, arguments: Sequence[str], *, cache: Path | None = None) -> Process:
        """Start a command."""
        return Process(arguments, self.folder / "log.txt", cache or self.cache)

    def train_arguments(self, run: Path) -> list[str]:
        """Return the arguments that train a run, or resume it."""
        overrides = [part for setting in SETTINGS for part in ("--set", setting)]
        options = ["--output", str(run), "--downscale", "8"]
        return ["train", str(self.scene), *options, "--resume", *overrides]

    def reader_arguments(self, name: str, run: Path) -> list[str]:
        """Return the arguments that call a command on a finished run."""
        options = list(READERS[name])
        return [name, str(run), *(["--env"] if name == "relight" else []), *options]

    def whole(self, arguments: Sequence[str]) -> float:
        """Let a command end; return its seconds.

        Raises
        ------
        RuntimeError
            If it fails.
        """
        began, process = time.monotonic(), self.process(arguments)
        if process.wait() != 0:
            raise RuntimeError(f"{' '.join(arguments[:2])}: {process.words()[-2000:]}")
        return time.monotonic() - began

    def prepare(self) -> None:
        """Train the reference, and run every command twice: to fill the cache, and to time it."""
        if not (self.reference / "training.json").exists():
            self.whole(self.train_arguments(self.reference))
        second_run = self.folder / "again"
        shutil.rmtree(second_run, ignore_errors=True)
        self.seconds["train"] = self.whole(self.train_arguments(second_run))
        mismatches = differences(second_run, self.reference)
        if mismatches:
            raise RuntimeError(f"two undisturbed runs differ: {mismatches}")
        for name in READERS:
            self.whole(self.reader_arguments(name, second_run))
            self.seconds[name] = self.whole(self.reader_arguments(name, second_run))
        print(f"undisturbed: { ({k: round(v, 1) for k, v in self.seconds.items()}) }", flush=True)

    def note(self, kill: Kill) -> None:
        """Store a kill, and print it with its faults."""
        self.kills.append(kill)
        print(
            f"{len(self.kills):4d} {kill.command:9s} {kill.moment:12s} signal {kill.number:2d}  "
            f"{kill.outcome:10s} after {kill.seconds:5.1f} s  {'; '.join(kill.faults)}",
            flush=True,
        )
        if kill.faults:
            print("     | " + "\n     | ".join(kill.lines[-12:]), flush=True)

    def chain(self, name: str, run: Path, arguments: Sequence[str], moments: Sequence[str]) -> None:
        """Kill a command some times, then let it end, and look at what there is."""
        kill_count = self.draw.randint(1, MOST_KILLS)
        last_kill: Kill | None = None
        for _ in range(kill_count):
            moment = self.draw.choice(moments)
            is_cold = moment == "compilation"
            cold_cache = self.folder / "cold"
            shutil.rmtree(cold_cache, ignore_errors=True)
            process = self.process(arguments, cache=cold_cache if is_cold else None)
            kill = killed(name, process, run, moment, self.seconds[name], self.draw)
            if kill is None:
                self._require_success(name, process, last_kill)
                continue
            last_kill = kill
            kill.faults += [f"half a file: {path}" for path in half_files(run)]
            self.note(kill)
        process = self.process(arguments)
        process.wait()
        self._require_success(name, process, last_kill)
        self.finished += 1

    def _require_success(self, name: str, process: Process, last_kill: Kill | None) -> None:
        """Record a fault of the last kill if a command that was left alone did not succeed."""
        status, text = process.wait(), process.words()
        fault = None
        if status != 0:
            fault = f"the next call of {name} ended with status {status}: {text[-500:]}"
        elif "damaged" in text:
            fault = f"the next call of {name} found damage: {text[-500:]}"
        if fault is not None:
            self._blame(last_kill, fault)

    def _blame(self, last_kill: Kill | None, fault: str) -> None:
        if last_kill is not None:
            last_kill.faults.append(fault)
        self.other_faults += last_kill is None
        print(f"     ! {fault}", flush=True)

    def train_trial(self) -> None:
        """Kill a training repeatedly, let it end, and compare it with the reference."""
        run = self.folder / "run"
        shutil.rmtree(run, ignore_errors=True)
        moments = ("anywhere", "anywhere", "checkpoint", "checkpoint", "step", "end of stage")
        if self.draw.random() < 0.15:
            moments = ("compilation", "anywhere")
        first_count = len(self.kills)
        self.chain("train", run, self.train_arguments(run), moments)
        mismatches = differences(run, self.reference)
        if mismatches:
            last_kill = self.kills[-1] if len(self.kills) > first_count else None
            self._blame(last_kill, f"the run is not that of the reference: {mismatches}")

    def reader_trial(self) -> None:
        """Kill a command on a copy of the finished run."""
        name, run = self.draw.choice(list(READERS)), self.folder / "run"
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(self.reference, run)
        self.chain(name, run, self.reader_arguments(name, run), ("anywhere", "anywhere", "file"))
        halves = half_files(run)
        if halves:
            self._blame(self.kills[-1] if self.kills else None, f"half files in the end: {halves}")

    def table(self) -> str:
        """Count outcomes by command, moment and signal."""
        rows = Counter((k.command, k.moment, k.number, k.outcome) for k in self.kills)
        lines = [f"{'command':10s} {'moment':14s} {'signal':>6s}  {'outcome':12s} {'kills':>5s}"]
        lines += [
            f"{command:10s} {moment:14s} {number:6d}  {outcome:12s} {count:5d}"
            for (command, moment, number, outcome), count in sorted(rows.items())
        ]
        waits = sorted(k.seconds for k in self.kills if k.number == signal.SIGINT)
        if waits:
            lines.append(
                f"Ctrl-C took {waits[len(waits) // 2]:.1f} s (median), {waits[-1]:.1f} s at most"
            )
        faulty_count = sum(bool(kill.faults) for kill in self.kills)
        lines.append(
            f"{len(self.kills)} kills, after which {self.finished} commands were left to end; "
            f"{faulty_count} kills with a fault, {self.other_faults} faults after none"
        )
        return "\n".join(lines)


def main() -> int:
    """Run trials until there are enough kills, and print what they found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="working folder")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    # Jobs in the background of a shell, and processes that they start, ignore Ctrl-C by default.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    study = Study(arguments.output, arguments.seed)
    study.prepare()
    while len(study.kills) < arguments.kills:
        if study.draw.random() < 0.6:
            study.train_trial()
        else:
            study.reader_trial()
    print(study.table())
    if arguments.json is not None:
        records = [asdict(kill) for kill in study.kills]
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")
    return int(study.other_faults > 0 or any(kill.faults for kill in study.kills))


if __name__ == "__main__":
    sys.exit(main())
