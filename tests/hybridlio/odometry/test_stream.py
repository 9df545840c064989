"""Live data give the estimates of the same data from a file; nothing is lost in silence."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from streams import MS, Event, events, feed, same, stream_of, thinned, with_point_times, without_imu

import hybridlio as hl
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Calibration, Frame, GpsFix
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.stream import OdometryStream
from hybridlio.sources.dead_reckoning import DeadReckoning


def offline(sequence: Sequence, **choices: str) -> list[Estimate]:
    odometry = Odometry(**choices)
    return [odometry.step(frame) for frame in sequence]


@pytest.fixture(scope="module")
def recordings(sequence: Sequence) -> dict[str, Sequence]:
    sequence = thinned(sequence, 4)  # for speed
    return {
        "instant scans": sequence,
        "swept scans": with_point_times(sequence),
        "no IMU": with_point_times(without_imu(sequence)),
    }


@pytest.fixture(scope="module")
def expected(recordings: dict[str, Sequence]) -> dict[str, list[Estimate]]:
    return {
        name: offline(recording, **({} if len(recording.imu) else {"initial_pose": "constant-velocity"}))
        for name, recording in recordings.items()
    }


def assert_same(found: list[Estimate], expected: list[Estimate]) -> None:
    assert [e.stamp_ns for e in found] == [e.stamp_ns for e in expected]
    assert [k for k, (a, b) in enumerate(zip(found, expected, strict=True)) if not same(a, b)] == []


# ------------------------------------------------------------------------------------------- the same as offline


@pytest.mark.parametrize("name", ["instant scans", "swept scans", "no IMU"])
def test_estimates_are_those_of_the_recording_to_the_last_bit(name, recordings, expected):
    assert_same(feed(stream_of(recordings[name]), events(recordings[name])), expected[name])


def test_order_across_sensors_does_not_matter(recordings, expected):
    recording = recordings["swept scans"]
    late_scans = [
        Event(e.arrival_ns + 300 * MS if e.method == "add_scan" else e.arrival_ns, e.method, e.arguments)
        for e in events(recording)
    ]
    late_imu = [
        Event(e.arrival_ns + 300 * MS if e.method == "add_imu" else e.arrival_ns, e.method, e.arguments)
        for e in events(recording)
    ]
    for data in (late_scans, late_imu):
        data.sort(key=lambda e: e.arrival_ns)
        assert_same(feed(stream_of(recording), data), expected["swept scans"])


@pytest.mark.parametrize("name", ["swept scans", "no IMU"])
def test_arrival_shuffled_within_the_lag_does_not_matter(name, recordings, expected, rng):
    data = events(recordings[name], delay=lambda: int(rng.integers(0, 240 * MS)))
    scans = [e.arguments[0] for e in data if e.method == "add_scan"]
    assert scans != sorted(scans)
    stream = stream_of(recordings[name], reorder_s=0.25, lag_s=0.25)
    assert_same(feed(stream, data), expected[name])
    counts = stream.counts
    assert counts.late_scans == counts.late_imu == counts.without_imu == counts.waiting_scans == 0


def test_a_callback_gets_the_same_estimates_from_two_feeding_threads(recordings, expected):
    recording, found = recordings["swept scans"], []
    data = events(recording)
    with stream_of(recording, on_estimate=found.append, lag_s=30.0) as stream:
        assert threading.current_thread().name != "hybridlio stream"
        feeders = [
            threading.Thread(target=lambda m=method: [e.add_to(stream) for e in data if e.method == m])
            for method in ("add_imu", "add_scan")
        ]
        for feeder in feeders:
            feeder.start()
        for feeder in feeders:
            feeder.join()
    assert_same(found, expected["swept scans"])


def test_an_imu_that_starts_late_is_taken_up_as_offline(recordings):
    recording = recordings["swept scans"]
    start_ns = int(recording.stamps_ns[8])
    late = replace(recording, imu=recording.imu.between(start_ns, int(recording.imu.stamps_ns[-1])))
    stream = stream_of(late, lag_s=0.2)
    assert_same(feed(stream, events(late)), offline(late))
    assert stream.counts.without_imu == 8


def test_a_record_of_a_stream_is_that_of_the_run(recordings):
    recording, odometry, run = recordings["instant scans"], Odometry(), Odometry()
    for frame in recording:
        run.step(frame)
    stream = stream_of(recording, odometry=odometry)
    data = events(recording)
    fix = Event(data[0].arrival_ns, "add_fix", (int(recording.stamps_ns[3]), np.zeros(3), np.eye(3)))
    feed(stream, [*data[:-2], fix, *data[-2:], fix])
    found, expected = stream.record(), run.record()
    np.testing.assert_array_equal(found.online.poses, expected.online.poses)
    np.testing.assert_array_equal(found.imu.stamps_ns, expected.imu.stamps_ns)
    np.testing.assert_array_equal(found.imu.accel_m_s2, expected.imu.accel_m_s2)
    assert [f.stamp_ns for f in found.gps] == [int(recording.stamps_ns[3])] * 2
    assert stream.counts.late_fixes == 2


class ListensToFixes(DeadReckoning):
    """A backend that lists the stamps of the fixes that each step brings."""

    def __init__(self, calibration: Calibration) -> None:
        super().__init__(calibration)
        self.fixes: list[tuple[int, ...]] = []

    def update(self, frame: Frame, relative: RelativePose) -> State:
        self.fixes.append(tuple(fix.stamp_ns for fix in frame.gps))
        return super().update(frame, relative)


def test_fixes_reach_a_backend_as_offline_without_a_record(recordings):
    recording = recordings["swept scans"]
    start_ns, end_ns = (int(stamp) for stamp in recording.stamps_ns[[0, -1]])
    fixes = tuple(GpsFix(t, np.zeros(3), np.eye(3)) for t in range(start_ns + 7 * MS, end_ns, 70 * MS))
    recording = replace(recording, gps=fixes)
    offline_backend, backend = (ListensToFixes(recording.calibration) for _ in range(2))
    run = Odometry(backend=offline_backend)
    expected = [run.step(frame) for frame in recording]
    stream = stream_of(recording, odometry=Odometry(backend=backend, keep_record=False))
    assert_same(feed(stream, events(recording)), expected)
    assert backend.fixes == offline_backend.fixes
    assert sum(backend.fixes, ()) == tuple(fix.stamp_ns for fix in fixes)
    assert stream.counts.fixes == len(fixes)
    assert stream.counts.late_fixes == 0


def test_fixes_without_a_record_change_no_estimate(recordings, expected):
    recording = recordings["swept scans"]
    fixes = tuple(GpsFix(int(t) + MS, np.full(3, 50.0), np.eye(3)) for t in recording.stamps_ns)
    assert_same(feed(stream_of(recording), events(replace(recording, gps=fixes))), expected["swept scans"])


# ------------------------------------------------------------------------------------------- when they are ready


def test_a_scan_waits_for_the_sample_at_its_end_and_no_longer(recordings):
    recording = recordings["swept scans"]
    stream, ready = stream_of(recording, odometry=Odometry(residual="none", keep_record=False)), {}
    for event in events(recording):
        for estimate in event.add_to(stream):
            ready[estimate.stamp_ns] = event
    period_ns = int(np.median(np.diff(recording.imu.stamps_ns)))
    assert len(ready) >= len(recording) - 1
    for stamp_ns, event in ready.items():
        assert 40 * MS <= event.arrival_ns - stamp_ns <= 40 * MS + period_ns


def test_without_an_imu_a_scan_waits_for_nothing(recordings):
    recording = without_imu(recordings["instant scans"])
    stream = stream_of(recording)
    assert [len(event.add_to(stream)) for event in events(recording)] == [1] * len(recording)


def test_scans_do_not_wait_longer_than_the_lag_for_an_imu_that_failed(recordings):
    recording = recordings["instant scans"]
    failed_ns = int(recording.stamps_ns[10])
    data = [e for e in events(recording) if e.method == "add_scan" or e.arguments[0] <= failed_ns]
    stream, behind = stream_of(recording, odometry=Odometry(residual="none", keep_record=False), lag_s=0.3), []
    for event in data:
        behind += [(event.arrival_ns - e.stamp_ns) / 1e9 for e in event.add_to(stream)]
    assert max(behind) == pytest.approx(0.3, abs=0.001)
    assert len(stream.flush()) == 3
    assert stream.counts.estimates == len(recording)
    assert stream.counts.without_imu == len(recording) - 11


def test_scans_before_the_first_sample_are_estimated_after_the_lag(recordings):
    recording = recordings["instant scans"]
    stream = stream_of(recording, odometry=Odometry(residual="none", keep_record=False))
    scans = [e for e in events(recording) if e.method == "add_scan"]
    assert [len(e.add_to(stream)) for e in scans[:8]] == [0, 0, 0, 0, 0, 1, 1, 1]


# ----------------------------------------------------------------------------------------------- what is refused


def test_late_data_are_refused_and_counted_each(recordings, caplog):
    recording = recordings["instant scans"]
    stream = stream_of(recording, odometry=Odometry(residual="none", keep_record=False))
    data = events(recording)
    feed(stream, data[: len(data) // 2])
    before = stream.counts
    scans, samples = ([e for e in data[:60] if e.method == m] for m in ("add_scan", "add_imu"))
    assert [scans[1].add_to(stream), samples[3].add_to(stream)] == [[], []]
    newest = [e for e in data[: len(data) // 2] if e.method == "add_imu"][-1]
    newest.add_to(stream)
    after = stream.counts
    assert (after.late_scans, after.late_imu + after.repeated_imu) == (1, 2)
    assert after.estimates == before.estimates
    assert "late or repeated, not used" in caplog.text


def test_every_scan_is_in_one_count(recordings, rng):
    recording = recordings["instant scans"]
    stream = stream_of(recording, odometry=Odometry(residual="none", keep_record=False))
    feed(stream, events(recording, delay=lambda: int(rng.integers(0, 400 * MS))))
    c = stream.counts
    assert c.scans == len(recording) == c.estimates + c.late_scans + c.skipped_scans + c.unusable_scans
    assert c.imu == len(recording.imu)
    assert c.late_scans > 0
    assert c.waiting_scans == 0


def test_a_scan_that_is_delivered_twice_is_bridged_as_in_a_run(recordings):
    recording = recordings["instant scans"]
    twice = replace(
        recording,
        load_scan=lambda k: replace(recording.load_scan(5 if k == 6 else k), stamp_ns=int(recording.stamps_ns[k])),
    )
    stream = stream_of(recording)
    found = feed(stream, events(twice))
    assert stream.counts.repeated_points == 1
    assert [e.index for e in found if e.relative is not None and not e.relative.ok] == [6]


def test_scans_that_cannot_start_a_run_are_skipped(recordings):
    recording = recordings["instant scans"]
    stream = stream_of(recording)
    data = events(recording)
    first = next(k for k, e in enumerate(data) if e.method == "add_scan")
    data[first] = replace(data[first], arguments=(data[first].arguments[0], np.empty((0, 3)), None))
    found = feed(stream, data)
    assert len(found) == len(recording) - 1
    assert stream.counts.unusable_scans == 1
    np.testing.assert_array_equal(found[0].pose, np.eye(4))


def test_scans_are_skipped_when_estimation_is_too_slow(recordings):
    recording = recordings["instant scans"]
    data, gate, found = events(recording), threading.Event(), []

    def slow(estimate: Estimate) -> None:
        gate.wait(timeout=20)
        found.append(estimate)

    odometry = Odometry(residual="none", keep_record=False)
    with stream_of(recording, odometry=odometry, on_estimate=slow, lag_s=0.1) as stream:
        for event in data:
            event.add_to(stream)
        assert stream.counts.waiting_scans < 14
        gate.set()
    counts = stream.counts
    assert counts.skipped_scans > 5
    assert counts.estimates == len(found) == len(recording) - counts.skipped_scans
    assert found[-1].stamp_ns == recording.stamps_ns[-1]


SAMPLE = (10**9, [0.0, 0, 0], [0, 0, 9.81])
WRONG = [
    ("add_imu", (1.5, *SAMPLE[1:]), "the stamp must be an integer number of nanoseconds, got 1.5"),
    ("add_imu", (2**63, *SAMPLE[1:]), "beyond the range"),
    ("add_imu", (10**9, [0.0, 0], [0, 0, 9.81]), "gyro_rad_s must be three numbers"),
    ("add_imu", (10**9, [0.0, 0, 0], "down"), "accel_m_s2 must be three numbers"),
    ("add_imu", (10**9, [0.0, np.nan, 0], [0, 0, 9.81]), "gyro_rad_s is not finite"),
    ("add_scan", (10**9, np.zeros((5, 2))), r"points must be \(N, 3\), got \(5, 2\)"),
    ("add_scan", (10**9, "points"), r"points must be an \(N, 3\) array of numbers"),
    ("add_scan", (10**9, np.ones((5, 3)), np.zeros(4, int)), r"time_offsets_ns must be \(5,\)"),
    ("add_scan", (10**9, np.ones((5, 3)), np.linspace(0, 0.1, 5)), "must be integer nanoseconds"),
    ("add_scan", (10**9, np.ones((5, 3)), np.full(5, 10**10)), "10 to 10 s from its stamp"),
    ("add_scan", (None, np.ones((5, 3))), "the stamp must be an integer"),
    ("add_fix", (10**9, [0.0, np.inf, 0], np.eye(3)), "three finite coordinates"),
    ("add_fix", (10**9, [0.0, 0, 0], "good"), "expected numbers"),
]


@pytest.mark.parametrize(("method", "arguments", "message"), WRONG)
def test_malformed_data_give_one_clear_line_and_change_nothing(method, arguments, message):
    stream = OdometryStream(Calibration(), Odometry())
    with pytest.raises(hl.HybridLioError, match=message) as caught:
        getattr(stream, method)(*arguments)
    assert "\n" not in str(caught.value)
    counts = stream.counts
    assert counts == type(counts)()


def test_a_clock_that_steps_back_is_an_error(recordings):
    recording = recordings["instant scans"]
    stream = stream_of(recording, odometry=Odometry(residual="none", keep_record=False))
    feed(stream, events(recording))
    counts, early_ns = stream.counts, int(recording.stamps_ns[0]) - 20 * 10**9
    for add in (lambda: stream.add_imu(early_ns, *SAMPLE[1:]), lambda: stream.add_scan(early_ns, np.ones((5, 3)))):
        with pytest.raises(hl.HybridLioError, match="before the last estimate; has the clock stepped back"):
            add()
    assert stream.counts == counts


def test_the_arrays_of_a_scan_are_copied(recordings, expected):
    stream, buffer = stream_of(recordings["instant scans"]), np.empty((200_000, 3), np.float32)
    found = []
    for event in events(recordings["instant scans"]):
        if event.method == "add_scan":
            stamp_ns, points, _ = event.arguments
            buffer[: len(points)] = points
            found += stream.add_scan(stamp_ns, buffer[: len(points)])
            buffer[:] = 1e3
        else:
            found += event.add_to(stream)
    assert_same(found + stream.flush(), expected["instant scans"])


def test_misuse_is_refused():
    with pytest.raises(hl.HybridLioError, match="lag_s must be between 0 and 30 s"):
        OdometryStream(None, lag_s=-1)
    with pytest.raises(hl.HybridLioError, match="made without an IMU"):
        OdometryStream(None).add_imu(*SAMPLE)
    with pytest.raises(hl.HybridLioError, match="calibration must be a Calibration"):
        OdometryStream(np.eye(4))  # type: ignore[arg-type]
    stream = OdometryStream(None)
    stream.close()
    with pytest.raises(hl.HybridLioError, match="closed"):
        stream.add_scan(0, np.ones((5, 3)))


@pytest.mark.parametrize("in_thread", [False, True])
def test_a_failed_stream_says_so_at_every_later_call(recordings, in_thread):
    class Failing:
        name = "failing"

        def start(self, frame: object) -> None: ...

        def refine(self, *_: object) -> object:
            raise RuntimeError("no more")

    recording = recordings["instant scans"]
    callback = {"on_estimate": lambda _: None} if in_thread else {}
    stream = stream_of(recording, odometry=Odometry(residual=Failing(), keep_record=False), **callback)
    with pytest.raises((RuntimeError, hl.HybridLioError), match="no more"):
        feed(stream, events(recording))
    with pytest.raises(hl.HybridLioError, match="stopped at an earlier error: no more"):
        stream.flush()
