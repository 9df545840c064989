"""Gross errors of an IMU's data and of its mounting, found by comparing its motion with the lidar's.

Each mistake that people make is a hypothesis: a matrix from the IMU's columns to the lidar's axes in place of the
stated mounting. One is named only if its squared differences are a small part of those of the stated mounting, which no
noise does.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from hybridlio.calibration.motion import ComparedMotion
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import GRAVITY_M_S2

DEGREE = float(np.deg2rad(1.0))
_SCALE_BAND = 1.2  # of a ratio about that of two units: between them lies a factor of 57 or 1000
_FAST_QUANTILE = 0.7  # of the turns, above which they are compared: there bias and noise are a small part
_RATIO_SPREAD = 0.1  # median deviation of the ratios: larger ones are noise, as on a straight road
_LEAST_TURN_RAD = 1e-6  # avoids 0/0
_FORCE_UNITS = {"g": 1.0, "mg": 1000.0, "mm/s²": 9810.0}  # what gravity reads in them
_FORCE_BAND = 1.25  # of the mean force about gravity's reading: braking and slopes change it by less
_NO_GRAVITY_SHARE = 0.3  # of gravity; the mean force of an IMU that measures it has all of it
# Squared differences by the stated mounting over those by another one. Noise alone gives ratios of 1; turns that are
# taken for another axis give tens to thousands.
_CLEAR_TURN_RATIO, _CLEAR_FORCE_RATIO = 5.0, 3.0
_LARGEST_UNEXPLAINED = 0.2  # of the squared turns by the better hypothesis, or it is no better explanation
_SAME_RAD = 20 * DEGREE  # rotations that differ by less are one hypothesis: the fine estimate tells them apart
_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What may have been mistaken.

    Attributes:
        name: in words.
        matrix: ``(3, 3)`` from the IMU's columns to the lidar's axes; orthogonal, of determinant 1 or -1.
    """

    name: str
    matrix: Array

    @property
    def is_rotation(self) -> bool:
        """Whether a rotation describes it; a mirrored frame has none."""
        return bool(np.linalg.det(self.matrix) > 0)


def gyro_scale(motion: ComparedMotion) -> float | None:
    """Return the gyroscope's rates over the lidar's where both turn fast; None if their ratio is not constant."""
    lidar, gyro = (np.linalg.norm(turns, axis=1) for turns in (motion.turns, motion.gyro_integrals))
    fast = gyro >= np.quantile(gyro, _FAST_QUANTILE)
    ratios = gyro[fast] / np.maximum(lidar[fast], _LEAST_TURN_RAD)
    scale = float(np.median(ratios))
    return scale if np.median(np.abs(ratios - scale)) < _RATIO_SPREAD * scale else None


def gyro_unit_factor(scale: float | None) -> float:
    """Return the factor that brings rates of this scale to rad/s; 1 if they are, or if no unit explains the scale."""
    for factor in (DEGREE, 1 / DEGREE):
        if scale is not None and 1 / _SCALE_BAND < scale * factor < _SCALE_BAND:
            return factor
    return 1.0


def force_unit(accel: Array) -> tuple[str, float] | None:
    """Return the unit of specific forces ``(S, 3)`` and its factor to m/s², if it is another one.

    The force of an IMU that drives about points up on average, so a mean as long as gravity reads in a unit shows that
    unit. Accelerations without gravity have a short mean.
    """
    mean, typical = float(np.linalg.norm(accel.mean(axis=0))), float(np.median(np.linalg.norm(accel, axis=1)))
    for unit, reading in _FORCE_UNITS.items():
        if all(reading / _FORCE_BAND < value < reading * _FORCE_BAND for value in (mean, typical)):
            return unit, GRAVITY_M_S2 / reading
    return None


def lacks_gravity(motion: ComparedMotion, M: Array) -> bool:
    """Whether the specific force is an acceleration without gravity."""
    return bool(np.linalg.norm(motion.up(M)) < _NO_GRAVITY_SHARE * GRAVITY_M_S2)


def hypotheses(R_imu_lidar: Array) -> list[Hypothesis]:
    """Return what may be mistaken about a stated mounting, the mounting itself first."""
    R = R_imu_lidar.T
    found = [Hypothesis("", R), Hypothesis("T_imu_lidar is the inverse of what it should be", R_imu_lidar)]
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            Q = np.zeros((3, 3))
            Q[range(3), order] = signs
            if not np.array_equal(Q, np.eye(3)):
                found.append(Hypothesis(_axes_name("IMU", Q), R @ Q))
                found.append(Hypothesis(_axes_name("lidar", Q), Q @ R))
    return found


def _axes_name(sensor: str, Q: Array) -> str:
    axes = ", ".join(("-" if row.sum() < 0 else "") + _AXES[int(np.abs(row).argmax())] for row in Q)
    kind = "are swapped or turned" if np.linalg.det(Q) > 0 else "are mirrored"
    return f"the {sensor}'s axes {kind}: its x, y, z should be {axes} of the data"


def mistaken_turns(motion: ComparedMotion, candidates: list[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that explain the gyroscope equally well and clearly better than the first; may be empty."""
    errors = np.array([motion.turn_error(h.matrix) for h in candidates])
    spread = _spread(motion.turns)
    if errors.min() > _LARGEST_UNEXPLAINED * spread:
        return []
    return _better(candidates, errors, _CLEAR_TURN_RATIO)


def mistaken_forces(motion: ComparedMotion, candidates: list[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that explain the accelerometer equally well and clearly better than the first."""
    if not len(motion.accelerations):
        return []
    errors = np.array([motion.force_error(h.matrix) for h in candidates])
    if errors.min() > _LARGEST_UNEXPLAINED * _spread(motion.accelerations):
        return []
    return _better(candidates, errors, _CLEAR_FORCE_RATIO)


def _better(candidates: list[Hypothesis], errors: Array, ratio: float) -> list[Hypothesis]:
    if errors[0] < ratio * errors.min():
        return []
    return [
        h for h, error in zip(candidates, errors, strict=True) if error * ratio < errors[0] and error < 2 * errors.min()
    ]


def _spread(values: Array) -> float:
    return float(((values - np.median(values, axis=0)) ** 2).sum(axis=1).mean())


def common(turned: list[Hypothesis], forced: list[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that explain both sensors."""
    return [h for h in turned if any(h is other for other in forced)]


def are_same(A: Array, B: Array) -> bool:
    """Whether two rotations differ by less than the fine estimate corrects."""
    return bool(np.linalg.norm(se3.so3_log(A.T @ B)) < _SAME_RAD)
