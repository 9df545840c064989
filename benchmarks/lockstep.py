"""Several systems over the same scans in lockstep: each in a process of its own, one scan of one system at a time.

So no system waits for another's threads, each has its own memory, and what else the machine does disturbs all alike.
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
from systems import Answer, Make

from hybridlio.core.progress import Progress
from hybridlio.datasets.sequence import Sequence

Open = Callable[[], Sequence]  # given to processes, so picklable

_MB = 2**20
_LOST_M = 1e6


@dataclass
class Pass:
    """One pass of one system over a recording.

    Attributes:
        answers: one a scan, up to where it failed.
        ms: what each took.
        cpu_ms: processor time of all its threads, which a busy machine does not lengthen by waiting.
        start_s: from the start of its process to the first answer; reading is part of it.
        resident_mb: after each scan.
        peak_mb: the most that it had resident.
        error: why it ended early, or None.
    """

    answers: list[Answer] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    start_s: float = float("nan")
    resident_mb: list[float] = field(default_factory=list)
    peak_mb: float = 0.0
    error: str | None = None


def run_in_lockstep(
    systems: dict[str, Make], opened: Open, scans: int, threads: int, progress: Progress | None = None
) -> dict[str, Pass]:
    """One pass of every system over the recording that ``opened`` opens; whose turn is first changes scan by scan."""
    passes = {name: Pass() for name in systems}
    with _processes(systems, opened, threads) as talks:
        for k in range(scans):
            names = list(talks)
            for name in names[k % len(names) :] + names[: k % len(names)]:
                if passes[name].error is None:
                    _turn(talks[name], k, passes[name])
            if progress is not None:
                progress("", k + 1, scans)
    return passes


def _turn(talk: Connection, k: int, kept: Pass) -> None:
    try:
        talk.send(k)
        said = talk.recv()
    except (EOFError, OSError):
        kept.error = f"its process ended at scan {k}"
        return
    if isinstance(said, str):
        kept.error = f"scan {k}: {said}"
        return
    answer, ms, cpu_ms, kept.peak_mb, resident_mb, kept.start_s = said
    kept.answers.append(answer)
    kept.ms.append(ms)
    kept.cpu_ms.append(cpu_ms)
    kept.resident_mb.append(resident_mb)


@contextmanager
def _processes(systems: dict[str, Make], opened: Open, threads: int) -> Iterator[dict[str, Connection]]:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    os.environ["OMP_WAIT_POLICY"] = "passive"  # who is not in turn leaves the cores alone
    context = multiprocessing.get_context("spawn")
    talks, children = {}, []
    try:
        for name, make in systems.items():
            ours, theirs = context.Pipe()
            child = context.Process(target=_serve, args=(theirs, make, opened, threads, time.time()), daemon=True)
            child.start()
            theirs.close()
            talks[name] = ours
            children.append(child)
            ours.recv()  # that it is ready: starts do not disturb each other
        yield talks
    finally:
        for talk in talks.values():
            talk.close()
        for child in children:
            child.join(timeout=10)
            child.kill()


def _serve(talk: Connection, make: Make, opened: Open, threads: int, spawned_s: float) -> None:
    """Answer scan numbers until the other end hangs up."""
    logging.getLogger("hybridlio").setLevel(logging.ERROR)  # the parent has said what is odd about the recording
    sequence, step = opened(), None
    ready_s, start_s = time.time() - spawned_s, float("nan")
    talk.send(None)
    while (k := _next(talk)) is not None:
        asked_s = time.time()
        try:
            frame = sequence[k]
            step = step or make(sequence, threads)
            begin, begin_cpu = time.perf_counter(), time.process_time()
            answer = step(frame)
            ms, cpu_ms = 1e3 * (time.perf_counter() - begin), 1e3 * (time.process_time() - begin_cpu)
            if np.abs(answer.pose).max() > _LOST_M:
                raise OverflowError("diverged")
        except Exception as error:
            talk.send(f"{type(error).__name__}: {error}")
            continue
        start_s = ready_s + time.time() - asked_s if k == 0 else start_s
        talk.send((answer, ms, cpu_ms, *_memory_mb(), start_s))


def _next(talk: Connection) -> int | None:
    try:
        return int(talk.recv())
    except EOFError:
        return None


def _memory_mb() -> tuple[float, float]:
    """The most that this process had resident, and what it has now."""
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / _MB, now / _MB


def resident_growth_mb(kept: Pass) -> float:
    """How much more was resident at the end than after the first fifth."""
    return float(kept.resident_mb[-1] - kept.resident_mb[len(kept.resident_mb) // 5]) if kept.resident_mb else np.nan
