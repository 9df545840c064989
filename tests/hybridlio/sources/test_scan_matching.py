from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matching import OFF, SURE, corridor, empty, guess, true_pose, with_points

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.settings import ScanMatchingSettings

TARGETS = ("local-map", "last-scan")


@pytest.fixture(scope="module")
def frames(sequence: Sequence) -> list[Frame]:
    return [sequence[k] for k in range(12)]


def error(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the error in degrees and metres."""
    xi = se3.log(se3.between(found, truth))
    return float(np.degrees(np.linalg.norm(xi[:3]))), float(np.linalg.norm(xi[3:]))


# -------------------------------------------------------------------------------------------------- a drive


@pytest.mark.parametrize("target", TARGETS)
def test_a_short_drive_is_recovered_from_poor_guesses(target: str, sequence: Sequence, frames: list[Frame]):
    matching = ScanMatching(ScanMatchingSettings(target=target))
    matching.start(frames[0])
    whole = np.eye(4)
    for k in range(1, len(frames)):
        truth = true_pose(sequence, k - 1, k)
        found = matching.refine(frames[k], guess(truth @ OFF))
        degrees, metres = error(found.pose, truth)
        assert found.ok
        assert found.source == "scan-matching"
        assert not found.from_imu
        assert metres < 0.04  # the initial poses are 15 cm off
        assert degrees < 0.35  # with 16 beams, and initial poses a third of a degree off
        whole = whole @ found.pose
    degrees, metres = error(whole, true_pose(sequence, 0, len(frames) - 1))
    assert metres < (0.06 if target == "local-map" else 0.12)
    assert degrees < (0.4 if target == "local-map" else 1.0)


@pytest.mark.parametrize("skipped", [2, 3, 4])
def test_an_unknown_speed_is_found_at_the_start(skipped: int, sequence: Sequence, frames: list[Frame]):
    """Leaving scans out of a drive at 8 m/s makes drives at 16, 24 and 32 m/s."""
    matching = ScanMatching()
    matching.start(frames[0])
    fast = with_points(frames[skipped], frames[skipped].scan.points, frames[1].scan.stamp_ns)
    found = matching.refine(fast, guess(np.eye(4), unknown_motion_covariance(0.1)))
    truth = true_pose(sequence, 0, skipped)
    assert truth[0, 3] > 0.78 * skipped
    assert error(found.pose, truth)[1] < 0.05


def test_a_start_at_rest_is_found_at_rest(frames: list[Frame]):
    matching = ScanMatching()
    matching.start(frames[0])
    found = matching.refine(frames[1], guess(np.eye(4), unknown_motion_covariance(0.1)))
    standing = ScanMatching()
    standing.start(frames[0])
    same = with_points(frames[0], frames[0].scan.points, frames[1].scan.stamp_ns)
    still = standing.refine(same, guess(np.eye(4), unknown_motion_covariance(0.1)))
    assert found.pose[0, 3] > 0.5
    assert error(still.pose, np.eye(4))[1] < 0.005


@pytest.mark.parametrize("target", TARGETS)
def test_the_same_drive_gives_identical_results(target: str, sequence: Sequence, frames: list[Frame]):
    def drive() -> list[bytes]:
        matching, out = ScanMatching(ScanMatchingSettings(target=target)), []
        matching.start(frames[0])
        for k in range(1, 7):
            found = matching.refine(frames[k], guess(true_pose(sequence, k - 1, k) @ OFF))
            out += [found.pose.tobytes(), found.covariance.tobytes()]
        return out

    assert drive() == drive()


def test_the_covariance_is_of_the_order_of_the_errors(sequence: Sequence, frames: list[Frame]):
    """A wide interval, because the pitch of a 16-beam sensor's first steps is less certain than its covariance."""
    matching, nees = ScanMatching(), []
    matching.start(frames[0])
    for k in range(1, len(frames)):
        truth = true_pose(sequence, k - 1, k)
        found = matching.refine(frames[k], guess(truth @ OFF))
        xi = se3.log(se3.between(found.pose, truth))[3:]
        nees.append(xi @ np.linalg.solve(found.covariance[3:, 3:], xi) / 3)
    assert 0.05 < np.mean(nees) < 3.0


# ------------------------------------------------------------------------------------------------ what it returns


def test_only_a_part_of_the_covariance_drifts_with_a_local_map(sequence: Sequence, frames: list[Frame]):
    for target in TARGETS:
        settings = ScanMatchingSettings(target=target)
        matching = ScanMatching(settings)
        matching.start(frames[0])
        found = matching.refine(frames[1], guess(true_pose(sequence, 0, 1)))
        if target == "last-scan":
            assert found.drift is None
        else:
            assert found.drift is not None
            share = np.trace(found.drift) / np.trace(found.covariance)
            assert settings.drift_share * 0.999 <= share < 1  # a larger share while the map is young
            np.testing.assert_allclose(found.drift, share * found.covariance)


def test_details_hold_the_registrations_diagnostics(sequence: Sequence, frames: list[Frame]):
    matching = ScanMatching()
    matching.start(frames[0])
    details = matching.refine(frames[1], guess(true_pose(sequence, 0, 1) @ OFF)).details
    assert set(details) == {"points", "matched", "iterations", "converged", "sigma_m", "cost"}
    assert details["points"] > 1000
    assert 0.8 < details["matched"] <= 1
    assert details["converged"] == 1
    assert 0.005 < details["sigma_m"] < 0.1
    assert 0 < details["cost"] < 0.5


def test_points_out_of_range_are_ignored(rng: np.random.Generator, sequence: Sequence, frames: list[Frame]):
    vehicle = rng.uniform(-1, 1, (3000, 3))
    beyond = rng.normal(size=(3000, 3))
    beyond *= 150 / np.linalg.norm(beyond, axis=1, keepdims=True)
    answers = []
    for extra in (np.empty((0, 3)), np.concatenate([vehicle, beyond])):
        matching = ScanMatching()
        for k in range(2):
            frame = with_points(frames[k], np.concatenate([frames[k].scan.points, extra]))
            if k == 0:
                matching.start(frame)
            else:
                answers.append(matching.refine(frame, guess(true_pose(sequence, 0, 1))).pose)
    np.testing.assert_array_equal(answers[0], answers[1])


def test_the_direction_along_a_corridor_is_degenerate(rng: np.random.Generator, frames: list[Frame]):
    matching = ScanMatching()
    matching.start(with_points(frames[0], corridor(rng)))
    initial = guess(se3.exp(np.array([0.0, 0.0, 0.004, 0.8, 0.05, -0.03])), SURE / 9)
    found = matching.refine(with_points(frames[1], corridor(rng)), initial)
    assert found.ok
    assert len(found.degenerate) == 1
    assert abs(found.degenerate[0, 3]) > 0.99
    assert np.sqrt(found.covariance[3, 3]) > 1.0
    assert (np.sqrt(np.diag(found.covariance)[[4, 5]]) < 0.05).all()
    # along the corridor the initial pose is kept, across it the walls decide
    assert found.pose[0, 3] == pytest.approx(0.8, abs=0.05)
    np.testing.assert_allclose(found.pose[1:3, 3], 0.0, atol=0.01)


def test_a_proposal_is_ignored_along_a_corridor(rng: np.random.Generator, frames: list[Frame]):
    matching = ScanMatching()
    matching.start(with_points(frames[0], corridor(rng)))
    initial = guess(se3.exp(np.array([0.0, 0.0, 0.004, 0.8, 0.05, -0.03])))
    proposed = replace(
        initial, proposed=se3.exp(np.array([0, 0, 0, 0.3, 0, 0]))
    )  # half a metre behind, without rotation
    found = matching.refine(with_points(frames[1], corridor(rng)), proposed)
    assert found.pose[0, 3] == pytest.approx(0.8, abs=0.05)
    np.testing.assert_allclose(found.pose[1:3, 3], 0.0, atol=0.01)


def test_a_good_proposal_saves_iterations_and_a_bad_one_has_no_effect(sequence: Sequence, frames: list[Frame]):
    truth, answers = true_pose(sequence, 0, 1), {}
    for name, proposed in {"none": None, "good": truth, "bad": truth @ OFF @ OFF @ OFF}.items():
        matching = ScanMatching()
        matching.start(frames[0])
        answers[name] = matching.refine(frames[1], replace(guess(truth @ OFF), proposed=proposed))
    assert answers["good"].details["iterations"] < answers["none"].details["iterations"]
    np.testing.assert_allclose(answers["good"].pose, answers["none"].pose, atol=2e-3)
    np.testing.assert_array_equal(answers["bad"].pose, answers["none"].pose)
    np.testing.assert_array_equal(answers["bad"].covariance, answers["none"].covariance)


# --------------------------------------------------------------------------------------------------- bad scans


@pytest.mark.parametrize("target", TARGETS)
def test_an_empty_scan_is_bridged_and_the_next_one_corrects_the_bridge(
    target: str, sequence: Sequence, frames: list[Frame]
):
    matching = ScanMatching(ScanMatchingSettings(target=target))
    matching.start(frames[0])
    matching.refine(frames[1], guess(true_pose(sequence, 0, 1)))
    initial = RelativePose(true_pose(sequence, 1, 2) @ OFF, SURE, "imu", from_imu=True)
    bridged = matching.refine(empty(frames[2]), initial)
    assert not bridged.ok
    assert (bridged.source, bridged.from_imu) == ("imu", True)
    np.testing.assert_allclose(bridged.pose, initial.pose, atol=1e-12)
    np.testing.assert_allclose(bridged.covariance, initial.covariance)
    assert bridged.details["points"] == 0
    after = matching.refine(frames[3], guess(true_pose(sequence, 2, 3)))
    assert after.ok
    # the next step undoes the bridge's error, because scan 3 is matched to scan 1
    assert error(bridged.pose @ after.pose, true_pose(sequence, 1, 3))[1] < 0.04


def test_three_empty_scans_in_a_row_are_bridged(sequence: Sequence, frames: list[Frame]):
    matching = ScanMatching()
    matching.start(frames[0])
    for k in (1, 2, 3):
        assert not matching.refine(empty(frames[k]), guess(true_pose(sequence, k - 1, k))).ok
    assert matching.refine(frames[4], guess(true_pose(sequence, 3, 4) @ OFF)).ok


def test_a_bridge_may_be_more_precise_than_the_map(sequence: Sequence, frames: list[Frame]):
    matching = ScanMatching()
    matching.start(frames[0])
    precise = guess(true_pose(sequence, 0, 1), np.eye(6) * 1e-12)
    assert not matching.refine(empty(frames[1]), precise).ok


def test_a_scan_of_another_place_is_bridged(rng: np.random.Generator, sequence: Sequence, frames: list[Frame]):
    matching = ScanMatching()
    matching.start(frames[0])
    elsewhere = rng.uniform([-60, -60, 10], [60, 60, 130], (5000, 3))
    initial = guess(true_pose(sequence, 0, 1))
    found = matching.refine(with_points(frames[1], elsewhere), initial)
    assert not found.ok
    np.testing.assert_allclose(found.pose, initial.pose, atol=1e-12)
    assert found.details["matched"] < 0.3


def test_a_bridged_scan_does_not_enter_the_map(sequence: Sequence, frames: list[Frame]):
    answers = []
    for between in (empty(frames[1]), with_points(frames[1], frames[1].scan.points[:40])):
        matching = ScanMatching()
        matching.start(frames[0])
        assert not matching.refine(between, guess(true_pose(sequence, 0, 1))).ok
        answers.append(matching.refine(frames[2], guess(true_pose(sequence, 1, 2))).pose)
    np.testing.assert_array_equal(answers[0], answers[1])


@pytest.mark.parametrize("target", TARGETS)
def test_scans_that_no_longer_fit_start_a_new_map(target: str, sequence: Sequence, frames: list[Frame]):
    """As after a gap: a few are bridged, and the next ones are matched to each other."""
    matching = ScanMatching(ScanMatchingSettings(target=target))
    rng = np.random.default_rng(2)
    matching.start(with_points(frames[0], rng.uniform([-60, -60, 10], [60, 60, 130], (20_000, 3))))
    known = [matching.refine(frames[k], guess(true_pose(sequence, k - 1, k))) for k in range(1, 10)]
    bridged = [not step.ok for step in known]
    first_again = bridged.index(False)
    assert 3 <= first_again <= 8
    assert not any(bridged[first_again:])
    truth = true_pose(sequence, first_again, first_again + 1)
    assert error(known[first_again].pose, truth)[1] < 0.05
    if target == "local-map":  # the path of the map gets the covariance of all bridges together, errors of one velocity
        drift = known[first_again - 1].drift
        assert drift is not None
        assert np.trace(drift) == pytest.approx(first_again**2 * np.trace(SURE), rel=0.2)


@pytest.mark.parametrize("points", [0, 40])
def test_a_first_scan_with_too_few_points_is_refused(points: int, frames: list[Frame]):
    poor = with_points(replace(frames[0], index=17), frames[0].scan.points[:points])
    with pytest.raises(DataError, match=r"frame 17: only \d+ points between .* start at a scan with at least 50"):
        ScanMatching().start(poor)


def test_a_failed_start_can_be_followed_by_another(sequence: Sequence, frames: list[Frame]):
    matching = ScanMatching()
    with pytest.raises(DataError):
        matching.start(empty(frames[0]))
    matching.start(frames[1])
    assert matching.refine(frames[2], guess(true_pose(sequence, 1, 2))).ok


def test_a_first_scan_without_planes_is_followed_by_another_first_keyframe(sequence: Sequence, frames: list[Frame]):
    turn = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    ring = np.column_stack([40 * np.cos(turn), 40 * np.sin(turn), np.full(900, -1.0)])
    matching = ScanMatching()
    matching.start(with_points(frames[0], ring))
    known = [matching.refine(frames[k], guess(true_pose(sequence, k - 1, k))).ok for k in (1, 2, 3)]
    assert known == [False, True, True]
