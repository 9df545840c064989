"""Odometry of live data: measurements go in as they come, estimates come out when they are ready."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType

from numpy.typing import ArrayLike

from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.frame_assembly import FrameAssembler
from hybridlio.odometry.measurement_checks import check_wait, checked_fix, checked_scan, checked_stamp, checked_vector
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.pose_prediction import LatestPrediction, PredictedPose
from hybridlio.odometry.stream_counts import StreamCounts
from hybridlio.odometry.warm_up import warm_up
from hybridlio.record.record import Record

_log = logging.getLogger(__name__)

_LONGEST_BEHIND_NS = NS_PER_S  # beyond the lag: a robot that drives by poses older than this is blind


class OdometryStream:
    """Odometry within a program of your own, such as a robot's node.

    Measurements are added as they come, in any order across sensors. A scan is estimated when an IMU sample at or after
    its last point has come, so the estimates are those of the same data from a file, bit for bit.

    Without ``on_estimate``, :meth:`add_scan`, :meth:`add_imu` and :meth:`add_fix` estimate in the calling thread and
    return the estimates that the call made ready. With it, they return at once and an empty list; a thread of the
    stream estimates and calls ``on_estimate``, also in order. If it is too slow, it skips the oldest waiting scans
    rather than fall more than a second (and the lag) behind.

    All methods may be called from several threads. Memory is bounded, unless ``odometry`` keeps a record. A stream
    whose estimation failed raises the error again at every further call. The first stream takes seconds to load.

    Args:
        calibration: the extrinsics; None if there is no IMU. Scans then wait for nothing.
        odometry: a new one, to choose sources and settings or to keep a record for smoothing; by default
            ``Odometry(keep_record=False)``.
        on_estimate: called with each estimate by the stream's thread.
        imu_noise: the IMU's noise densities, unless the odometry's configuration gives them; by default those of a
            MEMS unit.
        lag_s: how long a scan waits for IMU samples, on the clock of the stamps. Then it is estimated with those that
            have come, and counted (``without_imu``).
        reorder_s: by how much stamps of one sensor may step back. Every scan waits so much longer.

    Raises:
        ConfigError: ``lag_s`` or ``reorder_s`` is not between 0 and 30 s.
    """

    def __init__(
        self,
        calibration: Calibration | None,
        odometry: Odometry | None = None,
        on_estimate: Callable[[Estimate], object] | None = None,
        *,
        imu_noise: ImuNoise | None = None,
        lag_s: float = 0.5,
        reorder_s: float = 0.0,
    ) -> None:
        check_wait("lag_s", lag_s)
        check_wait("reorder_s", reorder_s)
        if calibration is not None and not isinstance(calibration, Calibration):
            raise ConfigError(f"OdometryStream: calibration must be a Calibration or None, got {calibration!r:.40}")
        if odometry is None:
            initial_pose = "constant-velocity" if calibration is None else None
            odometry = Odometry(initial_pose=initial_pose, keep_record=False)
        warm_up(odometry)
        self.odometry = odometry
        self._calibration, self._on_estimate = calibration, on_estimate
        self._lag_ns, reorder_ns = round(lag_s * NS_PER_S), round(reorder_s * NS_PER_S)
        self._longest_behind_ns = self._lag_ns + reorder_ns + _LONGEST_BEHIND_NS
        self._frames = FrameAssembler(calibration, imu_noise, self._lag_ns, reorder_ns)
        self._changed = threading.Condition()  # guards everything but the odometry
        self._estimating = threading.Lock()  # guards the odometry; taken before _changed
        self._prediction = LatestPrediction(odometry, calibration or Calibration(), self._frames.imu)
        self._flushing = self._busy = self._closed = False
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None
        if on_estimate is not None:
            self._thread = threading.Thread(target=self._work, name="hybridlio stream", daemon=True)
            self._thread.start()

    def add_imu(self, stamp_ns: int, gyro_rad_s: ArrayLike, accel_m_s2: ArrayLike) -> list[Estimate]:
        """Add one IMU sample.

        Args:
            stamp_ns: its time.
            gyro_rad_s: ``(3,)`` angular velocity in the IMU frame.
            accel_m_s2: ``(3,)`` specific force in the IMU frame; at rest +9.81 on the axis that points up.

        Returns:
            The estimates that it made ready.

        Raises:
            DataError: a value is not finite or has another shape, or the stamp is over 10 s before the last estimate.
                The stream is then unchanged.
            ConfigError: the stream was made without extrinsics, or is closed.
        """
        stamp_ns = checked_stamp(stamp_ns, "IMU sample")
        if self._calibration is None:
            raise ConfigError("add_imu: the stream was made without an IMU; give its calibration (T_imu_lidar)")
        values = (
            *checked_vector(gyro_rad_s, stamp_ns, "gyro_rad_s"),
            *checked_vector(accel_m_s2, stamp_ns, "accel_m_s2"),
        )
        return self._add(lambda: self._frames.add_imu(stamp_ns, values))

    def add_scan(self, stamp_ns: int, points: ArrayLike, time_offsets_ns: ArrayLike | None = None) -> list[Estimate]:
        """Add one scan; the arrays are copied.

        Args:
            stamp_ns: the time to which motion compensation moves the points.
            points: ``(N, 3)`` in the lidar frame, metres; rows that are not finite are left out.
            time_offsets_ns: ``(N,)`` integers, each point's time minus ``stamp_ns``; None if the scan needs no motion
                compensation.

        Returns:
            The estimates that it made ready.

        Raises:
            DataError: an array has another shape or type, points are over 1 s from the stamp, or the stamp is over 10 s
                before the last estimate. The stream is then unchanged.
            ConfigError: the stream is closed.
        """
        scan = checked_scan(stamp_ns, points, time_offsets_ns)
        return self._add(lambda: self._frames.add_scan(scan))

    def add_fix(
        self, stamp_ns: int, position_m: ArrayLike, covariance_m2: ArrayLike, origin: GeodeticPoint | None = None
    ) -> list[Estimate]:
        """Add one GPS fix, for the next frame and for the record, if one is kept.

        hybridlio's own backends use fixes after the run alone; a backend of yours finds them in ``Frame.gps``.

        Args:
            stamp_ns: its time.
            position_m: ``(3,)`` of the antenna in a local east-north-up frame, the same for all fixes.
            covariance_m2: ``(3, 3)``.
            origin: geodetic position of that frame's origin.

        Raises:
            DataError: as :meth:`add_imu`.
            ConfigError: the stream is closed.
        """
        fix = checked_fix(stamp_ns, position_m, covariance_m2, origin)
        return self._add(lambda: self._frames.add_fix(fix))

    def predict(self, stamp_ns: int) -> PredictedPose:
        """Return the pose at a time after the last estimate, by the IMU samples since.

        It takes some 0.1 ms, so it may be called at the IMU's rate. Where the newest sample is over
        0.25 s before the stamp, and without an IMU, the last step's velocity continues.

        Raises:
            EstimationError: there are not two estimates yet.
            DataError: the stamp is before the last estimate, or no integer.
        """
        with self._changed:
            return self._prediction.pose_at(checked_stamp(stamp_ns, "predict"))

    @property
    def counts(self) -> StreamCounts:
        """What became of the data so far."""
        with self._changed:
            counts = self._frames.counts
            left = counts.estimates + counts.late_scans + counts.skipped_scans + counts.unusable_scans
            return replace(counts, waiting_scans=counts.scans - left)

    def record(self) -> Record:
        """As :meth:`Odometry.record`, with all fixes so far; those after the last scan can show a clock's offset."""
        with self._estimating, self._changed:
            record = self.odometry.record()
            fixes = [*record.gps, *self._frames.fixes]
            return replace(record, gps=tuple(sorted(fixes, key=lambda fix: fix.stamp_ns)))

    def flush(self) -> list[Estimate]:
        """Estimate all scans that wait, without more IMU samples; return their estimates, if not to ``on_estimate``."""
        if self._thread is None:
            return self._estimate_ready(everything=True)
        if threading.current_thread() is self._thread:
            raise ConfigError("flush: not within on_estimate, which would wait for itself")
        with self._changed:
            self._flushing = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._failure or not (self._frames.waiting() or self._busy))
            self._flushing = False
            self._raise_failure()
        return []

    def close(self) -> list[Estimate]:
        """Flush, and take no more data."""
        try:
            return [] if self._closed else self.flush()
        finally:
            self._stop()

    def __enter__(self) -> OdometryStream:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is not None:
            self._stop()
        elif lost := self.close():
            _log.warning("the last %d estimates were not taken; call flush before the stream closes", len(lost))

    def _stop(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None and threading.current_thread() is not self._thread:
            self._thread.join()

    def _add(self, add: Callable[[], None]) -> list[Estimate]:
        with self._changed:
            self._raise_failure()
            if self._closed:
                raise ConfigError("the stream is closed; make a new one")
            add()
            self._prediction.advance()
            if self._thread is not None:
                if self._frames.waiting():
                    self._frames.skip_scans(self._longest_behind_ns)
                self._changed.notify_all()
                return []
            if not self._frames.has_frame(everything=False):
                return []
        return self._estimate_ready()

    def _estimate_ready(self, everything: bool = False) -> list[Estimate]:
        """Estimate what is ready, in the calling thread."""
        done: list[Estimate] = []
        with self._estimating:
            while True:
                with self._changed:
                    self._raise_failure()
                    frame = self._frames.next_frame(everything)
                if frame is None:
                    return done
                try:
                    estimate = self._step(frame)
                except Exception as error:
                    self._fail(error)
                    raise
                done += [] if estimate is None else [estimate]

    def _work(self) -> None:
        """Estimate in the stream's thread until the stream is closed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._frames.has_frame(self._flushing))
                frame = None if self._closed else self._frames.next_frame(self._flushing)
                self._busy = frame is not None
            if frame is None:
                return
            try:
                with self._estimating:
                    estimate = self._step(frame)
                if estimate is not None and self._on_estimate is not None:
                    self._on_estimate(estimate)
            except Exception as error:
                self._fail(error)
                return
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _step(self, frame: Frame) -> Estimate | None:
        """Estimate one frame; None if the run cannot start at its scan."""
        try:
            estimate = self.odometry.step(frame)
        except DataError as error:
            if self._prediction.estimate is not None:
                raise
            with self._changed:
                self._frames.counts.unusable_scans += 1
            _log.warning("cannot start at this scan, trying the next: %s", error)
            return None
        with self._changed:
            self._frames.counts.estimates += 1
            self._prediction.restart(estimate)
        return estimate

    def _fail(self, error: Exception) -> None:
        with self._changed:
            self._failure, self._busy = error, False
            self._changed.notify_all()
        _log.error("the stream stopped: %s", error)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise EstimationError(f"the stream stopped at an earlier error: {self._failure}") from self._failure
