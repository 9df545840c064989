"""The lidar's pose after the last estimate: by the IMU samples since, else at constant velocity."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, EstimationError
from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import changed_motion_covariance
from hybridlio.core.sensors import LONGEST_INTERPOLATION_NS, NS_PER_S, Calibration, ImuNoise
from hybridlio.graph.run.inertial_prediction import InertialPrediction
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.imu_buffer import ImuBuffer
from hybridlio.odometry.odometry import Odometry


@dataclass(frozen=True, eq=False)
class PredictedPose:
    """A pose after the last estimate.

    Attributes:
        stamp_ns: its time.
        pose: ``(4, 4)`` lidar pose ``T_world_lidar``, as in :class:`~hybridlio.odometry.estimate.Estimate`.
        covariance: ``(6, 6)`` of a right perturbation of ``pose``, rad² and m², rotation first.
        from_imu: whether IMU samples gave it; else the last step continues at constant velocity.
    """

    stamp_ns: int
    pose: Array
    covariance: Array
    from_imu: bool


class PosePrediction:
    """Predicts poses after one estimate.

    Args:
        estimate: the last one; it has a step.
        before_ns: stamp of the estimate before.
        state: the backend's state at the estimate.
        noise: the IMU's noise densities.
        calibration: the extrinsics.
    """

    def __init__(
        self, estimate: Estimate, before_ns: int, state: State, noise: ImuNoise, calibration: Calibration
    ) -> None:
        assert estimate.step is not None
        self._estimate, self._state, self._noise = estimate, state, noise
        self._twist = se3.log(estimate.step.pose) * NS_PER_S / (estimate.stamp_ns - before_ns)
        self._T_imu_lidar, self._T_lidar_imu = calibration.T_imu_lidar, se3.inverse(calibration.T_imu_lidar)
        self._rotation = se3.adjoint(self._T_lidar_imu)  # of covariances, from the IMU's frame to the lidar's
        self._inertial = InertialPrediction(state, noise)

    def advance(self, stamp_ns: int, imu: ImuBuffer) -> None:
        """Integrate the samples up to a stamp."""
        last = imu.last_before(stamp_ns)
        if stamp_ns < self._inertial.stamp_ns:
            self._inertial = InertialPrediction(self._state, self._noise)
        if self._state.has_imu and last is not None and last > self._inertial.stamp_ns:
            self._inertial.advance(*imu.steps(self._inertial.stamp_ns, last))

    def pose_at(self, stamp_ns: int, imu: ImuBuffer) -> PredictedPose:
        """Return the pose at a stamp; samples are held for a quarter of a second behind the newest.

        Raises:
            DataError: the stamp is before the estimate.
        """
        if stamp_ns < self._estimate.stamp_ns:
            raise DataError(
                f"predict: {stamp_ns} ns is before the last estimate at {self._estimate.stamp_ns} ns; predictions go "
                "forward from it"
            )
        last = imu.last_before(stamp_ns)
        if not self._state.has_imu or last is None or stamp_ns - last > LONGEST_INTERPOLATION_NS:
            return self._at_constant_velocity(stamp_ns)
        self.advance(stamp_ns, imu)
        start_ns = self._inertial.stamp_ns
        rest = imu.steps(start_ns, stamp_ns) if stamp_ns > start_ns else ((), ())
        pose, covariance = self._inertial.pose_after(*rest)
        return PredictedPose(
            stamp_ns,
            self._T_lidar_imu @ pose @ self._T_imu_lidar,
            self._rotation @ covariance @ self._rotation.T,
            from_imu=True,
        )

    def _at_constant_velocity(self, stamp_ns: int) -> PredictedPose:
        dt_s = (stamp_ns - self._estimate.stamp_ns) / NS_PER_S
        step = se3.exp(self._twist * dt_s)
        covariance = se3.compose_covariance(self._estimate.covariance, step, changed_motion_covariance(dt_s))
        return PredictedPose(stamp_ns, self._estimate.pose @ step, covariance, from_imu=False)


class LatestPrediction:
    """Predicts from the last estimate of an odometry.

    Args:
        odometry: the odometry.
        calibration: the extrinsics.
        imu: the samples, which others add.
    """

    def __init__(self, odometry: Odometry, calibration: Calibration, imu: ImuBuffer) -> None:
        self._odometry, self._calibration, self._imu = odometry, calibration, imu
        self._prediction: PosePrediction | None = None
        self._is_used = False
        self.estimate: Estimate | None = None  # the last one

    def restart(self, estimate: Estimate) -> None:
        """Continue from a new estimate of the odometry."""
        before, self.estimate = self.estimate, estimate
        state, noise = self._odometry.last_state, self._odometry.imu_noise
        if before is None or state is None or noise is None:
            return
        self._prediction = PosePrediction(estimate, before.stamp_ns, state, noise, self._calibration)
        self.advance()

    def advance(self) -> None:
        """Integrate the new samples, if predictions are wanted, so that :meth:`pose_at` need not."""
        if self._is_used and self._prediction is not None and self._imu.newest_ns is not None:
            self._prediction.advance(self._imu.newest_ns, self._imu)

    def pose_at(self, stamp_ns: int) -> PredictedPose:
        """As :meth:`PosePrediction.pose_at`.

        Raises:
            EstimationError: there are not two estimates yet.
        """
        self._is_used = True
        if self._prediction is None:
            raise EstimationError("predict: no velocity is known before the second estimate")
        return self._prediction.pose_at(stamp_ns, self._imu)
