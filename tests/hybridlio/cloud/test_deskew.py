import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlio.cloud.deskew import constant_twist, deskew
from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Scan
from hybridlio.core.trajectory import Trajectory

STAMP_NS = 1_700_000_000_123_456_789
SWEEP_NS = 100_000_000


def world(seed: int, count: int = 2000) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [30.0, 30.0, 3.0]


def measured(still: np.ndarray, T_stamp_point: np.ndarray, offsets_ns: np.ndarray) -> Scan:
    """Return what a moving sensor measures of static points, which are given in its frame at the stamp."""
    return Scan(STAMP_NS, se3.transform(se3.inverse(T_stamp_point), still[:, None])[:, 0], None, offsets_ns)


@pytest.mark.parametrize(
    "xi_per_s", [(0.1, -0.2, 0.8, 15.0, 1.0, -0.5), (0, 0, 0, 30, 0, 0), (0, 0, 3, 0, 0, 0), (1e-10,) * 6]
)
@pytest.mark.parametrize("window_ns", [(0, SWEEP_NS), (-SWEEP_NS, 0), (-SWEEP_NS // 2, SWEEP_NS // 2)])
def test_a_sweep_at_constant_twist_is_restored(xi_per_s, window_ns):
    still, xi = world(0), np.array(xi_per_s, dtype=float)
    offsets = np.random.default_rng(1).integers(*window_ns, len(still))
    scan = measured(still, se3.exp(offsets[:, None] / 1e9 * xi), offsets)
    # the motion is known from the interval before the stamp
    restored = deskew(scan, constant_twist(se3.exp(0.1 * xi), STAMP_NS - SWEEP_NS, STAMP_NS))
    assert np.abs(restored.points - still).max() < 1e-5
    assert restored.time_offsets_ns is None
    assert restored.stamp_ns == STAMP_NS


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), steps=st.integers(2, 20))
def test_points_move_with_the_pose_interpolated_at_their_own_time(seed, steps):
    rng = np.random.default_rng(seed)
    knots = np.sort(rng.choice(np.arange(-SWEEP_NS, SWEEP_NS, 1000), steps, replace=False))
    knots[0], knots[-1] = -SWEEP_NS, SWEEP_NS  # around the stamp
    poses = [se3.exp(rng.normal(size=6))]
    for _ in range(steps - 1):
        poses.append(poses[-1] @ se3.exp(rng.normal(size=6) * [0.02, 0.02, 0.02, 0.2, 0.2, 0.2]))
    motion = Trajectory(STAMP_NS + knots, np.array(poses))

    def pose_at(t):
        k = min(max(np.searchsorted(knots, t, side="right") - 1, 0), steps - 2)
        return se3.interpolate(motion.poses[k], motion.poses[k + 1], (t - knots[k]) / (knots[k + 1] - knots[k]))

    offsets = rng.integers(knots[0], knots[-1] + 1, 50)
    still = rng.normal(size=(50, 3)) * 5
    T = np.array([se3.between(pose_at(0), pose_at(int(t))) for t in offsets])
    assert np.abs(deskew(measured(still, T, offsets), motion).points - still).max() < 1e-5


def test_the_world_frame_of_the_poses_does_not_matter():
    scan = Scan(STAMP_NS, world(3), None, np.linspace(0, SWEEP_NS, 2000).astype(np.int64))
    motion = constant_twist(se3.exp([0, 0, 0.1, 1.0, 0, 0]), STAMP_NS, STAMP_NS + SWEEP_NS)
    elsewhere = Trajectory(motion.stamps_ns, se3.exp([0.3, 0.2, 2.0, 50, -20, 3]) @ motion.poses)
    assert np.allclose(deskew(scan, motion).points, deskew(scan, elsewhere).points, atol=1e-5)


def test_a_scan_without_times_is_returned_untouched():
    scan = Scan(STAMP_NS, world(0))
    assert deskew(scan, constant_twist(np.eye(4), 0, 1)) is scan


def test_a_sensor_that_stands_still_changes_nothing_but_the_offsets():
    scan = Scan(STAMP_NS, world(0), np.arange(2000) / 2000, np.arange(2000))
    restored = deskew(scan, constant_twist(np.eye(4), STAMP_NS - SWEEP_NS, STAMP_NS))
    assert np.array_equal(restored.points, scan.points)
    assert np.array_equal(restored.intensity, scan.intensity)
    assert restored.time_offsets_ns is None


def test_a_sweep_of_no_points_stays_empty():
    scan = Scan(STAMP_NS, np.empty((0, 3)), None, np.empty(0, np.int64))
    assert len(deskew(scan, constant_twist(np.eye(4), 0, 1))) == 0


def test_a_motion_of_a_single_pose_is_an_error():
    scan = Scan(STAMP_NS, world(0, 5), None, np.arange(5))
    with pytest.raises(DataError, match="two poses"):
        deskew(scan, Trajectory(np.array([STAMP_NS]), np.eye(4)[None]))


def test_a_twist_over_no_time_is_an_error():
    with pytest.raises(DataError, match="time"):
        constant_twist(np.eye(4), STAMP_NS, STAMP_NS)
