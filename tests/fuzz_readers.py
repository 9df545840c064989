"""Damage the inputs of every reader: each must give a result or one clear error.

    python tests/fuzz_readers.py [--count 2000] [--seconds S] [--seed 0] [READER…]

A tiny recording is written in each reader's layout, and every other kind of file that hybridlio reads. Each mutation
changes one or two of the files (bits, lengths, numbers in headers, words of texts, files in each other's place) from
its seed, and opens the recording and every scan, or reads the file. Before them come the cases kept in tests/corpora
(see fuzz_guided.py), and those that are made of the whole files (see tests/helpers/fuzz_corpus.py). Workers are
processes of their own, so that a crash, a hang, more than 10 s of processor time or memory over 2 GiB is seen; they
continue behind it. Prints one line a reader, and each failure with its seed; exits with 1 if there is any.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/helpers")]

import mutations  # noqa: E402
import numpy as np  # noqa: E402
from fuzz_corpus import Corpus  # noqa: E402
from fuzz_input import HANG_S, MEMORY_BYTES, outcome  # noqa: E402
from fuzz_inputs import INPUTS, chosen  # noqa: E402

FORK = multiprocessing.get_context("fork")  # workers need not import everything again
START_S = 120  # until the first message: a busy machine may write the files for long
LEAST_S = 1.0  # for each reader, where the starts of those before took the time of all
LOST_S = 6 * HANG_S  # without a message: the worker hangs where Python's alarm does not reach, or waits


def work(name: str, start: int, count: int, done: set[str], pipe: Connection) -> None:
    """Try the cases that are not done, then run mutations; send each, then what it gives, to the parent."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", ResourceWarning)  # of files that NumPy leaves to the collector after an error
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        arguments, read = INPUTS[name].write(root / "data"), INPUTS[name].read
        if (found := outcome(read, arguments, limit_s=0)) != "ok":  # without a limit, as it may import PyTorch
            raise SystemExit(f"{name}: the undamaged files give {found}")
        shutil.copytree(root / "data", root / "whole")
        corpus = Corpus(name, root / "data")
        vsize = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (vsize + MEMORY_BYTES,) * 2)
        for case, content in corpus.cases().items():
            if case not in done:
                pipe.send((case, None))
                with corpus.applied(content):
                    pipe.send((case, outcome(read, arguments)))
        for seed in range(start, start + count):
            pipe.send((seed, None))
            changed = mutations.damage(root / "data", np.random.default_rng([seed, len(name)]))
            pipe.send((seed, outcome(read, arguments).replace("\n", " ")[:300]))
            for path in changed:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes((root / "whole" / path.relative_to(root / "data")).read_bytes())


@dataclass
class Result:
    """What the kept cases and the mutations of one reader gave."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def add(self, which: int | str, text: str) -> None:
        kind = text if text in ("ok", "error") else "failed"
        self.counts[kind] += isinstance(which, int) or kind == "failed"
        if kind == "failed":
            self.failures.append(f"{'seed' if isinstance(which, int) else 'case'} {which}: {text}")


def run(name: str, start: int, count: int, seconds: float | None) -> Result:
    """Run the mutations of a reader in workers, a new one behind each crash; all cases and one mutation at least.

    The time begins with the first mutation: a slow reader's start and cases would take all of it.
    """
    result, seed, end = Result(), start, start + count
    done: set[str] = set()  # of the cases
    until: float | None = None
    while seed < end and (until is None or time.monotonic() < until):
        receive, send = FORK.Pipe(duplex=False)
        worker = FORK.Process(target=work, args=(name, seed, end - seed, done, send), daemon=True)
        worker.start()
        send.close()
        which: int | str | None = None
        is_over = False
        while not is_over:
            message = _received(receive) if receive.poll(START_S if which is None else LOST_S) else None
            if message is None:
                break
            which, text = message
            if until is None and seconds is not None and isinstance(which, int):
                until = time.monotonic() + seconds
            if text is not None:
                result.add(which, text)
                is_over = until is not None and time.monotonic() >= until
                seed = which + 1 if isinstance(which, int) else seed
                if isinstance(which, str):
                    done.add(which)
                    which = None
        is_unfinished = isinstance(which, str) or which == seed
        is_alive = worker.is_alive() and not receive.poll(0)
        worker.kill()
        worker.join()
        if is_over or (seed == end and not is_unfinished):
            break
        if not is_unfinished:
            raise SystemExit(f"{name}: the worker ended ({worker.exitcode})")
        assert which is not None
        result.add(which, "hangs" if is_alive else f"the process ends with {worker.exitcode}")
        if isinstance(which, str):
            done.add(which)
        else:
            seed += 1
    return result


def _received(receive: Connection) -> tuple[int | str, str | None] | None:
    try:
        return receive.recv()  # type: ignore[no-any-return]
    except EOFError:
        return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(INPUTS)} (default: all)")
    parser.add_argument("--count", type=int, default=2000, help="mutations of each (default: %(default)s)")
    parser.add_argument("--seconds", type=float, help="stop after about this time, shared by the readers")
    parser.add_argument("--seed", type=int, default=0, help="of the first mutation; -1 for fresh ones")
    options = parser.parse_args()
    seed = options.seed if options.seed >= 0 else time.time_ns() // 10**9 % 10**9
    names, began, failed = chosen(parser, options.readers), time.monotonic(), 0
    for number, name in enumerate(names):
        seconds = None
        if options.seconds is not None:
            left = options.seconds - (time.monotonic() - began)
            seconds = max(left / (len(names) - number), LEAST_S)
        result = run(name, seed, options.count, seconds)
        counts = ", ".join(f"{result.counts[kind]} {kind}" for kind in ("ok", "error", "failed"))
        print(f"{name}: {sum(result.counts.values())} mutations from seed {seed}: {counts}", flush=True)
        for failure in result.failures:
            print(f"  {failure}", flush=True)
        failed += len(result.failures)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
