"""Point times of every vendor's name, type, unit and origin, and those that cannot be used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_times import PointTimes, StatedTimes, find_point_times, time_columns
from hybridlio.datasets.points.whole_times import whole_ns

START_NS, STEP_NS, SWEEP_NS, SCANS = 1_700_000_000_123_456_789, 100_000_000, 99_900_000, 4
STAMPS = [START_NS + k * STEP_NS for k in range(SCANS)]
SWEEP = np.linspace(0, SWEEP_NS, 500).astype(np.int64)


def find(
    times: list[NDArray[Any]],
    name: str = "t",
    stamps: list[int] = STAMPS,
    step_ns: int | None = STEP_NS,
    stated: StatedTimes | None = None,
) -> tuple[PointTimes | None, list[str]]:
    notes = Notes("ride")
    samples = [(stamp, {name: values}) for stamp, values in zip(stamps, times, strict=True)]
    return find_point_times(samples, step_ns, notes, stated), notes.texts


def offsets(found: PointTimes | None, times: NDArray[Any], stamp: int = START_NS) -> NDArray[np.int64]:
    assert found is not None
    return found.offsets_ns({found.column: times}, stamp)


UNITS: dict[str, tuple[int, str]] = {
    "float32 s": (10**9, "<f4"),
    "float64 s": (10**9, "<f8"),
    "float32 ms": (10**6, "<f4"),
    "float64 us": (1000, "<f8"),
    "float32 ns": (1, "<f4"),
    "int32 us": (1000, "<i4"),
    "uint32 ns": (1, "<u4"),
    "int64 ns": (1, "<i8"),
    "uint16 ms": (10**6, "<u2"),
}


@pytest.mark.parametrize(
    ("unit", "place"),  # unsigned numbers hold no times before the stamp
    [(u, p) for u, (_, dtype) in UNITS.items() for p in ("start", "middle", "end") if p == "start" or dtype[1] != "u"],
)
@pytest.mark.parametrize("sweep_ns", [20_000_000, SWEEP_NS, 100_000_000])
def test_relative_times_of_every_unit_and_type_are_found(unit: str, place: str, sweep_ns: int) -> None:
    unit_ns, dtype = UNITS[unit]
    true = SWEEP * sweep_ns // SWEEP_NS - {"start": 0, "middle": sweep_ns // 2, "end": sweep_ns}[place]
    written = (true / unit_ns).astype(dtype)
    found, notes = find([written] * SCANS)
    np.testing.assert_allclose(offsets(found, written), true, atol=max(10, unit_ns if "f" not in dtype else 0))
    assert f"(the stamp is the sweep's {place})" in notes[0]
    assert f"in {unit.split()[1]} from the scan's stamp" in notes[0]


@pytest.mark.parametrize(
    ("unit_ns", "dtype"),
    [*((ns, "<f8") for ns in (10**9, 10**6, 1000, 1)), (1000, "<i8"), (1, "<i8"), (1000, "<u8"), (1, "<u8")],
)
@pytest.mark.parametrize("place", ["start", "middle", "end"])
def test_absolute_times_of_every_unit_are_found_on_the_stamps_clock(unit_ns: int, dtype: str, place: str) -> None:
    shift = {"start": 0, "middle": SWEEP_NS // 2, "end": SWEEP_NS}[place]
    exact = [stamp + SWEEP - shift for stamp in STAMPS]
    times = [(t // unit_ns + (t % unit_ns / unit_ns if dtype == "<f8" else 0)).astype(dtype) for t in exact]
    found, notes = find(times, "timestamp")
    for t, stamp in zip(times, STAMPS, strict=True):
        np.testing.assert_allclose(offsets(found, t, stamp), SWEEP - shift, atol=1000)  # float64 s have steps of 238 ns
    assert "on the stamps' clock" in notes[0]
    assert f"the sweep's {place}" in notes[0]


@pytest.mark.parametrize("start", [5.0, 991.587364520, 1e7])
def test_times_of_another_clock_count_from_the_first_point_and_are_noted(start: float) -> None:
    times = [start + k * 0.1 + SWEEP / 1e9 for k in range(SCANS)]
    found, notes = find(times)
    np.testing.assert_allclose(offsets(found, times[2]), SWEEP, atol=10)
    assert "so another clock" in notes[0]


def test_times_since_the_first_scan_are_absolute_where_stamps_count_from_zero() -> None:
    stamps = [k * STEP_NS for k in range(SCANS)]
    times = [(stamp + SWEEP) / 1e9 for stamp in stamps]
    found, _ = find(times, stamps=stamps)
    np.testing.assert_allclose(offsets(found, times[3], stamps[3]), SWEEP, atol=10)


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_shares_of_the_sweep_take_the_distance_between_stamps(dtype: str) -> None:
    shares = np.linspace(0, 1, 500).astype(dtype)
    found, notes = find([shares] * SCANS, "time")
    np.testing.assert_allclose(offsets(found, shares), np.linspace(0, STEP_NS, 500), atol=10)
    assert "in normalised" in notes[0]


def test_the_user_is_asked_where_two_readings_are_possible() -> None:
    shares, step = np.linspace(0, 1, 500), 1_000_000_000  # a sweep of 1 s, or shares of any sweep
    stamps = [START_NS + k * step for k in range(SCANS)]
    with pytest.raises(DataError, match=r"its unit can be s or normalised.*point_times"):
        find([shares] * SCANS, stamps=stamps, step_ns=step)
    stated = StatedTimes(unit="normalised", sweep_s=0.1)
    found, _ = find([shares] * SCANS, stamps=stamps, step_ns=step, stated=stated)
    np.testing.assert_allclose(offsets(found, shares), np.linspace(0, 1e8, 500), atol=1)


@pytest.mark.parametrize("span", [1e-5, 3e10, 700.0])
def test_a_span_that_fits_no_unit_is_refused_with_advice(span: float) -> None:
    times = np.linspace(0, span, 500)
    with pytest.raises(DataError, match=r"its unit can be none of.*'point_times: none'"):
        find([times] * SCANS)
    assert find([times] * SCANS, stated=StatedTimes(ignored=True)) == (None, [])


@pytest.mark.parametrize("step_ns", [None, STEP_NS, 5 * STEP_NS, 50 * STEP_NS])
def test_scans_may_be_missing_between_those_that_are_left(step_ns: int | None) -> None:
    found, _ = find([SWEEP / 1e9] * SCANS, step_ns=step_ns)
    assert found == PointTimes("t", 10**9, "stamp")


@pytest.mark.parametrize(
    ("times", "says"),
    [
        (np.zeros(500, "<f4"), "zeros only"),
        (np.zeros(500, "<u4"), "zeros only"),
        (np.full(500, 0.05), "is constant"),
        (np.linspace(1.7e9, 1.7e9 + 0.1, 500).astype("<f4"), "float32 at 1.7e+09 and has steps of 128"),
        (np.linspace(1.7e9 - 300, 1.7e9 + 300, 500).astype("<f4"), "steps of 128"),
    ],
    ids=["zeros", "whole zeros", "constant", "float32 since 1970", "float32 across steps"],
)
def test_a_column_without_times_is_noted_and_not_used(times: NDArray[Any], says: str) -> None:
    found, notes = find([times] * SCANS)
    assert found is None
    assert says in notes[0]
    assert notes[0].endswith("not used")


def test_the_next_column_is_used_where_the_first_is_of_no_use() -> None:
    samples = [(stamp, {"timestamp": SWEEP / 1e9, "t": np.zeros(500)}) for stamp in STAMPS]
    found = find_point_times(samples, STEP_NS, Notes("ride"))
    assert found == PointTimes("timestamp", 10**9, "stamp")


@pytest.mark.parametrize(("origin", "shift"), [("start", 0), ("middle", SWEEP_NS // 2), ("end", SWEEP_NS)])
def test_a_stated_origin_puts_the_stamp_at_that_place_of_the_sweep(origin: str, shift: int) -> None:
    found, _ = find([SWEEP] * SCANS, stated=StatedTimes(origin=origin))
    np.testing.assert_array_equal(offsets(found, SWEEP), SWEEP - shift)


def test_a_stated_column_is_used_whatever_its_name() -> None:
    found, _ = find([SWEEP] * SCANS, name="alpha", stated=StatedTimes(column="alpha"))
    np.testing.assert_array_equal(offsets(found, SWEEP), SWEEP)
    with pytest.raises(DataError, match="no column 'beta'; the columns are alpha"):
        find([SWEEP] * SCANS, name="alpha", stated=StatedTimes(column="beta"))


def test_every_usual_name_is_recognised_also_with_its_unit() -> None:
    usual = ["t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset", "ts", "offset"]
    assert set(time_columns([*usual, "x", "ring", "intensity", "tag"])) == set(usual)
    assert time_columns(["offset_ns", "Timestamp", "T", "tx"]) == ["T", "Timestamp", "offset_ns"]
    assert set(time_columns(["GpsTime", "PointTime", "OffsetTime_us", "timer"])) == {
        "GpsTime",
        "PointTime",
        "OffsetTime_us",
    }
    found, _ = find([SWEEP // 1000], "offset_us", stamps=STAMPS[:1], step_ns=None)
    assert found == PointTimes("offset_us", 1000, "stamp")


@pytest.mark.parametrize("value", [1e300, -1e300, 2**63 * 1.0, np.finfo("f8").max])
def test_no_value_overflows(value: float) -> None:
    with pytest.raises(DataError, match="beyond any clock"):
        whole_ns(np.array([0.0, value]), 1, "t")
    with pytest.raises(DataError, match="beyond any clock"):
        whole_ns(np.array([2**64 - 1], np.uint64), 10**9, "t")


def test_a_scan_far_from_its_stamp_and_values_that_are_not_finite_are_refused() -> None:
    times = PointTimes("t", 1, "absolute")
    with pytest.raises(DataError, match="over 1 s from the scan's stamp"):
        times.offsets_ns({"t": SWEEP + START_NS}, START_NS + 5 * 10**9)
    with pytest.raises(DataError, match="not finite"):
        times.offsets_ns({"t": np.array([0.0, np.nan])}, 0)
    with pytest.raises(DataError, match="'t' of the point times is missing"):
        times.offsets_ns({}, 0)


def test_livox_float64_nanoseconds_give_offsets_within_the_sweep(cases: Path) -> None:
    data = (cases / "livox_float64_ns.pcd").read_bytes().split(b"DATA binary\n", 1)[1]
    row = np.dtype([("xyzi", "<f4", 4), ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")])
    times = np.frombuffer(data, row)["timestamp"]
    for stamp in (1_700_000_000_000_000_000, 1_600_000_000_000_000_000, 0):
        found, _ = find([times], "timestamp", stamps=[stamp], step_ns=None)
        assert found is not None
        ns = found.offsets_ns({"timestamp": times}, stamp)
        assert ns.min() >= 0
        assert 90_000_000 < ns.max() <= 100_000_000


@pytest.mark.parametrize("bad", [np.nan, 1e300, 1e10, -5e9])
@pytest.mark.parametrize("at", range(5))
def test_one_bad_scan_among_five_does_not_decide(bad: float, at: int) -> None:
    stamps = [START_NS + k * STEP_NS for k in range(5)]
    times = [SWEEP.astype(np.float64) for _ in stamps]
    times[at] = times[at].copy()
    times[at][7] = bad
    found, _ = find(times, stamps=stamps)
    assert found == PointTimes("t", 1, "stamp")
    np.testing.assert_array_equal(offsets(found, times[(at + 1) % 5]), SWEEP)


@pytest.mark.parametrize("factor", [1000, 1_000_000, 1_000_000_000])
def test_a_scan_in_another_unit_than_the_others_is_refused(factor: int) -> None:
    found, _ = find([SWEEP for _ in STAMPS])
    with pytest.raises(DataError, match=r"spans [\d,]+ ns in this scan and 99,900,000 ns in others.*another unit"):
        offsets(found, SWEEP // factor)


def test_a_piece_of_a_sweep_is_in_the_unit_of_the_others() -> None:
    found, _ = find([SWEEP for _ in STAMPS])
    np.testing.assert_array_equal(offsets(found, SWEEP[200:205]), SWEEP[200:205])


@pytest.mark.parametrize(("step_ns", "noted"), [(STEP_NS, False), (STEP_NS // 2, True)])
def test_sweeps_longer_than_the_distance_between_scans_are_noted(step_ns: int, noted: bool) -> None:
    _, notes = find(
        [SWEEP / 1e9 for _ in STAMPS], stamps=[START_NS + k * step_ns for k in range(SCANS)], step_ns=step_ns
    )
    assert any("between scans; check its unit and the rate" in note for note in notes) == noted
