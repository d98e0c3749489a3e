"""The documents: links lead somewhere, every page is in the site, examples run."""

import re
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from geosplat_jax.fit.config import all_settings
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.stages import require_rates
from geosplat_jax.io.dataset import LAYOUTS, load_dataset
from geosplat_jax.losses import VIEW_TERMS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "examples" / "README.md"]

CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def headings(path):
    """Anchors of a page, as GitHub and mkdocs make them."""
    lines = re.findall(
        r"^#+ (.+)$", re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL), re.M
    )
    return {re.sub(r"[^\w\- ]", "", line.lower()).strip().replace(" ", "-") for line in lines}


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_links_lead_to_files_and_headings(path):
    for target in LINK.findall(CODE.sub("", path.read_text(encoding="utf-8"))):
        if target.startswith(("https://", "http://")):
            continue
        name, _, anchor = target.partition("#")
        linked_path = (path.parent / name).resolve() if name else path
        assert linked_path.exists(), f"{path.name} links to {target}, which is not there"
        if path.parent == DOCS:
            assert DOCS in linked_path.parents, f"{target} lies outside of the site"
        if anchor:
            assert anchor in headings(linked_path), f"{path.name}: no heading for {target}"


@pytest.mark.parametrize("name", ["gradients.md", "numerics.md"])
def test_tables_name_what_the_code_and_its_tests_have(name):
    """Rows name a function or constant and the tests for it, and all of these must exist."""
    files = sorted((ROOT / "geosplat_jax").rglob("*.py"))
    test_source = "".join(path.read_text() for path in sorted((ROOT / "tests").glob("test_*.py")))
    text = (DOCS / name).read_text()
    rows = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    named_members = set(re.findall(r"`([a-z_]+)\.([A-Za-z_]+)`", rows))
    assert len(named_members) > 5
    for module, member in named_members - {("numerics", "py"), ("material", "position_gradient")}:
        sources = [path.read_text() for path in files if path.stem == module]
        assert sources, f"{name} names {module}.{member}, and there is no such module"
        is_defined = any(re.search(rf"^ *(def |class )?{member}\b", text, re.M) for text in sources)
        assert is_defined, f"{name} names {module}.{member}, which is not there"
    for path in re.findall(r"`((?:tests|experiments|benchmarks)/[\w/]+\.py)`", text):
        assert (ROOT / path).exists(), f"{name} names {path}, which is not there"
    for test in re.findall(r"`([a-z_0-9]{30,})`", rows):
        assert f"def test_{test}(" in test_source, f"{name} names test_{test}, which is not there"


def test_every_page_is_in_the_site():
    site_pages = set(re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    assert site_pages == {path.name for path in PAGES}


def test_commands_in_the_tutorial_exist():
    from geosplat_jax.cli.arguments import command_line

    text = "".join((DOCS / name).read_text() for name in ("tutorial.md", "choosing.md", "index.md"))
    lines = re.findall(r"^geosplat-jax (.+)$", text, re.M)
    assert len(lines) > 8
    for line in lines:
        command_line().parse_args(line.replace("SCENE", "scene").split())


def test_bounds_are_read_as_they_are_printed():
    from geosplat_jax.cli.arguments import command_line

    corners = ["-1.2e-05", "-1", "-.5", "1e-05", "1.5E+06", "2."]
    arguments = command_line().parse_args(["info", "scene", "--bounds", *corners])
    assert arguments.bounds == [float(text) for text in corners]


def test_the_table_of_settings_has_them_all():
    hooks = {}
    exec((DOCS / "site_hooks.py").read_text(), hooks)
    page = hooks["on_page_markdown"]((DOCS / "settings.md").read_text())
    for path, *_ in all_settings(make_config()):
        assert f"| `{path}` |" in page
    cells = [line.count("|") for line in page.splitlines() if line.startswith("| `")]
    assert set(cells) == {5}
    assert hooks["on_page_markdown"]("another page") == "another page"


@pytest.fixture
def examples():
    """Names that the Python blocks of the page define; what they register is removed at the end."""
    text = (DOCS / "extending.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    names = {}
    exec("\n".join(blocks), names)
    yield names
    del VIEW_TERMS["haze"], LAYOUTS["plain"]


def test_the_loss_of_the_page_counts_where_it_has_a_weight(examples):
    assert examples["with_haze"].stage("split_sum").weights["haze"].value == 0.05
    for coverage, expected in ((0.0, 0.0), (1.0, 0.0), (0.5, 1.0)):
        images = SimpleNamespace(output=SimpleNamespace(alpha=jnp.full((1, 4, 4), coverage)))
        assert float(VIEW_TERMS["haze"](images)) == pytest.approx(expected)


def test_the_reader_of_the_page_is_recognised(examples, tmp_path):
    (tmp_path / "images").mkdir()
    poses = []
    for number in range(3):
        pixels = np.full((8, 12, 4), 200, np.uint8)
        pixels[:2] = 0
        Image.fromarray(pixels).save(tmp_path / "images" / f"{number}.png")
        poses.append([1, 0, 0, number, 0, 1, 0, 0, 0, 0, 1, 5, 20])
    np.savetxt(tmp_path / "poses.txt", poses)
    bounds = ((-1.0,) * 3, (1.0,) * 3)
    dataset = load_dataset(tmp_path, bounds=bounds)
    assert dataset.layout == "plain"
    assert (len(dataset.train), len(dataset.test)) == (2, 1)
    np.testing.assert_allclose(dataset.train.camera_to_world[1, :3, 3], [2, 0, 5])
    np.testing.assert_allclose(dataset.train.intrinsics[0], [[20, 0, 6], [0, 20, 4], [0, 0, 1]])
    (tmp_path / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="13 numbers for each of 3 images"):
        load_dataset(tmp_path, bounds=bounds)


def test_the_stage_of_the_page_trains_the_albedo_alone(examples):
    stage = examples["polished"].active_stages[-1]
    assert stage.name == "polish"
    require_rates(examples["polished"])
    assert "splat_albedo" not in stage.frozen
    assert {"sdf", "light", "roughness_metallic", "splat_means"} <= set(stage.frozen)
    assert stage.splats == examples["polished"].active_stages[-2].splats


def test_docstrings_of_the_site_are_lists():
    pytest.importorskip("griffe", reason="the site needs the extra `docs`")
    names = {}
    exec((DOCS / "site_docstrings.py").read_text(), names)
    text = (
        "Render.\n\nAs in::\n\n    code\n\nParameters\n----------\na, b : first\n    and more.\n"
        "c : second\n\nReturns\n-------\n() in [0, 1]. It is\nsmall.\n\n"
        "Raises\n------\nValueError\n    If not."
    )
    assert names["as_markdown"]("A plain one.") == "A plain one."
    assert names["as_markdown"](text).splitlines()[-13:] == [
        "",
        "**Parameters**",
        "",
        "- `a, b`: first and more.",
        "- `c`: second",
        "",
        "**Returns**",
        "",
        "- () in [0, 1]. It is small.",
        "",
        "**Raises**",
        "",
        "- `ValueError`: If not.",
    ]
    assert "As in:\n\n    code" in names["as_markdown"](text)
