"""The IMU of another system's odometry, brought to the clock of its poses."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from hybridlio.calibration.clock_offset import ClockOffset, find_clock_offset
from hybridlio.calibration.turns import Turns
from hybridlio.core.sensors import NS_PER_S, Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory

_log = logging.getLogger(__name__)

# Bound of the search. Clocks of separate computers and logs that count from their own first row differ by seconds;
# a minute's difference is visible to the user.
LARGEST_OFFSET_S = 5.0


@dataclass(frozen=True, eq=False)
class OnPosesClock:
    """Samples on the clock of an odometry's poses.

    Attributes:
        imu: the samples, their stamps moved.
        offset_s: seconds that were added to them.
        notes: what was found.
        agreeing: the samples at the offset that the rotations show, where a stated one contradicts them. The noise of
            an odometry is estimated from these: from samples of a wrong clock it would seem as large as their error.
    """

    imu: ImuSamples
    offset_s: float = 0.0
    notes: tuple[str, ...] = ()
    agreeing: ImuSamples | None = None


def on_poses_clock(
    trajectory: Trajectory, imu: ImuSamples, calibration: Calibration, stated_s: float | None = None
) -> OnPosesClock:
    """Return the samples on the poses' clock, and log what was found.

    Args:
        trajectory: lidar poses of any odometry.
        imu: the samples; may be empty.
        calibration: ``T_imu_lidar``.
        stated_s: seconds to add to the samples' stamps; by default found from the rotations. A stated offset is
            applied, and noted as doubtful where the rotations contradict it.
    """
    if stated_s is not None:
        imu = ImuSamples(imu.stamps_ns + round(stated_s * NS_PER_S), imu.gyro_rad_s, imu.accel_m_s2)
    R_imu_lidar = calibration.T_imu_lidar[:3, :3]
    found = find_clock_offset(Turns.of(trajectory), imu, R_imu_lidar, LARGEST_OFFSET_S)
    if found is None or stated_s is not None or not found.is_significant:
        notes = _doubts(found) if found is not None else _not_compared(trajectory, imu)
        for note in notes:
            _log.warning(note)
        agreeing = found.applied_to(imu) if found is not None and found.is_significant else None
        return OnPosesClock(imu, stated_s or 0.0, notes, agreeing)
    note = f"IMU clock: stamps moved by {found}, found from the rotations of odometry and gyroscope"
    _log.warning(note)
    return OnPosesClock(found.applied_to(imu), found.offset_s, (note,))


def _not_compared(trajectory: Trajectory, imu: ImuSamples) -> tuple[str, ...]:
    """Return why the clocks were not compared; nothing without samples."""
    if not len(imu):
        return ()
    (start, end), (first, last) = trajectory.stamps_ns[[0, -1]], imu.stamps_ns[[0, -1]]
    apart_s = max(first - end, start - last) / NS_PER_S
    if apart_s > 0:
        return (
            f"no IMU sample lies in the time of the poses, they are {apart_s:.1f} s apart: the IMU is not used. Give "
            "imu_time_offset_s, or samples of this drive",
        )
    return ("too few steps between poses have IMU samples: the offset of the clocks is not known and taken as stated",)


def _doubts(found: ClockOffset) -> tuple[str, ...]:
    if found.is_significant:
        return (
            f"the rotations of odometry and gyroscope show a further offset of the clocks of {found}: check "
            "imu_time_offset_s",
        )
    if not found.contradicts:
        if found.is_determined:
            return ()
        return (
            f"the turns of the drive do not determine the offset of the clocks (± {1e3 * found.sigma_s:.0f} ms): it is "
            "taken as stated; give imu_time_offset_s if it is known",
        )
    return (
        f"the gyroscope does not measure the turns of the odometry at any offset of the clocks within "
        f"{LARGEST_OFFSET_S:g} s ({found.unexplained:.0%} of them unexplained): check T_imu_lidar, the unit (rad/s) "
        "and that both are of one drive",
    )
