"""The same drive with the fields, types, units and origins of every vendor's times, as ``.pcd`` files and as bags."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import Scan
from hybridlio.datasets import Sequence, open_sequence

CLOUD = "sensor_msgs/msg/PointCloud2"
XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
PAD = ("pad", "<f4")  # `_` in a .pcd file
LIVOX = [*XYZ, ("intensity", "<f4"), ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")]
OUSTER = [*XYZ, PAD, ("intensity", "<f4"), ("t", "<u4"), ("reflectivity", "<u2"), ("ring", "u1"), ("range", "<u4")]


def seconds(stamp_ns: int, offsets_ns: NDArray[Any]) -> NDArray[Any]:
    return stamp_ns // 10**9 + (stamp_ns % 10**9 + offsets_ns) / 1e9


# vendor -> fields, name of the times, their values from stamp and offsets in ns
VENDORS: dict[str, tuple[list[tuple[str, str]], str, Callable[[int, NDArray[Any]], NDArray[Any]]]] = {
    "velodyne": ([*XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")], "time", lambda _, ns: ns / 1e9),
    "ouster": (OUSTER, "t", lambda _, ns: ns),
    "hesai": (
        [*XYZ, ("intensity", "<f4"), ("timestamp", "<f8"), ("ring", "<u2")],
        "timestamp",
        seconds,
    ),
    "robosense": (
        [*XYZ, PAD, ("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8")],
        "timestamp",
        seconds,
    ),
    "livox": (LIVOX, "timestamp", lambda t, ns: (t + ns).astype(np.float64)),
    "livox offset_time": ([*XYZ, ("reflectivity", "u1"), ("offset_time", "<u4")], "offset_time", lambda _, ns: ns),
    "microseconds": ([*XYZ, ("intensity", "<f4"), ("t_us", "<f8")], "t_us", lambda _, ns: ns / 1e3),
}


# 2^-9 s: its multiples are exact in every unit and type but float64 nanoseconds since 1970, which are multiples of 256
STEPS_NS = {vendor: 256 * 7629 if vendor == "livox" else 1_953_125 for vendor in VENDORS}


@dataclass(frozen=True)
class Exact:
    """A drive whose times every vendor's fields hold exactly, and what odometry estimates from the plain folder."""

    drive: Any
    estimates: Array


@pytest.fixture(scope="module")
def exact(as_folder: Any, drive_with_times: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Exact]:
    """The drive with stamps at the start of sweeps, by the step of its times."""
    made = {}
    for step_ns in set(STEPS_NS.values()):
        scans = []
        for scan in drive_with_times.scans:
            times = scan.stamp_ns + scan.time_offsets_ns
            stamp_ns = int(times.min()) // step_ns * step_ns
            scans.append(Scan(stamp_ns, scan.points, scan.intensity, (times - stamp_ns) // step_ns * step_ns))
        stamps = np.array([scan.stamp_ns for scan in scans])
        drive = type(drive_with_times)(replace(drive_with_times.sequence, stamps_ns=stamps), scans)
        plain = open_sequence(as_folder(tmp_path_factory.mktemp("exact"), drive))
        made[step_ns] = Exact(drive, drive.estimates(plain))
    return made


def points(vendor: str, scan: Scan) -> NDArray[Any]:
    fields, name, times = VENDORS[vendor]
    rows = np.zeros(len(scan), fields)
    for axis, values in zip("xyz", scan.points.T, strict=True):
        rows[axis] = values
    assert scan.time_offsets_ns is not None
    rows[name] = times(scan.stamp_ns, scan.time_offsets_ns)
    if "ring" in (rows.dtype.names or ()):
        rows["ring"] = np.arange(len(scan)) % 16
    return rows


def put_pcd(path: Path, rows: NDArray[Any]) -> None:
    kinds = [rows.dtype[name] for name in rows.dtype.names or ()]
    names = ["_" if name == "pad" else name for name in rows.dtype.names or ()]
    head = {
        "FIELDS": names,
        "SIZE": [kind.itemsize for kind in kinds],
        "TYPE": [kind.kind.upper() for kind in kinds],
        "COUNT": [1] * len(kinds),
        "WIDTH": [len(rows)],
        "HEIGHT": [1],
        "DATA": ["binary"],
    }
    path.write_bytes(
        "".join(f"{key} {' '.join(map(str, row))}\n" for key, row in head.items()).encode() + rows.tobytes()
    )


def check(sequence: Sequence, exact: Exact) -> None:
    for ours, theirs in zip(sequence, exact.drive.scans, strict=True):
        assert ours.scan.time_offsets_ns is not None
        np.testing.assert_array_equal(ours.scan.points, theirs.points)
        np.testing.assert_array_equal(ours.scan.time_offsets_ns, theirs.time_offsets_ns)
    np.testing.assert_allclose(exact.drive.estimates(sequence), exact.estimates, atol=1e-6)


@pytest.mark.parametrize("vendor", VENDORS)
def test_estimates_of_pcd_files_equal_those_of_the_plain_folder(
    vendor: str, as_folder: Any, exact: dict[int, Exact], tmp_path: Path
) -> None:
    chosen = exact[STEPS_NS[vendor]]
    folder = as_folder(tmp_path, chosen.drive)
    shutil.rmtree(folder / "scans")
    (folder / "scans").mkdir()
    for k, scan in enumerate(chosen.drive.scans):
        put_pcd(folder / f"scans/{k}.pcd", points(vendor, scan))
    check(open_sequence(folder), chosen)


@pytest.mark.parametrize("vendor", ["ouster"])
def test_estimates_of_clouds_in_bags_equal_those_of_the_plain_folder(
    vendor: str, exact: dict[int, Exact], tmp_path: Path
) -> None:
    chosen = exact[STEPS_NS[vendor]]
    maker = bags.Messages(is_ros2=True)
    content = [row for row in chosen.drive.messages(maker) if row[1] != "/points"]
    clouds = [(scan.stamp_ns, maker.cloud(scan.stamp_ns, points(vendor, scan), "lidar")) for scan in chosen.drive.scans]
    content += [(stamp_ns, "/points", CLOUD, cloud) for stamp_ns, cloud in clouds]
    path = bags.write(tmp_path / "drive", maker, content, "mcap")
    check(open_sequence(path), chosen)
