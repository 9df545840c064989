"""The main loop: run an odometry over a sequence, from the first usable scan until the end or an interrupt."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import NS_PER_S, Frame
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.evaluate import Steps
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate, steps_of, trajectory_of
from hybridlio.record.packed_arrays import PackedList
from hybridlio.record.record import Record
from hybridlio.sources.gate.gate_result import GATE_NIS, Verdict

_log = logging.getLogger(__name__)

_MAX_CLOCK_OFFSET_NS = 30 * NS_PER_S  # more than the 18 s between GPS time and UTC
_MAX_START_WARNINGS = 3  # enough to see why; later unusable scans are logged as information
_FROM_IMU, _WITHOUT_IMU = "preintegration", "constant-velocity"


class FrameByFrame(Protocol):
    """What a run needs of its odometry; :class:`hybridlio.Odometry` provides it."""

    def step(self, frame: Frame) -> Estimate:
        """Estimate the frame's pose."""
        ...

    def record(self, scans: int | None = None) -> Record:
        """Return what smoothing needs of all scans so far, or of the first ``scans``."""
        ...

    def state(self, row: int = 0) -> dict[str, Any] | None:
        """Return what another odometry needs to go on, with the loop keyframes from ``row`` on."""
        ...

    def resume(self, done: Iterable[tuple[Frame, Estimate]], state: Mapping[str, Any]) -> float:
        """Go on from there; return by how much the poses differ."""
        ...


class Keeps(Protocol):
    """What keeps a run on the disk while it goes; :class:`hybridlio.runs.unfinished.keeper.Keeper`."""

    def see(self, frame: Frame) -> None:
        """Take the frame that is estimated next."""
        ...

    def after_scan(self) -> None:
        """Write what is due."""
        ...


class Watches(Protocol):
    """What shows a run while it goes; :class:`hybridlio.viewing.rerun_live.LiveView`."""

    def after_scan(self) -> None:
        """Show what is new."""
        ...


