"""Damage the inputs of every reader: each must give a result or one clear error.

    python tests/fuzz_readers.py [--count 2000] [--seconds S] [--seed 0] [READER…]

A tiny recording is written in each reader's layout. Each mutation changes one or two of its files (bits, lengths,
numbers in headers, words of texts, files in each other's place) from its seed, and opens the recording and every scan.
Workers are processes of their own, so that a crash, a hang over 10 s or memory over 2 GiB is seen; they continue behind
it. Prints one line a reader, and each failure with its seed; exits with 1 if there is any.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/helpers")]

import mutations  # noqa: E402
import numpy as np  # noqa: E402
import published_data  # noqa: E402
import rides  # noqa: E402
from PIL import Image  # noqa: E402

from hybridlio.core.errors import HybridLioError  # noqa: E402
from hybridlio.datasets import open_sequence  # noqa: E402

PACKETS = Path(os.environ.get("HYBRIDLIO_SHARED_DATA", "no such folder")) / "other_lidars"
BAGS = ("sqlite3", "mcap", "ros1", "lz4")
HANG_S, MEMORY_BYTES = 10, 2 << 30
START_S = 300  # until the first line: a busy machine imports and writes the recording for a minute
LOST_S = 3 * HANG_S  # without a line: the worker hangs where Python's alarm does not reach
UNCLEAR = "the scan cannot be read ("  # an error that no reader foresaw, turned into one by the sequence


class HangError(BaseException):
    """A mutation took over 10 s; no ordinary exception, so that no reader catches it."""


def written_bag(root: Path, name: str) -> dict[str, Any]:
    """Write the ride as a bag of ROS 1, or of ROS 2 in one of its storages."""
    return {"path": rides.write_bag(root, rides.Ride(), name)}


def written_cut_bag(root: Path, name: str) -> dict[str, Any]:
    """Write the ride as a bag without the end of its index, as where its recorder was killed."""
    path = rides.write_bag(root, rides.Ride(), name)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    cut = file.rename(root / f"cut{file.suffix}")
    cut.write_bytes(cut.read_bytes()[:-40])
    return {"path": cut}


def written_depth(root: Path) -> dict[str, Any]:
    """Write a recording of depth images."""
    folder = root / "rgbd_dataset_ride"
    (folder / "depth").mkdir(parents=True)
    for k in range(4):
        depth = np.full((480, 640), 6000 + 100 * k, np.uint16)
        depth[:, ::7] += 4000
        Image.fromarray(depth).save(folder / f"depth/{k}.png")
    (folder / "depth.txt").write_text("".join(f"{10 + 0.1 * k:.2f} depth/{k}.png\n" for k in range(4)))
    (folder / "groundtruth.txt").write_text("".join(f"{10 + 0.1 * k:.2f} 0 0 {k} 0 0 0 1\n" for k in range(4)))
    return {"path": folder}


def copied_packets(root: Path, name: str, *beside: str) -> dict[str, Any]:
    """Copy a real capture, and the files beside it."""
    root.mkdir(parents=True)
    for file in (name, *beside):
        shutil.copyfile(PACKETS / file, root / file)
    return {"path": root / name}


def written_odometry(root: Path) -> dict[str, Any]:
    return {
        "path": rides.write_odometry(root / "odometry", rides.Ride()),
        "raw_root": rides.write_raw(root / "raw", rides.Ride()).parents[1],
    }


def written_published(root: Path, name: str) -> dict[str, Any]:
    return {"path": published_data.WRITERS[name](root).path}


INPUTS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "kitti-raw": lambda root: {"path": rides.write_raw(root, rides.Ride())},
    "kitti-odometry": written_odometry,
    "folder": lambda root: {"path": rides.write_folder(root, rides.Ride())},
    **{f"rosbag-{kind}": lambda root, kind=kind: written_bag(root, kind) for kind in BAGS},
    **{f"rosbag-cut-{kind}": lambda root, kind=kind: written_cut_bag(root, kind) for kind in ("ros1", "mcap")},
    **{name: lambda root, name=name: written_published(root, name) for name in published_data.WRITERS},
    "tum-rgbd": written_depth,
}
if PACKETS.is_dir():  # real captures; there is none that tests could write
    OUSTER = "OS-1-128_v2.3.0_1024x10"
    if find_spec("ouster") is not None:
        INPUTS["ouster"] = lambda root: copied_packets(root, f"{OUSTER}_lb_n3.pcap", f"{OUSTER}.json")
    if find_spec("velodyne_decoder") is not None:
        INPUTS["velodyne"] = lambda root: copied_packets(root, "sample_velodyne_vlp16_gps.pcap")


@contextmanager
def limits() -> Iterator[None]:
    """Raise :class:`HangError` after 10 s."""

    def hangs(_signal: int, _frame: Any) -> NoReturn:
        raise HangError

    signal.signal(signal.SIGALRM, hangs)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)


def outcome(arguments: dict[str, Any]) -> str:
    """Open a recording and its scans; return ``ok``, ``error``, or what is wrong."""
    errors = 0
    try:
        with limits():
            try:
                sequence = open_sequence(**arguments)
            except HybridLioError as error:
                return "error" if str(error).strip() else "an error without a text"
            for k in range(len(sequence)):
                try:
                    frame = sequence[k]
                except HybridLioError as error:
                    errors += 1
                    if UNCLEAR in str(error):
                        return f"unclear error: {error}"
                else:
                    if not np.isfinite(frame.scan.points).all():
                        return f"frame {k} has points that are not finite"
    except HangError:
        return f"takes over {HANG_S} s"
    except MemoryError:
        return "takes over 2 GiB"
    except BaseException as error:
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        where = f"{Path(place.tb_frame.f_code.co_filename).name}:{place.tb_lineno}" if place else ""
        return f"{type(error).__name__}: {error} at {where}"
    return "error" if errors == len(sequence) else "ok"


def work(name: str, start: int, count: int) -> None:
    """Run mutations, one line each; the parent watches."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        arguments = INPUTS[name](root / "data")
        if (found := outcome(arguments)) != "ok":
            raise SystemExit(f"{name}: the undamaged recording gives {found}")
        shutil.copytree(root / "data", root / "whole")
        vsize = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (vsize + MEMORY_BYTES,) * 2)
        for seed in range(start, start + count):
            print(f"{seed} starts", flush=True)
            changed = mutations.damage(root / "data", np.random.default_rng([seed, len(name)]))
            text = outcome(arguments).replace("\n", " ")[:300]
            print(f"{seed} {text}", flush=True)
            for path in changed:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes((root / "whole" / path.relative_to(root / "data")).read_bytes())


