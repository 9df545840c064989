"""Time and memory of online solvers: ``python benchmarks/pose_graphs_online.py [--poses N] [--loop-every M]``.

A robot drives laps of 400 steps with noisy odometry and closes a loop to the lap before at every M-th pose;
``fixed-lag`` to the middle of its lag. Each backend runs in a process of its own. Prints median and 99th percentile of
the update's time over the last thousand poses and over all, and the process's memory, at several points; in CPU time,
so that what else the machine does does not count.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

_LAP = 400
_SIGMAS = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]  # rad, m: of a step
_LOOP_SIGMAS = 5 * _SIGMAS


def memory_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def drive(backend: str, poses: int, loop_every: int, lag: int) -> None:
    rng = np.random.default_rng(0)
    step = np.array([0, 0, 2 * np.pi / _LAP, 1.0, 0, 0])
    graph = PoseGraph()
    solver = graph.online(backend, lag=lag, forget=True)
    reach = _LAP if backend == "incremental" else lag // 2
    graph.add_prior(0, np.eye(4), sigmas=1e-4)
    spent_s: list[float] = []
    for k in range(poses):
        if k:
            graph.add_between(k - 1, k, se3.exp(step) @ se3.exp(_SIGMAS * rng.standard_normal(6)), sigmas=_SIGMAS)
        if k > reach and k % loop_every == 0:
            back = se3.exp(-reach * step) @ se3.exp(_LOOP_SIGMAS * rng.standard_normal(6))
            graph.add_between(k, k - reach, back, sigmas=_LOOP_SIGMAS)
        begin = time.process_time()
        solver.update()
        solver.pose(k)
        spent_s.append(time.process_time() - begin)
        if (k + 1) % (poses // 5) == 0:
            last_ms = 1e3 * np.array(spent_s[-1000:])
            median, late = np.median(last_ms), np.quantile(last_ms, 0.99)
            print(f"{backend:12s} {k + 1:7d} {median:10.2f} {late:10.2f} {memory_mib():9.1f}", flush=True)
    all_ms = 1e3 * np.array(spent_s)
    print(f"{backend:12s} {'all':>7s} {np.median(all_ms):10.2f} {np.quantile(all_ms, 0.99):10.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--loop-every", type=int, default=100)
    parser.add_argument("--lag", type=int, default=200)
    options = parser.parse_args()
    print(f"{'':12s} {'poses':>7s} {'median ms':>10s} {'99 % ms':>10s} {'RSS MiB':>9s}")
    for backend in ("incremental", "fixed-lag"):
        run = multiprocessing.get_context("spawn").Process(
            target=drive, args=(backend, options.poses, options.loop_every, options.lag)
        )
        run.start()
        run.join()


if __name__ == "__main__":
    main()