@dataclass(eq=False)
class Run:
    """A run over a sequence, complete or up to where it stopped.

    Attributes:
        sequence: the recording.
        odometry: the odometry, in its last state.
        estimates: one per scan, from the first usable scan on.
        skipped: number of scans before the first usable one.
        unreadable: by frame, why a scan could not be read or the run could not start at it. Such a scan is bridged
            by the initial pose, or skipped before the first estimate.
        reading_s: seconds spent reading, one per estimate.
        seconds: wall time of the loop, and before a kill.
        stopped: the error or KeyboardInterrupt that stopped the run early, or None.
        last_points: ``(N, 3)`` points of the last scan read, to detect a scan that is delivered twice.
    """

    sequence: Sequence
    odometry: FrameByFrame
    estimates: PackedList[Estimate] | list[Estimate] = field(default_factory=PackedList)
    skipped: int = 0
    unreadable: dict[int, str] = field(default_factory=dict)
    reading_s: list[float] = field(default_factory=list)
    seconds: float = 0.0
    stopped: BaseException | None = None
    last_points: NDArray[np.float32] | None = field(default=None, repr=False)

    @property
    def done(self) -> int:
        """Number of scans processed, including those before the first usable one."""
        return self.skipped + len(self.estimates) if self.estimates else 0

    @property
    def trajectory(self) -> Trajectory:
        """The estimated poses, in the frame of the first usable scan, with covariances."""
        return trajectory_of(self.estimates)

    @property
    def stamps_before(self) -> NDArray[np.int64]:
        """``(skipped,)`` stamps of the scans before the first usable one."""
        return self.sequence.stamps_ns[: self.skipped]

    @property
    def steps(self) -> Steps:
        """The relative poses between estimates, as the backend has them."""
        return steps_of(self.estimates)

    @property
    def initial_poses(self) -> Array:
        """Initial relative poses ``(N-1, 4, 4)`` of the ``N`` estimates."""
        return np.array([e.initial.pose for e in self.estimates if e.initial is not None]).reshape(-1, 4, 4)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """``(N-1,)``; False where the residual source failed and the initial pose is used instead."""
        return np.array([e.relative.ok for e in self.estimates if e.relative is not None], dtype=bool)

    @property
    def degenerate(self) -> NDArray[np.bool_]:
        """``(N-1,)``; True where the scan does not constrain every direction."""
        return np.array([len(e.relative.degenerate) > 0 for e in self.estimates if e.relative is not None], dtype=bool)

    @property
    def bridged(self) -> list[int]:
        """The frames where :attr:`ok` is False: bridged by the initial pose."""
        return (np.flatnonzero(~self.ok) + self.skipped + 1).tolist()

    def frames_with(self, verdict: Verdict) -> list[int]:
        """Return the frames with this verdict of the innovation gate, which compares scan and IMU."""
        return [self.skipped + k for k, e in enumerate(self.estimates) if e.gate.verdict == verdict]

    @property
    def timings_s(self) -> dict[str, Array]:
        """Seconds by stage, including reading; one per estimate after the first."""
        seconds = [e.seconds for e in islice(self.estimates, 1, None)]
        stages = dict.fromkeys(stage for spent in seconds for stage in spent)
        spent = {stage: np.array([one.get(stage, 0.0) for one in seconds]) for stage in stages}
        return {"reading": np.array(self.reading_s[1:]), **spent} if spent else {}

    @property
    def record(self) -> Record | None:
        """The input of smoothing; None for fewer than two estimates.

        GPS fixes shortly before and after the run are included, as their clock may be offset.
        """
        if len(self.estimates) < 2:
            return None
        record = self.odometry.record(
            len(self.estimates)
        )  # an interrupt can leave the odometry one scan ahead of the list
        begin, end = (int(stamp) for stamp in record.online.stamps_ns[[0, -1]])
        near = (
            fix
            for fix in self.sequence.gps
            if begin - _MAX_CLOCK_OFFSET_NS <= fix.stamp_ns <= end + _MAX_CLOCK_OFFSET_NS
        )
        return replace(record, gps=tuple(near))


def run_odometry(
    sequence: Sequence, odometry: FrameByFrame, progress: Progress | None = None, keeper: Keeps | None = None
) -> Run:
    """Run an odometry over all frames of a sequence.

    A scan that cannot be read is bridged by the initial pose, with a warning. An error or interrupt that stops the
    run is returned in :attr:`Run.stopped`, not raised, so that the estimates before it are kept.

    Args:
        sequence: the recording.
        odometry: a new odometry.
        progress: called after each scan with the distance travelled (``12.3 m``), scans done and scans in all.
        keeper: keeps the estimates on the disk.
    """
    return finish_run(Run(sequence, odometry), progress, keeper)


def finish_run(
    run: Run, progress: Progress | None = None, keeper: Keeps | None = None, watcher: Watches | None = None
) -> Run:
    """Run the rest of a run; see :func:`run_odometry`."""
    sequence = run.sequence
    _log.info(
        "%s: %d scans in %.1f s, %d IMU samples", sequence.name, len(sequence), sequence.duration_s, len(sequence.imu)
    )
    start = time.perf_counter() - run.seconds
    distance_m = run.trajectory.length_m if run.estimates else 0.0
    try:
        for k in range(run.done, len(sequence)):
            _advance(run, k, keeper)
            run.seconds = time.perf_counter() - start
            if keeper is not None:
                keeper.after_scan()
            if watcher is not None:
                watcher.after_scan()
            if len(run.estimates) > 1:
                last = run.estimates[-2].pose[:3, 3], run.estimates[-1].pose[:3, 3]
                distance_m += float(np.linalg.norm(last[1] - last[0]))
            if progress is not None:
                progress(f"{distance_m:.1f} m", k + 1, len(sequence))
        if not run.estimates:
            raise DataError(f"{sequence.name}: no usable scan; the first: {next(iter(run.unreadable.values()))}")
    except (KeyboardInterrupt, Exception) as error:
        run.stopped = error
    run.seconds = time.perf_counter() - start
    return run


