"""Whether a change leaves every result as it was, to the last bit.

    python benchmarks/digests.py FOLDER [--data SHARED_DATA] [-o before.json]
    python benchmarks/digests.py FOLDER [--data SHARED_DATA] [-o after.json] --compare before.json

Runs the commands `simulate`, `odometry` and `smooth` of the checkout that this file lies in, and keeps a SHA-256 digest
of every result: the poses as text, each array in `covariances.npz`, the same of the smoothed run, and the recording.
It uses only the command line, so that modules may move in between.

Drives are simulated below FOLDER unless they are there; give an empty FOLDER to put the simulator to the test as well.
SHARED_DATA holds `unpack.py` and KITTI's drives, whose cases are left out without it. Runs stay in FOLDER/runs, below
the name of the file with the digests, for a look at what differs.

Numerical libraries get one thread each, in every process alike (--threads). Other versions of them, or another
processor, may change last bits by themselves; it says so where the earlier digests are of other circumstances.
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

DRIVES = {  # how each is simulated
    "demo": "--seconds 60 --seed 1",
    "hdl-64e": "--seconds 20 --seed 2",
    "16-beam": "--seconds 20 --seed 3 --lidar 16-beam",
    "distortion": "--seconds 20 --seed 4 --distortion",
}


class Case(NamedTuple):
    """A recording, by its folder's name, and how odometry is run on it."""

    recording: str
    options: str = ""


CASES = {
    **{name: Case(name) for name in ("demo", f"{KITTI}0005", f"{KITTI}0048", "16-beam", "distortion")},
    WITHOUT_IMU: Case(WITHOUT_IMU, "--reader folder"),
    "lstm+network": Case("hdl-64e", "--initial-pose lstm --residual network"),
    "network+scan-matching": Case("hdl-64e", "--residual network+scan-matching"),
}


class Bench:
    """Runs the checkout's commands.

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
            sys.exit(f"the commands would be those of {where}, not of {ROOT}")

    def recording(self, name: str) -> Path | None:
        """The recording's folder, made unless it is there; None if it is one of KITTI's that are not at hand."""
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
        """The folder of an odometry run on a recording, smoothed too, in place of an earlier one."""
        run = self._folder / "runs" / out
        shutil.rmtree(run, ignore_errors=True)
        self._python("-m", "hybridlio", "odometry", data, *options.split(), "-o", run)
        self._python("-m", "hybridlio", "smooth", run)
        return run

    def _kitti(self, drive: str) -> Path:
        self._python(str(self._unpack), self._folder / "kitti", "--drives", drive)
        return self._folder / "kitti/kitti_raw/2011_09_26" / f"2011_09_26_drive_{drive}_sync"

    def _python(self, *words: str | Path) -> str:
        """What a Python process prints; this one ends if that fails."""
        command = [sys.executable, *map(str, words)]
        done = subprocess.run(command, cwd=ROOT, env=self._env, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{' '.join(command)}\nfailed with exit code {done.returncode}:\n{done.stdout}{done.stderr}")
        return done.stdout


def digests_of_run(run: Path) -> Digests:
    """Digests of a run's results and of the smoothed ones, by file and array."""
    found: Digests = {}
    for folder in (run, run / SMOOTHED):
        poses, covariances = folder / POSES, folder / COVARIANCES
        found[str(poses.relative_to(run))] = hashlib.sha256(poses.read_bytes()).hexdigest()
        if not covariances.exists():
            continue
        with np.load(covariances, allow_pickle=False) as arrays:
            for name, array in sorted(arrays.items()):
                told = hashlib.sha256(f"{name} {array.dtype.str} {array.shape}\n".encode())
                told.update(np.ascontiguousarray(array).tobytes())
                found[f"{covariances.relative_to(run)}: {name}"] = told.hexdigest()
    return found


def digest_of_files(folder: Path) -> str:
    """One digest of the names and contents of all files below a folder."""
    told = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        told.update(f"{path.relative_to(folder)} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return told.hexdigest()


def circumstances(threads: int) -> dict[str, str]:
    """What may change last bits although no line of the library changed."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    python = {"threads": str(threads), "python": platform.python_version(), "processor": processor}
    return python | {name: version(name) for name in LIBRARIES}


def compare(found: dict[str, Any], earlier: dict[str, Any], cases: list[str]) -> bool:
    """Print what is the same and what is not; whether everything is."""
    for name in sorted(found["circumstances"].keys() | earlier["circumstances"].keys()):
        now, then = (told["circumstances"].get(name) for told in (found, earlier))
        if now != then:
            print(f"other circumstances: {name} was {then} and is {now}")
    verdicts = []
    for case in cases:
        now, then = (told["cases"].get(case, {}).get("digests", {}) for told in (found, earlier))
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
    parser.add_argument("--cases", default=",".join(CASES), metavar="A,B,…", help="by default all: %(default)s")
    parser.add_argument("--threads", type=int, default=1, help="of each numerical library (default: %(default)s)")
    parser.add_argument("--compare", type=Path, metavar="EARLIER", help="digests to hold these against")
    parser.add_argument("-o", "--out", type=Path, default=Path("digests.json"), help="(default: %(default)s)")
    options = parser.parse_args()
    cases = options.cases.split(",")
    if unknown := set(cases) - CASES.keys():
        parser.error(f"unknown cases: {', '.join(sorted(unknown))}")
    earlier = json.loads(options.compare.read_text()) if options.compare else None
    bench = Bench(options.folder, options.data, options.threads)
    found: dict[str, Any] = {"circumstances": circumstances(options.threads), "cases": {}}
    for name in cases:
        began = time.monotonic()
        data = bench.recording(CASES[name].recording)
        if data is None:
            print(f"{name}: left out, as --data does not give a folder that holds unpack.py", flush=True)
            continue
        ready = time.monotonic()
        run = bench.run(data, CASES[name].options, Path(options.out.stem) / name)
        digests = {RECORDING: digest_of_files(data), **digests_of_run(run)}
        seconds = {"recording": round(ready - began, 1), "run": round(time.monotonic() - ready, 1)}
        found["cases"][name] = {"seconds": seconds, "digests": digests}
        print(f"{name}: {len(digests)} digests, recording {seconds['recording']} s, run {seconds['run']} s", flush=True)
        options.out.write_text(json.dumps(found, indent=2) + "\n")
    if earlier is not None and not compare(found, earlier, cases):
        sys.exit(1)


if __name__ == "__main__":
    main()
