"""A short ride in closed form, written in the layout of every reader."""

from __future__ import annotations

from pathlib import Path

import pytest
import rides


class Recordings:
    """The ride and the writers, as one fixture."""

    ride = rides.Ride()
    write_raw = staticmethod(rides.write_raw)
    write_odometry = staticmethod(rides.write_odometry)
    write_folder = staticmethod(rides.write_folder)
    write_bag = staticmethod(rides.write_bag)
    put = staticmethod(rides.put)
    put_bin = staticmethod(rides.put_bin)
    put_oxts = staticmethod(rides.put_oxts)
    put_rows = staticmethod(rides.put_rows)
    imu_csv = staticmethod(rides.imu_csv)
    iso = staticmethod(rides.iso)


@pytest.fixture(scope="session")
def recordings() -> type[Recordings]:
    return Recordings


@pytest.fixture
def drive(recordings: type[Recordings], tmp_path: Path) -> Path:
    """A KITTI raw drive with its 100 Hz recording beside it."""
    return recordings.write_raw(tmp_path, recordings.ride)
