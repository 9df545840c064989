"""The check of an IMU against the path of a lidar: what is corrected in its samples, doubtful, or wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.calibration.clock_offset import ClockOffset, coarse_clock_offset, find_clock_offset
from hybridlio.calibration.gross_errors import (
    DEGREE,
    Hypothesis,
    common,
    force_unit,
    gyro_scale,
    gyro_unit_factor,
    hypotheses,
    lacks_gravity,
    mistaken_forces,
    mistaken_turns,
)
from hybridlio.calibration.motion import ComparedMotion, compare_motion
from hybridlio.calibration.turns import Turns
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Mask
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.core.trajectory import Trajectory

# A rotation between stated and estimated mounting that is named: hand-measured mountings are within 2°.
_NAMED_ROTATION_RAD = 2 * DEGREE
_NAMED_SIGMAS = 4.0
_NAMED_RATIO = 3.0  # of the residuals' variances: 1 to 1.1 for right mountings, 10 and more for 5°
_PIECE_SCANS = 50  # five seconds at 10 Hz: bends and braking in each, and eight pieces of the usual check
_SCALE_BAND = (0.8, 1.25)  # of the gyroscope's rates over the lidar's; sensors agree to 2 %


@dataclass(eq=False)
class ImuCheck:
    """What the comparison of an IMU with a lidar's path shows.

    Attributes:
        imu: the samples, corrected.
        offset: of the clocks; None where the motion was not compared.
        corrected: what was changed in the samples.
        doubtful: what is probably not right, with what to do.
        wrong: why the samples cannot be used, with what to do.
    """

    imu: ImuSamples
    offset: ClockOffset | None = None
    corrected: list[str] = field(default_factory=list)
    doubtful: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


def check_imu(
    paths: list[Trajectory],
    imu: ImuSamples,
    T_imu_lidar: Array,
    largest_s: float,
    measured: Mask | None = None,
    more_sigma_s: float = 0.0,
) -> ImuCheck:
    """Compare samples with the path of the lidar.

    Units and the accelerometer's sign are corrected where the data leave no doubt, and an offset of the clocks where it
    is significant (:class:`~hybridlio.calibration.clock_offset.ClockOffset`).

    Args:
        paths: of the lidar, stretches of the recording in order of time.
        imu: the samples.
        T_imu_lidar: ``(4, 4)`` as stated.
        largest_s: bound of the clocks' offset.
        measured: ``(N, 3)`` whether the path's steps measure turns about the lidar's axes; by default all do.
        more_sigma_s: standard deviation that the paths add to the offset, besides the errors of their turns.
    """
    found, turns = ImuCheck(imu), Turns.of(*paths, measured=measured)
    _correct_force_unit(found)
    coarse_s = coarse_clock_offset(turns, imu, largest_s)
    if coarse_s is None:
        return found
    lever_m, pieces = se3.inverse(T_imu_lidar)[:3, 3], [piece for path in paths for piece in _pieces(path)]

    def motion(parts: list[Trajectory]) -> ComparedMotion:
        return compare_motion(parts, moved(found.imu, coarse_s), lever_m)

    _correct_gyro_unit(found, motion(paths))
    _find_mistakes(found, motion(paths), [motion([piece]) for piece in pieces], T_imu_lidar)
    if not found.wrong:
        found.offset = find_clock_offset(turns, found.imu, T_imu_lidar[:3, :3], largest_s)
        if found.offset is not None:
            sigma_s = float(np.hypot(found.offset.sigma_s, more_sigma_s))
            found.offset = replace(found.offset, sigma_s=sigma_s)
            _judge(found, found.offset, T_imu_lidar, largest_s)
    return found


def moved(imu: ImuSamples, offset_s: float) -> ImuSamples:
    """Return the samples with seconds added to their stamps."""
    return ImuSamples(imu.stamps_ns + round(offset_s * NS_PER_S), imu.gyro_rad_s, imu.accel_m_s2)


def _correct_force_unit(found: ImuCheck) -> None:
    unit = force_unit(found.imu.accel_m_s2)
    if unit is not None:
        name, factor = unit
        found.imu = ImuSamples(found.imu.stamps_ns, found.imu.gyro_rad_s, found.imu.accel_m_s2 * factor)
        found.corrected.append(f"the specific force is in {name}; converted to m/s²")


def _pieces(path: Trajectory) -> list[Trajectory]:
    """Return a path in pieces that are judged one by one: where registration is lost, few of them are wrong."""
    starts = range(0, max(len(path) - _PIECE_SCANS, 0) + 1, _PIECE_SCANS)
    rows = [slice(start, start + _PIECE_SCANS + 1) for start in starts]
    return [Trajectory(path.stamps_ns[r], path.poses[r]) for r in rows if len(path.stamps_ns[r]) > _PIECE_SCANS // 2]


def _correct_gyro_unit(found: ImuCheck, motion: ComparedMotion) -> None:
    """Convert rates in another unit."""
    scale = gyro_scale(motion)
    factor = gyro_unit_factor(scale)
    if factor == 1.0:
        if scale is not None and not _SCALE_BAND[0] < scale < _SCALE_BAND[1]:
            found.doubtful.append(
                f"the gyroscope's rates are {scale:.2g} times those of the scans: check its scale and the stamps"
            )
        return
    imu = found.imu
    found.imu = ImuSamples(imu.stamps_ns, imu.gyro_rad_s * factor, imu.accel_m_s2)
    unit = "°/s" if factor < 1 else "rad/s, and were converted as if in °/s"
    found.corrected.append(f"angular velocities are in {unit}: {scale:.3g} times the scans' rates; converted to rad/s")


def _supported(
    find: Callable[[ComparedMotion, list[Hypothesis]], list[Hypothesis]],
    motion: ComparedMotion,
    pieces: list[ComparedMotion],
    candidates: list[Hypothesis],
) -> list[Hypothesis]:
    """Return the hypotheses that ``find`` returns for the whole motion and for at least half of its pieces."""
    whole = find(motion, candidates)
    each = [find(piece, candidates) for piece in pieces] if whole else []
    return [h for h in whole if 2 * sum(any(h is other for other in found) for found in each) >= len(each)]


def _find_mistakes(found: ImuCheck, motion: ComparedMotion, pieces: list[ComparedMotion], T_imu_lidar: Array) -> None:
    candidates = hypotheses(T_imu_lidar[:3, :3])
    turned = _supported(mistaken_turns, motion, pieces, candidates)
    forced = _supported(mistaken_forces, motion, pieces, candidates)
    stated = candidates[0].matrix
    if turned:
        both = common(turned, forced)
        if both or not forced:
            what = "" if both else _gyro_alone(motion, stated)
            found.wrong.append(_describe((both or turned)[0], T_imu_lidar, what))
        else:
            found.wrong.append(
                f"gyroscope: {turned[0].name}; accelerometer: {forced[0].name}. Check the columns of both"
            )
    elif any(np.allclose(h.matrix, -stated) for h in forced):
        imu = found.imu
        found.imu = ImuSamples(imu.stamps_ns, imu.gyro_rad_s, -imu.accel_m_s2)
        found.corrected.append("the accelerometer has the wrong sign (at rest it reads -9.81 upwards); negated")
    elif forced:
        found.wrong.append(_describe(forced[0], T_imu_lidar, "accelerometer: "))
    elif len(motion.accelerations) and lacks_gravity(motion, stated):
        up = float(np.linalg.norm(motion.up(stated)))
        found.wrong.append(
            f"gravity is missing from the accelerometer's data ({up:.1f} m/s² in the mean, 9.8 are needed). Record the "
            "specific force, not the linear acceleration without gravity, or leave the IMU out"
        )


def _gyro_alone(motion: ComparedMotion, stated: Array) -> str:
    """Return the prefix that names the gyroscope where the accelerometer fits the stated mounting well."""
    alone = len(motion.accelerations) and np.isclose(np.linalg.norm(motion.up(stated)), 9.81, rtol=0.1)
    spread = float(motion.accelerations.var(axis=0).sum()) if alone else 0.0
    return "gyroscope: " if alone and motion.force_error(stated) < 0.2 * spread else ""


def _describe(mistake: Hypothesis, T_imu_lidar: Array, what: str) -> str:
    if not mistake.is_rotation or what:
        return f"{what}{mistake.name}. Exchange or negate columns of the IMU's data accordingly"
    return f"{mistake.name}. {_line(mistake.matrix.T, T_imu_lidar)}"


def _line(R_imu_lidar: Array, T_imu_lidar: Array) -> str:
    """Return what to write into ``calibration.yaml``."""
    roll, pitch, yaw = Rotation.from_matrix(R_imu_lidar).as_euler("ZYX", degrees=True)[::-1]
    stated = T_imu_lidar[:3, 3]
    translation = se3.inverse(T_imu_lidar)[:3, 3] if np.allclose(R_imu_lidar, T_imu_lidar[:3, :3].T) else stated
    numbers = ", ".join(f"{value:.3f}" for value in translation)
    return (
        f"In calibration.yaml: 'T_imu_lidar: {{translation: [{numbers}], "
        f"roll_pitch_yaw_deg: [{roll:.1f}, {pitch:.1f}, {yaw:.1f}]}}'"
    )


def _judge(found: ImuCheck, offset: ClockOffset, T_imu_lidar: Array, largest_s: float) -> None:
    """Apply a significant offset, and note a mounting that is off."""
    if offset.contradicts:
        found.doubtful.append(
            f"the gyroscope does not measure the turns of the scans at any offset of the clocks within {largest_s:g} s "
            f"({offset.unexplained:.0%} of them unexplained): check T_imu_lidar, and that both are of one drive"
        )
    if offset.is_significant:
        found.imu = moved(found.imu, offset.offset_s)
        found.corrected.append(
            f"the IMU's clock differs from the lidar's: stamps moved by {offset}. To state it, write "
            f"'imu_time_offset_s: {offset.offset_s:.4f}' in calibration.yaml"
        )
    angle, size = offset.rotation_rad, float(np.linalg.norm(offset.rotation_rad))
    clear = (np.abs(angle) > _NAMED_SIGMAS * offset.rotation_sigma_rad).any()
    if size > _NAMED_ROTATION_RAD and clear and offset.stated_rotation_ratio > _NAMED_RATIO:
        R = se3.so3_exp(angle) @ T_imu_lidar[:3, :3]
        sigma = float(np.linalg.norm(offset.rotation_sigma_rad * angle / size))
        found.doubtful.append(
            f"T_imu_lidar is turned by {size / DEGREE:.1f} ± {sigma / DEGREE:.1f}° from what the motion shows. "
            f"{_line(R, T_imu_lidar)}"
        )
