import numpy as np

from hybridlio import se3
from hybridlio.estimates import KeyframePose, RelativePose
from hybridlio.keyframes import KeyframeMaker, KeyframeSettings
from hybridlio.record_maker import RecordMaker, joined
from hybridlio.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.startup import start_state

STEP_NS = 10**8


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    root = 0.01 * rng.standard_normal((6, 6))
    return root @ root.T + 1e-6 * np.eye(6)


def random_step(rng: np.random.Generator, k: int) -> RelativePose:
    """One of all kinds: with and without drift, failed, of the IMU, with loose directions, with keyframes."""
    pose, covariance = se3.exp(0.1 * rng.standard_normal(6)), random_covariance(rng)
    near = (KeyframePose(k * STEP_NS, pose, covariance),) if k % 7 == 0 else ()
    return RelativePose(
        pose,
        covariance,
        f"source {k % 3}",
        degenerate=np.eye(6)[: k % 3],
        ok=k % 5 > 0,
        from_imu=k % 4 == 0,
        drift=0.1 * covariance if k % 2 else None,
        keyframes=near,
    )


def test_steps_that_have_become_arrays_are_as_they_were(rng: np.random.Generator):
    made, steps = RecordMaker(), [(random_step(rng, k), random_step(rng, k + 1)) for k in range(250)]
    made.add(0, np.eye(4), np.eye(6))
    for k, step in enumerate(steps):
        made.add((k + 1) * STEP_NS, se3.exp(np.full(6, k / 1000)), random_covariance(rng), step)
    record = made.record(
        start_state(0, ImuSamples.empty(), ImuNoise()),
        Calibration(),
        ImuNoise(),
        KeyframeMaker(KeyframeSettings()).keyframes(),
    )
    assert len(made) == len(record.online) == 251
    assert made.last_ns == record.online.stamps_ns[-1] == 250 * STEP_NS
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
    for (_, was), found in zip(steps, record.relative, strict=True):  # initial poses know no keyframes
        assert [k.stamp_ns for k in found.keyframes] == [k.stamp_ns for k in was.keyframes]
        for a, b in zip(was.keyframes, found.keyframes, strict=True):
            np.testing.assert_array_equal(b.pose, a.pose)
            np.testing.assert_array_equal(b.covariance, a.covariance)


def test_what_came_after_the_last_estimate_is_no_part_of_the_record():
    made, stamps = RecordMaker(), np.arange(0, 5 * STEP_NS, STEP_NS // 10)
    made.add(0, np.eye(4), np.eye(6))
    made.add(2 * STEP_NS, np.eye(4), np.eye(6))
    for part in (stamps[:21], stamps[20:]):
        made.felt(ImuSamples(part, np.zeros((len(part), 3)), np.zeros((len(part), 3))))
    made.heard(tuple(GpsFix(stamp, np.zeros(3), np.eye(3)) for stamp in (STEP_NS, 3 * STEP_NS)))
    keyframes = KeyframeMaker(KeyframeSettings()).keyframes()
    record = made.record(start_state(0, ImuSamples.empty(), ImuNoise()), Calibration(), ImuNoise(), keyframes)
    np.testing.assert_array_equal(record.imu.stamps_ns, stamps[:21])
    assert [fix.stamp_ns for fix in record.gps] == [STEP_NS]


def test_samples_on_a_common_border_are_taken_once():
    stamps = np.arange(11) * 10**7
    whole = ImuSamples(stamps, np.arange(33.0).reshape(11, 3), np.arange(33.0).reshape(11, 3))
    again = joined([whole.between(0, 5 * 10**7), ImuSamples.empty(), whole.between(5 * 10**7, 10**8)])
    np.testing.assert_array_equal(again.stamps_ns, stamps)
    np.testing.assert_array_equal(again.gyro_rad_s, whole.gyro_rad_s)
    assert len(joined([])) == 0
