"""One simulated drive with point times, to be written as bags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import Scan
from hybridlio.datasets import Sequence, open_sequence


@dataclass
class Drive:
    """The drive, and its scans in memory."""

    sequence: Sequence
    scans: list[Scan]

    def messages(self, maker: bags.Messages, **options: Any) -> list[bags.Message]:
        s = self.sequence
        return bags.drive_messages(maker, self.scans, s.imu, s.calibration.T_imu_lidar, s.reference, **options)

    @staticmethod
    def estimates(sequence: Sequence) -> Array:
        """The poses ``(N, 4, 4)`` that odometry estimates."""
        from hybridlio.odometry.odometry import Odometry

        odometry = Odometry(initial_pose="preintegration", residual="scan-matching")
        return np.array([odometry.step(frame).pose for frame in sequence])


@pytest.fixture(scope="session")
def plain(as_folder: Any, drive_with_times: Drive, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return open_sequence(as_folder(tmp_path_factory.mktemp("plain"), drive_with_times))


@pytest.fixture(scope="session")
def plain_poses(plain: Sequence) -> Array:
    return Drive.estimates(plain)


@pytest.fixture(scope="session")
def drive_with_times(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """12 scans of a 16-beam lidar that moves during its sweeps."""
    from hybridlio.simulation import SimulationConfig, simulate

    config = SimulationConfig(seconds=1.2, seed=3, lidar="16-beam", motion_distortion=True)
    sequence = open_sequence(simulate(tmp_path_factory.mktemp("distorted"), config))
    return Drive(sequence, [frame.scan for frame in sequence])


@dataclass
class SmallBag:
    """Writes bags of a few small clouds and some inertial samples at rest; tests change the messages."""

    folder: Path
    maker: bags.Messages
    start_ns: int = 1_700_000_000_000_000_000

    def clouds(self, topic: str = "/points", count: int = 4, **changes: Any) -> list[bags.Message]:
        rng = np.random.default_rng(0)
        content = []
        for k in range(count):
            points = np.zeros(30, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
            for axis in "xyz":
                points[axis] = rng.uniform(1, 9, 30)
            t = self.start_ns + k * 100_000_000
            content.append((t, topic, "sensor_msgs/msg/PointCloud2", self.maker.cloud(t, points, **changes)))
        return content

    def imu(self, topic: str = "/imu", factor: float = 1.0, frame: str = "imu") -> list[bags.Message]:
        times = [self.start_ns + k * 10_000_000 for k in range(-3, 34)]
        force = np.array([0, 0, 9.81]) * factor
        return [(t, topic, "sensor_msgs/msg/Imu", self.maker.imu(t, np.zeros(3), force, frame)) for t in times]

    def mount(self, topic: str = "/tf_static", parent: str = "imu", x_m: float = 0.5, at: int = 0) -> bags.Message:
        T = np.eye(4)
        T[0, 3] = x_m
        content = self.maker.tf(self.maker.transform(0, parent, "lidar", T))
        return self.start_ns + at, topic, "tf2_msgs/msg/TFMessage", content

    def write(self, *parts: list[bags.Message], name: str = "small.bag") -> Path:
        storage = "" if name.endswith(".bag") else "mcap"
        return bags.write(self.folder / name, self.maker, [m for part in parts for m in part], storage)

    def standard(self) -> list[bags.Message]:
        return [*self.clouds(), *self.imu(), self.mount()]


@pytest.fixture
def small(tmp_path: Path) -> SmallBag:
    return SmallBag(tmp_path, bags.Messages(is_ros2=False))


@pytest.fixture
def small_2(tmp_path: Path) -> SmallBag:
    return SmallBag(tmp_path, bags.Messages(is_ros2=True))


@pytest.fixture(scope="session")
def as_folder() -> Callable[[Path, Drive], Path]:
    """Writes the drive as a plain folder."""
    from hybridlio.core.trajectory import write_tum

    def write(root: Path, drive: Drive) -> Path:
        sequence, folder = drive.sequence, root / "plain"
        (folder / "scans").mkdir(parents=True)
        for k, scan in enumerate(drive.scans):
            np.save(folder / f"scans/{k}", bags.structured(scan))
        (folder / "timestamps.txt").write_text("".join(f"{t}\n" for t in sequence.stamps_ns))
        imu = sequence.imu
        rows = zip(imu.stamps_ns.tolist(), np.hstack([imu.gyro_rad_s, imu.accel_m_s2]).tolist(), strict=True)
        lines = [f"{t},{','.join(map(repr, row))}" for t, row in rows]
        (folder / "imu.csv").write_text("\n".join(["stamp_ns,gx,gy,gz,ax,ay,az", *lines]) + "\n")
        T = sequence.calibration.T_imu_lidar.tolist()
        (folder / "calibration.yaml").write_text(f"T_imu_lidar: {T}\n")
        assert sequence.reference is not None
        write_tum(folder / "poses_tum.txt", sequence.reference)
        return folder

    return write
