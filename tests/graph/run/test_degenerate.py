"""Degenerate directions: the IMU constrains them, and the covariance tells how well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import State
from hybridlio.graph.run.fixed_lag_backend import FixedLagBackend
from hybridlio.graph.run.inertial_steps import InertialSteps

OPEN_M = 10.0  # standard deviation that scan matching gives a degenerate direction


def through_a_corridor(chain: Callable[..., Any], seed: int, steps: int) -> tuple[Any, list[State]]:
    """Thirty normal steps, then steps in a corridor: 0.3 m wrong along it, with that direction claimed as unknown."""
    drive = chain(seed, steps=30 + steps)
    unknown = np.zeros((6, 6))
    unknown[3, 3] = OPEN_M**2
    slip = se3.exp(np.array([0, 0, 0, 0.3, 0, 0]))
    for k in range(30, 30 + steps):
        relative = drive.relative[k]
        drive.relative[k] = replace(relative, pose=relative.pose @ slip, covariance=relative.covariance + unknown)
    backend = FixedLagBackend(InertialSteps(drive.calibration, drive.noise))
    backend.start(drive.start)
    return drive, [backend.update(f, r) for f, r in zip(drive.frames[1:], drive.relative, strict=True)]


def test_along_a_corridor_the_imu_determines_the_distance(chain: Callable[..., Any]):
    along, claimed = [], []
    for seed in range(400, 408):
        drive, states = through_a_corridor(chain, seed, steps=20)
        error = se3.log(se3.between(states[-1].T_world_imu, drive.poses[50]))
        along.append(error[3])
        claimed.append(np.sqrt(states[-1].covariance[3, 3]))
    # 20 errors of 0.3 m would be 6 m; a MEMS accelerometer whose bias is still converging errs by decimetres in 2 s
    assert np.sqrt(np.mean(np.square(along))) < 0.6
    assert 0.3 < np.sqrt(np.mean(np.square(np.array(along) / claimed))) < 1.7


def test_along_a_corridor_the_covariance_grows_faster_than_across_it_and_before_it(chain: Callable[..., Any]):
    _, states = through_a_corridor(chain, 400, steps=20)
    variances = np.array([np.diag(state.covariance)[3:6] for state in states])
    added = variances[49] - variances[29]
    before = variances[29] - variances[9]
    assert added[0] > 2 * added[1]
    assert added[0] > 4 * before[0]
