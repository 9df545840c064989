"""Two residual sources in a row: where each starts, whose answer is used, and failures of either."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Frame, Scan
from hybridlio.sources.residual_chain import ResidualChain

FRAME = Frame(3, Scan(0, np.ones((1, 3), np.float32)))
UNSURE = RelativePose(se3.exp([0, 0, 0.01, 1, 0, 0]), np.eye(6) * 0.04, "guess", from_imu=True)
SURE = replace(UNSURE, covariance=np.eye(6) * 1e-4)


class Moved:
    """Moves the initial pose forward and remembers its input."""

    def __init__(self, name, metres, sigma=0.01, ok=True):
        self.name, self._metres, self._covariance, self._ok = name, metres, np.eye(6) * sigma**2, ok
        self.started, self.given, self.degenerate = [], [], np.empty((0, 6))

    def start(self, frame):
        self.started.append(frame.index)

    def refine(self, _, initial):
        self.given.append(initial)
        if not self._ok:
            return replace(initial, ok=False, proposed=None, details={"points": 7.0})
        details = {"cost": self._metres}
        return RelativePose(self._moved(initial), self._covariance, self.name, self.degenerate, details=details)

    def propose(self, _, initial):
        return self._moved(initial) if self._ok else None

    def assess(self, frame, initial):
        return self.refine(frame, initial)

    def _moved(self, initial):
        return initial.pose @ se3.exp([0, 0, 0, self._metres, 0, 0])


def ahead_m(relative):
    return se3.log(se3.between(UNSURE.pose, relative.pose))[3]


def test_from_a_vague_pose_the_second_source_refines_the_first_ones_answer():
    first, second = Moved("coarse", 0.2), Moved("fine", 0.03)
    chain = ResidualChain(first, second)
    chain.start(FRAME)
    found = chain.refine(FRAME, UNSURE)
    assert first.started == second.started == [3]
    assert chain.name == found.source == "coarse+fine"
    assert ahead_m(second.given[0]) == pytest.approx(0.2)
    assert ahead_m(found) == pytest.approx(0.23)
    assert np.array_equal(found.covariance, np.eye(6) * 0.01**2)
    assert found.details == {"coarse ok": 1, "coarse cost": 0.2, "fine ok": 1, "fine cost": 0.03}


def test_if_the_first_source_fails_the_second_starts_at_the_initial_pose():
    second = Moved("fine", 0.03)
    found = ResidualChain(Moved("coarse", 0.2, ok=False), second).refine(FRAME, UNSURE)
    assert second.given == [UNSURE]
    assert found.ok
    assert found.details["coarse ok"] == 0
    assert ahead_m(found) == pytest.approx(0.03)


def test_if_the_second_source_fails_the_first_ones_answer_is_used():
    found = ResidualChain(Moved("coarse", 0.2), Moved("fine", 0.0, ok=False)).refine(FRAME, UNSURE)
    assert found.ok
    assert ahead_m(found) == pytest.approx(0.2)
    assert np.array_equal(found.covariance, np.eye(6) * 0.01**2)
    assert found.details["fine ok"] == 0


def test_if_both_sources_fail_the_initial_pose_bridges():
    found = ResidualChain(Moved("coarse", 0.2, ok=False), Moved("fine", 0.0, ok=False)).refine(FRAME, UNSURE)
    assert not found.ok
    assert (found.source, found.from_imu) == ("guess", True)
    assert np.allclose(found.pose, UNSURE.pose, atol=1e-15)
    assert np.array_equal(found.covariance, UNSURE.covariance)
    assert (found.details["coarse ok"], found.details["fine ok"]) == (0, 0)


def test_if_the_first_source_is_degenerate_the_second_starts_at_the_initial_pose():
    first, second = Moved("coarse", 0.2), Moved("fine", 0.0)
    first.degenerate = np.eye(6)[3:4]
    found = ResidualChain(first, second).refine(FRAME, UNSURE)
    assert second.given == [UNSURE]
    assert (found.ok, len(found.degenerate)) == (True, 0)


def test_from_a_certain_pose_the_first_source_only_proposes():
    first, second = Moved("coarse", 0.2), Moved("fine", 0.03)
    found = ResidualChain(first, second).refine(FRAME, SURE)
    assert first.given == []
    (given,) = second.given
    assert np.allclose(given.pose, SURE.pose, atol=1e-15)
    assert np.array_equal(given.covariance, SURE.covariance)
    assert ahead_m(replace(given, pose=given.proposed)) == pytest.approx(0.2)
    assert (found.ok, found.source, ahead_m(found)) == (True, "coarse+fine", pytest.approx(0.03))
    assert found.details == {"fine ok": 1, "fine cost": 0.03}


def test_if_the_second_source_fails_from_a_certain_pose_the_proposal_is_assessed_and_used():
    class Keeping(Moved):
        def take_back(self, initial):
            self.kept = initial

    second = Keeping("fine", 0.0, ok=False)
    found = ResidualChain(Moved("coarse", 0.2), second).refine(FRAME, SURE)
    assert (found.ok, found.source, ahead_m(found)) == (True, "coarse+fine", pytest.approx(0.2))
    assert np.array_equal(found.covariance, np.eye(6) * 0.01**2)
    assert np.array_equal(second.kept.pose, found.pose)
    assert (found.details["coarse ok"], found.details["fine ok"]) == (1, 0)


def test_if_both_sources_fail_a_certain_pose_bridges():
    found = ResidualChain(Moved("coarse", 0.2, ok=False), Moved("fine", 0.0, ok=False)).refine(FRAME, SURE)
    assert (found.ok, found.source, found.proposed) == (False, "guess", None)
    assert np.array_equal(found.covariance, SURE.covariance)


def test_both_sources_take_a_rejected_answer_back():
    class Humble(Moved):
        def take_back(self, initial):
            self.given.append(("back", initial))

    first, second = Humble("coarse", 0.2), Moved("fine", 0.03)
    ResidualChain(first, second).take_back(UNSURE)
    assert first.given == [("back", UNSURE)]
    assert second.given == []
