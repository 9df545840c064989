"""Whether a step continues the motion: by the accelerations of a calm platform, and by what this one does."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.sources.gate.motion_change import MotionChange

DT_S = 0.1


def step(speed_m_s: float, rate_rad_s: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([0, 0, rate_rad_s, speed_m_s, 0, 0]) * DT_S)


def at_speed(speed_m_s: float) -> MotionChange:
    motion = MotionChange()
    motion.learn(step(speed_m_s), DT_S, is_typical=True)
    return motion


@pytest.mark.parametrize(
    ("change_m_s", "change_rad_s", "continues"),
    [(0.7, 0.0, True), (0.0, 0.2, True), (5.0, 0.0, False), (0.0, 1.0, False)],
    ids=["hard braking", "into a bend", "half a metre off", "six degrees off"],
)
def test_a_calm_platform_brakes_and_turns_but_does_not_jump(change_m_s: float, change_rad_s: float, continues: bool):
    assert at_speed(10.0).continues(step(10.0 + change_m_s, change_rad_s), DT_S) == continues


def test_a_violent_platform_may_change_as_it_has_shown():
    motion = at_speed(0.0)
    violent = step(0.0, 2.0)
    assert not motion.continues(violent, DT_S)
    for k in range(40):
        motion.learn(step(0.0, 2.0 * (k % 2)), DT_S, is_typical=True)
    assert motion.continues(violent, DT_S)


def test_untypical_steps_teach_nothing():
    motion = at_speed(0.0)
    for k in range(40):
        motion.learn(step(0.0, 2.0 * (k % 2)), DT_S, is_typical=False)
    assert not motion.continues(step(0.0, -2.0), DT_S)


def test_before_the_first_step_nothing_is_continued():
    assert not MotionChange().continues(step(0.0), DT_S)
