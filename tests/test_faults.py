"""The list of faults fits the package: every line is there, and so are the tests that notice."""

import re
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "faults"))

from plant import read_faults  # noqa: E402

FAULTS = read_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_line_of_a_fault_is_there_once(fault):
    compile(fault.planted(), fault.file, "exec")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_tests_that_notice_a_fault_exist(fault):
    assert fault.tests
    for test in fault.tests:
        name, _, function = test.partition("::")
        text = (HERE / name).read_text(encoding="utf-8")
        assert not function or re.search(rf"^def {function}\(", text, re.MULTILINE)


def test_every_part_of_the_package_has_a_fault():
    package = HERE.parent / "geosplat_jax"
    parts = {path.stem for path in package.iterdir() if not path.stem.startswith("__")}
    faulty_parts = {Path(fault.file).parts[0].removesuffix(".py") for fault in FAULTS}
    # Only these parts may have no fault; the tests of `gradcheck` plant faults themselves.
    assert parts - faulty_parts <= {"gradcheck", "run", "camera_rounds", "model_choice"}
