"""Changed files of a run are reported in one line that names the file, never by a traceback."""

import io
import json
import shutil
import zipfile

import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.cli import main
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.loop import new_loop
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.train import load_trained
from geosplat_jax.io.checkpoints import CheckpointError, latest_checkpoint
from geosplat_jax.io.documents import parse_json
from geosplat_jax.run import Run

DEEP = "[" * 100_000
SDF = "['state'].params.geometry.sdf"


@pytest.fixture(scope="module")
def untouched(tmp_path_factory):
    """A run with a checkpoint of its start."""
    dataset, config = sphere_dataset(count=3, size=8), tiny_config()
    folder = RunFolder(tmp_path_factory.mktemp("tampering") / "run")
    with folder.locked():
        folder.begin(dataset, config, replace=False)
    new_loop(dataset, config, folder).save()
    return folder


@pytest.fixture
def run(untouched, tmp_path):
    return RunFolder(shutil.copytree(untouched.path, tmp_path / "run"))


def npy(array):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array)
    return buffer.getvalue()


def rewrite(run, change, *, compression=zipfile.ZIP_STORED):
    """Write the checkpoint again, with ``change`` applied to its members and its header."""
    path = latest_checkpoint(run.checkpoints)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(np.load(io.BytesIO(members["__meta__.npy"])).tobytes())
    new_header = change(members, header)
    if new_header is not None:
        text = new_header if isinstance(new_header, str) else json.dumps(new_header)
        members["__meta__.npy"] = npy(np.frombuffer(text.encode(), np.uint8))
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def without(mapping, name):
    return {key: value for key, value in mapping.items() if key != name}


def meta(**changes):
    return lambda _, header: {**header, "meta": {**header["meta"], **changes}}


def capacities(count):
    return lambda _, header: meta(capacities={"quads": count})(_, header)


def leaf(described):
    return lambda _, header: {**header, "leaves": {**header["leaves"], SDF: described}}


def config(section, value):
    def change(_, header):
        return meta(config={**header["meta"]["config"], section: value})(_, header)

    return change


CHANGES = {
    "leaf of terabytes": (leaf({"dtype": "float32", "shape": [10**12]}), "has shape"),
    "leaf of no type": (leaf({"dtype": "zzz", "shape": [1210]}), "has dtype zzz"),
    "no config": (lambda m, h: {**h, "meta": without(h["meta"], "config")}, "config is missing"),
    "config is a list": (meta(config=[]), "config must be"),
    "config of nothing": (meta(config={}), "stage 'split_sum', which its settings do not have"),
    "stages are a list": (config("stages", [1]), "stages must be an object"),
    "light of terabytes": (config("light", {"height": 4096, "width": 8192}), "memory.*light"),
    "stage without steps": (meta(stage="refine"), "stage 'refine', which its settings"),
    "stage is null": (meta(stage=None), "stage must be a valid string"),
    "no surface": (lambda m, h: {**h, "meta": without(h["meta"], "surface")}, "surface is missing"),
    "no grid": (meta(surface={}), r"surface \{\} .* describe no arrays"),
    "negative grid": (meta(surface={"grid_shape": [-1, 4, 4]}), "grid_shape must be three"),
    "grid of text": (meta(surface={"grid_shape": "abc"}), "grid_shape must be three"),
    "flat grid": (meta(surface={"grid_shape": [4, 4]}), "describe no arrays"),
    "grid of terabytes": (meta(surface={"grid_shape": [10**5] * 3}), "has shape"),
    "capacities are a list": (meta(capacities=[1]), "capacities must be"),
    "capacity is negative": (capacities(-5), r"capacities\.quads must be greater"),
    "capacity is 0": (capacities(0), r"capacities\.quads must be greater"),
    "capacity is text": (capacities("x"), r"capacities\.quads must be a valid integer"),
    "capacity of terabytes": (capacities(10**12), r"capacities\.quads must be less than"),
    "stage to come is a number": (meta(to_come=5), "to_come must be"),
    "recoveries are negative": (meta(recoveries=-1), "recoveries must be"),
}


@pytest.mark.parametrize(("change", "message"), CHANGES.values(), ids=CHANGES)
def test_a_changed_checkpoint_is_refused_by_its_file(run, change, message):
    path = rewrite(run, change)
    with pytest.raises((CheckpointError, RunError, TrainingError), match=message) as error_info:
        load_trained(run)
    assert str(path) in str(error_info.value)
    assert "\n" not in str(error_info.value)


def larger(members, _):
    array_bytes = npy(np.zeros(3, np.float32))
    members[f"{SDF}.npy"] = array_bytes.replace(b"(3,), }           ", b"(300000000000,), }")


UNREADABLE = {
    "no meta": lambda _, header: without(header, "meta"),
    "no leaves": lambda _, header: without(header, "leaves"),
    "meta is a list": lambda _, header: {**header, "meta": [1]},
    "leaves are null": lambda _, header: {**header, "leaves": None},
    "step is negative": lambda _, header: {**header, "step": -1},
    "leaf is null": leaf(None),
    "header is no JSON": lambda *_: "{x",
    "header is nested": lambda *_: DEEP,
    "header is a list": lambda *_: [],
    "another format": lambda _, header: {**header, "format": 2},
}


