"""Measure time and memory of online solvers.

    python benchmarks/pose_graphs_online.py [--poses N] [--first K] [--loop-every M] [--robust KERNEL]

A robot drives laps of 400 steps with noisy odometry and closes a loop to the previous lap at every M-th pose
(``fixed-lag``: to the middle of its lag). The first update takes K poses at once, as a graph that was loaded. Each
backend runs in its own process. Prints, at five points of the run, the median and 99th percentile of an update's
processor time over the last 1,000 poses, and the memory of the process; then the two times over all poses.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from typing import Literal

import numpy as np
from common import resident_mib

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

_LAP = 400  # steps
_SIGMAS = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]  # of a step: rad, m
_LOOP_SIGMAS = 5 * _SIGMAS


def drive(
    backend: Literal["incremental", "fixed-lag"],
    poses: int,
    first: int,
    loop_every: int,
    lag: int,
    robust: str | None,
) -> None:
    rng = np.random.default_rng(0)
    step = np.array([0, 0, 2 * np.pi / _LAP, 1.0, 0, 0])
    graph = PoseGraph()
    solver = graph.online(backend, lag=lag, forget=True)
    loop_length = _LAP if backend == "incremental" else lag // 2
    graph.add_prior(0, np.eye(4), sigmas=1e-4)
    spent_s: list[float] = []
    for k in range(poses):
        if k:
            graph.add_between(k - 1, k, se3.exp(step) @ se3.exp(_SIGMAS * rng.standard_normal(6)), sigmas=_SIGMAS)
        if k > loop_length and k % loop_every == 0:
            back = se3.exp(-loop_length * step) @ se3.exp(_LOOP_SIGMAS * rng.standard_normal(6))
            graph.add_between(k, k - loop_length, back, sigmas=_LOOP_SIGMAS, robust=robust)
        if k + 1 < first:
            continue
        begin = time.process_time()
        solver.update()
        solver.pose(k)
        spent_s.append(time.process_time() - begin)
        if (k + 1) % (poses // 5) == 0:
            last_ms = 1e3 * np.array(spent_s[-1000:])
            median, late = np.median(last_ms), np.quantile(last_ms, 0.99)
            print(f"{backend:12s} {k + 1:7d} {median:10.2f} {late:10.2f} {resident_mib():9.1f}", flush=True)
    all_ms = 1e3 * np.array(spent_s[1:])
    print(f"{backend:12s} {'all':>7s} {np.median(all_ms):10.2f} {np.quantile(all_ms, 0.99):10.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=10_000, help="of the drive (default: %(default)s)")
    parser.add_argument("--first", type=int, default=1, metavar="K", help="poses of the first update (default: 1)")
    parser.add_argument("--loop-every", type=int, default=100, metavar="M", help="poses (default: %(default)s)")
    parser.add_argument("--lag", type=int, default=200, help="of fixed-lag, in poses (default: %(default)s)")
    parser.add_argument("--backends", nargs="+", default=["incremental", "fixed-lag"], help="(default: both)")
    parser.add_argument("--robust", help="kernel of the loops (default: none)")
    options = parser.parse_args()
    print(f"{'':12s} {'poses':>7s} {'median ms':>10s} {'p99 ms':>10s} {'RSS MiB':>9s}")
    for backend in options.backends:
        run = multiprocessing.get_context("spawn").Process(
            target=drive, args=(backend, options.poses, options.first, options.loop_every, options.lag, options.robust)
        )
        run.start()
        run.join()


if __name__ == "__main__":
    main()
