"""Check that a change leaves every result the same to the last bit.

    python benchmarks/digests.py FOLDER [--data SHARED_DATA] [-o before.json]
    python benchmarks/digests.py FOLDER [--data SHARED_DATA] [-o after.json] --compare before.json

Runs the commands `simulate`, `odometry` and `smooth` of the checkout that holds this file, and writes a SHA-256 digest
of every result: the recording, the poses as text, each array of `covariances.npz`, and the same of the smoothed run. It
uses the command line alone, so modules may move between two calls.

Drives that FOLDER lacks are simulated; give an empty FOLDER to check the simulator as well. SHARED_DATA holds
`unpack.py` and KITTI's drives; without it their cases are left out. Runs stay in FOLDER/runs/NAME, where NAME is that
of the file of digests, so that differences can be inspected.

All numerical libraries use the same number of threads (--threads). Other versions of them, or another processor, can
change the last bits too; the comparison lists such differences between the two calls.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LIBRARIES = ("gtsam", "numpy", "open3d", "scipy", "small_gicp", "torch")
POSES, COVARIANCES, SMOOTHED, RECORDING = "poses_tum.txt", "covariances.npz", "smoothed", "recording"
KITTI, WITHOUT_IMU = "kitti-", "without-imu"

Digests = dict[str, str]

DRIVES = {  # options of `hybridlio simulate`
    "demo": "--seconds 60 --seed 1",
    "hdl-64e": "--seconds 20 --seed 2",
    "16-beam": "--seconds 20 --seed 3 --lidar 16-beam",
    "distortion": "--seconds 20 --seed 4 --distortion",
}


class Case(NamedTuple):
    """The name of a recording's folder, and options of `hybridlio odometry`."""

    recording: str
    options: str = ""


CASES = {
    **{name: Case(name) for name in ("demo", f"{KITTI}0005", f"{KITTI}0048", "16-beam", "distortion")},
    WITHOUT_IMU: Case(WITHOUT_IMU, "--reader folder"),
    "lstm+network": Case("hdl-64e", "--initial-pose lstm --residual network"),
    "network+scan-matching": Case("hdl-64e", "--residual network+scan-matching"),
}


