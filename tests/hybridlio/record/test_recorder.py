"""The recorder: packing, records of the first scans, and interrupts."""

import sys

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import EarlierScanPose, RelativePose
from hybridlio.core.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.record.loop_keyframes import LoopKeyframes, LoopKeyframeSelector, LoopKeyframeSettings
from hybridlio.record.record import Record
from hybridlio.record.recorder import Recorder

STEP_NS = 10**8


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    root = 0.01 * rng.standard_normal((6, 6))
    return root @ root.T + 1e-6 * np.eye(6)


def random_step(rng: np.random.Generator, k: int) -> RelativePose:
    """A step whose kind varies with ``k``: drift, failure, IMU source, degenerate directions, earlier scans."""
    pose, covariance = se3.exp(0.1 * rng.standard_normal(6)), random_covariance(rng)
    near = (EarlierScanPose(k * STEP_NS, pose, covariance),) if k % 7 == 0 else ()
    return RelativePose(
        pose,
        covariance,
        f"source {k % 3}",
        degenerate=np.eye(6)[: k % 3],
        ok=k % 5 > 0,
        from_imu=k % 4 == 0,
        drift=0.1 * covariance if k % 2 else None,
        earlier_scans=near,
    )


def test_packing_changes_no_step(rng: np.random.Generator):
    recorder, steps = Recorder(), [(random_step(rng, k), random_step(rng, k + 1)) for k in range(250)]
    recorder.add(0, np.eye(4), np.eye(6))
    for k, step in enumerate(steps):
        recorder.add((k + 1) * STEP_NS, se3.exp(np.full(6, k / 1000)), random_covariance(rng), step)
    record = recorder.record(
        start_state(0, ImuSamples.empty(), ImuNoise()),
        Calibration(),
        ImuNoise(),
        LoopKeyframeSelector(LoopKeyframeSettings()).keyframes(),
    )
    assert len(recorder) == len(record.online) == 251
    assert recorder.last_ns == record.online.stamps_ns[-1] == 250 * STEP_NS
    for was, found in zip(
        [step for pair in steps for step in pair],
        [step for pair in zip(record.initial, record.relative, strict=True) for step in pair],
        strict=True,
    ):
        np.testing.assert_array_equal(found.pose, was.pose)
        np.testing.assert_array_equal(found.covariance, was.covariance)
        np.testing.assert_array_equal(found.degenerate, was.degenerate)
        assert (found.source, found.ok, found.from_imu) == (was.source, was.ok, was.from_imu)
        assert (found.drift is None) == (was.drift is None)
        if was.drift is not None:
            np.testing.assert_array_equal(found.drift, was.drift)
    for (_, was), found in zip(steps, record.relative, strict=True):  # initial poses have none to earlier scans
        assert [k.stamp_ns for k in found.earlier_scans] == [k.stamp_ns for k in was.earlier_scans]
        for a, b in zip(was.earlier_scans, found.earlier_scans, strict=True):
            np.testing.assert_array_equal(b.pose, a.pose)
            np.testing.assert_array_equal(b.covariance, a.covariance)


def five_scans() -> Recorder:
    recorder = Recorder()
    for k in range(5):
        stamps = np.arange(max(k - 1, 0) * STEP_NS, k * STEP_NS + 1, STEP_NS // 10)
        samples = ImuSamples(stamps, np.zeros((len(stamps), 3)), np.zeros((len(stamps), 3)))
        fix = GpsFix(k * STEP_NS, np.zeros(3), np.eye(3))
        step = RelativePose(np.eye(4), np.eye(6), "here")
        recorder.add(k * STEP_NS, np.eye(4), np.eye(6), (step, step) if k else None, samples, (fix,))
    return recorder


def record_of(recorder: Recorder, keyframes: LoopKeyframes, scans: int | None = None) -> Record:
    return recorder.record(start_state(0, ImuSamples.empty(), ImuNoise()), Calibration(), ImuNoise(), keyframes, scans)


def three_keyframes() -> LoopKeyframes:
    """Keyframes of scans 1, 3 and 4."""
    rows = np.array([1, 3, 4])
    return LoopKeyframes(rows, rows * STEP_NS, tuple(np.full((1, 3), row, np.int16) for row in rows))


def test_a_record_of_the_first_scans_ends_with_the_last_of_them():
    record = record_of(five_scans(), three_keyframes(), scans=4)
    assert record.online.stamps_ns.tolist() == [0, STEP_NS, 2 * STEP_NS, 3 * STEP_NS]
    assert len(record.initial) == len(record.relative) == 3
    assert record.imu.stamps_ns.tolist() == list(range(0, 3 * STEP_NS + 1, STEP_NS // 10))
    assert [fix.stamp_ns for fix in record.gps] == record.online.stamps_ns.tolist()
    assert record.keyframes.rows.tolist() == [1, 3]
    assert [cloud[0, 0] for cloud in record.keyframes.clouds] == [1, 3]
    assert len(record_of(five_scans(), three_keyframes()).online) == 5


@pytest.mark.parametrize("scans", [3, 50, 51, 120])
def test_an_interrupt_at_any_line_of_add_keeps_the_previous_scans(monkeypatch, scans):
    step = RelativePose(np.eye(4), np.eye(6), "here")
    for line in range(1, 12):
        recorder = Recorder()
        for k in range(scans):
            recorder.add(k * STEP_NS, np.eye(4), np.eye(6), (step, step) if k else None)
        lines = iter(range(1, 100))

        def tracer(frame, event, _arg, lines=lines, stop=line):
            if frame.f_code is not Recorder.add.__code__:
                return None
            if event == "line" and next(lines) == stop:
                raise KeyboardInterrupt
            return tracer

        sys.settrace(tracer)
        try:
            recorder.add(scans * STEP_NS, np.eye(4), np.eye(6), (step, step))
        except KeyboardInterrupt:
            assert len(recorder) == scans
            assert recorder.last_ns == (scans - 1) * STEP_NS
        finally:
            sys.settrace(None)
        record = record_of(recorder, LoopKeyframeSelector(LoopKeyframeSettings()).keyframes())
        assert record.online.stamps_ns.tolist() == [k * STEP_NS for k in range(len(recorder))]
        assert len(record.relative) == len(recorder) - 1


def test_samples_on_a_common_border_are_kept_once():
    stamps = np.arange(11) * 10**7
    whole = ImuSamples(stamps, np.arange(33.0).reshape(11, 3), np.arange(33.0).reshape(11, 3))
    again = ImuSamples.concatenate([whole.between(0, 5 * 10**7), ImuSamples.empty(), whole.between(5 * 10**7, 10**8)])
    np.testing.assert_array_equal(again.stamps_ns, stamps)
    np.testing.assert_array_equal(again.gyro_rad_s, whole.gyro_rad_s)
    assert len(ImuSamples.concatenate([])) == 0
