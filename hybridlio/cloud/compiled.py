"""Loops over points as machine code, where array operations would pass over all points many times."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

_log = logging.getLogger(__name__)

_ANNOUNCEMENT = "compiling loops for this machine, which takes some 20 s after an installation; later runs load them"

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return the function as Numba compiles it at its first call, which takes a second; later processes load the code.

    The code is kept beside the module, or in the user's cache where that folder is read-only. It is compiled again when
    the module's own file changes, so compiled functions call only those of the same module. Import such modules where
    they are first used: Numba takes 0.15 s to load. Results do not depend on the number of threads, and rounding is
    that of IEEE 754.
    """
    from numba import njit

    _announce_compilation()
    try:
        return cast(Function, njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # no folder to keep the code in can be written
        return cast(Function, njit(nogil=True, error_model="numpy")(function))


@cache
def _announce_compilation() -> None:
    """Log once in a process that loops are being compiled, as Numba is silent for ten seconds and more."""
    from numba.core import event

    class Announcer(event.Listener):
        is_announced = False

        def on_start(self, _event: object) -> None:
            if not self.is_announced:
                _log.warning(_ANNOUNCEMENT, extra={"kind": "once"})
            self.is_announced = True

        def on_end(self, _event: object) -> None:
            pass

    event.register("numba:compile", Announcer())  # type: ignore[no-untyped-call]
