"""Loops over points as machine code, where array operations would pass over all points many times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return the function as Numba compiles it at its first call, which takes a second; later processes load the code.

    The code is kept beside the module, or in the user's cache where that folder is read-only. It is compiled again when
    the module's own file changes, so compiled functions call only those of the same module. Import such modules where
    they are first used: Numba takes 0.15 s to load. Results do not depend on the number of threads, and rounding is
    that of IEEE 754.
    """
    from numba import njit

    try:
        return cast(Function, njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # no folder to keep the code in can be written
        return cast(Function, njit(nogil=True, error_model="numpy")(function))
