from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.visibility import Visibility

RETURNS, VIEW_M, PERIOD_NS = 2000, 20.0, 100_000_000
SURE = np.diag(np.r_[np.full(3, 0.001), np.full(3, 0.02)] ** 2)


def seen(k: int, share: float = 1.0) -> Scan:
    return Scan(k * PERIOD_NS, np.ones((round(share * RETURNS), 3), np.float32))


def after_clear_scans(view_m: float = VIEW_M, scans: int = 30) -> Visibility:
    visibility = Visibility()
    assert not any(visibility.is_lost(seen(k), view_m) for k in range(scans))
    return visibility


@pytest.mark.parametrize(
    ("returns", "view", "is_lost"),
    [(0.15, 0.25, True), (0.45, 0.54, True), (0.15, 1.0, False), (1.0, 0.25, False), (0.6, 0.75, False)],
)
def test_only_a_scan_with_few_returns_from_near_is_lost(returns: float, view: float, is_lost: bool):
    assert after_clear_scans().is_lost(seen(30, returns), view * VIEW_M) == is_lost


def test_nothing_is_lost_in_a_stairwell():
    assert not after_clear_scans(view_m=2.5).is_lost(seen(30, 0.4), 1.2)


@pytest.mark.parametrize(("scans", "is_lost"), [(5, True), (100, False)])
def test_a_cloud_comes_at_once_and_a_scene_slowly(scans: int, is_lost: bool):
    visibility, shares = after_clear_scans(), np.geomspace(1.0, 0.3, scans)
    assert any(visibility.is_lost(seen(30 + k, a), a * VIEW_M) for k, a in enumerate(shares)) == is_lost


def test_what_lasts_is_the_scene():
    visibility = after_clear_scans()
    lost = [visibility.is_lost(seen(k, 0.3), 0.3 * VIEW_M) for k in range(30, 90)]
    assert sum(lost) == lost.index(False)  # once it is over, it is
    assert 2.0 < 0.1 * sum(lost) < 4.0
    assert not any(visibility.is_lost(seen(k), VIEW_M) for k in range(90, 100))


def test_a_scan_without_points_changes_nothing():
    visibility = after_clear_scans()
    assert not visibility.is_lost(seen(30, 0.0), np.nan)
    assert visibility.is_lost(seen(31, 0.2), 0.3 * VIEW_M)


@pytest.mark.parametrize("has_imu", [True, False])
def test_inside_a_cloud_the_imu_is_believed(has_imu: bool, sequence: Sequence):
    """The cloud comes along, so its returns say that nothing moves."""
    assert sequence.reference is not None
    steps = se3.between(sequence.reference.poses[:9], sequence.reference.poses[1:10])
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((len(sequence[0].scan) // 4, 3))
    cloud = directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(2.5, 4.0, (len(directions), 1))
    matching = ScanMatching()
    matching.start(sequence[0])
    found = []
    for k in range(1, 10):
        frame = sequence[k]
        if 4 <= k < 8:
            frame = replace(frame, scan=Scan(frame.scan.stamp_ns, cloud.astype(np.float32)))
        found.append(matching.refine(frame, RelativePose(steps[k - 1], SURE, "guess", from_imu=has_imu)))
    inside = [one.details["points"] == 0 and not one.ok for one in found]
    assert inside == [has_imu and 4 <= k < 8 for k in range(1, 10)]
    if has_imu:
        np.testing.assert_array_equal(found[5].pose, steps[5])
        assert np.linalg.norm(found[7].pose[:3, 3] - steps[7][:3, 3]) < 0.04
