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


def vote(travelled_m: float, offset_m: float = 0.0) -> Vote:
    """A vote of a run along x, whose world is displaced in the map."""
    pose = se3.make(np.eye(3), np.array([travelled_m, 0.0, 0.0]))
    return Vote(se3.make(np.eye(3), np.array([0.0, offset_m, 0.0])), pose, travelled_m, np.eye(6))


def test_a_place_is_believed_when_scans_metres_apart_agree():
    confirmation = Confirmation(ConfirmationSettings(places=3, distance_m=8.0))
    assert [confirmation.add(vote(metres)) for metres in (0.0, 4.0, 8.0)] == [False, False, True]


def test_a_vehicle_that_stands_confirms_nothing():
    confirmation = Confirmation()
    assert not any(confirmation.add(vote(0.001 * k)) for k in range(50))


def test_scans_that_disagree_confirm_nothing():
    confirmation = Confirmation()
    assert not any(confirmation.add(vote(4.0 * k, offset_m=2.0 * k)) for k in range(10))


def test_a_rival_that_is_half_as_good_prevents_belief():
    confirmation = Confirmation(ConfirmationSettings(places=3, distance_m=8.0, rival_share=0.5))
    votes = [vote(1.0, 30.0), vote(5.0, 30.0), vote(2.0), vote(6.0), vote(10.0)]
    assert not any(confirmation.add(one) for one in votes)
    assert confirmation.add(vote(14.0))


def test_old_votes_are_forgotten():
    confirmation = Confirmation(ConfirmationSettings(places=3, distance_m=8.0, window_m=20.0))
    assert not any(confirmation.add(vote(metres)) for metres in (0.0, 15.0, 30.0, 45.0))
