"""Everything that estimation loads or compiles at its first use, done ahead of the first scan."""

from __future__ import annotations

from functools import cache

import numpy as np

from hybridlio.core.arrays import Floats
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuSamples, Scan
from hybridlio.odometry.odometry import Odometry

_HALF_ROOM_M = np.array([5.0, 4.0, 1.5])  # of a room whose walls fix a pose in all directions
_POINTS, _SCANS = 3000, 4  # enough for planes of a wall; a start is found from the first three
_SWEEP_NS, _SAMPLE_NS = NS_PER_S // 10, NS_PER_S // 200
_GRAVITY_M_S2 = 9.81


def warm_up(odometry: Odometry) -> None:
    """Load and compile what an odometry needs, once in a process, so that its first scan is not late.

    Libraries take a second to load. The first process after an installation also compiles loops, which takes ten
    seconds or more; later ones load them. Networks, and sources that are objects, are left to the first scan.
    """
    initial_pose, _, backend = odometry.chosen
    by_imu = initial_pose == "preintegration"
    _rehearse("preintegration" if by_imu else "constant-velocity", backend if isinstance(backend, str) else "none")


@cache
def _rehearse(initial_pose: str, backend: str) -> None:
    """Estimate four scans of a made-up room at rest."""
    odometry = Odometry(initial_pose, "scan-matching", backend, keep_record=False)
    for index in range(_SCANS):
        odometry.step(made_up_frame(index, initial_pose == "preintegration"))


def made_up_frame(index: int, with_imu: bool) -> Frame:
    """Return a scan of the room, with the samples of an IMU at rest if it is to have an IMU."""
    stamp_ns = (1 + index) * _SWEEP_NS
    scan = Scan(
        stamp_ns, _points_of_walls(index), time_offsets_ns=np.linspace(0, _SWEEP_NS - 1, _POINTS, dtype=np.int64)
    )
    if not with_imu:
        return Frame(index, scan)
    before, sweep = _at_rest(stamp_ns - _SWEEP_NS, stamp_ns), _at_rest(stamp_ns, stamp_ns + _SWEEP_NS)
    return Frame(index, scan, before, sweep_imu=sweep, calibration=Calibration())


def _points_of_walls(seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-_HALF_ROOM_M, _HALF_ROOM_M, (_POINTS, 3))
    axis = rng.integers(0, 3, _POINTS)
    points[np.arange(_POINTS), axis] = _HALF_ROOM_M[axis] * rng.choice([-1, 1], _POINTS)
    return points.astype(np.float32)


def _at_rest(first_ns: int, last_ns: int) -> ImuSamples:
    stamps_ns = np.arange(first_ns, last_ns + 1, _SAMPLE_NS)
    return ImuSamples(stamps_ns, np.zeros((len(stamps_ns), 3)), np.tile([0.0, 0.0, _GRAVITY_M_S2], (len(stamps_ns), 1)))
