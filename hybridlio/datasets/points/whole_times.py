"""Columns of times as whole nanoseconds, without overflow and without loss of digits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import NS_PER_S, Stamps
from hybridlio.core.errors import DataError

_EXACT = 2**53  # float64 holds every integer up to here
_MAX_NS = 2**62  # far from the limit of int64, also after subtracting a stamp
HOW_TO_STATE = (
    "state it in calibration.yaml as 'point_times: {unit: s|ms|us|ns|normalised, origin: stamp|absolute|start|middle|"
    "end}', or ignore the column with 'point_times: none'"
)


def whole_ns(values: NDArray[Any], unit_ns: int, column: str) -> Stamps:
    """Convert times to int64 nanoseconds without overflow; float64 seconds since 1970 keep all of their digits.

    Raises:
        DataError: a value is not finite, or beyond the range of int64 nanoseconds.
    """
    if values.dtype.kind not in "iuf":
        raise DataError(f"column '{column}' of the point times has the type {values.dtype}, not a number")
    if not len(values):
        return np.empty(0, np.int64)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise DataError(f"column '{column}' has times that are not finite")
    if values.dtype.itemsize < 8:  # nothing is lost, and what follows passes over memory without gaps
        values = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
    largest = max(abs(values.max().item()), abs(values.min().item())) * unit_ns
    if largest > _MAX_NS:
        raise DataError(f"column '{column}' reaches {largest / NS_PER_S:.3g} s, beyond any clock; {HOW_TO_STATE}")
    if values.dtype.kind in "iu":
        whole_units = values.astype(np.int64, copy=False)
        return whole_units if unit_ns == 1 else whole_units * unit_ns
    exact = values.astype(np.float64)
    if largest < _EXACT:
        return np.round(exact * unit_ns).astype(np.int64)
    whole = np.floor(exact)  # apart, so that the product with the unit is exact
    return whole.astype(np.int64) * unit_ns + np.round((exact - whole) * unit_ns).astype(np.int64)


def readable(name: str, found: list[tuple[int, NDArray[Any]]]) -> list[tuple[int, NDArray[Any]]]:
    """Return the scans whose times are finite numbers of a clock; those that are not raise when they are loaded.

    Raises:
        DataError: there is none.
    """
    kept, errors = [], []
    for stamp, column in found:
        try:
            whole_ns(column, 1, name)
        except DataError as error:
            errors.append(error)
        else:
            kept.append((stamp, column))
    if not kept:
        raise errors[0]
    return kept
