"""Odometry: estimates a lidar pose with covariance from each frame, by initial pose, residual, gate and backend."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.estimates import Backend, InitialPoseSource, ResidualSource, State
from hybridlio.core.sensors import Frame, ImuNoise, Scan
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.measured_step import measure_step, restore_search
from hybridlio.odometry.pipeline import Pipeline, timed
from hybridlio.odometry.registry import check_names, make_implementations
from hybridlio.odometry.setup import Setup
from hybridlio.odometry.start.late_imu import take_up_imu
from hybridlio.odometry.start.start_up import start_backend, start_residual
from hybridlio.record import plain_values
from hybridlio.record.loop_keyframes import LoopKeyframeSelector
from hybridlio.record.record import Record
from hybridlio.record.recorder import Recorder
from hybridlio.sources.gate.imu_trust import without_imu

# The first pose defines the frame, so it is exact. GTSAM and the file formats need a positive definite covariance;
# 1e-6 rad and m are far below any sensor's noise.
_FIRST_COVARIANCE = np.eye(6) * 1e-12
_STATE_NAMES = (
    "residual", "gate", "start_search", "late_start", "late_noise", "keyframe_position", "keyframes", "start",
    "imu_noise",
)  # fmt: skip


class Odometry:
    """Estimates poses frame by frame, in order.

    Args:
        initial_pose: name or object of an initial-pose source.
        residual: name or object of a residual source.
        backend: name or object of a backend.
        config: settings. Names given as arguments take precedence over those in it.
        keep_record: whether :meth:`record` is wanted. Without it memory does not grow with the run, once IMU samples
            have come.

    Attributes:
        chosen: initial-pose source, residual source and backend, each by name or as an object.
        keeps_record: whether :meth:`record` may be called.
        last_scan: the last frame's scan, motion compensated to its stamp; None before the second frame.

    Raises:
        ConfigError: a name is unknown.
    """

    def __init__(
        self,
        initial_pose: str | InitialPoseSource | None = None,
        residual: str | ResidualSource | None = None,
        backend: str | Backend | None = None,
        config: Config | None = None,
        keep_record: bool = True,
    ) -> None:
        config = config or Config()
        if not isinstance(config, Config):
            raise ConfigError(f"config must be a Config, got {config!r}; hybridlio.load_config reads one from a file")
        self._config = config
        self.chosen = (initial_pose or config.initial_pose, residual or config.residual, backend or config.backend)
        check_names(*self.chosen)
        self._pipeline: Pipeline | None = None  # made at the first frame, which brings the calibration
        self._recorder = Recorder()
        self._keyframes = LoopKeyframeSelector(config.keyframes)
        self.keeps_record = keep_record
        self.last_scan: Scan | None = None

    @property
    def last_state(self) -> State | None:
        """The backend's state at the last scan, with velocity and biases; None before the second scan."""
        return None if self._pipeline is None else self._pipeline.state

    @property
    def imu_noise(self) -> ImuNoise | None:
        """The noise densities that the run uses; None before the first scan."""
        return None if self._pipeline is None else self._pipeline.imu_noise

    def step(self, frame: Frame) -> Estimate:
        """Estimate the frame's pose.

        Raises:
            DataError: the frame is not after the last one, or the first scan has too few points.
            ConfigError: there are IMU samples without extrinsics, or a source cannot be made with its settings.
        """
        if not isinstance(frame, Frame):
            raise ConfigError(
                f"step takes a Frame, got {type(frame).__name__}; Frame(index, Scan(stamp_ns, points)) is one"
            )
        if frame.calibration is None and len(frame.imu):
            raise ConfigError(
                f"frame {frame.index} carries IMU samples but no calibration: set Frame.calibration (T_imu_lidar)"
            )
        if self._pipeline is None:
            self._pipeline = self._start(frame)
            return self._keep(_first_estimate(frame), frame)
        if frame.scan.stamp_ns <= self._recorder.last_ns:
            raise DataError(f"frame {frame.index}: its stamp is not after the last frame's; give frames in order")

        pipeline = self._pipeline
        seconds: dict[str, float] = {}
        before = self._state_before(frame, pipeline)
        recorded, frame = frame, pipeline.usable(frame)
        with timed(seconds, "initial pose"):
            initial = pipeline.predict(frame, before)
        compensated, relative = measure_step(pipeline, frame, initial, before, seconds)
        with timed(seconds, "graph"):
            relative, gate = pipeline.apply_gate(recorded, initial, relative, before)
            frame = frame if gate.uses_imu else without_imu(frame)
            pipeline.state = pipeline.backend.update(frame, relative)
            step = pipeline.backend.last_step()
        pipeline.correct(frame, initial, relative, step)
        pipeline.learn(frame, gate)
        self.last_scan = compensated.scan
        pose, covariance = pipeline.lidar_pose(pipeline.state)
        if self.keeps_record:
            with timed(seconds, "keyframes"):
                self._keyframes.offer(len(self._recorder), compensated.scan, pose)
        inertial = pipeline.inertial_state(pipeline.state)
        return self._keep(
            Estimate(
                frame.index, frame.scan.stamp_ns, pose, covariance, initial, relative, step, seconds, gate, inertial
            ),
            frame,
        )

    def record(self, scans: int | None = None) -> Record:
        """Return what smoothing and the run's files need of all scans so far, or of the first ``scans``.

        Raises:
            EstimationError: fewer than two frames have been estimated, or this odometry keeps no record.
        """
        if not self.keeps_record:
            raise EstimationError("this odometry keeps no record; make it with keep_record=True")
        return self._record(scans)

    def _record(self, scans: int | None = None) -> Record:
        pipeline = self._pipeline
        if pipeline is None or pipeline.start is None or pipeline.state is None:
            raise EstimationError("a record needs at least two frames; call step for more")
        keyframes = self._keyframes.keyframes()
        return self._recorder.record(pipeline.start, pipeline.calibration, pipeline.trust.noise, keyframes, scans)

    def state(self, row: int = 0) -> dict[str, Any] | None:
        """Return what :meth:`resume` needs besides the frames and estimates: the state of the front end.

        Args:
            row: return the loop keyframes among the estimates from this one on.

        Returns:
            Values for :func:`hybridlio.record.plain_values.encode`; None before the second estimate.
        """
        pipeline = self._pipeline
        if pipeline is None or pipeline.state is None:
            return None
        return {
            "residual": plain_values.state_of(pipeline.residual),
            "gate": plain_values.state_of(pipeline.gate),
            "start_search": None if pipeline.start_search is None else plain_values.state_of(pipeline.start_search),
            "late_start": pipeline.late_start,
            "late_noise": pipeline.late_noise,
            "keyframe_position": self._keyframes.last_position,
            "keyframes": self._keyframes.kept_since(row),
            "start": pipeline.start,
            "imu_noise": pipeline.imu_noise,
        }

    def resume(self, done: Iterable[tuple[Frame, Estimate]], state: Mapping[str, Any]) -> float:
        """Bring this new odometry to where another one with the same settings was.

        Backend and initial-pose source get all steps again, which takes a tenth to a fifth of the time that the run
        took: GTSAM cannot store iSAM2. The residual source and the gate continue from their stored state.

        Args:
            done: every frame so far, without points, and its estimate.
            state: of the other odometry after the last of these, by :meth:`state`, with all keyframes.

        Returns:
            The largest difference between a stored pose and the pose now, in metres and radians; 0 with the same
            processor and libraries.

        Raises:
            DataError: the state lacks a value or has one that is not known, as that of another version.
        """
        plain_values.check_names(state, _STATE_NAMES, "state")
        difference = 0.0
        for frame, estimate in done:
            if self._pipeline is None:
                self._pipeline = self._make_pipeline(frame)
                self._pipeline.late_noise = state["late_noise"]
            else:
                difference = max(difference, self._repeat(self._pipeline, frame, estimate))
            self._keep(estimate, frame)
        if self._pipeline is not None:
            plain_values.restore(self._pipeline.residual, state["residual"])
            plain_values.restore(self._pipeline.gate, state["gate"])
            restore_search(self._pipeline, state["start_search"])
            self._pipeline.late_start = state["late_start"]
        self._keyframes.restore(state["keyframes"], state["keyframe_position"])
        return difference

    def _repeat(self, pipeline: Pipeline, frame: Frame, estimate: Estimate) -> float:
        """Give a step to the backend and the initial-pose source again; return how far its pose is from the stored."""
        assert estimate.relative is not None
        frame = frame if estimate.gate.uses_imu else without_imu(frame)
        initial = pipeline.predict(frame, self._state_before(frame, pipeline))
        pipeline.state = pipeline.backend.update(frame, estimate.relative)
        pipeline.correct(frame, initial, estimate.relative, pipeline.backend.last_step())
        pipeline.learn(frame, estimate.gate)
        return float(np.abs(pipeline.lidar_pose(pipeline.state)[0] - estimate.pose).max())

    def _start(self, first: Frame) -> Pipeline:
        pipeline = self._make_pipeline(first)
        start_residual(pipeline)
        return pipeline

    def _make_pipeline(self, first: Frame) -> Pipeline:
        setup = Setup.from_frame(self._config, first)
        implementations = make_implementations(self.chosen, setup)
        return Pipeline(first, setup, *implementations)

    def _state_before(self, frame: Frame, pipeline: Pipeline) -> State:
        """Return the state at the last scan. Start the backend first, or restart it at the first IMU samples."""
        if pipeline.state is None:
            return start_backend(pipeline, frame)
        if len(frame.imu) and not pipeline.state.has_imu:
            return take_up_imu(pipeline, self._record(), frame)
        return pipeline.state

    def _keep(self, estimate: Estimate, frame: Frame) -> Estimate:
        """Add the estimate to the record and return it."""
        initial, relative = estimate.initial, estimate.relative
        step = None if initial is None or relative is None else (initial, relative)
        self._recorder.add(estimate.stamp_ns, estimate.pose, estimate.covariance, step, frame.imu, frame.gps)
        state = self.last_state
        if not self.keeps_record and state is not None and state.has_imu:  # an IMU that starts late needs all steps
            self._recorder.forget()
        return estimate


def _first_estimate(frame: Frame) -> Estimate:
    return Estimate(frame.index, frame.scan.stamp_ns, np.eye(4), _FIRST_COVARIANCE.copy(), None, None, None, {})
