"""A scan that is matched a second time."""

from __future__ import annotations

import numpy as np
import pytest
from matching import OFF, guess, true_pose, with_points

from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.settings import ScanMatchingSettings


@pytest.fixture(scope="module")
def frames(sequence: Sequence) -> list[Frame]:
    return [sequence[k] for k in range(12)]


def test_a_scan_that_is_matched_again_is_matched_as_if_once(sequence: Sequence, frames: list[Frame]):
    steps = []
    for times in (1, 2):
        matching = ScanMatching()
        matching.start(frames[0])
        for k in range(1, 4):
            initial = guess(true_pose(sequence, k - 1, k) @ OFF)
            found = matching.refine(frames[k], initial)
            if times == 2:
                found = matching.refine_again(frames[k], initial)
            steps.append(found)
    for once, twice in zip(steps[:3], steps[3:], strict=True):
        np.testing.assert_array_equal(once.pose, twice.pose)
        np.testing.assert_array_equal(once.covariance, twice.covariance)


def test_a_scan_that_is_matched_again_counts_once_for_the_scale_of_the_scene(sequence: Sequence, frames: list[Frame]):
    """A running mean over scans that shrink to a room's size goes as far with a second match of each as without."""
    scales = []
    for again in (False, True):
        matching = ScanMatching(ScanMatchingSettings(registration=RegistrationSettings(max_distance_m=3.0)))
        matching.start(frames[0])
        for k in range(1, 6):
            smaller = with_points(frames[k], frames[k].scan.points * 0.85**k)
            matching.refine(smaller, guess(np.eye(4)))
            if again:
                matching.refine_again(smaller, guess(np.eye(4)))
            scales.append(matching.settings.map_voxel_m)
    assert scales[:5] == scales[5:]
    assert scales[4] < scales[0]
