"""What a run with the viewer costs.

    python benchmarks/viewer.py DATA [--frames A:B] [--rounds N]

Runs the odometry with and without the viewer in turns, the viewer's data going to a file (`--save`). Prints the speed
with it as a share of the speed without, by the run's wall time and by processor time, the share of scans whose points
are shown, and the size of the file.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence, part_of
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import Run, finish_run
from hybridlio.viewing.rerun_live import LiveView
from hybridlio.viewing.rerun_stream import rerun_stream


class CountingView(LiveView):
    """Counts the scans whose points are shown."""

    shown_clouds = 0

    def _points(self, pose):  # type: ignore[no-untyped-def]
        points, map_points = super()._points(pose)
        self.shown_clouds += points is not None
        return points, map_points


def run_once(sequence: Sequence, save: Path | None) -> tuple[float, float, float]:
    """Return the wall time and the processor time of a run in seconds, and the share of the clouds that are shown."""
    run, view = Run(sequence, Odometry()), None
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    with ExitStack() as stack:
        if save is not None:
            view = CountingView(stack.enter_context(rerun_stream(sequence.name, save)), run)
        finish_run(run, watcher=view)
        if view is not None:
            view.finish()
    if run.stopped is not None:
        raise run.stopped
    shown = 0.0 if view is None else view.shown_clouds / len(run.estimates)
    return time.perf_counter() - start_s, time.process_time() - start_cpu_s, shown


def main() -> None:
    """Run in turns and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--frames")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    sequence = part_of(open_sequence(options.data), options.frames)
    without, with_view = [], []
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        save = Path(folder) / "run.rrd"
        run_once(part_of(sequence, ":20"), save)  # loads libraries, which takes a second or two once
        for k in range(options.rounds):
            without.append(run_once(sequence, None))
            with_view.append(run_once(sequence, save))
            wall, cpu = (a / b for a, b in zip(without[-1][:2], with_view[-1][:2], strict=True))
            print(f"round {k + 1}: speed with the viewer {wall:.3f} by wall time, {cpu:.3f} by processor time")
        size = save.stat().st_size
    wall, cpu = np.sum(without, axis=0)[:2] / np.sum(with_view, axis=0)[:2]
    print(f"{len(sequence)} scans, {options.rounds} rounds: {wall:.3f} by wall time, {cpu:.3f} by processor time")
    shown = np.mean([one[2] for one in with_view])
    print(f"points of {shown:.0%} of the scans shown; {size / 1e6:.1f} MB, {size / len(sequence) / 1e3:.0f} kB a scan")


if __name__ == "__main__":
    main()
