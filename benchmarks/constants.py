"""Whether a test fails when a tuned constant is changed grossly.

    python benchmarks/constants.py [--only NAME ...] [--list]

Copies the checkout to a temporary folder, replaces the value of one constant at a time in its source line, runs the
tests listed for it, and prints which test caught each change. Exits with 1 if a change goes uncaught, and with 2 if the
tests fail without any change.

Only constants whose value is a choice are listed: of registration, degeneracy, covariance, map, gate and scan matching.
Those that merely save time without changing results, such as the work per thread, are not.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("hybridlio", "graph", "learned", "tests", "pyproject.toml")
CAUGHT, UNCAUGHT, BROKEN = 0, 1, 2


class Constant(NamedTuple):
    """A tuned constant.

    Attributes:
        file: below the root.
        name: as in the file; ``Class.attribute`` for a default in a class.
        gross: expressions to put in place of its value, one at a time.
        tests: paths for pytest, the most likely to fail first.
    """

    file: str
    name: str
    gross: tuple[str, ...]
    tests: tuple[str, ...]


def _in(file: str, tests: tuple[str, ...], **gross: tuple[str, ...]) -> list[Constant]:
    return [Constant(file, name.replace("__", "."), values, tests) for name, values in gross.items()]


REGISTRATION = "tests/hybridlio/registration/test_"
SOURCES = "tests/hybridlio/sources/test_"
ICP = tuple(f"{REGISTRATION}{name}.py" for name in ("icp_limits", "icp", "icp_covariance"))
INFORMATION = tuple(f"{REGISTRATION}{name}.py" for name in ("information", "icp_covariance", "degeneracy"))
DEGENERACY = tuple(f"{REGISTRATION}{name}.py" for name in ("cost_profile", "degeneracy_limits", "degeneracy"))
MAP = tuple(f"{REGISTRATION}{name}.py" for name in ("local_map_limits", "local_map", "ring_planes", "voxel_map"))
PLANES = ("tests/hybridlio/cloud/test_plane_fitting.py", "tests/hybridlio/cloud/test_normals.py", *MAP)
POINTS = tuple(f"{REGISTRATION}{name}.py" for name in ("point_to_point", "degeneracy"))
SEARCH = (f"{REGISTRATION}motion_search.py",)
ADRIFT = f"{REGISTRATION}adrift.py", f"{SOURCES}scans_adrift.py"
GATE = tuple(f"tests/hybridlio/sources/gate/test_innovation_gate{end}.py" for end in ("_constants", ""))
MATCHING = tuple(f"{SOURCES}{name}.py" for name in ("scan_matching_constants", "scan_matching"))
START = ("tests/hybridlio/odometry/start/test_start_search.py",)
VISIBILITY = (f"{SOURCES}visibility.py",)
SECOND_PASS = ("tests/hybridlio/odometry/test_second_pass.py",)

TABLE = [
    *_in(
        "hybridlio/registration/information.py",
        INFORMATION,
        NORMAL_NOISE=("NormalNoise(2e-5, 8e-5)", "NormalNoise(5e-2, 2e-1)", "NormalNoise(2e-3, 8e-5)"),
        NORMAL_NOISE_WEIGHTED=("NormalNoise(1.2e-5, 8e-5)", "NormalNoise(5e-2, 2e-1)"),
        _STRONG_RATIO=("0.1", "100"),
        UNKNOWN_SIGMA_M=("0.5", "1000.0"),
        _HALF=("0.0", "2.0"),
    ),
    *_in("hybridlio/core/motion_limits.py", INFORMATION, MEASUREMENT_FLOOR_SIGMAS=("np.zeros(6)", "np.full(6, 0.1)")),
    *_in("hybridlio/core/motion_limits.py", MATCHING, POINT_LEVER_M=("0.0", "1e4")),
    *_in("hybridlio/registration/icp.py", ICP, _MAX_MATCHINGS=("1",)),
    *_in(
        "hybridlio/registration/loops.py",
        ICP,
        _ROTATION_CONVERGED_RAD=("1e-2", "1e-12"),
        _TRANSLATION_CONVERGED_M=("1e-1", "1e-12"),
        _REMATCH_ROTATION_RAD=("1.0", "1e-8"),
        _REMATCH_TRANSLATION_M=("10.0", "1e-8"),
        _LONG_STEP=("1e9",),
        _MIN_MATCHES=("1", "1000"),
    ),
    *_in(
        "hybridlio/registration/settings.py",
        ICP,
        MATCH_KERNELS=("0.3", "30"),
        RegistrationSettings__kernel_m=("0.005", "2.0"),
        RegistrationSettings__max_distance_m=("0.05", "50.0"),
        RegistrationSettings__max_iterations=("1",),
    ),
    *_in(
        "hybridlio/registration/settings.py",
        MAP,
        LocalMapSettings__keyframe_m=("0.2", "20.0"),
        LocalMapSettings__keyframe_deg=("1.0", "90.0"),
        LocalMapSettings__voxel_m=("0.2", "20.0"),
        LocalMapSettings__spacing_m=("1e-9", "1.0"),
        LocalMapSettings__horizon_keyframes=("3", "300"),
        LocalMapSettings__radius_m=("10.0", "1000.0"),
        LocalMapSettings__neighbours=("5", "100"),
    ),
    *_in("hybridlio/registration/match_loops.py", POINTS, THIN_PLANE_WEIGHT=("0.0", "1.1")),
    *_in(
        "hybridlio/registration/cost_profile.py",
        DEGENERACY,
        PROBE_STEP_M=("0.05", "3.0"),
        _OBSERVED_RATIO=("1.0", "20.0"),
        OFFSETS_M=("np.linspace(-0.5, 0.5, 9)", "np.linspace(-20.0, 20.0, 9)"),
        _TEMPERATURE=("0.2", "10.0"),
        _SHARED_ERROR_SCALE=("0.5", "20.0"),
        _UNINFORMATIVE_SHARE=("0.3", "2.0"),
    ),
    *_in(
        "hybridlio/registration/degeneracy.py",
        DEGENERACY,
        _PROBE_ITERATIONS=("1", "2"),
        _MAX_ROUNDS=("1",),
        _SETTLED_M=("5.0",),
        _OBSERVED_VARIANCE_SCALE=("1.0", "60.0"),
        _OPEN_GROUND_DIRECTIONS=("1", "4"),
        _POINT_KERNEL_RATIO=("0.01", "5.0"),
        _POINT_VARIANCE_SCALE=("1.0", "400.0"),
        _POINT_START_M=("0.0", "1.5"),
        _SELF_MATCH_M=("0.0", "5.0"),
    ),
    *_in(
        "hybridlio/registration/motion_search.py",
        SEARCH,
        _COARSE_KERNEL=("0.02", "10.0"),
        _JUDGED_STRIDE=("1", "500"),
        _COARSE_ITERATIONS=("1",),
        _REFINED_CANDIDATES=("1", "1000"),
        _MIN_MATCHED_RATIO=("0.0", "1.0"),
    ),
    *_in(
        "hybridlio/registration/local_map.py",
        MAP,
        _REBUILD_APPENDED_RATIO=("0.001", "10.0"),
        _REBUILD_DISTANCE_RATIO=("0.001", "10.0"),
        _OVERDUE=("0.0", "100.0"),
    ),
    *_in(
        "hybridlio/registration/voxel_map.py",
        MAP,
        _KEY_BITS=("8", "31"),
        MAX_POINTS_PER_CELL=("2", "100"),
        _SPARSE_RANGE=("1.0", "100.0"),
        _SPARSE_SHARE=("0.0", "0.5"),
    ),
    *_in(
        "hybridlio/registration/ring_planes.py",
        MAP,
        _KEYFRAMES=("1", "50"),
        _NEIGHBOURS=("5", "100"),
        _MAX_DISTANCE=("0.25", "20.0"),
        _MIN_WIDTH=("0.005", "1.5"),
    ),
    *_in(
        "hybridlio/cloud/plane_fitting.py",
        PLANES,
        MIN_NEIGHBOURS=("1", "50"),
        _HALF_WEIGHT_THICKNESS_M=("0.01", "2.0"),
        _SAME_RING_RAD=("np.deg2rad(0.001)", "np.deg2rad(3.0)"),
        _MIN_OTHER_RINGS=("0", "8"),
    ),
    *_in("hybridlio/sources/gate/gate_result.py", GATE, GATE_NIS=("5.0", "300.0")),
    *_in("hybridlio/sources/gate/innovation_gate.py", GATE, GROSS_NIS=("30.0", "1e6"), MAX_REJECTIONS=("1", "50")),
    *_in("hybridlio/sources/gate/innovation_gate.py", GATE, WARM_UP_STEPS=("0", "100"), _BISECTIONS=("3",)),
    *_in("hybridlio/sources/scan_matching.py", MATCHING, LOST_COST=("0.01", "1.0"), _LOST_SCANS=("1", "50")),
    *_in("hybridlio/registration/results.py", ADRIFT, LONG_ADRIFT=("1", "50")),
    *_in("hybridlio/sources/matching_state.py", ADRIFT, _DISBELIEVED_CLAIMS=("0", "50")),
    *_in("hybridlio/registration/surface.py", (f"{REGISTRATION}surface.py", *MATCHING), _ASIDE_SHARE=("0.05", "10.0")),
    *_in("hybridlio/sources/refinding.py", MATCHING, _UNKNOWN_ROTATION_SIGMA_RAD=("1e-5", "10.0")),
    *_in("hybridlio/sources/map_errors.py", MATCHING, _YOUNG_MAP_INFLATION=("0.0", "100.0")),
    *_in("hybridlio/sources/map_errors.py", MATCHING, _YOUNG_MAP_DRIFT_SHARE=("0.0", "50.0")),
    *_in("hybridlio/sources/map_errors.py", MATCHING, _DENSE_SHARE=("0.1", "5.0"), _DENSE=("0.5", "20.0")),
    *_in("hybridlio/sources/map_errors.py", MATCHING, _UNCHANGED_MAP_DRIFT_SHARE=("0.5", "0.0")),
    *_in("hybridlio/sources/map_errors.py", MATCHING, _UNCHANGED_YOUNG_MAP_DRIFT_SHARE=("0.0", "1.0")),
    *_in("hybridlio/odometry/second_pass.py", SECOND_PASS, _LEAST_RATIO=("10.0",)),
    *_in("hybridlio/odometry/measured_step.py", START, _TURN_SIGMA_RAD=("1.0",)),
    *_in("hybridlio/sources/thinned_scan.py", MATCHING, _VOXEL_SHRINKAGE=("0.1",), _AMPLE=("0.1",)),
    *_in("hybridlio/sources/visibility.py", VISIBILITY, _LOST=("np.log([0.3, 0.6])", "np.log([0.9, 0.9])")),
    *_in("hybridlio/sources/visibility.py", VISIBILITY, _WIDE_VIEW_M=("1.0", "30.0"), _LONGEST_S=("0.3", "30.0")),
    *_in("hybridlio/sources/visibility.py", VISIBILITY, _MEMORY_SCANS=("1", "1000")),
    *_in("hybridlio/sources/settings.py", (f"{SOURCES}scene_scale.py",), STREET_VIEW_M=("3.0", "40.0")),
    *_in(
        "hybridlio/sources/scene_scale.py",
        (f"{SOURCES}scene_scale.py",),
        _STEPS=("1", "20"),
        _HYSTERESIS=("0.5", "4.0"),
        _NEW_SHARE=("0.01", "1.0"),
        _LEAST_NOISE_SCALE=("0.01", "1.0"),
        _FEW_POINTS=("300", "30000"),
        _ENOUGH_POINTS=("450", "450000"),
        _MOSTLY_SINGLE=("0.01", "2.0"),
        _FINEST_STEP=("1", "12"),
    ),
]


def replaced(source: str, name: str, value: str) -> str:
    """Return a module's source with the value of a constant or a class's default replaced by an expression."""
    scope: list[ast.stmt] = ast.parse(source).body
    *classes, attribute = name.split(".")
    for wanted in classes:
        scope = next(node.body for node in scope if isinstance(node, ast.ClassDef) and node.name == wanted)
    for node in scope:
        if isinstance(node, ast.Assign | ast.AnnAssign) and (old := _value_of(node, attribute)):
            assert old.end_lineno is not None
            lines = source.splitlines(keepends=True)
            first, last = old.lineno - 1, old.end_lineno - 1
            head = lines[first].encode()[: old.col_offset].decode()  # columns count bytes
            tail = lines[last].encode()[old.end_col_offset :].decode()
            return "".join([*lines[:first], head + value + tail, *lines[last + 1 :]])
    raise SystemExit(f"no constant {name} in this file; change the table in {Path(__file__).name}")


def _value_of(node: ast.Assign | ast.AnnAssign, name: str) -> ast.expr | None:
    """Return the expression assigned to a name, also within ``a, b = 1, 2``."""
    for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
        pairs = [(target, node.value)]
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            pairs = list(zip(target.elts, node.value.elts, strict=True))
        for part, value in pairs:
            if isinstance(part, ast.Name) and part.id == name:
                return value
    return None


def copy_checkout(folder: Path) -> None:
    """Copy the files that git knows, and new ones that it does not ignore, without compiled caches."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *COPIED]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        source, target = ROOT / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink() or source.is_file():
            shutil.copy2(source, target, follow_symlinks=False)


