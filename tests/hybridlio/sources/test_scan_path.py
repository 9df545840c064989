"""The quick path through scans."""

import numpy as np
from handheld import as_sequence, carried

from hybridlio.core import se3
from hybridlio.core.sensors import Calibration, ImuSamples, Scan
from hybridlio.sources.scan_path import best_paths, scan_paths


def test_the_turns_of_a_path_are_those_of_the_lidar(rng: np.random.Generator):
    walk = carried(rng, seconds=4.0, turning=0.6)
    scans = [as_sequence(rng, walk).load_scan(k) for k in range(len(walk.path))]
    (found,) = scan_paths(scans, Calibration(), ImuSamples.empty())
    path = found.trajectory
    np.testing.assert_array_equal(path.stamps_ns, walk.path.stamps_ns)
    steps, true = (se3.between(poses[:-1], poses[1:]) for poses in (path.poses, walk.path.poses))
    errors = se3.so3_log(se3.between(steps, true)[:, :3, :3])
    assert np.median(np.linalg.norm(errors, axis=1)) < 2e-3


def test_a_new_path_begins_after_a_scan_that_does_not_fit(rng: np.random.Generator):
    walk = carried(rng, seconds=3.0, turning=0.6)
    sequence = as_sequence(rng, walk)
    scans = [sequence.load_scan(k) for k in range(len(walk.path))]
    scans[12] = Scan(scans[12].stamp_ns, np.empty((0, 3), np.float32))
    paths = scan_paths(scans, Calibration(), ImuSamples.empty())
    assert len(paths) == 2
    assert len(paths[0].trajectory) == 12


def test_a_turn_that_the_scans_do_not_show_is_not_counted_as_measured(rng: np.random.Generator):
    flat = [Scan(k * 100_000_000, _ground(rng), None) for k in range(15)]
    turning = ImuSamples(
        np.arange(0, 1_600_000_000, 10_000_000), np.tile([0.0, 0.0, 0.5], (160, 1)), np.tile([0, 0, 9.81], (160, 1))
    )
    (path,) = scan_paths(flat, Calibration(), turning)
    assert path.measured[:, :2].all()
    assert not path.measured[:, 2].any()


def _ground(rng: np.random.Generator) -> np.ndarray:
    places = rng.uniform(-30, 30, (6000, 2))
    heights = rng.normal(-1.7, 0.01, len(places))
    return np.column_stack([places, heights]).astype(np.float32)


def test_no_scans_give_no_path():
    assert scan_paths([], Calibration(), ImuSamples.empty()) == []


def test_a_path_that_began_with_a_false_fit_is_left_out(rng: np.random.Generator):
    walk = carried(rng, seconds=4.0, turning=0.6)
    sequence = as_sequence(rng, walk)
    scans = [sequence.load_scan(k) for k in range(len(walk.path))]
    (right,) = scan_paths(scans, Calibration(), ImuSamples.empty())
    noise = [rng.normal(0, 0.06, scan.points.shape).astype(np.float32) for scan in scans]
    blurred = [Scan(scan.stamp_ns, scan.points + more) for scan, more in zip(scans, noise, strict=True)]
    wrong = scan_paths(blurred, Calibration(), ImuSamples.empty())
    (kept,) = best_paths([*wrong, right])
    np.testing.assert_array_equal(kept.trajectory.poses, right.trajectory.poses)