class Commands:
    """Runs the commands of this checkout.

    Args:
        folder: for recordings and runs.
        data: the folder that holds ``unpack.py``, or None.
        threads: of each numerical library.
    """

    def __init__(self, folder: Path, data: Path | None, threads: int) -> None:
        self._folder, self._unpack = folder.resolve(), data and data.resolve() / "unpack.py"
        self._env = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"} | dict.fromkeys(THREADS, str(threads))
        where = Path(self._python("-c", "import hybridlio; print(hybridlio.__file__)").strip())
        if not where.is_relative_to(ROOT):
            sys.exit(f"hybridlio would be imported from {where}, not from {ROOT}")

    def recording(self, name: str) -> Path | None:
        """Return the folder of a recording, made if necessary; None for one of KITTI's without its data."""
        if name.startswith(KITTI):
            return self._kitti(name.removeprefix(KITTI)) if self._unpack and self._unpack.is_file() else None
        folder = self._folder / name
        if name != WITHOUT_IMU:
            self._python("-m", "hybridlio", "simulate", folder, *DRIVES[name].split())
            return folder
        self.recording("16-beam")
        (scans,) = (self._folder / "16-beam").glob("*/*_sync/velodyne_points")
        shutil.copytree(scans / "data", folder / "scans", dirs_exist_ok=True)
        shutil.copy(scans / "timestamps.txt", folder)
        (folder / "calibration.yaml").write_text("lidar: 16-beam\n")
        return folder

    def run(self, data: Path, options: str, out: Path) -> Path:
        """Run odometry and smoothing on a recording and return the folder; replaces an earlier run."""
        run = self._folder / "runs" / out
        shutil.rmtree(run, ignore_errors=True)
        self._python("-m", "hybridlio", "odometry", data, *options.split(), "-o", run)
        self._python("-m", "hybridlio", "smooth", run)
        return run

    def _kitti(self, drive: str) -> Path:
        self._python(str(self._unpack), self._folder / "kitti", "--drives", drive)
        return self._folder / "kitti/kitti_raw/2011_09_26" / f"2011_09_26_drive_{drive}_sync"

    def _python(self, *words: str | Path) -> str:
        """Run Python and return its output; exit if it fails."""
        command = [sys.executable, *map(str, words)]
        done = subprocess.run(command, cwd=ROOT, env=self._env, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{' '.join(command)}\nfailed with exit code {done.returncode}:\n{done.stdout}{done.stderr}")
        return done.stdout


def digests_of_run(run: Path) -> Digests:
    """Return digests of a run's results and of the smoothed ones, by file and array."""
    found: Digests = {}
    for folder in (run, run / SMOOTHED):
        poses, covariances = folder / POSES, folder / COVARIANCES
        found[str(poses.relative_to(run))] = hashlib.sha256(poses.read_bytes()).hexdigest()
        if not covariances.exists():
            continue
        with np.load(covariances, allow_pickle=False) as arrays:
            for name, array in sorted(arrays.items()):
                digest = hashlib.sha256(f"{name} {array.dtype.str} {array.shape}\n".encode())
                digest.update(np.ascontiguousarray(array).tobytes())
                found[f"{covariances.relative_to(run)}: {name}"] = digest.hexdigest()
    return found


def digest_of_files(folder: Path) -> str:
    """Return one digest of the names and contents of all files in a folder and its subfolders."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(f"{path.relative_to(folder)} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


def circumstances(threads: int) -> dict[str, str]:
    """Return what can change the last bits besides the code: threads, Python, processor, libraries."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    python = {"threads": str(threads), "python": platform.python_version(), "processor": processor}
    return python | {name: version(name) for name in LIBRARIES}


def compare(found: dict[str, Any], earlier: dict[str, Any], cases: list[str]) -> bool:
    """Print which results are the same, and return whether all are."""
    for name in sorted(found["circumstances"].keys() | earlier["circumstances"].keys()):
        now, then = (one["circumstances"].get(name) for one in (found, earlier))
        if now != then:
            print(f"changed: {name} from {then} to {now}")
    verdicts = []
    for case in cases:
        now, then = (one["cases"].get(case, {}).get("digests", {}) for one in (found, earlier))
        for file in [*then, *(now.keys() - then.keys())]:
            both = now.get(file), then.get(file)
            verdicts.append("same" if both[0] == both[1] else "DIFFERENT" if all(both) else "ONLY IN ONE")
            print(f"{case:22s} {file:40s} {verdicts[-1]}")
    print(f"{verdicts.count('same')} of {len(verdicts)} results are the same")
    return set(verdicts) == {"same"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="for recordings and runs")
    parser.add_argument("--data", type=Path, metavar="SHARED_DATA", help="the folder that holds unpack.py")
    parser.add_argument("--cases", default=",".join(CASES), metavar="A,B,…", help="(default: all)")
    parser.add_argument("--threads", type=int, default=1, help="of each numerical library (default: %(default)s)")
    parser.add_argument("--compare", type=Path, metavar="EARLIER", help="digests to compare with")
    parser.add_argument("-o", "--out", type=Path, default=Path("digests.json"), help="(default: %(default)s)")
    options = parser.parse_args()
    cases = options.cases.split(",")
    if unknown := set(cases) - CASES.keys():
        parser.error(f"unknown cases: {', '.join(sorted(unknown))}")
    earlier = json.loads(options.compare.read_text()) if options.compare else None
    commands = Commands(options.folder, options.data, options.threads)
    found: dict[str, Any] = {"circumstances": circumstances(options.threads), "cases": {}}
    for name in cases:
        began = time.monotonic()
        data = commands.recording(CASES[name].recording)
        if data is None:
            print(f"{name}: left out, as --data names no folder that holds unpack.py", flush=True)
            continue
        ready = time.monotonic()
        run = commands.run(data, CASES[name].options, Path(options.out.stem) / name)
        digests = {RECORDING: digest_of_files(data), **digests_of_run(run)}
        seconds = {"recording": round(ready - began, 1), "run": round(time.monotonic() - ready, 1)}
        found["cases"][name] = {"seconds": seconds, "digests": digests}
        print(f"{name}: {len(digests)} digests, recording {seconds['recording']} s, run {seconds['run']} s", flush=True)
        options.out.write_text(json.dumps(found, indent=2) + "\n")
    if earlier is not None and not compare(found, earlier, cases):
        sys.exit(1)


if __name__ == "__main__":
    main()