def _advance(run: Run, k: int, keeper: Keeps | None) -> None:
    """Read frame ``k`` and estimate its pose. Before the first estimate, an unusable frame is skipped."""
    start = time.perf_counter()
    frame = _read_frame(run, k)
    read_s = time.perf_counter() - start
    if keeper is not None:
        keeper.see(frame)
    try:
        if not run.estimates and k in run.unreadable:
            raise DataError(run.unreadable[k])
        estimate = run.odometry.step(frame)
    except DataError as error:
        if run.estimates:
            raise
        run.unreadable[k] = str(error).removeprefix(f"frame {k}: ")
        run.skipped += 1
        level = logging.WARNING if run.skipped <= _MAX_START_WARNINGS else logging.INFO
        more = "; further scans like this are logged with -v" if run.skipped == _MAX_START_WARNINGS else ""
        _log.log(level, "cannot start at this scan, trying the next: %s%s", error, more)
        return
    run.reading_s.append(read_s)
    run.estimates.append(estimate)
    nis, verdict = estimate.gate.nis, estimate.gate.verdict
    if nis is not None and nis > GATE_NIS:
        _log.info("frame %d: %s: innovation against the IMU has χ² = %.0f (gate %.0f)", k, verdict, nis, GATE_NIS)
    elif estimate.relative is not None and not estimate.relative.ok and k not in run.unreadable:
        _log.info("frame %d: bridged by the initial pose: %s", k, _bridging_reason(estimate.relative.details))
    _log.debug("frame %d: %s", k, _describe(estimate))


def _bridging_reason(details: Mapping[str, float]) -> str:
    points = f"{details.get('points', 0.0):.0f} points"
    return f"{details['matched']:.0%} of {points} match" if "matched" in details else f"{points} to match"


def _describe(estimate: Estimate) -> str:
    relative = estimate.relative
    if relative is None:
        return "first estimate"
    words = [f"{relative.source}{'' if relative.ok else ' (bridged)'}"]
    words += [f"{len(relative.degenerate)} directions unconstrained"] if len(relative.degenerate) else []
    words += [f"{name} {value:.4g}" for name, value in relative.details.items()]
    return ", ".join(words + [f"{stage} {1e3 * spent:.0f} ms" for stage, spent in estimate.seconds.items()])


def _read_frame(run: Run, k: int) -> Frame:
    """Return frame ``k``, without points if its scan cannot be read or repeats the one before."""
    try:
        frame = run.sequence[k]
        before, run.last_points = run.last_points, frame.scan.points
        if len(frame.scan) and before is not None and np.array_equal(frame.scan.points, before):
            raise DataError("its points are identical to those of the scan before; it was delivered twice")
        return frame
    except DataError as error:
        run.unreadable[k] = str(error).removeprefix(f"frame {k}: ")
        if run.estimates:
            _log.warning("frame %d: bridged by the initial pose: %s", k, run.unreadable[k])
        return run.sequence.without_scan(k)


def adapt_config(sequence: Sequence, config: Config, is_explicit: bool = False) -> Config:
    """Return the configuration, with initial poses by constant velocity if the recording has no IMU data.

    Args:
        sequence: the recording.
        config: the settings.
        is_explicit: the user chose the initial pose; do not change it.

    Raises:
        DataError: the user chose preintegration, and there are no IMU data.
    """
    if len(sequence.imu) or (is_explicit and config.initial_pose != _FROM_IMU):
        return config
    if is_explicit:
        raise DataError(
            f"{sequence.name}: no IMU data for {_FROM_IMU}; choose another initial pose, such as {_WITHOUT_IMU}"
        )
    _log.warning("%s: no IMU data; the initial poses are by %s", sequence.name, _WITHOUT_IMU)
    return config.model_copy(update={"initial_pose": _WITHOUT_IMU})
