"""Plant the faults of ``faults.toml`` one at a time, and see which of them the tests notice.

    python tests/faults/plant.py [--only NAME] [--jobs N] [--all-tests] [--sound]

Every fault is planted in a copy of the package in a temporary folder; the checkout stays as it is.
The tests that the list names for the fault run against the copy. Prints for every fault whether it
was noticed, and after how many seconds; the exit status is 1 where fewer than 90 % are noticed.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "geosplat_jax"
LIST = Path(__file__).with_name("faults.toml")
WANTED = 0.9
"""Share of the faults that the default tests have to notice."""

_BESIDE = (
    *("benchmarks", "examples", "experiments"),
    *("CONTRIBUTING.md", "README.md", "mkdocs.yml", "pyproject.toml"),
)
"""Files and folders that tests read, apart from what is copied."""

_PASSED, _FAILED = 0, 1
"""Exit statuses of pytest; any other status means that the tests did not run."""


@dataclass(frozen=True)
class Fault:
    """A line of the package and the line with the fault, see ``faults.toml``."""

    name: str
    file: str
    old: str
    new: str
    harm: str
    tests: tuple[str, ...]

    @property
    def source(self) -> Path:
        """The file that the fault is planted in."""
        return ROOT / PACKAGE / self.file

    def planted(self) -> str:
        """Return the text of the file with the fault.

        Raises
        ------
        ValueError
            If the file does not hold the line exactly once, since the list is older than the
            package, or if the fault changes nothing.
        """
        text = self.source.read_text(encoding="utf-8")
        count = text.count(self.old)
        if count != 1:
            raise ValueError(
                f"fault {self.name!r}: its line is {count} times in {self.file}, not once; write "
                f"it anew in {LIST.name}"
            )
        if self.new == self.old:
            raise ValueError(f"fault {self.name!r} changes nothing")
        return text.replace(self.old, self.new)


def read_faults() -> list[Fault]:
    """Read the list of faults.

    Raises
    ------
    ValueError
        If two faults have the same name.
    """
    rows = tomllib.loads(LIST.read_text(encoding="utf-8"))["fault"]
    faults = [Fault(**{**row, "tests": tuple(row["tests"])}) for row in rows]
    names = [fault.name for fault in faults]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise ValueError(f"faults of one name: {', '.join(duplicates)}")
    return faults


def copied(folder: Path) -> Path:
    """Copy the package and its tests into a folder, and link the other files that tests read."""
    ignored = shutil.ignore_patterns("__pycache__")
    for name in (PACKAGE, "docs", "tests"):  # links between documents must not lead out of docs
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in _BESIDE:
        (folder / name).symlink_to(ROOT / name)
    return folder


def run_tests(folder: Path, tests: Sequence[str]) -> tuple[int, str]:
    """Run tests of a copy; return the exit status of pytest and the end of its output.

    If no tests are given, the whole default run is made.
    """
    paths = [str(folder / "tests" / test) for test in tests] or [str(folder / "tests")]
    options = ["-x", "-q", "-n0", "-p", "no:cacheprovider", "--no-header"]
    process = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "--rootdir", str(folder), *paths],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )
    return process.returncode, (process.stdout + process.stderr)[-2000:]


def verdict(fault: Fault, *, all_tests: bool) -> str:
    """Plant a fault and return the verdict of the tests: killed, survived, or why it is unclear."""
    text = fault.planted()
    with tempfile.TemporaryDirectory(prefix="fault_") as temporary:
        folder = copied(Path(temporary))
        (folder / PACKAGE / fault.file).write_text(text, encoding="utf-8")
        status, output = run_tests(folder, fault.tests)
        if status == _PASSED and all_tests:
            status, output = run_tests(folder, ())
    if status not in (_PASSED, _FAILED):
        return f"unclear: pytest ended with status {status}\n{output}"
    return "killed" if status == _FAILED else "survived"


def timed(fault: Fault, *, all_tests: bool) -> str:
    """Print the verdict on a fault and the seconds that it took; return the verdict."""
    began = time.monotonic()
    result = verdict(fault, all_tests=all_tests)
    seconds = time.monotonic() - began
    print(f"{result.splitlines()[0]:10s} {seconds:6.1f} s  {fault.file}: {fault.name}", flush=True)
    if not result.startswith("killed"):
        print(f"           {fault.harm}\n{result.partition(chr(10))[2]}", flush=True)
    return result


def main() -> int:
    """Plant the faults that were asked for, and print a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", action="append", help="some of the faults")
    parser.add_argument("--jobs", type=int, default=1, help="faults at a time")
    parser.add_argument(
        "--all-tests", action="store_true", help="the whole default run for those that survive"
    )
    parser.add_argument(
        "--sound", action="store_true", help="run the named tests without any fault: all pass"
    )
    arguments = parser.parse_args()
    faults = read_faults()
    for fault in faults:
        fault.planted()
    if arguments.only is not None:
        unknown_names = sorted(set(arguments.only) - {fault.name for fault in faults})
        if unknown_names:
            parser.error(f"there is no fault {unknown_names[0]!r}")
        faults = [fault for fault in faults if fault.name in arguments.only]
    if arguments.sound:
        tests = sorted({test for fault in faults for test in fault.tests})
        with tempfile.TemporaryDirectory(prefix="fault_") as temporary:
            status, output = run_tests(copied(Path(temporary)), tests)
        print(output)
        return status
    with ThreadPoolExecutor(arguments.jobs) as pool:
        verdicts = list(pool.map(lambda one: timed(one, all_tests=arguments.all_tests), faults))
    killed_count = verdicts.count("killed")
    print(f"{killed_count} of {len(verdicts)} killed ({killed_count / len(verdicts):.0%})")
    survivors = [fault.name for fault, one in zip(faults, verdicts, strict=True) if one != "killed"]
    if survivors:
        print("not noticed: " + "; ".join(survivors))
    return int(killed_count < WANTED * len(verdicts))


if __name__ == "__main__":
    sys.exit(main())
