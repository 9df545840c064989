"""Scans as LAS, LAZ, Feather and Parquet, written by the formats' own libraries."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.point_files import read_scan

COUNT = 400
RNG = np.random.default_rng(0)
XYZ = RNG.uniform(-50, 50, (COUNT, 3))
TIMES = np.linspace(0, 0.0999, COUNT)


def write_las(path: Path, shift: float = 0.0) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [shift] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = (XYZ + shift).T
    las.intensity = np.arange(COUNT) * 100
    las.gps_time = TIMES
    las.write(path)


def write_arrow(path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    # the columns of an Argoverse 2 sweep
    columns = {axis: XYZ[:, k].astype(np.float16) for k, axis in enumerate("xyz")}
    columns |= {"intensity": np.arange(COUNT).astype("u1"), "laser_number": np.zeros(COUNT, "u1")}
    table = pa.table(columns | {"offset_ns": (TIMES * 1e9).astype("<i4"), "name": ["a"] * COUNT})
    feather.write_feather(table, path) if path.suffix == ".feather" else parquet.write_table(table, path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_files_give_metres_intensity_and_gps_times(tmp_path: Path, suffix: str) -> None:
    write_las(tmp_path / f"scan{suffix}")
    scan = read_scan(tmp_path / f"scan{suffix}", 0)
    np.testing.assert_allclose(scan.points, XYZ, atol=6e-4)
    np.testing.assert_allclose(scan.intensity, np.arange(COUNT) * 100 / 65535, atol=1e-6)
    np.testing.assert_allclose(scan.time_offsets_ns, TIMES * 1e9, atol=1)


def test_a_las_file_in_a_maps_frame_is_refused_with_the_cause(tmp_path: Path) -> None:
    write_las(tmp_path / "scan.las", shift=500_000.0)
    with pytest.raises(DataError, match="must be in the lidar's"):
        read_scan(tmp_path / "scan.las", 0)


@pytest.mark.parametrize("suffix", [".feather", ".parquet"])
def test_tables_give_the_columns_of_numbers_by_name(tmp_path: Path, suffix: str) -> None:
    write_arrow(tmp_path / f"scan{suffix}")
    scan = read_scan(tmp_path / f"scan{suffix}", 0)
    np.testing.assert_array_equal(scan.points, XYZ.astype(np.float16).astype(np.float32))
    np.testing.assert_array_equal(scan.time_offsets_ns, (TIMES * 1e9).astype(np.int64))
    assert scan.intensity is not None


@pytest.mark.parametrize("suffix", [".las", ".laz", ".feather", ".parquet"])
def test_truncated_and_damaged_files_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"scan{suffix}"
    write_las(path) if suffix.startswith(".la") else write_arrow(path)
    data = path.read_bytes()
    for keep in (0, 10, len(data) // 3, len(data) - 50):
        path.write_bytes(data[:keep])
        with pytest.raises(DataError, match=f"scan{suffix}"):
            read_scan(path, 0)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("place", [100, 107, "chunks"])
def test_counts_that_the_file_does_not_hold_are_refused_before_memory_is_taken(
    tmp_path: Path, suffix: str, place: int | str
) -> None:
    path = tmp_path / f"scan{suffix}"
    write_las(path)
    data = bytearray(path.read_bytes())
    if place == "chunks":  # the library aborts the process on these
        start = int.from_bytes(data[96:100], "little")
        place = int.from_bytes(data[start : start + 8], "little") + 4 if suffix == ".laz" else 107
    data[place : place + 4] = b"\xff" * 4
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"truncated|announces"):
        read_scan(path, 0)


@pytest.mark.parametrize(("suffix", "module", "extra"), [(".las", "laspy", "las"), (".feather", "pyarrow", "arrow")])
def test_a_missing_library_is_named_with_the_extra_that_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, module: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"scan{suffix}").write_bytes(b"x")
    with pytest.raises(DataError, match=rf"needs {module}: pip install 'hybridlio\[{extra}\]'"):
        read_scan(tmp_path / f"scan{suffix}", 0)
