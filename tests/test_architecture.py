"""The order of modules, the purity of the jitted ones, and docstrings of everything public."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import geosplat_jax

PACKAGE = Path(geosplat_jax.__file__).parent
PAGE = Path(__file__).parent.parent / "docs" / "architecture.md"
NAME = "geosplat_jax"

# Lowest first: a module imports only modules above its own line. A folder is one layer; within it,
# modules may import each other without a cycle.
ORDER = [
    "core",
    "rays",
    "surface",
    "geometry",
    "banded",
    "hashgrid",
    "materials",
    "adapter",
    "refinement",
    "splats",
    "transport",
    "render",
    "deferred",
    "losses",
    "pipeline",
    "io",
    "fit",
    "report",
    "model_choice",
    "capture",
    "run",
    "camera_rounds",
    "gradcheck",
    "viewer",
    "cli",
    "__main__",
]

# Everything below `io` may run inside jit, takes plain arguments and knows no settings of a run
# (the order enforces that).
JITTED = ORDER[: ORDER.index("io")]
HOST_ONLY = {"OpenImageIO", "trimesh", "skimage", "xatlas", "PIL", "rich"}


def module_name(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {
    module_name(path): ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    for path in sorted(PACKAGE.rglob("*.py"))
}
MODULES = sorted(name for name in SOURCES if name)
"""All modules except the package itself, which imports the names that it exports."""
IN_FOLDERS = [m for m in MODULES if "." in m and not (PACKAGE / m.replace(".", "/")).is_dir()]


def layer(module):
    return module.split(".")[0]


def resolve(dotted):
    """Return the longest prefix of a dotted name that is a module of the package, or None."""
    parts = dotted.split(".")
    names = (".".join(parts[:end]) for end in range(len(parts), 0, -1))
    return next((name for name in names if name in SOURCES), None)


def imports(module):
    """Return the package's own modules and the foreign packages that a module imports anywhere."""
    own_modules, foreign_packages = set(), set()
    for node in ast.walk(SOURCES[module]):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                f"{module}:{node.lineno} imports relatively; name {NAME} instead"
            )
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if layer(name) != NAME:
                foreign_packages.add(layer(name))
            elif "." in name and (target := resolve(name.split(".", 1)[1])):
                own_modules.add(target)
    return own_modules, foreign_packages


@pytest.mark.parametrize("module", MODULES)
def test_every_module_has_its_place_in_the_order(module):
    assert layer(module) in ORDER, (
        f"{NAME}.{module} has no place in the architecture: add {layer(module)!r} to ORDER in "
        "tests/test_architecture.py (below all that it imports) and to docs/architecture.md"
    )


def test_the_page_has_the_layers_in_their_order():
    table = PAGE.read_text().partition("| layer |")[2].partition("\n\n")[0]
    first_cells = [row.split("|")[1] for row in table.splitlines()[2:]]
    assert re.findall(r"`(\w+)/?`", " ".join(first_cells)) == ORDER


@pytest.mark.parametrize("module", IN_FOLDERS)
def test_the_page_lists_every_module_by_its_first_line(module):
    folder, _, name = module.rpartition(".")
    section = PAGE.read_text().partition(f"### {folder.replace('.', '/')}\n")[2].partition("\n#")[0]
    summary = " ".join(ast.get_docstring(SOURCES[module]).split("\n\n")[0].split())
    assert f"- `{name}`: {summary.replace('``', '`')}" in section.splitlines()


@pytest.mark.parametrize("module", [m for m in MODULES if layer(m) in ORDER])
def test_imports_go_only_to_lower_modules(module):
    rank = ORDER.index(layer(module))
    upward = {
        imported_module
        for imported_module in imports(module)[0]
        if layer(imported_module) != layer(module)
        and (layer(imported_module) not in ORDER or ORDER.index(layer(imported_module)) >= rank)
    }
    assert not upward, f"{module} imports {sorted(upward)}, not below it in ORDER"


@pytest.mark.parametrize("module", [m for m in MODULES if layer(m) in JITTED])
def test_jitted_modules_import_no_host_library(module):
    host_imports = imports(module)[1] & HOST_ONLY
    assert not host_imports, (
        f"{module} may run inside jit; move its use of {sorted(host_imports)} to io"
    )


def test_modules_of_one_layer_have_no_import_cycle():
    visited, path = set(), []

    def visit(module):
        assert module not in path, f"import cycle: {' -> '.join([*path, module])}"
        if module in visited:
            return
        path.append(module)
        for imported_module in sorted(imports(module)[0] - {module}):
            visit(imported_module)
        path.pop()
        visited.add(module)

    for module in MODULES:
        visit(module)


def public_definitions(module):
    """Yield (name, node) of a module, its public functions and classes, and their methods."""
    tree = SOURCES[module]
    yield module, tree
    definitions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for node in tree.body:
        if isinstance(node, definitions) and not node.name.startswith("_"):
            yield f"{module}.{node.name}", node
            for member in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(member, definitions) and not member.name.startswith("_"):
                    yield f"{module}.{node.name}.{member.name}", member


@pytest.mark.parametrize("module", [m for m in MODULES if SOURCES[m].body])
def test_public_functions_and_classes_have_docstrings(module):
    undocumented_names = [
        name for name, node in public_definitions(module) if not ast.get_docstring(node)
    ]
    assert not undocumented_names, f"without a docstring: {undocumented_names}"


def test_public_names_and_modules_are_there_when_they_are_asked_for():
    code = (
        "import sys, geosplat_jax as gs; assert 'jax' not in sys.modules; gs.geometry.isosurface; "
        "assert all(hasattr(gs, name) for name in gs.__all__); assert not hasattr(gs, 'nothing')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
