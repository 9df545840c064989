"""What is believed: covariance intersection, and the confirmation of a place."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.localization.confirmation import Confirmation, ConfirmationSettings, Vote
from hybridlio.localization.fusion import UncertainPose


def uncertain(metres: float, sigma_m: float) -> UncertainPose:
    return UncertainPose(se3.make(np.eye(3), np.array([metres, 0.0, 0.0])), np.diag(np.full(6, sigma_m**2)))


def test_matches_that_share_their_error_do_not_add_up_to_certainty():
    pose = uncertain(0.0, 0.02)
    for _ in range(100):
        pose = pose.fused(uncertain(0.0, 0.01))
    np.testing.assert_allclose(pose.covariance, uncertain(0.0, 0.01).covariance, rtol=1e-6)


def test_a_vague_pose_yields_to_a_sure_one_and_not_the_other_way():
    vague, sure = uncertain(1.0, 1.0), uncertain(0.0, 0.01)
    for one, other in ((vague, sure), (sure, vague)):
        np.testing.assert_allclose(one.fused(other).pose[:3, 3], 0.0, atol=1e-3)


def votes(confirmation: Confirmation, places_m: list[float], offsets_m: list[float]) -> list[bool]:
    """Whether each answer of a run along x is believed; an offset displaces the answer sideways."""
    believed, at_m = [], 0.0
    for metres, offset in zip(places_m, offsets_m, strict=True):
        confirmation.move(se3.make(np.eye(3), np.array([metres - at_m, 0.0, 0.0])), 1e-8 * np.eye(6))
        pose = se3.make(np.eye(3), np.array([metres, offset, 0.0]))
        believed.append(confirmation.add(Vote(UncertainPose(pose, 1e-4 * np.eye(6)), metres)) is not None)
        at_m = metres
    return believed


def test_a_place_is_believed_when_scans_metres_apart_agree():
    confirmation = Confirmation(ConfirmationSettings(places=3, distance_m=8.0))
    assert votes(confirmation, [0.0, 4.0, 8.0], [0.0] * 3) == [False, False, True]


def test_a_vehicle_that_stands_confirms_nothing():
    assert not any(votes(Confirmation(), [0.001 * k for k in range(50)], [0.0] * 50))


def test_scans_that_disagree_confirm_nothing():
    assert not any(votes(Confirmation(), [4.0 * k for k in range(10)], [2.0 * k for k in range(10)]))


def test_a_rival_that_is_half_as_good_prevents_belief():
    confirmation = Confirmation(ConfirmationSettings(places=3, distance_m=8.0, rival_share=0.5))
    places, offsets = [1.0, 2.0, 5.0, 6.0, 10.0, 14.0], [30.0, 0.0, 30.0, 0.0, 0.0, 0.0]
    assert votes(confirmation, places, offsets) == [False] * 5 + [True]


def test_old_votes_are_forgotten():
    confirmation = Confirmation(ConfirmationSettings(places=3, distance_m=8.0, window_m=20.0))
    assert not any(votes(confirmation, [0.0, 15.0, 30.0, 45.0], [0.0] * 4))


def test_the_pose_believed_is_not_that_of_one_scan_decimetres_off():
    step = se3.make(np.eye(3), np.array([5.0, 0.0, 0.0]))
    for outlier in range(3):
        confirmation, believed = Confirmation(), None
        for k in range(3):
            confirmation.move(step, 1e-6 * np.eye(6))
            pose = se3.make(np.eye(3), np.array([5.0 * k, 0.4 * (k == outlier), 0.0]))
            believed = confirmation.add(Vote(UncertainPose(pose, 1e-4 * np.eye(6)), 5.0 * k))
        assert believed is not None
        np.testing.assert_allclose(believed.pose[:3, 3], [10.0, 0.0, 0.0], atol=1e-9)
        assert np.trace(believed.covariance) >= 6e-4 - 1e-12  # with the drift of the odometry on the way
