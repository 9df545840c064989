"""IMU files with the columns and units of recorders and data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.notes import Notes

START_NS, COUNT = 1_403_636_579_758_555_392, 400
STAMPS = START_NS + np.arange(COUNT) * 5_000_000
RNG = np.random.default_rng(0)
GYRO = RNG.normal(0, 0.3, (COUNT, 3))
ACCEL = RNG.normal(0, 0.4, (COUNT, 3)) + np.array([0, 0, 9.81])
G = 9.80665


def read(path: Path, names: list[str], times: list[str], gyro: object = GYRO, accel: object = ACCEL) -> tuple:
    rows = [",".join([t, *map(repr, map(float, [*g, *a]))]) for t, g, a in zip(times, gyro, accel, strict=True)]
    path.write_text("\n".join([",".join(names), *rows]))
    notes = Notes("ride")
    return read_imu_csv(path, notes), notes.texts


def seconds(ns: int, unit: int = 10**9) -> str:
    whole, rest = divmod(int(ns), unit)
    return f"{whole}.{rest:0{len(str(unit)) - 1}d}" if unit > 1 else str(ns)


HEADERS: dict[str, tuple[list[str], int]] = {
    "this project": (["stamp_ns", "gx", "gy", "gz", "ax", "ay", "az"], 1),
    "seconds": (["t_s", "gx_rad_s", "gy_rad_s", "gz_rad_s", "ax_m_s2", "ay_m_s2", "az_m_s2"], 10**9),
    "EuRoC": (
        ["#timestamp [ns]", *(f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"), *(f"a_RS_S_{a} [m s^-2]" for a in "xyz")],
        1,
    ),
    "rostopic echo -p": (
        ["%time", *(f"field.angular_velocity.{a}" for a in "xyz"), *(f"field.linear_acceleration.{a}" for a in "xyz")],
        1,
    ),
    "seconds without a unit": (["Time", "wx", "wy", "wz", "acc_x", "acc_y", "acc_z"], 10**9),
    "milliseconds without a unit": (["timestamp", "GyroX", "GyroY", "GyroZ", "AccX", "AccY", "AccZ"], 10**6),
    "microseconds without a unit": (["t", *(f"gyr_{a}" for a in "xyz"), *(f"accel.{a}" for a in "xyz")], 1000),
    "units in brackets": (
        ["time (us)", *(f"omega_{a} (rad/s)" for a in "xyz"), *(f"linear_acceleration_{a} (m/s²)" for a in "xyz")],
        1000,
    ),
}


@pytest.mark.parametrize("header", HEADERS)
def test_every_usual_header_is_read_to_the_nanosecond(tmp_path: Path, header: str) -> None:
    names, unit = HEADERS[header]
    imu, notes = read(tmp_path / "imu.csv", names, [seconds(t, unit) for t in STAMPS])
    np.testing.assert_array_equal(imu.stamps_ns, STAMPS)
    np.testing.assert_allclose(imu.gyro_rad_s, GYRO, rtol=1e-12)
    np.testing.assert_allclose(imu.accel_m_s2, ACCEL, rtol=1e-12)
    assert bool(notes) == ("without a unit" in header or header == "rostopic echo -p")


@pytest.mark.parametrize("names", [("header.stamp.secs", "header.stamp.nsecs"), ("stamp.sec", "stamp.nanosec")])
def test_times_in_two_columns_are_joined(tmp_path: Path, names: tuple[str, str]) -> None:
    header = [*names, *(f"angular_velocity.{a}" for a in "xyz"), *(f"linear_acceleration.{a}" for a in "xyz")]
    imu, _ = read(tmp_path / "imu.csv", header, [f"{t // 10**9},{t % 10**9}" for t in STAMPS.tolist()])
    np.testing.assert_array_equal(imu.stamps_ns, STAMPS)


@pytest.mark.parametrize(
    ("gyro", "accel", "rad_s", "m_s2"),
    [
        ("g{}_deg_s", "a{}_g", np.pi / 180, G),
        ("gyro_{} [dps]", "acc_{} [mg]", np.pi / 180, G / 1000),
        ("w{} (mrad/s)", "a{} (m/s^2)", 1e-3, 1.0),
        ("gyro_{} (°/s)", "accel_{} (g)", np.pi / 180, G),
        ("gyro_{} (deg s^-1)", "accel_{} (m s⁻²)", np.pi / 180, 1.0),
    ],
)
def test_units_in_the_header_are_converted(tmp_path: Path, gyro: str, accel: str, rad_s: float, m_s2: float) -> None:
    names = ["stamp_ns", *(gyro.format(a) for a in "xyz"), *(accel.format(a) for a in "xyz")]
    imu, notes = read(tmp_path / "imu.csv", names, list(map(str, STAMPS)), GYRO / rad_s, ACCEL / m_s2)
    np.testing.assert_allclose(imu.gyro_rad_s, GYRO, rtol=1e-12)
    np.testing.assert_allclose(imu.accel_m_s2, ACCEL, rtol=1e-12)
    assert notes == []


PLAIN = HEADERS["this project"][0]


@pytest.mark.parametrize(("unit", "factor"), [("g", G), ("mg", G / 1000)])
def test_forces_whose_median_is_one_g_are_read_in_g_with_a_note(tmp_path: Path, unit: str, factor: float) -> None:
    imu, notes = read(tmp_path / "imu.csv", PLAIN, list(map(str, STAMPS)), GYRO, ACCEL / factor)
    np.testing.assert_allclose(imu.accel_m_s2, ACCEL, rtol=1e-12)
    assert f"read in {unit}" in notes[0]


def test_a_stated_unit_is_not_overruled_by_the_values(tmp_path: Path) -> None:
    names = [*PLAIN[:4], *(f"a{axis}_m_s2" for axis in "xyz")]
    imu, notes = read(tmp_path / "imu.csv", names, list(map(str, STAMPS)), GYRO, ACCEL / G)
    np.testing.assert_allclose(imu.accel_m_s2, ACCEL / G, rtol=1e-12)
    assert "check the unit" in notes[0]


def test_rates_beyond_any_gyroscope_are_read_in_degrees_with_a_note(tmp_path: Path) -> None:
    imu, notes = read(tmp_path / "imu.csv", PLAIN, list(map(str, STAMPS)), np.degrees(GYRO * 5), ACCEL)
    np.testing.assert_allclose(imu.gyro_rad_s, GYRO * 5, rtol=1e-12)
    assert "read in °/s" in notes[0]


@pytest.mark.parametrize("step", [10**12, 1e-10])
def test_a_time_whose_unit_cannot_be_told_is_refused_with_the_names_that_say_it(tmp_path: Path, step: float) -> None:
    times = [str(k * step) for k in range(COUNT)]
    with pytest.raises(DataError, match="name the column time_s, time_ms, time_us or time_ns"):
        read(tmp_path / "imu.csv", ["time", *PLAIN[1:]], times)


@pytest.mark.parametrize("time", ["nan", "inf", "1e400", "9" * 40])
def test_times_beyond_int64_are_refused(tmp_path: Path, time: str) -> None:
    with pytest.raises(DataError, match=r"imu\.csv"):
        read(tmp_path / "imu.csv", ["t_s", *PLAIN[1:]], [time, *(str(k * 0.005) for k in range(COUNT - 1))])


@pytest.mark.parametrize(
    ("form", "east_h"), [("%sT%s.%09dZ", 0), ("%s %s.%09d", 0), ("%sT%s.%09d+02:00", 2)], ids=["Z", "bare", "offset"]
)
def test_dates_are_times_to_the_nanosecond(tmp_path: Path, form: str, east_h: int) -> None:
    local = (STAMPS + east_h * 3600 * 10**9).astype("datetime64[ns]").astype(str)
    dates = [form % (*text.partition(".")[0].split("T"), int(text.partition(".")[2])) for text in local]
    imu, notes = read(tmp_path / "imu.csv", ["time", "gx", "gy", "gz", "ax", "ay", "az"], dates)
    assert np.array_equal(imu.stamps_ns, STAMPS)
    assert any("'time' holds dates, in UTC where they state no offset" in note for note in notes)


@pytest.mark.parametrize("second", ["2024-05-01T25:00:00Z", "1714550400.5"], ids=["no date", "a number"])
def test_a_date_that_is_none_is_refused(tmp_path: Path, second: str) -> None:
    names = ["time", "gx", "gy", "gz", "ax", "ay", "az"]
    with pytest.raises(DataError, match=r"line 3: expected numbers|holds dates in some rows and numbers in others"):
        read(tmp_path / "imu.csv", names, ["2024-05-01T12:00:00Z", second], GYRO[:2], ACCEL[:2])


@pytest.mark.parametrize("sign", [";", "\t"])
def test_decimal_commas_are_read_where_they_separate_nothing(tmp_path: Path, sign: str) -> None:
    names = ["t_s", "gx", "gy", "gz", "ax", "ay", "az"]
    stamps = [seconds(ns) for ns in STAMPS]
    plain, _ = read(tmp_path / "plain.csv", names, stamps)
    lines = (tmp_path / "plain.csv").read_text().replace(",", sign).replace(".", ",")
    (tmp_path / "commas.csv").write_text(lines)
    found = read_imu_csv(tmp_path / "commas.csv", Notes("ride"))
    for name in ("stamps_ns", "gyro_rad_s", "accel_m_s2"):
        assert np.array_equal(getattr(found, name), getattr(plain, name))


def test_a_comma_that_may_part_thousands_is_no_decimal_one(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text("t_s;gx;gy;gz;ax;ay;az\n1;0;0;0;1,234;0;9,810\n2;0;0;0;1,234;0;9,810\n")
    with pytest.raises(DataError, match="line 2: expected numbers"):
        read_imu_csv(tmp_path / "imu.csv", Notes("ride"))
