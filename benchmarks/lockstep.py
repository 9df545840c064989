"""Run several systems over the same scans in lockstep: each in its own process, one scan of one system at a time.

No system waits for another's threads, each has its own memory, and other load on the machine slows all alike.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

import numpy as np
from common import MIB, resident_mib
from systems import Answer, Make, Step

from hybridlio.core import se3
from hybridlio.core.progress import Progress
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence

Open = Callable[[], Sequence]  # opens the recording in each process, so it must be picklable

_LONGEST_S = 20  # hundreds of times a usual scan; a system that has lost its way may search without end
_DIVERGED_M = 1e6  # farther than any drive goes; beyond it later computations overflow


@dataclass
class Pass:
    """One pass of one system over a recording.

    Attributes:
        answers: one for each scan up to a failure.
        ms: wall-clock time of each.
        cpu_ms: processor time of each, summed over threads; other load on the machine does not lengthen it.
        start_s: from the start of its process to the first answer, including reading, loading and compiling.
        resident_mib: memory after each scan.
        peak_mib: the largest resident memory.
        error: why the pass ended early, or None.
    """

    answers: list[Answer] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    start_s: float = float("nan")
    resident_mib: list[float] = field(default_factory=list)
    peak_mib: float = 0.0
    error: str | None = None

    def trajectory(self) -> Trajectory:
        """Return the poses relative to the first, with covariances if every answer has one."""
        poses = np.array([answer.pose for answer in self.answers])
        stamps = np.array([answer.stamp_ns for answer in self.answers])
        given = [answer.covariance for answer in self.answers if answer.covariance is not None]
        return Trajectory(stamps, se3.between(poses[0], poses), np.array(given) if len(given) == len(poses) else None)

    def memory_growth_mib(self) -> float:
        """Return the growth of resident memory from the end of the first fifth to the end."""
        return self.resident_mib[-1] - self.resident_mib[len(self.resident_mib) // 5] if self.resident_mib else np.nan


def run_in_lockstep(
    systems: dict[str, Make], opened: Open, scans: int, threads: int, progress: Progress | None = None
) -> dict[str, Pass]:
    """Run every system once over the recording that ``opened`` opens. The first in turn changes with every scan."""
    passes = {name: Pass() for name in systems}
    with _processes(systems, opened, threads) as connections:
        for k in range(scans):
            names = list(connections)
            for name in names[k % len(names) :] + names[: k % len(names)]:
                if passes[name].error is None:
                    _run_scan(connections[name], k, passes[name])
            if progress is not None:
                progress("", k + 1, scans)
    return passes


def _run_scan(connection: Connection, k: int, kept: Pass) -> None:
    try:
        connection.send(k)
        if not connection.poll(_LONGEST_S):
            kept.error = f"scan {k}: no answer within {_LONGEST_S} s"
            return
        reply = connection.recv()
    except (EOFError, OSError):
        kept.error = f"its process ended at scan {k}"
        return
    if isinstance(reply, str):
        kept.error = f"scan {k}: {reply}"
        return
    answer, ms, cpu_ms, resident, kept.peak_mib, kept.start_s = reply
    kept.answers.append(answer)
    kept.ms.append(ms)
    kept.cpu_ms.append(cpu_ms)
    kept.resident_mib.append(resident)


@contextmanager
def _processes(systems: dict[str, Make], opened: Open, threads: int) -> Iterator[dict[str, Connection]]:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    os.environ["OMP_WAIT_POLICY"] = "passive"  # waiting threads do not spin on the cores of the system in turn
    context = multiprocessing.get_context("spawn")
    connections, children = {}, []
    try:
        for name, make in systems.items():
            ours, theirs = context.Pipe()
            child = context.Process(target=_serve, args=(theirs, make, opened, threads, time.time()), daemon=True)
            child.start()
            theirs.close()
            connections[name] = ours
            children.append(child)
            ours.recv()  # wait until it is ready, so that one start does not slow another
        yield connections
    finally:
        for connection in connections.values():
            connection.close()
        for child in children:
            child.join(timeout=10)
            child.kill()


def _serve(connection: Connection, make: Make, opened: Open, threads: int, spawned_s: float) -> None:
    """Process the scans whose numbers arrive, until the other end closes."""
    logging.getLogger("hybridlio").setLevel(logging.ERROR)  # the parent has printed warnings about the recording
    sequence, start_s = opened(), float("nan")
    step = _made(make, sequence, threads)
    ready_s = time.time() - spawned_s
    connection.send(None)
    while (k := _next(connection)) is not None:
        asked_s = time.time()
        try:
            if isinstance(step, Exception):
                raise step
            frame = sequence[k]
            begin, begin_cpu = time.perf_counter(), time.process_time()
            answer = step(frame)
            ms, cpu_ms = 1e3 * (time.perf_counter() - begin), 1e3 * (time.process_time() - begin_cpu)
            if np.abs(answer.pose).max() > _DIVERGED_M:
                raise OverflowError("diverged")
        except Exception as error:
            connection.send(f"{type(error).__name__}: {error}")
            continue
        start_s = ready_s + time.time() - asked_s if k == 0 else start_s
        peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MIB
        connection.send((answer, ms, cpu_ms, resident_mib(), peak_mib, start_s))


def _made(make: Make, sequence: Sequence, threads: int) -> Step | Exception:
    """Make the system, which loads and compiles what it needs; return the error if that fails."""
    try:
        return make(sequence, threads)
    except Exception as error:
        return error


def _next(connection: Connection) -> int | None:
    try:
        return int(connection.recv())
    except EOFError:
        return None