@pytest.mark.parametrize("change", UNREADABLE.values(), ids=UNREADABLE)
def test_a_checkpoint_that_cannot_be_read_is_passed_over(run, change):
    path = rewrite(run, change)
    with pytest.warns(RuntimeWarning, match=str(path)), pytest.raises(TrainingError, match="holds"):
        load_trained(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (larger, r"geometry\.sdf\.npy has 12 bytes instead of 1200000000000"),
        (lambda members, _: members.pop(f"{SDF}.npy"), r"geometry\.sdf"),
        (lambda members, _: members.update({f"{SDF}.npy": b"\x93NUMPY junk"}), "is damaged"),
    ],
)
def test_an_array_that_is_not_what_it_says_costs_no_memory(run, change, message):
    path = rewrite(run, lambda members, header: change(members, header) and None)
    with pytest.raises(CheckpointError, match=message) as error_info:
        load_trained(run)
    assert str(path) in str(error_info.value)


def test_a_compressed_checkpoint_is_not_unfolded(run):
    path = rewrite(run, lambda *_: None, compression=zipfile.ZIP_DEFLATED)
    with pytest.warns(RuntimeWarning, match="compressed"), pytest.raises(TrainingError):
        load_trained(run)
    assert path.exists()


@pytest.mark.parametrize("text", ["[]", "null", "{}", '{"a":', DEEP, "\xff"])
def test_a_record_that_is_none_is_refused_by_its_file(run, text):
    path = run.path / "run.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(RunError, match="run.json") as error_info:
        Run(run.path)
    assert str(path) in str(error_info.value)
    assert "\n" not in str(error_info.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("scene", None, "scene must be a valid string"),
        ("scene", ["a"], "scene must be a valid string"),
        ("dataset", None, "dataset must be an object"),
        ("dataset", [1], "dataset must be an object"),
        ("dataset", {"downscale": 2.5}, r"dataset\.downscale must be a valid integer"),
        ("dataset", {"downscale": -4}, r"dataset\.downscale must be greater"),
        ("dataset", {"light": 5}, r"dataset\.light must be a valid string"),
        ("dataset", {"bounds": [1, 2]}, r"dataset\.bounds"),
        ("dataset", {"cameras": 5}, r"dataset\.cameras must be a valid string"),
    ],
)
def test_a_record_of_impossible_values_is_refused_by_its_file(run, name, value, message):
    path = run.path / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(RunError, match=f"{path} is damaged: {message}") as error_info:
        Run(run.path)
    assert "\n" not in str(error_info.value)


@pytest.mark.parametrize("value", [None, [], {"stages": None}, {"run": {"seed": -1}}])
def test_settings_of_a_record_that_cannot_be_are_refused_by_the_file(run, value):
    path = run.path / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "config": value}))
    with pytest.raises(RunError, match=f"^{path}: "):
        Run(run.path).config  # noqa: B018


def test_what_a_training_noted_is_refused_where_it_is_damaged(run):
    for text in ("{", "[]", "{}", '{"seconds_total": "long"}', '{"seconds_total": NaN}'):
        (run.path / "training.json").write_text(text)
        with pytest.raises(RunError, match=r"training\.json is damaged"):
            run.training()


@pytest.mark.filterwarnings("default")
def test_a_run_that_is_damaged_is_one_line_on_the_command_line(run, capsys):
    rewrite(run, CHANGES["negative grid"][0])
    assert main(["export", str(run.path)]) == 2
    error_text = capsys.readouterr().err
    assert error_text.startswith("error: checkpoint ")
    assert error_text.count("\n") == 1
    latest_checkpoint(run.checkpoints).write_bytes(b"hello")
    assert main(["export", str(run.path)]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("warning: checkpoint ")
    assert second.startswith("error: ")


@pytest.mark.parametrize("size", [-5, 0, 100_000_000])
def test_textures_of_impossible_sizes_are_refused(run, capsys, size):
    assert main(["export", str(run.path), "--texture-size", str(size)]) == 2
    assert f"--texture-size must be from 1 to 16384, got {size}" in capsys.readouterr().err


def test_whole_numbers_beyond_floating_point_are_infinite():
    """Then the check for finite numbers names the entry; Python's own error names nothing."""
    assert parse_json(f"[{10**200}]") == [10**200]
    for sign, digits in (("", 400), ("-", 400), ("", 5000)):
        (number,) = parse_json(f"[{sign}1{'0' * digits}]")
        assert number == float(f"{sign}inf")


def test_documents_that_are_nested_too_deeply_are_one_line():
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(DEEP)
    with pytest.raises(ValueError, match="not UTF-8 at byte 1"):
        parse_json(b"1\xff")
