"""Calls into GTSAM on a stack that is large enough for the graph.

GTSAM walks elimination and Bayes trees recursively. The tree of a chain is as deep as the chain is long, and a chain of
100,000 poses overflows the usual stack of 8 MiB, which ends the process. The calling thread's stack cannot grow, so
large graphs are handled in a thread of their own.
"""

from __future__ import annotations

import contextvars
import threading
from collections.abc import Callable
from typing import TypeVar

from hybridlio.core.errors import GraphError

_Result = TypeVar("_Result")

# Poses up to which the caller's stack is enough: 8 MiB carry 85,000, and a thread that is not the main one has 2 MiB on
# some systems.
_SHALLOW = 10_000
# Of stack for each pose: 85,000 take 8 MiB, 100 bytes each, in COLAMD's order of a chain. Velocities and biases take as
# much again each, and other orders more; only what is used takes memory.
_BYTES_PER_POSE = 4096
_lock = threading.Lock()  # threading.stack_size holds for the whole process
_depth = threading.local()  # of the current thread: poses that its stack is made for


def on_deep_stack(poses: int, call: Callable[[], _Result]) -> _Result:
    """Return what the call returns, or raise what it raises, on a stack for a tree of this number of poses.

    Raises:
        GraphError: the system does not give the stack.
    """
    if poses <= max(_SHALLOW, getattr(_depth, "poses", 0)):
        return call()
    results: list[_Result] = []
    errors: list[BaseException] = []

    def work() -> None:
        _depth.poses = poses
        try:
            results.append(call())
        except BaseException as error:  # raised again in the calling thread
            errors.append(error)

    context = contextvars.copy_context()
    thread = threading.Thread(target=context.run, args=(work,), daemon=True)  # daemon: Ctrl-C ends the process
    _start(thread, poses)
    thread.join()
    if errors:
        raise errors[0]
    return results[0]


def _start(thread: threading.Thread, poses: int) -> None:
    with _lock:
        before = threading.stack_size(poses * _BYTES_PER_POSE)
        try:
            thread.start()
        except RuntimeError as error:
            megabytes = poses * _BYTES_PER_POSE >> 20
            raise GraphError(
                f"a graph of {poses} poses needs a stack of {megabytes} MiB, which the system does not give"
            ) from error
        finally:
            threading.stack_size(before)
