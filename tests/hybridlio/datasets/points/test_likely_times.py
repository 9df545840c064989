"""Columns that behave like point times under another name are named to the user, and others are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_times import find_point_times

SCANS, POINTS, STEP_NS = 5, 3200, 100_000_000
RNG = np.random.default_rng(3)


def noted(name: str, columns: list[NDArray[Any]], step_ns: int | None = STEP_NS) -> list[str]:
    notes = Notes("ride")
    samples = [
        (10**18 + k * STEP_NS, {"x": RNG.normal(size=len(column)), name: column}) for k, column in enumerate(columns)
    ]
    assert find_point_times(samples, step_ns, notes) is None
    return notes.texts


def sweep(unit_ns: float, dtype: str, rows: int = 1) -> list[NDArray[Any]]:
    """Times of a sweep, in the order of measurement or with a row of points for each beam."""
    row = np.linspace(0, 0.999 * STEP_NS / unit_ns, POINTS // rows)
    return [np.tile(row, rows).astype(dtype) for _ in range(SCANS)]


@pytest.mark.parametrize("name", ["curvature", "t_low", "Scalar field"])
@pytest.mark.parametrize(("unit_ns", "dtype"), [(1, "<u4"), (1000, "<f4"), (10**6, "<f4"), (10**9, "<f8")])
@pytest.mark.parametrize("rows", [1, 16])
def test_a_column_that_spans_every_sweep_is_named(name: str, unit_ns: int, dtype: str, rows: int) -> None:
    (text,) = noted(name, sweep(unit_ns, dtype, rows))
    assert f"'{name}' may hold them, and is not used; 'point_times: {{column: {name}}}'" in text


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("quality", [RNG.uniform(0, 100, POINTS) for _ in range(SCANS)]),  # spans 100, as milliseconds would
        ("ring", sweep(10**6, "<f4")),
        ("curvature", [RNG.uniform(0, 1e-3, POINTS) for _ in range(SCANS)]),
        ("confidence", [np.full(POINTS, 7.0) for _ in range(SCANS)]),
        ("age", [column * factor for column, factor in zip(sweep(10**6, "<f4"), (1, 1, 3, 1, 1), strict=True)]),
    ],
    ids=["random", "a ring", "short", "constant", "one scan differs"],
)
def test_other_columns_are_not(name: str, columns: list[NDArray[Any]]) -> None:
    assert noted(name, columns) == []


def test_without_a_distance_between_scans_only_names_tell() -> None:
    assert noted("curvature", sweep(10**6, "<f4"), step_ns=None) == []
    assert len(noted("pointdelta", sweep(10**6, "<f4"), step_ns=None)) == 1
