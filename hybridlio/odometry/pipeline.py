"""The stages of one step, and the state that a run has from its first frame on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import Backend, InitialPoseSource, RelativePose, ResidualSource, State, TakesBack
from hybridlio.core.sensors import Calibration, Frame, ImuNoise
from hybridlio.odometry.compensation import MotionCompensation
from hybridlio.sources.innovation_gate import GateResult, InnovationGate


@dataclass(eq=False)
class Pipeline:
    """The implementations that a run uses, and what they have estimated.

    Attributes:
        first: the first frame.
        calibration: the extrinsics.
        imu_noise: the IMU's noise densities.
        initial_pose, residual, backend: implementations of the three seams.
        predict_from_imu: predicts the step to a frame from its samples and the state before, for the gate.
        compensation: motion compensation.
        gate: compares relative poses with the IMU.
        start: state at the first scan that the backend started from; None until the second frame.
        state: the backend's state at the last scan; None until the second frame has been added.
    """

    first: Frame
    calibration: Calibration
    imu_noise: ImuNoise
    initial_pose: InitialPoseSource
    residual: ResidualSource
    backend: Backend
    predict_from_imu: Callable[[Frame, State], RelativePose | None]
    compensation: MotionCompensation = field(init=False)
    gate: InnovationGate = field(default_factory=InnovationGate)
    start: State | None = None
    state: State | None = None

    def __post_init__(self) -> None:
        self.compensation = MotionCompensation(self.calibration, self.imu_noise)

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
            compensated = self.compensation.compensate(
                frame, initial.pose, state.stamp_ns, frame.scan.stamp_ns, state.gyro_bias_rad_s
            )
            noise = self.compensation.noise(frame)
        with timed(seconds, "residual"):
            relative = _checked(self.residual.refine(compensated, initial), self.residual.name)
        return compensated, relative if noise is None or not relative.ok else relative.wider(added=noise)

    def apply_gate(
        self, frame: Frame, initial: RelativePose, measured: RelativePose, state: State
    ) -> tuple[RelativePose, GateResult]:
        """Down-weight or reject a relative pose that contradicts the IMU; the initial pose bridges a rejected one.

        The prediction is the IMU's whatever the initial-pose source, so that every source is gated alike.
        """
        predicted = self.predict_from_imu(frame, state) if state.has_imu else None
        relative, result = self.gate.apply(measured, predicted, initial)
        if result.verdict == "rejected" and isinstance(self.residual, TakesBack):
            self.residual.take_back(initial)
        return relative, result

    def correct(self, frame: Frame, initial: RelativePose, relative: RelativePose, step: RelativePose) -> None:
        """Let the initial-pose source learn from the backend's step, unless the step is only its own prediction."""
        if relative.ok and relative.source != initial.source:
            self.initial_pose.correct(frame, step)

    def lidar_pose(self, state: State) -> tuple[Array, Array]:
        """Return the state's lidar pose ``(4, 4)`` in the first scan's frame, and its covariance ``(6, 6)``."""
        T_imu_lidar = self.calibration.T_imu_lidar
        T_lidar_imu = se3.inverse(T_imu_lidar)
        covariance = se3.rotate_covariance(state.covariance[:6, :6], T_lidar_imu)
        return T_lidar_imu @ state.T_world_imu @ T_imu_lidar, covariance


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Put the block's duration in seconds into ``seconds[stage]``; nothing where the block raises."""
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def _checked(answer: RelativePose, source: str) -> RelativePose:
    """Check that a user's source returned a RelativePose."""
    if not isinstance(answer, RelativePose):
        raise ConfigError(f"source {source!r} must return a RelativePose, got {type(answer).__name__}")
    return answer
