"""Damage the inputs of every reader: each must give a result or one clear error.

    python tests/fuzz_readers.py [--count 2000] [--seconds S] [--seed 0] [READER…]

A tiny recording is written in each reader's layout, and every other kind of file that hybridlio reads. Each mutation
changes one or two of the files (bits, lengths, numbers in headers, words of texts, files in each other's place) from
its seed, and opens the recording and every scan, or reads the file. Workers are processes of their own, so that a
crash, a hang over 10 s or memory over 2 GiB is seen; they continue behind it. Prints one line a reader, and each
failure with its seed; exits with 1 if there is any.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/helpers")]

import mutations  # noqa: E402
import numpy as np  # noqa: E402
from fuzz_files import FILES  # noqa: E402
from fuzz_input import HANG_S, MEMORY_BYTES, outcome  # noqa: E402
from fuzz_learned import LEARNED  # noqa: E402
from fuzz_recordings import RECORDINGS  # noqa: E402

START_S = 300  # until the first line: a busy machine imports and writes the recording for a minute
LOST_S = 3 * HANG_S  # without a line: the worker hangs where Python's alarm does not reach
INPUTS = {**RECORDINGS, **FILES, **LEARNED}


def work(name: str, start: int, count: int) -> None:
    """Run mutations, one line each; the parent watches."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", ResourceWarning)  # of files that NumPy leaves to the collector after an error
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        arguments, read = INPUTS[name].write(root / "data"), INPUTS[name].read
        if (found := outcome(read, arguments)) != "ok":
            raise SystemExit(f"{name}: the undamaged files give {found}")
        shutil.copytree(root / "data", root / "whole")
        vsize = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (vsize + MEMORY_BYTES,) * 2)
        for seed in range(start, start + count):
            print(f"{seed} starts", flush=True)
            changed = mutations.damage(root / "data", np.random.default_rng([seed, len(name)]))
            text = outcome(read, arguments).replace("\n", " ")[:300]
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
