"""The stages of one step, and the state that a run has from its first frame on."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import (
    Backend,
    InitialPoseSource,
    RefinesAgain,
    RelativePose,
    ResidualSource,
    State,
    TakesBack,
)
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise
from hybridlio.odometry.compensation import MotionCompensation
from hybridlio.odometry.estimate import InertialState
from hybridlio.odometry.second_pass import SecondCompensation
from hybridlio.odometry.start.start_search import StartSearch
from hybridlio.sources.gate.gate_result import GateResult
from hybridlio.sources.gate.imu_trust import ImuTrust, without_imu
from hybridlio.sources.gate.innovation_gate import InnovationGate
from hybridlio.sources.late_start import LateStart

if TYPE_CHECKING:
    from hybridlio.odometry.setup import Setup

_log = logging.getLogger(__name__)

_CONTRADICTS = (
    "frame %d: the IMU's %s contradict the scans, which move on smoothly; its samples are left out until they agree "
    "again. If this happens often, check T_imu_lidar, units and clock"
)
_DOUBTED = (
    "frame %d: scans, map and IMU contradict each other, as where scans jump, the sensor was carried or the start "
    "failed; positions from here on may be off by %.1f m (standard deviation per axis), relative to those before"
)
_NOISY = (
    "frame %d: the IMU's %s differ from the scans' motion %.0f times as much as their noise explains; they are "
    "believed that much less. That is usual where the body shakes, or where scans fit the map poorly, as among leaves; "
    "if neither is so, state the noise (imu_noise), or check T_imu_lidar, units and clock"
)
# Noise of an IMU on a platform that shakes is a few times that of its data sheet; wrong units or axes make more of it.
_NOISE_FACTOR_WARNED = 5.0


@dataclass(eq=False)
class Pipeline:
    """The implementations that a run uses, and what they have estimated.

    Attributes:
        first: the first frame.
        setup: sensors and preintegration.
        initial_pose, residual, backend: implementations of the three seams.
        compensation: motion compensation.
        gate: compares relative poses with the IMU.
        trust: how far the IMU is believed.
        start: state at the first scan that the backend started from; None until the second frame.
        state: the backend's state at the last scan; None until the second frame has been added.
        start_search: while the first motion is undecided, its search; None otherwise.
        late_start: while the IMU has not covered a scan, the first one; None otherwise.
        late_noise: ``(6, 6)`` of steps before the first samples, by what these show; None without such steps.
    """

    first: Frame
    setup: Setup
    initial_pose: InitialPoseSource
    residual: ResidualSource
    backend: Backend
    compensation: MotionCompensation = field(init=False)
    gate: InnovationGate = field(init=False)
    trust: ImuTrust = field(init=False)
    start: State | None = None
    state: State | None = None
    start_search: StartSearch | None = None
    late_start: LateStart | None = None
    late_noise: Array | None = None
    _has_warned: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.compensation = MotionCompensation(self.calibration, self.imu_noise, self.first.scan.stamp_ns)
        self.gate = InnovationGate(isinstance(self.residual, TakesBack))
        self.trust = ImuTrust(self.imu_noise)

    @property
    def calibration(self) -> Calibration:
        """The extrinsics."""
        return self.setup.calibration

    @property
    def imu_noise(self) -> ImuNoise:
        """The IMU's noise densities as stated or assumed."""
        return self.setup.imu_noise

    def usable(self, frame: Frame) -> Frame:
        """Return the frame, without its inertial samples if the IMU is left out at present."""
        return without_imu(frame) if self.trust.left_out else frame

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Return the initial relative pose of the step to ``frame``.

        Raises:
            ConfigError: the source returned something else than a RelativePose.
        """
        return _checked(self.initial_pose.predict(frame, state), self.initial_pose.name)

    def refine(
        self, frame: Frame, initial: RelativePose, state: State, seconds: dict[str, float]
    ) -> tuple[Frame, RelativePose]:
        """Compensate the scan's motion by the initial pose, then refine that pose.

        Args:
            frame: the frame as recorded.
            initial: initial relative pose of the step to it.
            state: the backend's state at the scan before.
            seconds: gets the time spent in both stages.

        Returns:
            The compensated frame and the refined relative pose, with the noise of compensation in its covariance.

        Raises:
            ConfigError: the source returned something else than a RelativePose.
        """
        with timed(seconds, "motion compensation"):
            compensated = self.compensated(frame, initial.pose, state)
        with timed(seconds, "residual"):
            relative = _checked(self.residual.refine(compensated, initial), self.residual.name)
        return compensated, self._with_compensation_noise(frame, relative, state)

    def refine_again(
        self, frame: Frame, initial: RelativePose, state: State, second: SecondCompensation
    ) -> tuple[Frame, RelativePose]:
        """Compensate the last scan once more, and refine the initial pose by it as :meth:`refine` did.

        The residual source is one that :class:`~hybridlio.core.estimates.RefinesAgain`.
        """
        assert isinstance(self.residual, RefinesAgain)
        compensated = self.compensated(frame, second.T_start_end, state, second.turns_by_gyroscope)
        again = self.residual.refine_again(compensated, initial)
        return compensated, self._with_compensation_noise(frame, again, state)

    def compensated(self, frame: Frame, T_start_end: Array, state: State, turns_by_gyroscope: bool = True) -> Frame:
        """Return the frame compensated by a step ``(4, 4)`` to it from a state."""
        return self.compensation.compensate(
            frame, T_start_end, state.stamp_ns, frame.scan.stamp_ns, state, frame.imu,
            turns_by_gyroscope=turns_by_gyroscope,
        )  # fmt: skip

    def _with_compensation_noise(self, frame: Frame, relative: RelativePose, state: State) -> RelativePose:
        noise = self.compensation.noise(frame, state.stamp_ns)
        return relative if noise is None or not relative.ok else _widened(relative, noise, frame)

    def apply_gate(
        self, frame: Frame, initial: RelativePose, measured: RelativePose, state: State
    ) -> tuple[RelativePose, GateResult]:
        """Compare a relative pose with the IMU and leave out, or weigh less, whichever is wrong.

        The prediction is the IMU's whatever the initial-pose source, so that every source is gated alike.

        Args:
            frame: with the step's samples, even if they are left out at present.
            initial: initial relative pose, which bridges a rejected scan.
            measured: the residual source's relative pose.
            state: the backend's state at the scan before.
        """
        predicted = self.setup.predict_from_imu(frame, state) if state.has_imu else None
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        doubted_m = self.gate.doubt.lasting_m
        relative, result = self.gate.apply(measured, predicted, initial, dt_s, self.trust.left_out)
        if self.gate.doubt.lasting_m > doubted_m:
            _log.log(logging.INFO if doubted_m else logging.WARNING, _DOUBTED, frame.index, self.gate.doubt.lasting_m)
        if result.takes_back and isinstance(self.residual, TakesBack):
            self.residual.take_back(initial)
        return relative, result

    def learn(self, frame: Frame, result: GateResult) -> None:
        """Let the trust in the IMU follow the gate's result of the step to ``frame``."""
        was_left_out = self.trust.left_out
        self.trust.learn(result, frame.scan.stamp_ns)
        self.setup.use_noise(self.trust.noise)
        if self.trust.left_out and not was_left_out:
            which = (
                "angular rates" if result.parts is not None and result.parts[0] > result.parts[1] else "accelerations"
            )
            level = logging.INFO if self._has_warned else logging.WARNING
            self._has_warned = True
            _log.log(level, _CONTRADICTS, frame.index, which)
        worst = int(self.trust.noise_factors.argmax())
        factor = float(self.trust.noise_factors[worst])
        if factor > _NOISE_FACTOR_WARNED and not self._has_warned:
            self._has_warned = True
            _log.warning(_NOISY, frame.index, ("angular rates", "accelerations")[worst], factor)

    def correct(self, frame: Frame, initial: RelativePose, relative: RelativePose, step: RelativePose) -> None:
        """Let the initial-pose source learn from the backend's step, unless the step is only its own prediction."""
        is_found = relative.ok and relative.source != initial.source
        self.compensation.learn(step if is_found else None, frame.scan.stamp_ns)
        if is_found:
            self.initial_pose.correct(frame, step)

    def lidar_pose(self, state: State) -> tuple[Array, Array]:
        """Return the state's lidar pose ``(4, 4)`` in the first scan's frame, and its covariance ``(6, 6)``.

        The covariance is the graph's, and what the gate doubts.
        """
        T_imu_lidar = self.calibration.T_imu_lidar
        T_lidar_imu = se3.inverse(T_imu_lidar)
        covariance = se3.rotate_covariance(state.covariance[:6, :6], T_lidar_imu)
        covariance = covariance + np.diag(np.r_[np.zeros(3), np.full(3, self.gate.doubt.m2)])
        return T_lidar_imu @ state.T_world_imu @ T_imu_lidar, covariance

    def pose_after(self, before: State, step: RelativePose) -> Array:
        """Return the pose ``(4, 4)`` after a step from a state, in the frame of the first scan."""
        assert self.start is not None
        T_imu_lidar = self.calibration.T_imu_lidar
        T_first_before = se3.between(self.start.T_world_imu @ T_imu_lidar, before.T_world_imu @ T_imu_lidar)
        return np.asarray(T_first_before @ step.pose)

    def inertial_state(self, state: State) -> InertialState | None:
        """Return the state's velocity and biases; None if no inertial data has entered it."""
        if not state.has_imu:
            return None
        R = self.calibration.T_imu_lidar[:3, :3].T  # from the IMU's frame at the first scan to the lidar's
        velocity_variances = np.diag(R @ state.covariance[6:9, 6:9] @ R.T)
        variances = np.concatenate([velocity_variances, np.diag(state.covariance)[9:15]])
        biases = state.accel_bias_m_s2, state.gyro_bias_rad_s
        return InertialState(R @ state.velocity_m_s, *biases, np.sqrt(variances))


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Put the block's duration in seconds into ``seconds[stage]``; nothing where the block raises."""
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def _widened(relative: RelativePose, noise: Array, frame: Frame) -> RelativePose:
    """Return a step with the noise of compensation in its covariance.

    Without an IMU the scans that make the map have such errors, too, and the share of them that adds up is that of the
    step's other errors.
    """
    wide = relative.wider(added=noise)
    if relative.drift is None or len(frame.imu):
        return wide
    share = np.trace(relative.drift[3:, 3:]) / np.trace(relative.covariance[3:, 3:])
    return replace(wide, drift=relative.drift + share * noise)


def _checked(answer: RelativePose, source: str) -> RelativePose:
    """Check that a user's source returned a RelativePose."""
    if not isinstance(answer, RelativePose):
        raise ConfigError(f"source {source!r} must return a RelativePose, got {type(answer).__name__}")
    return answer
