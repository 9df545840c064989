"""One step of odometry, from a frame to a pose with covariance: initial pose, residual, graph."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace

import numpy as np

from hybridlio.cloud.deskew import compensation_noise, constant_twist, deskew, sweep_motion
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.estimates import Backend, InitialPoseSource, RelativePose, ResidualSource, State, TakesBack
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.core.setting_checks import check_positive
from hybridlio.core.start_state import start_state
from hybridlio.odometry.config import Config
from hybridlio.odometry.late_imu import take_up_imu
from hybridlio.odometry.registry import Setup, check_names, make_chosen
from hybridlio.record.loop_keyframes import LoopKeyframeSelector
from hybridlio.record.record import Record
from hybridlio.record.recorder import Recorder, concatenate_imu
from hybridlio.sources.innovation_gate import UNTESTED, GateResult, InnovationGate

_STARTS_WITHOUT_IMU = 3  # then the first step changes no more


@dataclass(frozen=True, eq=False)
class Estimate:
    """One step's outcome.

    Attributes:
        index, stamp_ns: the frame's.
        pose: ``(4, 4)`` lidar pose in the first scan's frame.
        covariance: ``(6, 6)`` of a right perturbation of ``pose``, rad² and m², rotation first.
        initial: the initial relative pose ``T̂``; None at the first frame.
        relative: the relative pose ``T = δT·T̂`` after the residual source; None at the first frame.
        step: the relative pose as the backend sees it after all; None at the first frame.
        seconds: time spent, by stage.
        gate: whether the residual source's pose and the IMU agree; ``relative`` is what passed the gate.
    """

    index: int
    stamp_ns: int
    pose: Array
    covariance: Array
    initial: RelativePose | None
    relative: RelativePose | None
    step: RelativePose | None
    seconds: dict[str, float]
    gate: GateResult = UNTESTED

    @property
    def residual(self) -> Array:
        """``δT`` ``(4, 4)``, by which the residual source moved the initial pose; the identity at the first frame."""
        if self.initial is None or self.relative is None:
            return np.eye(4)
        return np.asarray(self.relative.pose @ se3.inverse(self.initial.pose))


class Odometry:
    """Estimates poses frame by frame, in order.

    Args:
        initial_pose: name or object of an initial-pose source.
        residual: name or object of a residual source.
        backend: name or object of a backend.
        config: settings; names given as arguments go before those in it.

    Raises:
        ConfigError: a name is unknown.
    """

    def __init__(
        self,
        initial_pose: str | InitialPoseSource | None = None,
        residual: str | ResidualSource | None = None,
        backend: str | Backend | None = None,
        config: Config | None = None,
    ) -> None:
        config = config or Config()
        if not isinstance(config, Config):
            raise ConfigError(f"config must be a Config, got {config!r}; hybridlio.load_config reads one from a file")
        self._config = config
        self._chosen = (initial_pose or config.initial_pose, residual or config.residual, backend or config.backend)
        check_names(*self._chosen)
        self._state: State | None = None
        self._first: Frame | None = None
        self._made = Recorder()
        self._keyframes = LoopKeyframeSelector(config.keyframes)

    def step(self, frame: Frame) -> Estimate:
        """Estimate the frame's pose.

        Raises:
            DataError: frames out of order, or a first scan without points.
            ConfigError: IMU samples without extrinsics, or a source that cannot be made as it is set.
        """
        if frame.calibration is None and len(frame.imu):
            raise ConfigError(
                f"frame {frame.index} carries IMU samples but no calibration: set Frame.calibration (T_imu_lidar)"
            )
        if self._first is None:
            return self._keep(self._begin(frame), frame)
        if frame.scan.stamp_ns <= self._made.last_ns:
            raise DataError(f"frame {frame.index}: its stamp is not after the last frame's; give frames in order")
        state = self._state if self._state is not None else self._start(frame)
        if self._state is not None and not state.has_imu and len(frame.imu):
            state = self._take_up_imu(frame, state)
        seconds: dict[str, float] = {}
        with _timed(seconds, "initial pose"):
            initial = _answer(self._initial_pose.predict(frame, state), self._initial_pose)
        relative = self._refine(frame, initial, state, seconds)
        if self._state is None and relative.ok:
            relative = self._restart(self._first, frame, relative, state)
        with _timed(seconds, "graph"):
            relative, gate = self._compare(frame, initial, relative, state)
            self._state = self._backend.update(frame, relative)
            step = self._backend.last_step()
        if relative.ok and relative.source != initial.source:  # its own guess is nothing to learn from
            self._initial_pose.correct(frame, step)
        pose, covariance = self._lidar_pose(self._state)
        with _timed(seconds, "keyframes"):
            self._keyframes.offer(len(self._made), self._compensated, pose)
        return self._keep(
            Estimate(frame.index, frame.scan.stamp_ns, pose, covariance, initial, relative, step, seconds, gate),
            frame,
        )

    def record(self, scans: int | None = None) -> Record:
        """Everything so far, or the first ``scans`` of it, for smoothing and for files.

        Raises:
            EstimationError: there are fewer than two frames yet.
        """
        if self._state is None:
            raise EstimationError("a record needs at least two frames; call step for more")
        setup = self._setup
        keyframes = self._keyframes.keyframes()
        return self._made.record(self._start_state, setup.calibration, setup.imu_noise, keyframes, scans)

    def _begin(self, frame: Frame) -> Estimate:
        """Take the first frame: it defines the origin."""
        self._setup = _setup(self._config, frame)
        self._initial_pose, self._residual, self._backend = make_chosen(self._chosen, self._setup)
        self._gate = InnovationGate()
        self._residual.start(self._turned_back(frame))
        self._first = frame
        covariance = np.eye(6) * 1e-12  # it defines the frame; GTSAM and files want it positive definite
        return Estimate(frame.index, frame.scan.stamp_ns, np.eye(4), covariance, None, None, None, {})

    def _turned_back(self, first: Frame) -> Frame:
        """The first frame with its sweep's turn taken out, which is known where the speed is not.

        The second scan is compensated for no more by its first initial pose. Scans that the same speed has distorted
        fit; one with its turn and one without end centimetres and milliradians off.
        """
        if first.scan.time_offsets_ns is None:
            return first
        standing = constant_twist(np.eye(4), first.scan.stamp_ns - NS_PER_S, first.scan.stamp_ns)
        motion = sweep_motion(first, standing, np.zeros(3), self._setup.calibration)
        return replace(first, scan=deskew(first.scan, motion))

    def _start(self, frame: Frame) -> State:
        """Start the graph at the first frame, with the second one's samples to tell where down is."""
        first = self._first
        assert first is not None
        near = ImuSamples.empty() if not len(first.imu) else first.imu.between(
            first.scan.stamp_ns - 10**9, first.scan.stamp_ns
        )  # fmt: skip
        self._start_state = start_state(first.scan.stamp_ns, concatenate_imu([near, frame.imu]), self._setup.imu_noise)
        self._backend.start(self._start_state)
        return self._start_state

    def _take_up_imu(self, frame: Frame, state: State) -> State:
        """Start the graph again, once there are samples to tell where down is."""
        self._start_state, self._state = take_up_imu(self._backend, self.record(), frame, state)
        return self._state

    def _refine(self, frame: Frame, initial: RelativePose, state: State, seconds: dict[str, float]) -> RelativePose:
        """Compensate the scan's motion, where its points carry times, and refine the initial pose."""
        turned = None
        with _timed(seconds, "motion compensation"):
            if frame.scan.time_offsets_ns is not None:
                turned = compensation_noise(frame, self._setup.imu_noise)
                step = constant_twist(initial.pose, state.stamp_ns, frame.scan.stamp_ns)
                motion = sweep_motion(frame, step, state.gyro_bias_rad_s, self._setup.calibration)
                frame = replace(frame, scan=deskew(frame.scan, motion))
        self._compensated = frame.scan
        with _timed(seconds, "residual"):
            relative = _answer(self._residual.refine(frame, initial), self._residual)
        return relative if turned is None or not relative.ok else relative.wider(added=turned)

    def _compare(
        self, frame: Frame, initial: RelativePose, measured: RelativePose, state: State
    ) -> tuple[RelativePose, GateResult]:
        """Down-weight or reject what the IMU contradicts."""
        predicted = self._setup.inertial_steps.predicted(frame, state) if state.has_imu else None
        relative, gate = self._gate.apply(measured, predicted, initial)
        if gate.verdict == "rejected" and isinstance(self._residual, TakesBack):
            self._residual.take_back(initial)
        return relative, gate

    def _restart(self, first: Frame, frame: Frame, found: RelativePose, state: State) -> RelativePose:
        """Do the first step again: only now is it known how fast the first two scans moved.

        Without IMU the turn, too, was looked for among a few at first; from about the right one the search gets better,
        and so does the compensation.
        """
        compensated = first.scan.time_offsets_ns is not None
        for _ in range(int(compensated) if state.has_imu else _STARTS_WITHOUT_IMU):
            step = constant_twist(found.pose, first.scan.stamp_ns, frame.scan.stamp_ns)
            motion = sweep_motion(first, step, state.gyro_bias_rad_s, self._setup.calibration)
            self._residual.start(replace(first, scan=deskew(first.scan, motion)))
            found = self._refine(frame, found, state, {})
            if not found.ok:
                break
        return found

    def _lidar_pose(self, state: State) -> tuple[Array, Array]:
        T_imu_lidar = self._setup.calibration.T_imu_lidar
        T_lidar_imu = se3.inverse(T_imu_lidar)
        covariance = se3.rotate_covariance(state.covariance[:6, :6], T_lidar_imu)
        return T_lidar_imu @ state.T_world_imu @ T_imu_lidar, covariance

    def _keep(self, estimate: Estimate, frame: Frame) -> Estimate:
        initial, relative = estimate.initial, estimate.relative
        step = None if initial is None or relative is None else (initial, relative)
        self._made.add(estimate.stamp_ns, estimate.pose, estimate.covariance, step, frame.imu, frame.gps)
        return estimate


def _setup(config: Config, frame: Frame) -> Setup:
    noise = config.imu_noise or frame.imu_noise or ImuNoise()
    check_positive(noise, *(field.name for field in fields(noise)))  # an IMU without noise is a simulator's only
    return Setup(config, frame.calibration or Calibration(), noise)


def _answer(found: RelativePose, source: InitialPoseSource | ResidualSource) -> RelativePose:
    """What a source of somebody's own answered, if it is what it should be."""
    if not isinstance(found, RelativePose):
        raise ConfigError(
            f"the source {source.name!r} must answer with a RelativePose, not with {type(found).__name__}"
        )
    return found


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start