def run_tests(folder: Path, tests: tuple[str, ...]) -> tuple[int, str]:
    """Return pytest's exit status, and the first test that failed or the end of its output."""
    # -B: without it a file changed within a second, to the same length, is taken from its compiled cache
    command = [sys.executable, "-B", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]
    threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    environment = {**os.environ, **threads, "PYTHONPATH": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return done.returncode, failed.group(1) if failed else done.stdout[-2000:] + done.stderr[-2000:]


def check(folder: Path, constant: Constant, value: str) -> bool:
    """Apply one change, run the tests, print the outcome, and return whether a test caught it."""
    file, started = folder / constant.file, time.monotonic()
    original = file.read_text()
    try:
        file.write_text(replaced(original, constant.name, value))
        status, report = run_tests(folder, constant.tests)
    finally:
        file.write_text(original)
    caught = status == 1
    outcome = report if caught else "UNCAUGHT" if status == 0 else f"pytest ended with {status}: {report}"
    print(f"{constant.name} = {value}  [{time.monotonic() - started:.0f} s]  {outcome}", flush=True)
    return caught


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="constants, or parts of their files' names")
    parser.add_argument("--list", action="store_true", help="print the table and end")
    options = parser.parse_args()
    chosen = [c for c in TABLE if not options.only or any(w == c.name or w in c.file for w in options.only)]
    if options.list:
        print(*("\t".join((c.file, c.name, *c.gross)) for c in chosen), sep="\n")
        return CAUGHT
    if not chosen:
        raise SystemExit(f"no constant named {', '.join(options.only)}; --list prints their names")
    with tempfile.TemporaryDirectory(prefix="hybridlio-constants-") as name:
        copy_checkout(folder := Path(name))
        status, report = run_tests(folder, tuple(dict.fromkeys(test for c in chosen for test in c.tests)))
        if status:
            print(f"the tests fail without any change: {report}")
            return BROKEN
        uncaught = [f"{c.name} = {v}" for c in chosen for v in c.gross if not check(folder, c, v)]
    total = sum(len(constant.gross) for constant in chosen)
    print(f"{total - len(uncaught)} of {total} changes caught" + "".join(f"\nuncaught: {one}" for one in uncaught))
    return UNCAUGHT if uncaught else CAUGHT


if __name__ == "__main__":
    sys.exit(main())
