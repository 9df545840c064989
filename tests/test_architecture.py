"""Limits: imports between rooms, the time that the import takes, sizes of files, functions and folders."""

from __future__ import annotations

import ast
import functools
import graphlib
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {
    "torch",
    "gtsam",
    "open3d",
    "matplotlib",
    "small_gicp",
    "scipy",
    "pydantic",
    "typer",
    "joblib",
    "rerun",
    "numba",
}
# a room imports only rooms of lower floors
FLOORS = {
    "core": 1,
    "calibration": 2,
    "cloud": 2,
    "datasets": 2,
    "evaluation": 2,
    "mapping": 3,
    "registration": 3,
    "record": 3,
    "sources": 4,
    "smoothing": 4,
    "simulation": 4,
    "learned": 4,
    "graph": 5,
    "odometry": 6,
    "runs": 7,
    "localization": 8,
    "viewing": 8,
    "commands": 9,
}
APART = {"graph", "learned", "simulation"}  # they do not import each other
JOINING_FLOOR = 6  # nothing below it imports graph or learned
LOOSE = {"__init__.py", "__main__.py", "cli.py", "py.typed"}
MAX_ROOMS, MAX_MODULES_IN_FOLDER, MAX_CHAIN = 16, 20, 15
MAX_MODULE_LINES, MAX_TEST_LINES, MAX_FUNCTION_LINES, MAX_IMPORT_S = 300, 400, 60, 0.05


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
    """Return all imports of a file, also those inside functions; ``from a import b`` counts as a and as a.b."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def importing(modules: Iterable[str], *packages: str) -> dict[str, set[str]]:
    """Return the ``modules`` that import one of ``packages`` or something inside it, and the names they import."""
    reached = {
        module: {name for name in imports(FILES[module]) for p in packages if name == p or name.startswith(p + ".")}
        for module in modules
    }
    return {module: names for module, names in reached.items() if names}


def inside(package: str) -> set[str]:
    return {module for module in MODULES if module == package or module.startswith(package + ".")}


GRAPH, LEARNED = inside("hybridlio.graph"), inside("hybridlio.learned")


def room(module: str) -> str:
    """Return the room of a module; empty for the package itself and its entry point."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in FLOORS else ""


@functools.cache
def module_imports(module: str) -> frozenset[str]:
    """Return the modules of hybridlio that a module imports; an imported name counts as its module."""
    found = set()
    for name in imports(MODULES[module]):
        while name and name not in MODULES:
            name = name.rpartition(".")[0]
        found.add(name)
    packages = {name.rpartition(".")[0] for name in found}  # "from a import b" names both a and a.b
    return frozenset(name for name in found if name.startswith("hybridlio.") and name != module) - packages


def order() -> list[str]:
    """Return the modules, each after all that it imports; raise CycleError if there is a circle."""
    return list(graphlib.TopologicalSorter({module: module_imports(module) for module in MODULES}).static_order())


def test_the_three_packages_are_found():
    assert {"hybridlio", "hybridlio.core.se3"} <= set(MODULES)
    assert "hybridlio.graph" in GRAPH
    assert "hybridlio.learned" in LEARNED
    assert len(set(MODULES.values())) == len(MODULES)


def test_only_graph_imports_gtsam():
    assert importing(GRAPH, "gtsam") != {}
    assert importing(set(MODULES) - GRAPH, "gtsam") == {}


def test_only_learned_imports_torch():
    assert importing(set(MODULES) - LEARNED, "torch") == {}


def test_learned_trains_on_a_machine_without_open3d():
    assert importing(LEARNED, "open3d") == {}


def test_a_room_imports_only_rooms_of_lower_floors():
    wrong = [
        f"{module} -> {other}"
        for module in MODULES
        for other in module_imports(module)
        if room(module) and room(other) and room(module) != room(other)
        if FLOORS[room(other)] >= FLOORS[room(module)]
    ]
    assert wrong == []


def test_graph_learned_and_simulation_do_not_import_each_other():
    pairs = {(room(module), room(other)) for module in MODULES for other in module_imports(module)}
    assert {(a, b) for a, b in pairs if {a, b} <= APART and a != b} == set()


def test_nothing_below_the_odometry_imports_graph_or_learned():
    below = {m for m in MODULES if room(m) and FLOORS[room(m)] < JOINING_FLOOR} - GRAPH - LEARNED
    assert importing(below, "hybridlio.graph", "hybridlio.learned") == {}


def test_no_modules_import_each_other_in_a_circle():
    assert set(order()) >= set(MODULES)


def test_no_chain_of_imports_is_long():
    length: dict[str, int] = {}
    for module in order():
        length[module] = 1 + max((length[other] for other in module_imports(module)), default=0)
    assert max(length.values()) <= MAX_CHAIN


def test_there_are_few_rooms_and_no_loose_modules():
    entries = [path for path in (ROOT / "hybridlio").iterdir() if not path.name.startswith("__pycache__")]
    rooms = {path.name for path in entries if path.is_dir() and not path.is_symlink()}
    assert rooms | {"graph", "learned"} == set(FLOORS)
    assert len(rooms) <= MAX_ROOMS
    assert {path.name for path in entries if path.is_file()} <= LOOSE


def test_no_folder_holds_many_modules():
    folders = Counter(path.parent for path in MODULES.values() if path.name != "__init__.py")
    assert {str(folder): count for folder, count in folders.items() if count > MAX_MODULES_IN_FOLDER} == {}


def test_the_folders_bare_names_are_never_imported():
    assert importing(FILES, "graph", "learned") == {}


def test_imports_are_absolute():
    relative = [n for path in FILES.values() for n in ast.walk(parsed(path)) if getattr(n, "level", 0)]
    assert relative == []


def swallows(handler: ast.ExceptHandler) -> bool:
    """Return whether the handler is a bare ``except``, or does nothing."""
    return handler.type is None or all(
        isinstance(line, ast.Pass) or (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
        for line in handler.body
    )


def test_no_handler_swallows_an_error():
    handlers = [(f, n) for f, p in FILES.items() for n in ast.walk(parsed(p)) if isinstance(n, ast.ExceptHandler)]
    assert [f"{file}:{handler.lineno}" for file, handler in handlers if swallows(handler)] == []


def test_every_module_has_a_docstring():
    assert [module for module, path in MODULES.items() if not ast.get_docstring(parsed(path))] == []


def test_files_stay_short():
    lines = {file: len(path.read_text().splitlines()) for file, path in FILES.items()}
    limits = {file: MAX_TEST_LINES if file.startswith("tests/") else MAX_MODULE_LINES for file in FILES}
    assert {file: count for file, count in lines.items() if count > limits[file]} == {}


def lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the length of a function in lines, without its docstring."""
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
        "import sys, time; start = time.process_time(); import hybridlio; spent = time.process_time() - start;"
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


def test_odometry_without_imu_and_graph_does_not_load_gtsam():
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
