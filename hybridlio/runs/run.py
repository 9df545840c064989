"""The loop: a sequence through an odometry, from the first scan to the last or to where it is stopped."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.packed_arrays import PackedList
from hybridlio.core.sensors import NS_PER_S, Frame
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.evaluate import Steps
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Estimate, Odometry
from hybridlio.record.record import Record
from hybridlio.sources.innovation_gate import GATE_NIS, Verdict

_log = logging.getLogger(__name__)

Progress = Callable[[int, int, float], None]

_CLOCKS_APART_NS = 30 * NS_PER_S  # GPS time and UTC are 18 s apart
_TOLD = 3  # scans that a run cannot start at, by warnings
_FROM_IMU, _WITHOUT_IMU = "preintegration", "constant-velocity"


@dataclass(eq=False)
class Run:
    """What a run came to, whole or up to where it stopped.

    Attributes:
        sequence: the recording.
        odometry: in the state it was left in.
        estimates: one for each scan from the first usable one on.
        skipped: scans before that one.
        unreadable: why, by frame, where a scan could not be read or not be started at; bridged where there is an
            estimate before.
        reading_s: seconds spent reading, one for each estimate.
        seconds: wall time of the whole loop.
        stopped: what stopped the run before its end, such as a KeyboardInterrupt; None for a whole one.
        points_before: of the last scan that was read.
    """

    sequence: Sequence
    odometry: Odometry
    estimates: PackedList[Estimate] | list[Estimate] = field(default_factory=PackedList)
    skipped: int = 0
    unreadable: dict[int, str] = field(default_factory=dict)
    reading_s: list[float] = field(default_factory=list)
    seconds: float = 0.0
    stopped: BaseException | None = None
    points_before: NDArray[np.float32] | None = field(default=None, repr=False)

    @property
    def done(self) -> int:
        """Scans dealt with, those before the first usable one too."""
        return self.skipped + len(self.estimates) if self.estimates else 0

    @property
    def trajectory(self) -> Trajectory:
        """The estimates, in the first usable scan's frame, with covariances."""
        estimates = list(self.estimates)
        return Trajectory(
            np.array([e.stamp_ns for e in estimates]),
            np.array([e.pose for e in estimates]).reshape(-1, 4, 4),
            np.array([e.covariance for e in estimates]).reshape(-1, 6, 6),
        )

    @property
    def stamps_before(self) -> NDArray[np.int64]:
        """``(skipped,)`` stamps of the scans before the first usable one."""
        return self.sequence.stamps_ns[: self.skipped]

    @property
    def steps(self) -> Steps:
        """The backend's motions from estimate to estimate."""
        steps = [e.step for e in self.estimates if e.step is not None]
        return Steps(
            np.array([s.pose for s in steps]).reshape(-1, 4, 4),
            np.array([s.covariance for s in steps]).reshape(-1, 6, 6),
        )

    @property
    def initial_poses(self) -> Array:
        """Initial relative poses ``(N-1, 4, 4)`` of the ``N`` estimates."""
        return np.array([e.initial.pose for e in self.estimates if e.initial is not None]).reshape(-1, 4, 4)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """``(N-1,)``; False where the residual source failed and the initial pose bridges."""
        return np.array([e.relative.ok for e in self.estimates if e.relative is not None], dtype=bool)

    @property
    def degenerate(self) -> NDArray[np.bool_]:
        """``(N-1,)``; True where the scan left a direction unconstrained."""
        return np.array([len(e.relative.degenerate) > 0 for e in self.estimates if e.relative is not None], dtype=bool)

    @property
    def bridged(self) -> list[int]:
        """The frames of which :attr:`ok` is False."""
        return (np.flatnonzero(~self.ok) + self.skipped + 1).tolist()

    def judged(self, verdict: Verdict) -> list[int]:
        """The frames whose relative pose came off so in the comparison with the IMU."""
        return [self.skipped + k for k, e in enumerate(self.estimates) if e.gate.verdict == verdict]

    @property
    def timings_s(self) -> dict[str, Array]:
        """Seconds by stage, one for each estimate after the first; reading the scan is a stage."""
        seconds = [e.seconds for e in islice(self.estimates, 1, None)]
        stages = dict.fromkeys(stage for spent in seconds for stage in spent)
        spent = {stage: np.array([one.get(stage, 0.0) for one in seconds]) for stage in stages}
        return {"reading": np.array(self.reading_s[1:]), **spent} if spent else {}

    @property
    def record(self) -> Record | None:
        """What smoothing needs, with fixes that another clock may have stamped; None for less than two estimates."""
        if len(self.estimates) < 2:
            return None
        record = self.odometry.record(len(self.estimates))  # an interrupt may have left it one scan ahead
        begin, end = (int(stamp) for stamp in record.online.stamps_ns[[0, -1]])
        near = (fix for fix in self.sequence.gps if begin - _CLOCKS_APART_NS <= fix.stamp_ns <= end + _CLOCKS_APART_NS)
        return replace(record, gps=tuple(near))


