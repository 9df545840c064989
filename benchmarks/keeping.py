"""What keeping a run on the disk costs, and what it costs to resume it.

    python benchmarks/keeping.py DATA [--frames A:B]

Prints the share of a run's time that its thread and its processor spend on the journal and the state, their sizes, and
the time per scan that a resumed run takes to get back to its last state.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Self

from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import part_of
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import Run, finish_run
from hybridlio.runs.unfinished.keeper import Keeper
from hybridlio.runs.unfinished.kept import resume_run
from hybridlio.runs.whole_folder import JOURNAL, STATE


class TimedKeeper(Keeper):
    """Adds up what the run waits for it, and what it computes."""

    waited_s = computed_s = beside_s = 0.0

    def __enter__(self) -> Self:
        """As in the base class."""
        super().__enter__()
        return self

    def after_scan(self) -> None:
        """As in the base class."""
        start_s, cpu_s = time.perf_counter(), time.thread_time()
        super().after_scan()
        self.waited_s += time.perf_counter() - start_s
        self.computed_s += time.thread_time() - cpu_s

    def _put(self, block: bytes, state: bytes | None) -> None:
        start_s = time.thread_time()
        super()._put(block, state)
        self.beside_s += time.thread_time() - start_s


def main() -> None:
    """Run, resume and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--frames")
    options = parser.parse_args()
    sequence, config = part_of(open_sequence(options.data), options.frames), Config()
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = Path(name)
        run = Run(sequence, Odometry())
        start_s = time.process_time()
        with TimedKeeper(folder, run, config) as keeper:
            finish_run(run, keeper=keeper)
        used_s = time.process_time() - start_s
        if run.stopped is not None:
            raise run.stopped
        print(f"{run.done} scans in {run.seconds:.1f} s")
        shares = [
            100 * keeper.waited_s / run.seconds,
            *(100 * s / used_s for s in (keeper.computed_s, keeper.beside_s)),
        ]
        print(f"the run waits {shares[0]:.2f} % of the time, {shares[1]:.2f} % of its processor time", end="")
        print(f"; a thread beside it uses {shares[2]:.2f} %")
        files = [folder / name for name in (JOURNAL, STATE)]  # a short run ends before its state is due
        sizes = [file.stat().st_size if file.is_file() else 0 for file in files]
        print(f"journal {sizes[0] / run.done / 1e3:.1f} kB a scan, state {sizes[1] / 1e6:.1f} MB")
        if not sizes[1]:
            print("too short for a state to resume from; give more scans")
            return
        start_s = time.perf_counter()
        resumed, _ = resume_run(folder, sequence, config, Odometry())
        spent_s = time.perf_counter() - start_s
        print(
            f"resumed after {resumed.done} scans in {spent_s:.2f} s, {1e3 * spent_s / resumed.done:.1f} ms a scan",
            end="",
        )
        print(f", {100 * spent_s / run.seconds:.0f} % of the time that they took")


if __name__ == "__main__":
    main()
