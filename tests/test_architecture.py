"""What may import what, how quickly the package loads, and how large its parts may grow."""

from __future__ import annotations

import ast
import functools
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"torch", "gtsam", "open3d", "matplotlib", "small_gicp", "scipy", "pydantic", "typer"}
# the only modules of hybridlio that may know that graph and learned exist
TOP = {"hybridlio", "hybridlio.__main__", "hybridlio.cli", "hybridlio.odometry", "hybridlio.run"}
MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_IMPORT_S = 300, 60, 0.3


def package_files() -> Iterator[tuple[str, Path]]:
    for package, folder in [("hybridlio", "hybridlio"), ("hybridlio.graph", "graph"), ("hybridlio.learned", "learned")]:
        links = {ROOT / "hybridlio/graph", ROOT / "hybridlio/learned"}
        for path in sorted((ROOT / folder).rglob("*.py")):
            if not links & set(path.parents):
                inside = path.relative_to(ROOT / folder).with_suffix("").parts
                yield ".".join([package, *(part for part in inside if part != "__init__")]), path


MODULES = dict(package_files())
SCRIPTS = {
    str(path.relative_to(ROOT)): path
    for folder in ("tests", "benchmarks", "examples", "docs")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
every_module = pytest.mark.parametrize("module", MODULES)
every_file = pytest.mark.parametrize("path", {**MODULES, **SCRIPTS}.values(), ids=[*MODULES, *SCRIPTS])


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """Everything a file imports, at its top or inside a function; ``from a import b`` counts as a and as a.b."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def reaches(path: Path, *packages: str) -> set[str]:
    return {name for name in imports(path) for package in packages if name == package or name.startswith(package + ".")}


def test_the_three_packages_are_found():
    assert {"hybridlio", "hybridlio.se3", "hybridlio.graph", "hybridlio.learned"} <= set(MODULES)
    assert len(set(MODULES.values())) == len(MODULES)


@every_module
def test_gtsam_lives_in_graph_and_torch_in_learned_and_nowhere_else(module):
    if not module.startswith("hybridlio.graph"):
        assert not reaches(MODULES[module], "gtsam")
    if not module.startswith("hybridlio.learned"):
        assert not reaches(MODULES[module], "torch")


@every_module
def test_learned_trains_on_a_machine_without_open3d(module):
    if module.startswith("hybridlio.learned"):
        assert not reaches(MODULES[module], "open3d")


@every_module
def test_imports_point_one_way(module):
    """Leaves know neither graph nor learned; these two know the leaves, but neither each other nor what joins them."""
    forbidden = {"hybridlio.graph", "hybridlio.learned", *TOP - {"hybridlio"}}
    own = ".".join(module.split(".")[:2])
    if module not in TOP:
        assert not reaches(MODULES[module], *forbidden - {own})


@every_file
def test_the_folders_bare_names_are_never_imported(path):
    assert not reaches(path, "graph", "learned")


def is_silent(handler: ast.ExceptHandler) -> bool:
    return all(
        isinstance(line, ast.Pass) or (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
        for line in handler.body
    )


@every_file
def test_no_handler_swallows_an_error_in_silence(path):
    handlers = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.ExceptHandler)]
    assert [node.lineno for node in handlers if node.type is None or is_silent(node)] == []


@every_module
def test_every_module_says_what_it_is(module):
    assert ast.get_docstring(parsed(MODULES[module]))


@every_file
def test_files_and_functions_stay_short(path):
    assert len(path.read_text().splitlines()) <= MAX_FILE_LINES
    functions = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    lengths = {node.name: (node.end_lineno or 0) - node.lineno + 1 for node in functions}
    assert {name: length for name, length in lengths.items() if length > MAX_FUNCTION_LINES} == {}


def import_in_a_new_process() -> tuple[float, set[str]]:
    code = (
        "import sys, time; start = time.perf_counter(); import hybridlio; spent = time.perf_counter() - start;"
        "import json; print(json.dumps([spent, list(sys.modules)]))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    spent, modules = json.loads(done.stdout)
    return spent, set(modules)


def test_importing_hybridlio_is_quick_and_loads_no_heavy_library():
    runs = [import_in_a_new_process() for _ in range(5)]
    assert min(spent for spent, _ in runs) < MAX_IMPORT_S
    assert not HEAVY & runs[0][1]
