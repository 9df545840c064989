"""Files of GPS fixes with the columns and units of recorders and exports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint, geodetic_from_enu
from hybridlio.core.sensors import GpsFix
from hybridlio.datasets.gps_csv import read_gps_csv
from hybridlio.datasets.notes import Notes

START_NS, COUNT = 1_403_636_579_758_555_392, 30
STAMPS = START_NS + np.arange(COUNT) * 200_000_000
RNG = np.random.default_rng(0)
ENU = np.cumsum(RNG.normal(0, 2, (COUNT, 3)), axis=0)
ENU -= ENU[0]
ORIGIN = GeodeticPoint(49.0, 8.4, 110.0)
PLACES = geodetic_from_enu(ENU, ORIGIN)


def read(path: Path, names: list[str], *columns: object) -> tuple[tuple[GpsFix, ...], list[str]]:
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([",".join(names), *rows]))
    notes = Notes("ride")
    return read_gps_csv(path, notes), notes.texts


def degrees(values: object) -> list[str]:
    return [f"{value:.12f}" for value in values]


@pytest.mark.parametrize(
    "latitude", ["latitude", "lat", "Latitude", "latitude_deg", "lat (deg)", "field.latitude", "gps_lat"]
)
@pytest.mark.parametrize("longitude", ["longitude", "lon", "long", "LNG", "longitude [°]", "gnss.longitude"])
def test_every_usual_name_of_a_place_is_read(tmp_path: Path, latitude: str, longitude: str) -> None:
    for height in ("height", "altitude", "alt", "Altitude(m)", "altitude_m", "elevation", "ellipsoidal_height", "hgt"):
        names = [height, "stamp_ns", longitude, latitude, "sigma", "speed"]
        columns = PLACES[:, 2], STAMPS, degrees(PLACES[:, 1]), degrees(PLACES[:, 0]), [0.5] * COUNT, ["x"] * COUNT
        fixes, notes = read(tmp_path / "gps.csv", names, *columns)
        np.testing.assert_allclose([fix.position_m for fix in fixes], ENU, atol=1e-4)
        np.testing.assert_array_equal([fix.stamp_ns for fix in fixes], STAMPS)
        assert notes == []


def test_units_in_the_header_are_converted(tmp_path: Path) -> None:
    names = ["time (ms)", "lat_rad", "lon [rad]", "alt_ft", "sigma (cm)"]
    columns = (degrees(np.radians(PLACES[:, k])) for k in (0, 1))
    fixes, _ = read(tmp_path / "gps.csv", names, STAMPS / 1e6, *columns, PLACES[:, 2] / 0.3048, [50] * COUNT)
    np.testing.assert_allclose([fix.position_m for fix in fixes], ENU, atol=1e-4)
    np.testing.assert_allclose([fix.covariance_m2 for fix in fixes], [0.25 * np.eye(3)] * COUNT)


@pytest.mark.parametrize(("unit", "size"), [("s", 10**9), ("ms", 10**6), ("us", 1000), ("ns", 1)])
def test_the_unit_of_times_is_told_from_their_distance(tmp_path: Path, unit: str, size: int) -> None:
    whole = [t // size if size == 1 else f"{t // size}.{t % size:0{len(str(size)) - 1}d}" for t in STAMPS.tolist()]
    fixes, notes = read(tmp_path / "gps.csv", ["time", "e", "n", "u", "sigma"], whole, *ENU.T, [0.5] * COUNT)
    np.testing.assert_array_equal([fix.stamp_ns for fix in fixes], STAMPS)
    assert f"read in {unit}" in notes[0]


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        (["accuracy"], [2.0], [2, 2, 2]),
        (["sigma_east", "sigma_north", "sigma_up"], [1.0, 2.0, 3.0], [1, 2, 3]),
        (["sdn(m)", "sde(m)", "sdu(m)"], [2.0, 1.0, 3.0], [1, 2, 3]),
        (["lat_std", "lon_std", "alt_std"], [2.0, 1.0, 3.0], [1, 2, 3]),
        (["horizontal_accuracy", "vertical_accuracy"], [1.0, 3.0], [1, 1, 3]),
        ([f"field.position_covariance{k}" for k in range(9)], [1, 0, 0, 0, 4, 0, 0, 0, 9], [1, 2, 3]),
    ],
)
def test_deviations_are_read_in_every_usual_form(
    tmp_path: Path, names: list[str], values: list[float], expected: list[float]
) -> None:
    columns = STAMPS, *PLACES.T, *([value] * COUNT for value in values)
    fixes, notes = read(tmp_path / "gps.csv", ["stamp_ns", "lat", "lon", "alt", *names], *columns)
    np.testing.assert_allclose(fixes[-1].covariance_m2, np.diag(expected) ** 2, atol=1e-12)
    assert notes == []


@pytest.mark.parametrize("names", [[], [f"position_covariance{k}" for k in range(9)]])
def test_fixes_without_a_deviation_have_5_m_with_a_note(tmp_path: Path, names: list[str]) -> None:
    columns = STAMPS, *PLACES.T, *([0] * COUNT for _ in names)
    fixes, notes = read(tmp_path / "gps.csv", ["stamp_ns", "lat", "lon", "alt", *names], *columns)
    np.testing.assert_array_equal(fixes[0].covariance_m2, 25 * np.eye(3))
    assert f"{COUNT} fixes without covariance; 5 m are assumed" in notes[0]


@pytest.mark.parametrize("place", [("nan", "nan", "nan"), ("", "", ""), ("0.0", "0.0", "12.5")])
def test_rows_without_a_fix_are_left_out_with_a_note(tmp_path: Path, place: tuple[str, str, str]) -> None:
    columns = [[value, *column[1:]] for value, column in zip(place, PLACES.T.tolist(), strict=True)]
    fixes, notes = read(tmp_path / "gps.csv", ["stamp_ns", "lat", "lon", "alt", "sigma"], STAMPS, *columns, [1] * COUNT)
    np.testing.assert_array_equal([fix.stamp_ns for fix in fixes], STAMPS[1:])
    assert f"1 of {COUNT} rows have no fix" in notes[0]


def test_a_negative_status_is_no_fix(tmp_path: Path) -> None:
    status = [0] * (COUNT - 1) + [-1]
    names = ["stamp_ns", "lat", "lon", "alt", "sigma", "field.status.status"]
    assert len(read(tmp_path / "gps.csv", names, STAMPS, *PLACES.T, [1] * COUNT, status)[0]) == COUNT - 1


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (["stamp_ns", "lat", "lon", "sigma"], "lacks height"),
        (["stamp_ns", "x", "y", "z", "sigma"], "lacks latitude, longitude, height"),
        (["lat", "lon", "alt", "sigma"], "lacks a time"),
        (["stamp_ns", "lat [gon]", "lon", "alt", "sigma"], "unknown unit 'gon'"),
    ],
)
def test_a_header_that_lacks_a_column_says_which_names_are_known(
    tmp_path: Path, names: list[str], complaint: str
) -> None:
    with pytest.raises(DataError, match=r"the header must name a time .*latitude longitude height.*") as error:
        read(tmp_path / "gps.csv", names, *([k] for k in range(len(names))))
    assert complaint in str(error.value)
