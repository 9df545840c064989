"""What may import what, how quickly the package loads, and how large its parts may grow."""

from __future__ import annotations

import ast
import functools
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"torch", "gtsam", "open3d", "matplotlib", "small_gicp", "scipy", "pydantic", "typer", "joblib"}
# the only modules of hybridlio that may know that graph and learned exist
JOINING = (
    "__main__",
    "batch",
    "cli",
    "compare",
    "config",
    "odometry",
    "recipes",
    "run",
    "run_folder",
    "run_outputs",
    "sources",
    "training_data",
)
MAX_MODULE_LINES, MAX_TEST_LINES, MAX_FUNCTION_LINES, MAX_IMPORT_S = 300, 400, 60, 0.3


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
FILES = {**MODULES, **SCRIPTS}


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
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def importing(modules: Iterable[str], *packages: str) -> dict[str, set[str]]:
    """Those of ``modules`` that import one of ``packages`` or something inside it, and what they import."""
    reached = {
        module: {name for name in imports(FILES[module]) for p in packages if name == p or name.startswith(p + ".")}
        for module in modules
    }
    return {module: names for module, names in reached.items() if names}


def inside(package: str) -> set[str]:
    return {module for module in MODULES if module == package or module.startswith(package + ".")}


TOP = {f"hybridlio.{name}" for name in JOINING} | inside("hybridlio.commands") | {"hybridlio"}
GRAPH, LEARNED = inside("hybridlio.graph"), inside("hybridlio.learned")


def test_the_three_packages_are_found():
    assert {"hybridlio", "hybridlio.core.se3"} <= set(MODULES)
    assert "hybridlio.graph" in GRAPH
    assert "hybridlio.learned" in LEARNED
    assert len(set(MODULES.values())) == len(MODULES)


def test_gtsam_lives_in_graph_and_nowhere_else():
    assert importing(GRAPH, "gtsam") != {}
    assert importing(set(MODULES) - GRAPH, "gtsam") == {}


def test_torch_lives_in_learned_and_nowhere_else():
    assert importing(set(MODULES) - LEARNED, "torch") == {}


def test_learned_trains_on_a_machine_without_open3d():
    assert importing(LEARNED, "open3d") == {}


def test_graph_and_learned_know_the_leaves_but_neither_each_other_nor_what_joins_them():
    joining = TOP - {"hybridlio"}
    assert importing(GRAPH, "hybridlio.learned", *joining) == {}
    assert importing(LEARNED, "hybridlio.graph", *joining) == {}


def test_leaves_know_neither_graph_nor_learned_nor_what_joins_them():
    leaves = set(MODULES) - GRAPH - LEARNED - TOP
    assert importing(leaves, "hybridlio.graph", "hybridlio.learned", *TOP - {"hybridlio"}) == {}


def test_the_folders_bare_names_are_never_imported():
    assert importing(FILES, "graph", "learned") == {}


def test_imports_are_absolute():
    relative = [n for path in FILES.values() for n in ast.walk(parsed(path)) if getattr(n, "level", 0)]
    assert relative == []


def swallows(handler: ast.ExceptHandler) -> bool:
    """Whether the handler catches everything by a bare ``except``, or does nothing at all."""
    return handler.type is None or all(
        isinstance(line, ast.Pass) or (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
        for line in handler.body
    )


def test_no_handler_swallows_an_error_in_silence():
    handlers = [(f, n) for f, p in FILES.items() for n in ast.walk(parsed(p)) if isinstance(n, ast.ExceptHandler)]
    assert [f"{file}:{handler.lineno}" for file, handler in handlers if swallows(handler)] == []


def test_every_module_says_what_it_is():
    assert [module for module, path in MODULES.items() if not ast.get_docstring(parsed(path))] == []


def test_files_stay_short():
    lines = {file: len(path.read_text().splitlines()) for file, path in FILES.items()}
    limits = {file: MAX_TEST_LINES if file.startswith("tests/") else MAX_MODULE_LINES for file in FILES}
    assert {file: count for file, count in lines.items() if count > limits[file]} == {}


def lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Length in lines, its docstring left out."""
    first = function.body[0]
    is_text = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    docstring = (first.end_lineno or 0) - first.lineno + 1 if is_text else 0
    return (function.end_lineno or 0) - function.lineno + 1 - docstring


def test_functions_stay_short():
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    functions = [(f, n) for f, path in FILES.items() for n in ast.walk(parsed(path)) if isinstance(n, kinds)]
    lines = {f"{file}:{node.name}": lines_of(node) for file, node in functions}
    assert {name: count for name, count in lines.items() if count > MAX_FUNCTION_LINES} == {}


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


def test_the_configuration_loads_no_pytorch():
    code = "import sys; from hybridlio.odometry.config import Config; Config(); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def test_odometry_without_imu_and_graph_does_without_gtsam():
    code = """
import sys
import numpy as np
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.core.sensors import Frame, ImuSamples, Scan

points = np.random.default_rng(0).uniform(-9, 9, (3000, 3)).astype(np.float32)
points[np.arange(3000), np.arange(3000) % 3] = 9
odometry = Odometry("constant-velocity", "scan-matching", "none")
for k in range(3):
    odometry.step(Frame(k, Scan(k * 10**8, points), ImuSamples.empty()))
print("gtsam" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
