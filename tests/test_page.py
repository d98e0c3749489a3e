"""The report: one valid page that needs no network, is complete, and escapes every name."""

import json
import re
import shlex
import shutil
from dataclasses import replace

import html5lib
import numpy as np
import pytest
from PIL import Image

from geosplat_jax.cli import main
from geosplat_jax.cli.arguments import command_line
from geosplat_jax.fit.budget import plan
from geosplat_jax.fit.config import Budget
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.presets import between_qualities, make_config
from geosplat_jax.io.checkpoints import save_checkpoint
from geosplat_jax.io.images import write_hdr
from geosplat_jax.report import facts, page
from geosplat_jax.report.facts import (
    changed_from_preset,
    command,
    curves,
    figure,
    protocol_text,
    stage_times,
)
from geosplat_jax.report.gallery import comparisons, write_gallery
from geosplat_jax.report.page import LARGEST_PAGE, RunResults, report_html

EVIL = "<script>alert(1)</script>\"'&"
TRIANGLE = b"glTF\x02\x00\x00\x00"
STEPS = 1700


def picture(seed, size=24):
    return np.random.default_rng(seed).uniform(0, 1, (size, size, 3)).astype(np.float32)


def make_run(folder, *, name="test_000", light="noon", config=None, size=24):
    """Write the files of a training and an evaluation, without running either."""
    folder.mkdir(parents=True)
    config = config or make_config("default", "draft", overrides=("run.seed=7",))
    record = {
        "scene": f"/scenes/{name}",
        "dataset": {"downscale": 4, "light": None, "bounds": [-1, -1, -1, 1, 1, 1.5]},
        "views": "40 of 32 x 32, abc",
        "config": config.to_dict(),
        "versions": {"python": "3.13", "jax": "0.10"},
    }
    (folder / "run.json").write_text(json.dumps(record))
    lines = [
        {
            "step": n,
            "stage": "split_sum" if n < 1000 else "monte_carlo",
            "loss": 1 / (n + 1),
            "psnr": 20 + n / 100,
            "splats": 100 + n,
            "seconds": 0.5,
            "peak_memory_mb": 900,
        }
        for n in range(STEPS)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "training.json").write_text('{"seconds_total": 600.0}')
    titles = ["truth", "render", "error", "albedo", "true albedo", "albedo, aligned", "seen by"]
    titles += [f"true {light}", light]
    row = {title: picture(n, size) for n, title in enumerate(titles)}
    lights = {"true light": picture(1, 8), "light": picture(2, 8)}
    gallery = write_gallery(folder, {name: row}, lights=lights)
    (folder / "evaluation" / "mesh.glb").write_bytes(TRIANGLE)
    write_hdr(folder / "evaluation" / "light_00.hdr", picture(3, 8))
    gallery["model"] = {
        "mesh": "evaluation/mesh.glb",
        "faces": 12345,
        "lights": {light: "evaluation/light_00.hdr"},
    }
    metrics = {
        "protocol": "geosplatting",
        "notes": ["a note"],
        "mean": {"nvs.psnr": 31.25, "normal.mae_masked_deg": 2.5, f"relight.{light}.psnr": 28.0},
        "views": [{"view": name, "nvs.psnr": 31.25}],
        "samples_drawn": 128,
        "seconds": 60.0,
        "training_peak_memory_mb": 2500,
        "gallery": gallery,
        "seen": {
            "asked": 32,
            "available": 40,
            "shares": [
                {"views": "none", "share": 0.25},
                {"views": "1 or 2", "share": 0.25},
                {"views": "3 to 7", "share": 0.4},
                {"views": "8 and more", "share": 0.1},
            ],
        },
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return RunResults.of(RunFolder(folder))


@pytest.fixture(scope="module")
def html(tmp_path_factory):
    return report_html([make_run(tmp_path_factory.mktemp("page") / "duck")])


@pytest.fixture
def small(monkeypatch):
    """Pages without the large scripts, which take a second to parse."""
    read_web_file = page._web
    monkeypatch.setattr(
        page, "_web", lambda name: "" if name.endswith("min.js") else read_web_file(name)
    )


def test_the_page_says_why_the_model_is_what_it_is(tmp_path, small):
    run = make_run(tmp_path / "duck")
    assert "Model</h2>" not in report_html([run])
    path = tmp_path / "duck" / "run.json"
    measurement = {"gain": 1.25, "standard_error": 0.5, "spread": 0.0}
    rung = {"part": "metallic", "title": "metallic", "smaller": 30.0, "larger": 31.25}
    rungs = [
        {**rung, "found": measurement, "is_kept": True, "note": ""},
        {**rung, "title": "shift", "larger": None, "found": None, "is_kept": False, "note": "<x>"},
    ]
    model = {"rungs": rungs, "by_hand": [], "held_back": ["a", "b"], "trainings": 7, "seconds": 9.0}
    path.write_text(json.dumps({**json.loads(path.read_text()), "model": model}))
    html = report_html([run])
    cells = ["metallic", "30.00 dB", "31.25 dB", "+1.25 +- 0.50 dB", "kept"]
    assert "".join(f"<td>{cell}</td>" for cell in cells) in html
    assert "<td>shift</td><td>30.00 dB</td><td>-</td><td>-</td><td>left out: &lt;x&gt;</td>" in html
    assert "Choosing took 9 s, 7 trainings" in texts_of(parsed(html))


def parsed(text):
    """Parse as a browser does; anything that is not valid HTML raises."""
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    return parser.parse(text)


def texts_of(tree):
    return " ".join("".join(tree.itertext()).split())


def test_the_page_is_valid_and_asks_nothing_of_the_network(html):
    tree = parsed(html)
    for element in tree.iter():
        for name in ("src", "href", "data-light", "srcset", "poster", "action"):
            value = element.get(name)
            assert value is None or value == "" or value.startswith("data:"), (element.tag, name)
    assert not tree.findall(".//link")
    assert not tree.findall(".//script[@src]")
    rules = tree.find(".//meta[@http-equiv='Content-Security-Policy']").get("content")
    assert "default-src 'none'" in rules
    assert "http" not in rules
    styles = "".join(style.text for style in tree.findall(".//style"))
    assert "url(" not in styles
    assert "@import" not in styles
    assert len(html.encode()) < LARGEST_PAGE


def test_the_page_holds_the_object_its_pictures_and_its_numbers(html):
    tree = parsed(html)
    viewer = tree.find(".//model-viewer")
    assert viewer.get("src").startswith("data:model/gltf-binary;base64,Z2xURg")
    lights = [button.get("data-light") for button in tree.findall(".//button[@data-light]")]
    assert [bool(light) for light in lights] == [True, False]
    assert lights[0].endswith("#.hdr")
    pairs = [figure.get("data-pair") for figure in tree.findall(".//figure[@data-pair]")]
    assert pairs == ["render", "albedo, aligned", "noon"]
    for stack in tree.findall(".//div[@class='stack']"):
        assert len(stack.findall("img")) == 2
        assert len(stack.findall("input[@type='range']")) == 1
    captions = [caption.text for caption in tree.findall(".//figcaption")]
    assert captions == ["error", "albedo", "seen by", "truth", "found"]
    page_text = texts_of(tree)
    for phrase in (
        *("31.2500", "PSNR", "dB", "degrees", "Protocol geosplatting", "New light: noon"),
        *("12,345 triangles", "32 of 40 were asked", "none: 25.0 %", "2,500 MB", "a note"),
        *("run.seed", "jax 0.10", "Licences of the embedded", "took 600 s"),
    ):
        assert phrase in page_text, phrase
    data = json.loads(tree.find(".//script[@id='data']").text)
    (run,) = data["runs"]
    assert run["step"][-1] == STEPS - 1
    assert [len(run[key]) for key in ("loss", "psnr", "splats", "memory")] == [len(run["step"])] * 4
    assert [stage["name"] for stage in run["stages"]] == ["split_sum", "monte_carlo"]
    assert "n-th step is drawn" in page_text


@pytest.mark.usefixtures("small")
def test_names_are_never_taken_for_markup(tmp_path):
    run = make_run(
        tmp_path / "<img src=x onerror=alert(2)>", name=EVIL, light=EVIL.replace("/", "|")
    )
    text = report_html([run])
    tree = parsed(text)
    assert len(tree.findall(".//script")) == 4
    assert not [e for e in tree.iter() if e.get("onerror") or e.get("onload")]
    assert "alert(1)" not in "".join(script.text or "" for script in tree.findall(".//script"))
    assert EVIL in texts_of(tree)
    assert tree.find(".//button[@data-view]").text.startswith(EVIL)


@pytest.mark.usefixtures("small")
def test_several_runs_are_compared_and_the_better_figure_is_marked(tmp_path):
    first, second = (make_run(tmp_path / name / "run") for name in ("a", "b"))
    metrics = json.loads((second.results / "metrics.json").read_text())
    metrics["mean"] |= {"nvs.psnr": 33.0, "normal.mae_masked_deg": 9.0, "albedo.psnr": 20.0}
    (second.results / "metrics.json").write_text(json.dumps(metrics))
    tree = parsed(report_html([first, second]))
    rows = {
        row.find("td").get("title"): row.findall("td[@class]")[2:]
        for row in tree.findall(".//section[@id='figures']//tr")
        if row.find("td") is not None
    }
    marks = {key: ["best" in cell.get("class") for cell in cells] for key, cells in rows.items()}
    assert marks["nvs.psnr"] == [False, True]
    assert marks["normal.mae_masked_deg"] == [True, False]
    assert [cell.text for cell in rows["albedo.psnr"]] == ["–", "20.0000"]
    assert marks["albedo.psnr"] == [False, False]
    assert [heading.text for heading in tree.findall(".//h2[@class='run']")] == ["a/run", "b/run"]


@pytest.mark.usefixtures("small")
def test_what_does_not_fit_is_left_out_and_named(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run")
    (run.results / "evaluation" / "mesh.glb").write_bytes(bytes(400_000))
    monkeypatch.setattr(page, "LARGEST_PAGE", 400_000)
    text = report_html([run])
    assert len(text.encode()) < 400_000
    tree = parsed(text)
    assert tree.find(".//model-viewer") is None
    assert "Left out, since the page would exceed" in texts_of(tree)
    assert "the mesh to turn" in texts_of(tree)
    with pytest.raises(ValueError, match="2 runs do not fit into one report"):
        report_html([run, run])


@pytest.mark.usefixtures("small")
def test_a_run_without_an_evaluation_has_a_page_that_says_so(tmp_path):
    run = make_run(tmp_path / "run")
    (run.results / "metrics.json").unlink()
    shutil.rmtree(run.results / "evaluation")
    page_text = texts_of(parsed(report_html([run])))
    assert "Not evaluated yet" in page_text
    assert "took 600 s" in page_text


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", 5, "evaluation"])
def test_no_file_outside_the_run_is_read(tmp_path, name):
    run = make_run(tmp_path / "run")
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    metrics = json.loads((run.results / "metrics.json").read_text())
    metrics["gallery"]["views"][0]["pictures"]["error"] = name
    metrics["gallery"]["model"]["mesh"] = name
    (run.results / "metrics.json").write_text(json.dumps(metrics))
    tree = parsed(report_html([run]))
    assert "error" not in [caption.text for caption in tree.findall(".//figcaption")]
    assert tree.find(".//model-viewer") is None


@pytest.mark.parametrize("metrics", ["[1]", "{", '{"mean": {}, "views": 3}', '{"mean": []}'])
def test_damaged_metrics_are_one_line_that_names_the_file(tmp_path, metrics, capsys):
    run = make_run(tmp_path / "run")
    (run.results / "metrics.json").write_text(metrics)
    with pytest.raises(RunError, match=r"metrics\.json.* damaged"):
        report_html([run])
    assert main(["report", str(run.folder)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_command_writes_the_page_beside_the_run(tmp_path, capsys):
    runs = [make_run(tmp_path / name) for name in ("a", "b")]
    assert main(["report", str(runs[0].folder)]) == 0
    assert "report.html" in capsys.readouterr().out
    assert (tmp_path / "a" / "report.html").stat().st_size > 1_000_000
    run_folders = [str(run.folder) for run in runs]
    assert main(["report", *run_folders]) == 2
    assert "needs --output" in capsys.readouterr().err
    assert main(["report", *run_folders, "--output", str(tmp_path / "both.html")]) == 0
    assert "2 runs compared" in (tmp_path / "both.html").read_text()
    assert main(["report", str(tmp_path)]) == 2
    assert "is not a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("key", "group", "label", "unit", "better"),
    [
        ("nvs.psnr_masked", "New views", "PSNR, object's pixels", "dB", "higher"),
        ("normal.mae_full_deg", "Normals", "mean angle, all pixels", "degrees", "lower"),
        ("relight.mean.ssim", "New lights, mean", "SSIM", "", "higher"),
        ("relight.a.b.psnr", "New light: a.b", "PSNR", "dB", "higher"),
        ("albedo.scale_r", "Albedo", "factor to the truth, red", "", ""),
        (
            "albedo.scale_ratio",
            "Albedo",
            "wrong colour: largest factor over the smallest",
            "",
            "lower",
        ),
        ("light.direction_error_deg", "Light", "angle between mean directions", "degrees", "lower"),
        ("light.yaw_correlation", "Light", "correlation after the best turn", "", "higher"),
        ("nvs.surprise", "New views", "surprise", "", ""),
    ],
)
def test_figures_have_names_and_units(key, group, label, unit, better):
    entry = figure(key)
    assert (entry.group, entry.label, entry.unit, entry.better) == (group, label, unit, better)


def test_the_command_of_the_report_makes_the_same_settings():
    overrides = ("stages.split_sum.steps=5", "run.seed=3", "adapter.thickness=1e-5",
                 "stages.split_sum.weights.entropy.end=none")  # fmt: skip
    config = make_config("default", "draft", overrides=overrides)
    assert set(changed_from_preset(config)) == {text.split("=")[0] for text in overrides}
    record = {"scene": "/a b", "dataset": {"downscale": 2, "light": "x y", "bounds": None}}
    text, is_whole = command(record, config)
    assert is_whole
    assignments = re.findall(r"--set '?([^ ']+)", text)
    assert make_config("default", "draft", overrides=tuple(assignments)) == config
    assert "'/a b'" in text
    assert "--light 'x y'" in text
    assert "--bounds" not in text
    # If no option of the command expresses a setting, the command counts as incomplete.
    for extra_options in ({"train_views": 4}, {"layout": "colmap"}, {"mask_files": False}):
        dataset = {**record["dataset"], **extra_options}
        assert not command({**record, "dataset": dataset}, config)[1]


def test_labels_of_ones_own_are_compared_with_the_defaults():
    """In Python, the names of preset, quality and prior are free."""
    config = make_config("default", "standard", overrides=("run.seed=3",))
    config = replace(config, preset="mine", quality="fast", material_prior="dull")
    assert changed_from_preset(config) == {"run.seed": (0, 3)}
    text, is_whole = command({"scene": "s", "dataset": {}}, config)
    assert is_whole
    arguments = command_line().parse_args(shlex.split(text.replace("\\\n", " "))[1:])
    assert (arguments.preset, arguments.quality) == ("default", "standard")


def test_a_protocol_says_how_each_kind_of_image_is_compared():
    text = protocol_text("orb")
    assert "for PSNR-H and PSNR-L, on the object alone, without a scale" in text
    assert "albedo on the object alone, each channel of each image scaled" in text
    assert "PSNR-H" not in protocol_text("geosplatting")


def test_settings_between_two_levels_are_said_beside_the_standard_ones():
    """Such settings come from a budget, and no quality level names them."""
    config = between_qualities(0.6)
    changes = changed_from_preset(config)
    assert changes["geometry.resolution"] == (48, config.geometry.resolution)
    assert "quality" not in changes
    text, is_whole = command({"scene": "s", "dataset": {}}, config)
    assert is_whole
    assert "--quality standard" in text
    assignments = re.findall(r"--set '?([^ ']+)", text)
    rebuilt_config = make_config("default", "standard", overrides=tuple(assignments))
    assert replace(rebuilt_config, quality=config.quality) == config


def test_the_command_of_a_budget_names_its_paces():
    planned = plan(Budget(600.0), (200, 200), slowness=1.0)
    assert planned.config.stages[0].pace
    text, is_whole = command({"scene": "s", "dataset": {}}, planned.config)
    assert is_whole
    assert "stages.split_sum.pace=[{step = 0, speed = " in text


def test_the_command_of_a_run_from_a_mesh_names_the_file(tmp_path):
    path = tmp_path / "a mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    config = make_config("paper", "draft", mesh=path, overrides=("geometry.max_faces=99",))
    assert set(changed_from_preset(config)) == {"geometry.max_faces"}
    text, is_whole = command({"scene": "s", "dataset": {}}, config)
    assert is_whole
    assert f"--mesh '{path}'" in text
    assert "geometry.max_faces=99" in text
    assert "geometry.path" not in text


def test_settings_that_options_cannot_say_are_not_pretended(monkeypatch):
    config = make_config("default", "draft", overrides=("run.seed=3",))
    assert command({"scene": "s", "dataset": {}}, config)[1]
    for spelling in ("nothing", "7"):  # one is refused, the other read as another value
        monkeypatch.setattr(facts, "as_written", lambda value, text=spelling: text)
        text, is_whole = command({"scene": "s", "dataset": {}}, config)
        assert not is_whole
        assert "--set" not in text


def test_a_run_that_was_trained_further_since_its_evaluation_says_so(tmp_path):
    folder = tmp_path / "run"
    make_run(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    save_checkpoint(RunFolder(folder).checkpoints, 1600, tree={"x": np.zeros(2)}, meta={})
    # A killed run has made steps since its last checkpoint, which no evaluation can see.
    for step, is_older in ((1600, False), (900, True)):
        (folder / "metrics.json").write_text(json.dumps({**metrics, "step": step}))
        html = report_html([RunResults.of(RunFolder(folder))])
        assert (f"was evaluated after {step} steps" in html) is is_older


def test_different_indirect_light_under_new_lights_is_said(tmp_path):
    runs = []
    for name, indirect in (("a", "traced"), ("b", "traced"), ("c", "none")):
        make_run(tmp_path / name)
        metrics = json.loads((tmp_path / name / "metrics.json").read_text())
        metrics["relight_indirect"] = indirect
        (tmp_path / name / "metrics.json").write_text(json.dumps(metrics))
        runs.append(RunResults.of(RunFolder(tmp_path / name)))
    warning = "relit with different indirect light"
    assert warning not in report_html(runs[:2])
    assert warning in report_html(runs)


def test_long_curves_are_thinned_and_keep_their_ends():
    lines = [
        {"step": n, "stage": "a", "loss": float("nan"), "psnr": 1.0, "splats": 1, "seconds": 2.0}
        for n in range(2001)
    ]
    thinned_curves = curves(lines)
    assert thinned_curves["every"] == 3
    assert (thinned_curves["step"][0], thinned_curves["step"][-1]) == (0, 2000)
    assert set(thinned_curves["loss"]) == {None}
    assert stage_times(lines)[0]["seconds"] == 4002.0
    assert curves([])["step"] == []


def test_truth_is_paired_with_what_was_found():
    titles = ["truth", "render", "true albedo", "albedo", "albedo, aligned", "true normal"]
    assert comparisons(titles) == [("truth", "render"), ("true albedo", "albedo, aligned")]