@dataclass
class Result:
    """What the mutations of one reader gave."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def add(self, seed: int, text: str) -> None:
        self.counts[text if text in ("ok", "error") else "failed"] += 1
        if text not in ("ok", "error"):
            self.failures.append(f"seed {seed}: {text}")


def run(name: str, start: int, count: int, until: float | None) -> Result:
    """Run the mutations of a reader in workers, a new one behind each crash."""
    result, seed, end = Result(), start, start + count
    while seed < end and (until is None or time.monotonic() < until):
        command = [sys.executable, __file__, "--worker", name, "--seed", str(seed), "--count", str(end - seed)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as worker:
            assert worker.stdout is not None
            assert worker.stderr is not None
            began, last = False, ""
            while True:
                limit_s = LOST_S if began or result.counts else START_S
                left = limit_s if until is None else min(limit_s, max(until - time.monotonic(), 0))
                ready = select.select([worker.stdout], [], [], left)[0]
                last = worker.stdout.readline() if ready else ""
                if not last:
                    break
                number, _, text = last.strip().partition(" ")
                began, seed = text == "starts", int(number)
                if not began:
                    result.add(seed, text)
                    seed += 1
            over = until is not None and (time.monotonic() >= until or not (ready or left == LOST_S))
            hangs = worker.poll() is None and not ready and not over
            worker.kill()
            status, said = worker.wait(), worker.stderr.read().strip()
        if over:
            break
        if not began and seed < end:
            raise SystemExit(f"{name}: the worker ended ({status}) {said[-500:]}")
        if began:
            result.add(seed, "hangs" if hangs else f"the process ends with {status} {said[-200:]}")
            seed += 1
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(INPUTS)} (default: all)")
    parser.add_argument("--count", type=int, default=2000, help="mutations of each (default: %(default)s)")
    parser.add_argument("--seconds", type=float, help="stop after this time, shared by the readers")
    parser.add_argument("--seed", type=int, default=0, help="of the first mutation; -1 for fresh ones")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options.worker, options.seed, options.count)
        return
    seed = options.seed if options.seed >= 0 else time.time_ns() // 10**9 % 10**9
    names, began, failed = options.readers or list(INPUTS), time.monotonic(), 0
    for number, name in enumerate(names):
        until = None
        if options.seconds is not None:
            left = options.seconds - (time.monotonic() - began)
            until = time.monotonic() + left / (len(names) - number)
        result = run(name, seed, options.count, until)
        counts = ", ".join(f"{result.counts[kind]} {kind}" for kind in ("ok", "error", "failed"))
        print(f"{name}: {sum(result.counts.values())} mutations from seed {seed}: {counts}", flush=True)
        for failure in result.failures:
            print(f"  {failure}", flush=True)
        failed += len(result.failures)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
