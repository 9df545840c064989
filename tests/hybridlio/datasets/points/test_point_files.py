"""Scans of every file format, with and without point times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.point_files import read_scan

STAMP_NS = 1_600_000_000_000_000_000
COUNT = 40
PCD_TYPES = {"f": "F", "u": "U", "i": "I"}
PLY_TYPES = {"<f4": "float", "<f8": "double", "<i4": "int", "<u4": "uint", "|u1": "uchar"}


def cloud(**extra: NDArray[np.generic]) -> NDArray[np.void]:
    """Return a structured array of x y z and further columns."""
    xyz = np.random.default_rng(0).uniform(-30, 30, size=(COUNT, 3)).astype("<f4")
    columns = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **extra}
    out = np.zeros(COUNT, dtype=[(name, values.dtype.str) for name, values in columns.items()])
    for name, values in columns.items():
        out[name] = values
    return out


def ascii_rows(points: NDArray[np.void]) -> bytes:
    return "".join(" ".join(repr(v.item()) for v in row) + "\n" for row in points).encode()


def pcd(points: NDArray[np.void], ascii: bool) -> bytes:
    kinds = [points.dtype[name] for name in points.dtype.names]
    header = f"""# .PCD v0.7
VERSION 0.7
FIELDS {" ".join(points.dtype.names)}
SIZE {" ".join(str(k.itemsize) for k in kinds)}
TYPE {" ".join(PCD_TYPES[k.kind] for k in kinds)}
COUNT {" ".join("1" for _ in kinds)}
WIDTH {len(points)}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {len(points)}
DATA {"ascii" if ascii else "binary"}
"""
    return header.encode() + (ascii_rows(points) if ascii else points.tobytes())


def ply(points: NDArray[np.void], ascii: bool) -> bytes:
    properties = "".join(f"property {PLY_TYPES[points.dtype[n].str]} {n}\n" for n in points.dtype.names)
    form = "ascii" if ascii else "binary_little_endian"
    header = f"ply\nformat {form} 1.0\ncomment made here\nelement vertex {len(points)}\n{properties}end_header\n"
    return header.encode() + (ascii_rows(points) if ascii else points.tobytes())


WRITERS = {
    "ascii.pcd": lambda points: pcd(points, ascii=True),
    "binary.pcd": lambda points: pcd(points, ascii=False),
    "ascii.ply": lambda points: ply(points, ascii=True),
    "binary.ply": lambda points: ply(points, ascii=False),
}


def write(folder: Path, name: str, points: NDArray[np.void]) -> Path:
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, points)
    else:
        path.write_bytes(WRITERS[name](points))
    return path


KINDS = [*WRITERS, "named.npy"]
OFFSETS_NS = np.linspace(-50_000_000, 50_000_000, COUNT).astype(np.int64)


@pytest.mark.parametrize("kind", KINDS)
class TestEveryKindWithNamedColumns:
    def test_points_and_intensities_are_read(self, tmp_path: Path, kind: str) -> None:
        points = cloud(intensity=np.linspace(0, 1, COUNT).astype("<f4"))
        scan = read_scan(write(tmp_path, kind, points), STAMP_NS)
        np.testing.assert_allclose(scan.points, np.column_stack([points[c] for c in "xyz"]), rtol=1e-6)
        np.testing.assert_allclose(scan.intensity, points["intensity"], rtol=1e-6)
        assert scan.time_offsets_ns is None
        assert scan.stamp_ns == STAMP_NS

    def test_intensities_up_to_255_are_scaled_to_one(self, tmp_path: Path, kind: str) -> None:
        points = cloud(intensity=np.linspace(0, 255, COUNT).astype("<f4"))
        scan = read_scan(write(tmp_path, kind, points), STAMP_NS)
        np.testing.assert_allclose(scan.intensity, np.linspace(0, 1, COUNT), atol=1e-6)

    def test_integer_times_are_nanoseconds_from_the_stamp(self, tmp_path: Path, kind: str) -> None:
        scan = read_scan(write(tmp_path, kind, cloud(t=OFFSETS_NS.astype("<i4"))), STAMP_NS)
        np.testing.assert_array_equal(scan.time_offsets_ns, OFFSETS_NS)

    def test_floating_point_times_are_seconds_from_the_stamp(self, tmp_path: Path, kind: str) -> None:
        scan = read_scan(write(tmp_path, kind, cloud(time=(OFFSETS_NS / 1e9).astype("<f4"))), STAMP_NS)
        np.testing.assert_allclose(scan.time_offsets_ns, OFFSETS_NS, atol=5)

    def test_absolute_times_are_recognised(self, tmp_path: Path, kind: str) -> None:
        scan = read_scan(write(tmp_path, kind, cloud(timestamp=(STAMP_NS + OFFSETS_NS) / 1e9)), STAMP_NS)
        # a float64 has 0.24 µs steps there
        np.testing.assert_allclose(scan.time_offsets_ns, OFFSETS_NS, atol=240)

    @pytest.mark.parametrize("unit_ns", [1000, 1_000_000])
    @pytest.mark.parametrize("dtype", ["<f8", "<i4"])
    def test_times_in_other_units_are_recognised(self, tmp_path: Path, kind: str, unit_ns: int, dtype: str) -> None:
        written = (OFFSETS_NS / unit_ns).astype(dtype)
        scan = read_scan(write(tmp_path, kind, cloud(offset_time=written)), STAMP_NS)
        np.testing.assert_allclose(scan.time_offsets_ns, OFFSETS_NS, atol=1 if dtype == "<f8" else unit_ns)

    def test_unsigned_times_are_read(self, tmp_path: Path, kind: str) -> None:
        times = OFFSETS_NS - OFFSETS_NS[0]
        scan = read_scan(write(tmp_path, kind, cloud(t=times.astype("<u4"))), STAMP_NS)
        np.testing.assert_array_equal(scan.time_offsets_ns, times)

    def test_names_of_columns_may_be_in_capitals(self, tmp_path: Path, kind: str) -> None:
        points = cloud(Intensity=np.linspace(0, 1, COUNT).astype("<f4"))
        points.dtype.names = ("X", "Y", "Z", "Intensity")
        scan = read_scan(write(tmp_path, kind, points), STAMP_NS)
        np.testing.assert_array_equal(scan.points[:, 1], points["Y"])
        assert scan.intensity is not None

    @pytest.mark.parametrize(
        ("times", "says"),
        [(OFFSETS_NS * 1e9, "its unit can be none of"), (np.full(COUNT, np.nan), "not finite")],
        ids=["no sweep", "not finite"],
    )
    def test_times_without_a_meaning_are_rejected(
        self, tmp_path: Path, kind: str, times: NDArray[np.float64], says: str
    ) -> None:
        path = write(tmp_path, kind, cloud(time=times))
        with pytest.raises(DataError, match=rf"{kind}.*{says}"):
            read_scan(path, STAMP_NS)

    def test_points_that_are_not_finite_are_left_out_with_their_times(self, tmp_path: Path, kind: str) -> None:
        points = cloud(t=OFFSETS_NS.astype("<i4"))
        points["y"][4] = np.nan
        scan = read_scan(write(tmp_path, kind, points), STAMP_NS)
        np.testing.assert_array_equal(scan.time_offsets_ns, np.delete(OFFSETS_NS, 4))

    def test_a_truncated_file_is_rejected(self, tmp_path: Path, kind: str) -> None:
        path = write(tmp_path, kind, cloud(t=OFFSETS_NS.astype("<i4")))
        data = path.read_bytes()
        for keep in (0, 10, len(data) // 4, len(data) // 2, len(data) - 90, len(data) - 15):
            path.write_bytes(data[:keep])
            with pytest.raises(DataError, match=kind):
                read_scan(path, STAMP_NS)

    def test_a_scan_without_points_is_rejected(self, tmp_path: Path, kind: str) -> None:
        with pytest.raises(DataError, match=kind):
            read_scan(write(tmp_path, kind, cloud()[:0]), STAMP_NS)


@pytest.mark.parametrize("form", ["ascii", "binary", "compressed"])
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_files_written_by_open3d_are_read_and_rejected_if_truncated(tmp_path: Path, suffix: str, form: str) -> None:
    o3d = pytest.importorskip("open3d")
    points = cloud()
    xyz = np.column_stack([points[c] for c in "xyz"])
    device_cloud = o3d.t.geometry.PointCloud(xyz)
    path = tmp_path / f"scan{suffix}"
    o3d.t.io.write_point_cloud(str(path), device_cloud, write_ascii=form == "ascii", compressed=form == "compressed")
    np.testing.assert_allclose(read_scan(path, 1).points, xyz, rtol=1e-5)
    path.write_bytes(path.read_bytes()[:-15])
    with pytest.raises(DataError, match=f"scan{suffix}: truncated"):
        read_scan(path, 1)


@pytest.mark.parametrize("columns", [3, 4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_plain_arrays_hold_x_y_z_and_optionally_intensity(tmp_path: Path, columns: int, dtype: type) -> None:
    values = np.random.default_rng(1).uniform(0, 1, size=(9, columns)).astype(dtype)
    np.save(tmp_path / "scan.npy", values)
    scan = read_scan(tmp_path / "scan.npy", 5)
    np.testing.assert_array_equal(scan.points, values[:, :3].astype(np.float32))
    assert (scan.intensity is None) == (columns == 3)


@pytest.mark.parametrize("shape", [(9, 2), (9, 8), (9,), (3, 9, 2)])
def test_plain_arrays_of_other_shapes_are_rejected(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "scan.npy", np.zeros(shape))
    with pytest.raises(DataError, match=r"scan\.npy: expected \(N, 3\)"):
        read_scan(tmp_path / "scan.npy", 5)


def test_arrays_of_python_objects_are_rejected(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match=r"scan\.npy"):
        read_scan(tmp_path / "scan.npy", 5)


def test_an_organised_cloud_becomes_one_row_a_point_without_those_that_are_not_finite(tmp_path: Path) -> None:
    cloud = np.random.default_rng(2).uniform(1, 9, size=(4, 50, 3)).astype(np.float32)
    cloud[1, 7] = np.nan
    np.save(tmp_path / "scan.npy", cloud)
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.npy", 5).points, np.delete(cloud.reshape(-1, 3), 57, 0))


def test_an_array_that_announces_more_than_its_file_holds_is_rejected_before_memory_is_taken(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", np.zeros((9, 3), np.float32))
    data = (tmp_path / "scan.npy").read_bytes().replace(b"(9, 3),     ", b"(9999999, 3)")
    (tmp_path / "scan.npy").write_bytes(data.replace(b"(9, 3), ", b"(10**9, 3), "))
    with pytest.raises(DataError, match=r"scan\.npy"):
        read_scan(tmp_path / "scan.npy", 5)


def test_names_that_cloudcompare_writes_are_known(tmp_path: Path) -> None:
    points = np.zeros(COUNT, [(name, "<f4") for name in ("x", "y", "z", "scalar_Intensity", "scalar_Time")])
    points["x"], points["scalar_Intensity"], points["scalar_Time"] = 1, 0.5, np.linspace(0, 0.1, COUNT)
    (tmp_path / "scan.ply").write_bytes(ply(points, ascii=False))
    scan = read_scan(tmp_path / "scan.ply", 0)
    assert scan.intensity is not None
    assert scan.time_offsets_ns is not None
    assert scan.time_offsets_ns[-1] == pytest.approx(1e8)