def run_odometry(sequence: Sequence, odometry: Odometry, progress: Progress | None = None) -> Run:
    """Give every frame of a sequence to an odometry.

    A scan that cannot be read is bridged as one of no points is, with a warning. What stops the run is kept in
    :attr:`Run.stopped` rather than raised, so that what was estimated before is not lost.

    Args:
        sequence: the recording.
        odometry: a fresh one.
        progress: called after each scan with scans done, scans in all and metres travelled.
    """
    run = Run(sequence, odometry)
    _log.info(
        "%s: %d scans in %.1f s, %d IMU samples", sequence.name, len(sequence), sequence.duration_s, len(sequence.imu)
    )
    start = time.perf_counter()
    distance_m = 0.0
    try:
        for k in range(len(sequence)):
            _advance(run, k)
            if len(run.estimates) > 1:
                last = run.estimates[-2].pose[:3, 3], run.estimates[-1].pose[:3, 3]
                distance_m += float(np.linalg.norm(last[1] - last[0]))
            if progress is not None:
                progress(k + 1, len(sequence), distance_m)
        if not run.estimates:
            raise DataError(f"{sequence.name}: no scan to start at; the first: {next(iter(run.unreadable.values()))}")
    except (KeyboardInterrupt, Exception) as error:
        run.stopped = error
    run.seconds = time.perf_counter() - start
    return run


def _advance(run: Run, k: int) -> None:
    """Read frame ``k`` and estimate it; before the first estimate a frame that cannot be started at is skipped."""
    start = time.perf_counter()
    frame = _frame(run, k)
    read = time.perf_counter() - start
    try:
        if not run.estimates and k in run.unreadable:
            raise DataError(run.unreadable[k])
        estimate = run.odometry.step(frame)
    except DataError as error:
        if run.estimates:
            raise
        run.unreadable[k] = str(error)
        run.skipped += 1
        level = logging.WARNING if run.skipped <= _TOLD else logging.INFO
        more = "; -v tells of more scans like this" if run.skipped == _TOLD else ""
        _log.log(level, "cannot start here, trying the next: %s%s", error, more)
        return
    run.reading_s.append(read)
    run.estimates.append(estimate)
    if estimate.gate.verdict in ("down-weighted", "rejected", "relocated"):
        nis, verdict = estimate.gate.nis, estimate.gate.verdict
        _log.info("frame %d: %s: innovation against the IMU has χ² = %.0f (gate %.0f)", k, verdict, nis, GATE_NIS)
    elif estimate.relative is not None and not estimate.relative.ok and k not in run.unreadable:
        _log.info("frame %d: bridged by the initial pose: %s", k, _why(estimate.relative.details))
    _log.debug("frame %d: %s", k, _described(estimate))


def _why(details: Mapping[str, float]) -> str:
    points = f"{details.get('points', 0.0):.0f} points"
    return f"{details['matched']:.0%} of {points} match" if "matched" in details else f"{points} to match"


def _described(estimate: Estimate) -> str:
    relative = estimate.relative
    if relative is None:
        return "the first"
    words = [f"{relative.source}{'' if relative.ok else ' (bridged)'}"]
    words += [f"{len(relative.degenerate)} directions unconstrained"] if len(relative.degenerate) else []
    words += [f"{name} {value:.4g}" for name, value in relative.details.items()]
    return ", ".join(words + [f"{stage} {1e3 * spent:.0f} ms" for stage, spent in estimate.seconds.items()])


def _frame(run: Run, k: int) -> Frame:
    try:
        frame = run.sequence[k]
        before, run.points_before = run.points_before, frame.scan.points
        if len(frame.scan) and before is not None and np.array_equal(frame.scan.points, before):
            raise DataError("its points are those of the scan before, to the last bit")  # delivered twice
        return frame
    except DataError as error:
        run.unreadable[k] = str(error)
        if run.estimates:
            _log.warning("frame %d: bridged by the initial pose: %s", k, error)
        return run.sequence.without_scan(k)


def suited_to(sequence: Sequence, config: Config, as_asked: bool = False) -> Config:
    """The configuration, with an initial pose that needs no inertial data where the recording has none.

    Args:
        sequence: the recording.
        config: the settings.
        as_asked: they are somebody's choice, and stay.

    Raises:
        DataError: preintegration was chosen, and there is nothing to integrate.
    """
    if len(sequence.imu) or (as_asked and config.initial_pose != _FROM_IMU):
        return config
    if as_asked:
        raise DataError(
            f"{sequence.name}: no IMU samples for initial poses by {_FROM_IMU}; choose another, such as {_WITHOUT_IMU}"
        )
    _log.warning("%s: no inertial data, so initial poses by %s", sequence.name, _WITHOUT_IMU)
    return config.model_copy(update={"initial_pose": _WITHOUT_IMU})
