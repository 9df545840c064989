import logging
import sys
from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError, GraphError
from hybridlio.core.sensors import GpsFix, Scan
from hybridlio.datasets.sequence import Sequence, part_of
from hybridlio.graph import PoseGraph
from hybridlio.graph.run.smooth import smooth
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.loop_keyframes import LoopKeyframeSelector, LoopKeyframeSettings
from hybridlio.record.packed_arrays import PackedCloud
from hybridlio.record.record import Record
from hybridlio.record.recorder import Recorder
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import notes, write_run
from hybridlio.sources.gate.gate_result import GateResult
from hybridlio.sources.residual_chain import NoResidual


@pytest.fixture(scope="module")
def whole(sequence) -> Run:
    return run_odometry(sequence, Odometry())


def with_scans(sequence: Sequence, bad: dict[int, Exception | Scan]) -> Sequence:
    """Return the sequence with some scans replaced, or failing to load, by ``bad``."""

    def load(k: int) -> Scan:
        scan = bad[k] if k in bad else sequence.load_scan(k)
        if isinstance(scan, Exception):
            raise scan
        return scan

    return replace(sequence, load_scan=load)


def end_error_m(run: Run) -> float:
    """Return the position error of the last pose, relative to the first estimate."""
    true = se3.between(run.sequence.reference.poses[run.skipped], run.sequence.reference.poses[run.done - 1])
    return float(np.linalg.norm(run.trajectory.poses[-1, :3, 3] - true[:3, 3]))


def test_every_scan_has_an_estimate_at_its_stamp(whole, sequence):
    assert whole.stopped is None
    assert whole.trajectory.stamps_ns.tolist() == sequence.stamps_ns.tolist()
    assert whole.done == len(sequence)
    assert whole.ok.all()
    assert end_error_m(whole) < 0.2


def test_progress_reports_each_scan_and_the_distance(sequence, tiny_drive):
    reports = []
    run = run_odometry(sequence, Odometry(residual="none"), lambda *values: reports.append(values))
    assert [(done, total) for _, done, total in reports] == [(k + 1, len(sequence)) for k in range(len(sequence))]
    assert reports[-1][0] == f"{run.trajectory.length_m:.1f} m"


def test_every_stage_is_timed_at_every_scan_after_the_first(whole, sequence):
    assert {"reading", "initial pose", "residual", "graph"} <= set(whole.timings_s)
    for spent in whole.timings_s.values():
        assert spent.shape == (len(sequence) - 1,)
        assert (spent >= 0).all()
    assert sum(spent.sum() for spent in whole.timings_s.values()) < whole.seconds


@pytest.mark.parametrize("kind", ["unreadable", "empty"])
def test_a_scan_without_points_is_bridged_by_the_initial_pose(kind, whole, sequence, caplog):
    empty = Scan(int(sequence.stamps_ns[15]), np.empty((0, 3), np.float32))
    bad = {15: DataError("frame 15: scans/15.bin: truncated") if kind == "unreadable" else empty}
    with caplog.at_level(logging.WARNING, logger="hybridlio"):
        run = run_odometry(with_scans(sequence, bad), Odometry())
    assert run.stopped is None
    assert run.done == len(sequence)
    assert run.bridged == [15]
    assert run.estimates[15].relative.source == "preintegration"
    assert run.steps.covariances[14].trace() > whole.steps.covariances[14].trace()
    assert end_error_m(run) < 0.2
    if kind == "unreadable":
        assert run.unreadable == {15: "scans/15.bin: truncated"}
        assert "frame 15: bridged by the initial pose: scans/15.bin: truncated" in caplog.text


@pytest.mark.parametrize("error", [ValueError, MemoryError, OverflowError, RuntimeError, TypeError, OSError])
def test_whatever_a_library_raises_about_a_damaged_scan_is_bridged_with_one_line(error, sequence):
    bad = {3: error("\x1b[31mbad\nheader\x1b[0m")}
    run = run_odometry(with_scans(sequence.part(0, 5), bad), Odometry(residual="none"))
    assert run.stopped is None
    assert run.unreadable == {3: f"the scan cannot be read ({error.__name__}: bad header)"}


def test_the_run_starts_at_the_first_usable_scan(sequence, caplog):
    few = Scan(int(sequence.stamps_ns[1]), np.ones((5, 3), np.float32))
    bad = {0: DataError("scans/0.bin: no such scan"), 1: few, 12: DataError("scans/12.bin: truncated")}
    with caplog.at_level(logging.WARNING, logger="hybridlio"):
        run = run_odometry(with_scans(sequence, bad), Odometry())
    assert run.skipped == 2
    assert run.stamps_before.tolist() == sequence.stamps_ns[:2].tolist()
    assert run.trajectory.stamps_ns.tolist() == sequence.stamps_ns[2:].tolist()
    assert run.done == len(sequence)
    assert run.bridged == [12]
    assert sorted(run.unreadable) == [0, 1, 12]
    assert end_error_m(run) < 0.3
    assert "scans/0.bin: no such scan" in caplog.text


def test_a_recording_without_usable_scan_ends_with_the_reason(sequence):
    bad = {k: DataError(f"scans/{k}.bin: truncated") for k in range(len(sequence))}
    for residual in ("scan-matching", "none"):
        run = run_odometry(with_scans(sequence, bad), Odometry(residual=residual))
        assert run.done == 0
        assert isinstance(run.stopped, DataError)
        assert "scans/0.bin: truncated" in str(run.stopped)


