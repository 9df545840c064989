"""Kill commands at random moments, run them again, and check that nothing is lost and the result is the same.

    python benchmarks/kills.py FOLDER [--kills 60] [--seed 1] [--commands odometry,smooth,…]

Each command runs once without a kill. Then it is killed (SIGKILL) at a random moment of its run, again and again in new
folders, and the same command is given again; a run of odometry that is unfinished gets ``--resume``. What must hold:

* the result is that of the run without a kill, to the last bit;
* a run of odometry that has a state on the disk goes on from there;
* what stood in the folder before stays until the new result is complete;
* no process lives on, and no hidden file stays after the second run.

The exit code is 1 if anything did not hold. FOLDER gets the drives and the results.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.runs.unfinished.kept import read_kept
from hybridlio.runs.whole_folder import partial_folder
from hybridlio.simulation import SimulationConfig, simulate

_PROGRAM = [sys.executable, "-m", "hybridlio"]
_LIVES_ON_S = 20.0  # workers look twice a second whether their parent lives; a busy machine takes longer


@dataclass(frozen=True)
class Command:
    """A command to kill.

    Attributes:
        words: returns its words for an output folder.
        again: returns its words for the second run.
        results: patterns of the files, below the output folder, that must be the same.
        before: prepares the output folder.
    """

    words: Callable[[Path], list[str]]
    results: tuple[str, ...]
    again: Callable[[Path], list[str]] | None = None
    before: Callable[[Path], object] | None = None


def commands(folder: Path, drives: list[Path]) -> dict[str, Command]:
    """Return the commands by name."""
    data, run = str(drives[0]), folder / "run"
    if not run.exists():
        subprocess.run([*_PROGRAM, "odometry", data, "-o", str(run)], check=True, capture_output=True)
    shards = folder / "shards"
    small = folder / "small.yaml"
    small.write_text(json.dumps(_SMALL))
    poses = ("poses_tum.txt", "poses_kitti.txt", "covariances.npz", "odometry.npz")

    def odometry(out: Path) -> list[str]:
        return ["odometry", data, "-o", str(out)]

    def odometry_again(out: Path) -> list[str]:
        unfinished = (partial_folder(out) / "state.bin").exists()
        return [*odometry(out), "--resume" if unfinished else "--overwrite"]

    train = ["train", data, "--preset", "paper", "--config", str(small), "--cache", str(shards), "--steps", "60"]
    ablate = ["ablate", data, "--test", data, "--table", "2", "--rows", "paper", "--reduced", "--steps", "4"]
    return {
        "odometry": Command(odometry, poses, odometry_again),
        "smooth": Command(
            lambda out: ["smooth", str(out)], ("smoothed/poses_tum.txt",), before=lambda out: shutil.copytree(run, out)
        ),
        "batch": Command(
            lambda out: ["batch", *map(str, drives), "-o", str(out), "-j", "2"], tuple(f"*/{name}" for name in poses)
        ),
        "train": Command(lambda out: [*train, "-o", str(out), "--device", "cpu"], ("weights.safetensors",)),
        "ablate": Command(
            lambda out: [*ablate, "-o", str(out), "--cache", str(shards), "--device", "cpu"],
            ("*/weights.safetensors",),
        ),
        "map": Command(
            lambda out: ["map", str(run), "-o", str(out), "--tiles", "ply", "--voxel", "0.3"], ("*.ply", "tiles.json")
        ),
        "simulate": Command(
            lambda out: ["simulate", str(out), "--seconds", "4", "--lidar", "16-beam"],
            ("*/*/velodyne_points/data/*", "*/*/poses.txt", "*/*/oxts/data/*"),
        ),
    }


_SMALL = {
    "network": {
        "geometry": "16-beam", "siamese": "twins", "normalisation": "group", "velocity": True, "projective_steps": 2,
        "imu_hidden": 8, "imu_layers": 1, "stem": 8, "stages": [8], "blocks": 1, "features": 8,
    },
    "optimiser": {"batch": 8, "learning_rate": 1e-3},
}  # fmt: skip


def digests(out: Path, patterns: tuple[str, ...]) -> dict[str, str]:
    """Return a digest of each result; archives of arrays by their arrays, because zip files hold the time."""
    found = {}
    for path in sorted(path for pattern in patterns for path in out.glob(pattern)):
        digest = hashlib.sha256()
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                for name in arrays.files:
                    digest.update(name.encode() + arrays[name].tobytes())
        elif path.suffix == ".safetensors":
            data = path.read_bytes()
            digest.update(data[8 + int.from_bytes(data[:8], "little") :])  # without the header, which tells the time
        else:
            digest.update(path.read_bytes())
        found[str(path.relative_to(out))] = digest.hexdigest()
    return found


def run(words: list[str]) -> float:
    """Run a command to its end; return the seconds it took."""
    start_s = time.monotonic()
    done = subprocess.run([*_PROGRAM, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stderr}")
    return time.monotonic() - start_s


def kill(words: list[str], after_s: float) -> bool:
    """Start a command in a session of its own and kill it; return whether it was still running.

    Raises:
        RuntimeError: one of its processes lives on.
    """
    process = subprocess.Popen(
        [*_PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    time.sleep(after_s)
    was_running = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    until = time.monotonic() + _LIVES_ON_S
    while alive := _session(process.pid):
        if time.monotonic() > until:
            for one in alive:
                os.kill(one, signal.SIGKILL)
            raise RuntimeError(f"{len(alive)} processes live on")
        time.sleep(0.05)
    return was_running


def _session(leader: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def kept_scans(out: Path) -> int:
    """Return how many estimates of an unfinished run are on the disk."""
    try:
        kept = read_kept(partial_folder(out))
    except DataError:
        return 0
    return 0 if kept is None else len(kept.estimates)


def check(command: Command, out: Path, after_s: float, expected: dict[str, str]) -> str:
    """Kill and run again; return what happened, beginning with FAILED if something did not hold."""
    if command.before is not None:
        command.before(out)
    before = {path.name: path.read_bytes() for path in out.glob("*.*") if path.is_file()}
    try:
        if not kill(command.words(out), after_s):
            return "had ended"
    except RuntimeError as error:
        return f"FAILED: {error}"
    if lost := [name for name, content in before.items() if (out / name).read_bytes() != content]:
        return f"FAILED: {lost} changed"
    scans = kept_scans(out)
    run((command.again or command.words)(out))
    if (found := digests(out, command.results)) != expected:
        return f"FAILED: {sorted(set(found.items()) ^ set(expected.items()))[0][0]} differs"
    hidden = [path for path in (*out.parent.iterdir(), *out.rglob("*")) if path.name.startswith(".")]
    if hidden:
        return f"FAILED: {hidden[0]} stays"
    return f"resumed, {scans} scans kept" if scans else "equal"


def main() -> None:
    """Kill all commands in turn and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--commands", default="odometry,smooth,batch,train,map,simulate,ablate")
    options = parser.parse_args()
    folder, chance = options.folder.resolve(), random.Random(options.seed)
    drives = [simulate(folder / f"drive-{k}", SimulationConfig(seconds=8.0, seed=k, lidar="16-beam")) for k in (3, 4)]
    known = commands(folder, drives)
    chosen = {name: known[name] for name in options.commands.split(",")}
    expected, took_s = {}, {}
    for name, command in chosen.items():
        out = folder / "whole" / name
        shutil.rmtree(out, ignore_errors=True)
        if name in ("train", "ablate"):  # the second time, recordings are prepared
            run(command.words(out))
            shutil.rmtree(out)
        if command.before is not None:
            command.before(out)
        took_s[name] = run(command.words(out))
        expected[name] = digests(out, command.results)
    outcomes: dict[str, Counter[str]] = {name: Counter() for name in chosen}
    for number in range(options.kills):
        name = list(chosen)[number % len(chosen)]
        place = folder / "killed" / f"{name}-{number}"
        after_s = chance.uniform(0, took_s[name])
        outcome = check(chosen[name], place / "out", after_s, expected[name])
        print(f"{name:9} killed after {after_s:5.2f} of {took_s[name]:5.2f} s: {outcome}", flush=True)
        outcomes[name][outcome.split(",")[0].split(":")[0]] += 1
        if not outcome.startswith("FAILED"):
            shutil.rmtree(place)
    print(json.dumps(outcomes, indent=2))
    raise SystemExit(any(counts["FAILED"] for counts in outcomes.values()))


if __name__ == "__main__":
    main()
