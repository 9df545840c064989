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
    """

    imu: ImuSamples
    offset_s: float = 0.0
    notes: tuple[str, ...] = ()


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
    if found is None:
        return OnPosesClock(imu, stated_s or 0.0)
    if stated_s is not None or not found.is_significant:
        notes = _doubts(found)
        for note in notes:
            _log.warning(note)
        return OnPosesClock(imu, stated_s or 0.0, notes)
    note = f"IMU clock: stamps moved by {found}, found from the rotations of odometry and gyroscope"
    _log.warning(note)
    return OnPosesClock(found.applied_to(imu), found.offset_s, (note,))


def _doubts(found: ClockOffset) -> tuple[str, ...]:
    if found.is_significant:
        return (
            f"the rotations of odometry and gyroscope show a further offset of the clocks of {found}: check "
            "imu_time_offset_s",
        )
    if not found.contradicts:
        return ()
    return (
        f"the gyroscope does not measure the turns of the odometry at any offset of the clocks within "
        f"{LARGEST_OFFSET_S:g} s ({found.unexplained:.0%} of them unexplained): check T_imu_lidar, the unit (rad/s) "
        "and that both are of one drive",
    )
