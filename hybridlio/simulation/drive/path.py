"""A smooth path in SE(3): one quintic spline, so that derivatives are exact at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError

DEGREE = 5  # acceleration and angular acceleration then have two continuous derivatives
_TIME_TOLERANCE_S = 1e-9  # rounding of times at the ends


@dataclass(frozen=True, eq=False)
class Motion:
    """The state of a path at ``N`` times.

    Attributes:
        poses: ``(N, 4, 4)`` ``T_world_body``.
        velocity_m_s, acceleration_m_s2: ``(N, 3)`` of the body's origin, in world.
        angular_velocity_rad_s, angular_acceleration_rad_s2: ``(N, 3)``, in body.
    """

    poses: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    angular_velocity_rad_s: Array
    angular_acceleration_rad_s2: Array


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Position and attitude over time as one quintic spline.

    The columns of the spline are the position in metres and a quaternion (x, y, z, w) of any length; the rotation is
    that of the normalised quaternion. No attitude is singular, and all derivatives follow from the polynomials'.
    """

    spline: BSpline

    @classmethod
    def through(cls, times_s: ArrayLike, poses: ArrayLike) -> SmoothPath:
        """Interpolate poses ``(N, 4, 4)`` ``T_world_body`` at increasing times ``(N,)``.

        Raises:
            DataError: fewer than 6 poses, or times that do not increase.
        """
        times, columns = _columns(times_s, poses)
        return cls(make_interp_spline(times, columns, k=DEGREE))

    @classmethod
    def near(cls, times_s: ArrayLike, poses: ArrayLike, knot_s: float) -> SmoothPath:
        """Fit a path to noisy poses by least squares, a knot every ``knot_s`` seconds; raises as :meth:`through`."""
        times, columns = _columns(times_s, poses)
        count = max(int((times[-1] - times[0]) / knot_s), 1)
        inner = np.linspace(times[0], times[-1], count + 1)[1:-1]
        knots = np.concatenate([np.repeat(times[0], DEGREE + 1), inner, np.repeat(times[-1], DEGREE + 1)])
        if len(knots) - DEGREE - 1 > len(times):
            return cls.through(times, poses)
        return cls(make_lsq_spline(times, columns, knots, k=DEGREE))

    @property
    def start_s(self) -> float:
        """Start of the interval on which the path is defined."""
        return float(self.spline.t[DEGREE])

    @property
    def end_s(self) -> float:
        """End of the interval on which the path is defined."""
        return float(self.spline.t[-DEGREE - 1])

    def poses(self, times_s: ArrayLike) -> Array:
        """Return ``T_world_body`` ``(N, 4, 4)`` at times ``(N,)``; raises as :meth:`motion`."""
        values = self.spline(self._inside(times_s))
        return se3.make(Rotation.from_quat(values[:, 3:]).as_matrix(), values[:, :3])

    def motion(self, times_s: ArrayLike) -> Motion:
        """Return poses with exact derivatives at times ``(N,)``.

        Raises:
            DataError: a time is outside the path.
        """
        times = self._inside(times_s)
        value, first, second = (self.spline(times, order) for order in range(3))
        q, dq, ddq = value[:, 3:], first[:, 3:], second[:, 3:]
        square = (q**2).sum(axis=1, keepdims=True)
        # body rate of a quaternion of any length: 2 Im(q* q') / |q|²; in its derivative, Im(q'* q') vanishes
        omega = 2 * _imaginary_of_conjugate_product(q, dq) / square
        shrink = 2 * (q * dq).sum(axis=1, keepdims=True) / square
        alpha = 2 * _imaginary_of_conjugate_product(q, ddq) / square - shrink * omega
        poses = se3.make(Rotation.from_quat(q).as_matrix(), value[:, :3])
        return Motion(poses, first[:, :3], second[:, :3], omega, alpha)

    def _inside(self, times_s: ArrayLike) -> Array:
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        earliest, latest = self.start_s - _TIME_TOLERANCE_S, self.end_s + _TIME_TOLERANCE_S
        if len(times) and (times.min() < earliest or times.max() > latest):
            raise DataError(
                f"path: times from {times.min():.3f} to {times.max():.3f} s are outside the path,"
                f" which is defined from {self.start_s:.3f} to {self.end_s:.3f} s"
            )
        return times


def _columns(times_s: ArrayLike, poses: ArrayLike) -> tuple[Array, Array]:
    """Return times, and positions and quaternions as ``(N, 7)``, without sign changes between quaternions."""
    times, poses = np.asarray(times_s, dtype=np.float64), np.asarray(poses, dtype=np.float64)
    if len(times) <= DEGREE or (np.diff(times) <= 0).any():
        raise DataError(f"path: expected at least {DEGREE + 1} poses at increasing times, got {len(times)}")
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    same_side = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(same_side)[:, None]
    return times, np.hstack([poses[:, :3, 3], quaternions])


def _imaginary_of_conjugate_product(a: Array, b: Array) -> Array:
    """Return Im(a* ⊗ b) ``(N, 3)`` of quaternions ``(N, 4)``, scalar last."""
    return np.asarray(a[:, 3:] * b[:, :3] - b[:, 3:] * a[:, :3] - np.cross(a[:, :3], b[:, :3]))