def test_an_interrupt_keeps_the_estimates(whole, sequence):
    def interrupt(stage: str, done: int, total: int) -> None:
        if done == 9:
            raise KeyboardInterrupt

    run = run_odometry(sequence, Odometry(), interrupt)
    assert isinstance(run.stopped, KeyboardInterrupt)
    assert run.done == 9
    np.testing.assert_array_equal(run.trajectory.poses, whole.trajectory.poses[:9])
    assert len(run.record.online) == 9


@pytest.mark.parametrize("within", [LoopKeyframeSelector.offer, PackedCloud.of, Recorder.add, Odometry.step])
def test_an_interrupt_inside_the_bookkeeping_leaves_a_run_that_can_be_smoothed(within, sequence, tmp_path):
    """The interrupt comes at the seventh return of the function, before its caller uses the result."""
    returned = iter(range(1, 100))

    def tracer(frame, event, _arg):
        if frame.f_code is not within.__code__:
            return None
        if event == "return" and next(returned) == 7:
            raise KeyboardInterrupt
        return tracer

    config = Config(residual="none", keyframes=LoopKeyframeSettings(spacing_m=1e-6))
    sys.settrace(tracer)
    try:
        run = run_odometry(sequence, Odometry(config=config))
    finally:
        sys.settrace(None)
    assert isinstance(run.stopped, KeyboardInterrupt)
    record = run.record
    assert len(record.online) == len(run.estimates) > 4
    assert (record.keyframes.rows < len(record.online)).all()
    write_run(tmp_path / "run", run, config)
    assert len(smooth(Record.load(tmp_path / "run/odometry.npz")).trajectory) == run.done
    assert len(PoseGraph.load(tmp_path / "run/graph.g2o")) == run.done


class Failing(NoResidual):
    """A residual source that raises an error at frame 8."""

    def __init__(self, error: BaseException) -> None:
        self._error = error

    def refine(self, frame, initial):
        if frame.index == 8:
            raise self._error
        return initial


@pytest.mark.parametrize("error", [GraphError("no"), ValueError("a bug"), KeyboardInterrupt()])
def test_an_error_within_a_step_keeps_the_steps_before_it_only(error, sequence):
    run = run_odometry(sequence, Odometry(residual=Failing(error)))
    assert run.stopped is error
    assert run.done == 8
    assert run.record.imu.stamps_ns[-1] == run.record.online.stamps_ns[-1] == sequence.stamps_ns[7]


def test_fewer_than_two_estimates_have_no_record(sequence):
    run = run_odometry(sequence.part(0, 1), Odometry(config=Config(residual="none")))
    assert run.done == 1
    assert run.record is None
    assert run.timings_s == {}
    assert run.steps.poses.shape == (0, 4, 4)


@pytest.mark.parametrize(("text", "rows"), [("5:9", (5, 9)), ("20:", (20, 25)), (":4", (0, 4)), ("-3:", (22, 25))])
def test_part_of_a_recording_has_the_same_frames_relative_to_its_first(text, rows, sequence):
    part = part_of(sequence, text)
    start, stop = rows
    assert part.stamps_ns.tolist() == sequence.stamps_ns[start:stop].tolist()
    np.testing.assert_array_equal(part[1].scan.points, sequence[start + 1].scan.points)
    np.testing.assert_array_equal(part[1].imu.stamps_ns, sequence[start + 1].imu.stamps_ns)
    poses = sequence.reference.poses
    np.testing.assert_allclose(part.reference.poses, se3.between(poses[start], poses[start:stop]), atol=1e-12)
    assert len(part.forward_speed_m_s) == stop - start


def test_without_a_range_the_whole_recording_is_used(sequence):
    assert part_of(sequence, None) is sequence


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("5", ConfigError),
        ("1:2:3", ConfigError),
        ("a:b", ConfigError),
        ("9:9", ConfigError),
        ("-2:-5", ConfigError),
        ("900:", DataError),
    ],
)
def test_a_malformed_or_empty_range_is_an_error(text, error, sequence):
    with pytest.raises(error, match=r"range such as|the range is empty|no scans in"):
        part_of(sequence, text)


def test_many_conflicts_with_the_imu_add_a_note_to_check_its_data(whole):
    estimates = list(whole.estimates)
    for count, has_hint in ((1, False), (5, True)):
        doubted = [replace(e, gate=GateResult("IMU left out", 1e3)) for e in estimates[-count:]]
        lines = notes(replace(whole, estimates=[*estimates[:-count], *doubted]))
        assert f"{count} scan" in lines[0]
        assert ("check T_imu_lidar, units and clock" in lines[-1]) == has_hint


def test_gps_fixes_shortly_before_and_after_the_run_are_kept_for_smoothing(sequence):
    stamps = [sequence.stamps_ns[0] + round(seconds * 1e9) for seconds in (-40, -18, 1, 18, 40)]
    fixes = tuple(GpsFix(int(stamp), np.zeros(3), np.eye(3)) for stamp in stamps)
    run = run_odometry(replace(sequence, gps=fixes), Odometry(residual="none"))
    assert run.record.gps == fixes[1:4]


def test_a_scan_delivered_twice_is_bridged_and_logged(sequence, caplog):
    again = with_scans(sequence, {6: replace(sequence.load_scan(5), stamp_ns=int(sequence.stamps_ns[6]))})
    run = run_odometry(again, Odometry())
    assert run.bridged == [6]
    assert "frame 6: bridged by the initial pose: its points are identical to those of the scan before" in caplog.text
    assert end_error_m(run) < 0.3
