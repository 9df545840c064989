"""Motion during a sweep: its estimate from the gyroscope, the noise left, and compensation at start-up."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.cloud.deskew import compensation_noise, constant_twist, sweep_motion
from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.odometry.compensation import MotionCompensation
from hybridlio.odometry.odometry import Odometry

SWEEP_NS = 100_000_000
RATE = np.array([0.05, -0.1, 0.6])  # rad/s
BIAS = np.array([0.01, 0.02, -0.03])
STANDING = constant_twist(np.eye(4), -SWEEP_NS, 0)


def turning(rate: np.ndarray, stamps_ns: np.ndarray) -> ImuSamples:
    up = np.tile([0.0, 0.0, 9.81], (len(stamps_ns), 1))
    return ImuSamples(stamps_ns, np.tile(rate, (len(stamps_ns), 1)), up)


def sweep(k: int, rng: np.random.Generator, imu: bool = True) -> tuple[Frame, np.ndarray]:
    """Return a scan of points around a lidar that rotates on the spot, and the points as seen at its stamp."""
    stamp_ns = k * SWEEP_NS
    offsets_ns = np.sort(rng.integers(-SWEEP_NS // 2, SWEEP_NS // 2, 400)).astype(np.int32)
    points = rng.uniform(-30.0, 30.0, (400, 3))
    turned = se3.so3_exp(RATE * (offsets_ns / 1e9)[:, None])
    seen = np.einsum("nji,nj->ni", turned, points)  # in the lidar frame at each point's time
    samples, during = ImuSamples.empty(), ImuSamples.empty()
    if imu:
        samples = turning(RATE, np.arange(stamp_ns - SWEEP_NS, stamp_ns + 1, SWEEP_NS // 10))
        during = turning(RATE, np.arange(stamp_ns - SWEEP_NS // 2, stamp_ns + SWEEP_NS // 2 + 1, SWEEP_NS // 10))
    scan = Scan(stamp_ns, seen.astype(np.float32), time_offsets_ns=offsets_ns)
    return Frame(k, scan, imu=samples, sweep_imu=during, calibration=Calibration()), points


class Watched:
    """A residual source that keeps its input and returns a known step."""

    name = "watched"

    def __init__(self) -> None:
        self.started: list[Frame] = []
        self.initial: list[RelativePose] = []

    def start(self, frame: Frame) -> None:
        self.started.append(frame)

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        self.initial.append(initial)
        turned = se3.make(se3.so3_exp(RATE * SWEEP_NS / 1e9), [1.0, 0.0, 0.0])
        return RelativePose(turned, np.eye(6) * 1e-6, self.name)


@pytest.mark.parametrize("speed_m_s", [0.0, 12.0])
def test_a_sweeps_rotation_comes_from_unbiased_samples_and_its_speed_from_the_step(rng, speed_m_s):
    frame, _ = sweep(1, rng)
    biased = Frame(1, frame.scan, sweep_imu=turning(RATE + BIAS, frame.sweep_imu.stamps_ns))
    step = constant_twist(se3.make(np.eye(3), [speed_m_s / 10, 0.0, 0.0]), 0, SWEEP_NS)
    motion = sweep_motion(biased, step, BIAS, Calibration())
    over_s = np.diff(motion.stamps_ns) / 1e9
    twists = se3.log(se3.between(motion.poses[:-1], motion.poses[1:])) / over_s[:, None]
    np.testing.assert_allclose(twists[:, :3], np.tile(RATE, (len(twists), 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(twists[:, 3:], axis=1), speed_m_s, atol=1e-3)


def test_without_samples_a_sweep_continues_the_step(rng):
    frame, _ = sweep(1, rng, imu=False)
    assert sweep_motion(frame, STANDING, BIAS, Calibration()) is STANDING


@pytest.mark.parametrize("imu", [True, False])
def test_the_error_left_by_compensation_has_the_predicted_variance(rng, imu):
    """Simulate the mean rotation of a sweep's points by the gyroscope's noise, or by a wrong rate without IMU."""
    noise, steps = ImuNoise(gyro_rad_s_sqrt_hz=2e-3), 200
    frame, _ = sweep(1, rng, imu=imu)
    said = compensation_noise(frame, noise)
    np.testing.assert_array_equal(said[3:], 0.0)
    dt_s, runs = SWEEP_NS / 1e9 / steps, 4000
    if imu:
        walk = np.cumsum(rng.normal(0.0, noise.gyro_rad_s_sqrt_hz * np.sqrt(dt_s), (runs, steps)), axis=1)
        turned = walk - walk[:, [steps // 2]]
        once = np.mean(turned.mean(axis=1) ** 2)  # of the whole scan
    else:
        turned = rng.normal(0.0, 0.02, (runs, 1)) * np.linspace(-0.5, 0.5, steps) * SWEEP_NS / 1e9
        once = np.mean(turned**2)  # of one point
    np.testing.assert_allclose(np.diag(said)[:3], 2 * once, rtol=0.1)


def test_a_frame_without_point_times_passes_unchanged_and_without_noise(rng):
    frame, points = sweep(1, rng)
    compensation = MotionCompensation(Calibration(), ImuNoise())
    compensated = compensation.compensate(frame, np.eye(4), 0, SWEEP_NS, None, ImuSamples.empty())
    np.testing.assert_allclose(compensated.scan.points, points, atol=1e-4)
    assert compensation.noise(frame, 0) is not None
    assert compensation.compensate(compensated, np.eye(4), 0, SWEEP_NS, None, ImuSamples.empty()) is compensated
    assert compensation.noise(compensated, 0) is None


def test_the_first_scan_is_compensated_for_rotation(rng):
    source = Watched()
    frame, points = sweep(0, rng)
    Odometry(residual=source).step(frame)
    np.testing.assert_allclose(source.started[0].scan.points, points, atol=1e-4)
    assert source.started[0].scan.time_offsets_ns is None


def test_the_first_scan_is_compensated_again_once_the_speed_is_known(rng):
    odometry = Odometry(residual=(source := Watched()))
    (first, points), (second, _) = sweep(0, rng), sweep(1, rng)
    for frame in (first, second):
        odometry.step(frame)
    offsets_s = first.scan.time_offsets_ns / 1e9
    ahead = source.started[-1].scan.points - points
    np.testing.assert_allclose(ahead[:, 0], 10.0 * offsets_s, atol=0.03)  # 1 m a sweep
    assert len(source.started) == 2


def test_without_imu_the_first_step_is_repeated_from_its_result(rng):
    odometry = Odometry("constant-velocity", residual=(source := Watched()))
    for k in range(3):
        odometry.step(sweep(k, rng, imu=False)[0])
    found = se3.make(se3.so3_exp(RATE * SWEEP_NS / 1e9), [1.0, 0.0, 0.0])
    assert len(source.initial) == 1 + 3 + 1
    for again in source.initial[1:4]:
        np.testing.assert_array_equal(again.pose, found)
