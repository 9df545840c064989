"""Whole drives: run through the incremental backend, or composed of their relative poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import IncrementalBackend


def run(chain: Any) -> tuple[IncrementalBackend, list[State], list[RelativePose]]:
    """Run the chain; return the backend, the states at all scans but the first, and the steps to them."""
    backend = IncrementalBackend(InertialSteps(chain.calibration, chain.noise))
    backend.start(chain.start)
    states, steps = [], []
    for frame, relative in zip(chain.frames[1:], chain.relative, strict=True):
        states.append(backend.update(frame, relative))
        steps.append(backend.last_step())
    return backend, states, steps


def composed(drive: Any) -> np.ndarray:
    """Compose the drive's relative poses; return the lidar poses ``(N, 4, 4)``."""
    poses = [np.eye(4)]
    for relative in drive.relative:
        poses.append(poses[-1] @ relative.pose)
    return np.array(poses)


def pose_error(state: State, T_world_imu: np.ndarray) -> np.ndarray:
    return se3.log(se3.between(state.T_world_imu, T_world_imu))
