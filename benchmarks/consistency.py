"""Check covariances: ANEES over simulated drives of known noise, online and smoothed. 1 is consistent.

python benchmarks/consistency.py [--runs 50] [--steps 100] [--seed 1000]

Each drive is a smooth path with an IMU (bias, bias random walk and white noise of its `ImuNoise`) and relative poses
whose errors have exactly the stated covariances: either independent from step to step, or those of registration to a
map, which scatter about the map and drift with it. `Odometry` with each backend and `smooth` estimate the poses.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field

import numpy as np

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import NS_PER_S, Frame
from hybridlio.evaluation.consistency import PoseConsistency, pose_consistency
from hybridlio.simulation.chain import Chain, ChainSettings, make_chain

DRIFT_SHARES = {"independent steps": None, "registered to a map": 0.02}  # share of a step's variance that drifts
BACKENDS = ("incremental", "fixed-lag")


class Standstill:
    """Predicts no motion; the residual source below does not use the prediction."""

    name = "standstill"

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Return the identity, with the covariance of an unknown motion."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Do nothing."""


class Simulated:
    """A residual source that returns the drive's relative poses."""

    name = "simulated"

    def __init__(self, drive: Chain) -> None:
        self._drive = drive

    def start(self, frame: Frame) -> None:
        """Do nothing."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return the relative pose of this step."""
        del initial
        return self._drive.relative[frame.index - 1]


@dataclass
class Errors:
    """Errors and covariances of many runs."""

    errors: list[np.ndarray] = field(default_factory=list)
    covariances: list[np.ndarray] = field(default_factory=list)

    def add(self, true: np.ndarray, poses: np.ndarray, covariances: np.ndarray) -> None:
        """Add a run: true and estimated poses ``(M, 4, 4)``, covariances ``(M, 6, 6)``."""
        self.errors.append(se3.log(se3.between(poses, true)))
        self.covariances.append(covariances)

    @property
    def consistency(self) -> PoseConsistency:
        """The consistency of all runs together."""
        return pose_consistency(np.concatenate(self.errors), np.concatenate(self.covariances))


def run(drive: Chain, backend: str) -> tuple[hl.Odometry, list[hl.Estimate]]:
    odometry = hl.Odometry(Standstill(), Simulated(drive), backend)
    return odometry, [odometry.step(frame) for frame in drive.frames]


def measure(seeds: range, steps: int, drift_share: float | None) -> dict[str, tuple[Errors, Errors]]:
    """Return errors of poses relative to the first, and errors of steps, by estimator."""
    out = {name: (Errors(), Errors()) for name in (*BACKENDS, "smoothed")}
    for seed in seeds:
        drive = make_chain(seed, ChainSettings(steps=steps, drift_share=drift_share))
        true = drive.lidar_poses
        true_steps = se3.between(true[:-1], true[1:])
        for backend in BACKENDS:
            odometry, estimates = run(drive, backend)
            of_poses, of_steps = out[backend]
            for errors, truth, found in (
                (of_poses, true[1:], [(e.pose, e.covariance) for e in estimates[1:]]),
                (of_steps, true_steps, [(e.step.pose, e.step.covariance) for e in estimates[1:] if e.step]),
            ):
                errors.add(truth, *(np.array(part) for part in zip(*found, strict=True)))
        smoothed = hl.smooth(odometry.record())
        of_poses, of_steps = out["smoothed"]
        poses, covariances = smoothed.trajectory.poses, smoothed.trajectory.covariances
        assert covariances is not None
        of_poses.add(true[1:], poses[1:], covariances[1:])
        of_steps.add(true_steps, se3.between(poses[:-1], poses[1:]), smoothed.step_covariances)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50, help="drives of each kind (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=100, help="of each drive (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1000, help="of the first drive (default: %(default)s)")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.runs)
    print(f"{options.runs} drives of {options.steps} steps, seeds {seeds.start} to {seeds.stop - 1}; ANEES")
    print(f"{'':34s} {'rotation':>9s} {'position':>9s} {'step rot.':>9s} {'step pos.':>9s}")
    for kind, share in DRIFT_SHARES.items():
        begin = time.process_time()
        for name, (poses, steps) in measure(seeds, options.steps, share).items():
            values = [
                part for found in (poses, steps) for part in (found.consistency.rotation, found.consistency.position)
            ]
            print(f"{kind:20s} {name:13s} " + " ".join(f"{part.value:9.3f}" for part in values), flush=True)
        print(f"{'':20s} {time.process_time() - begin:.0f} s processor time")


if __name__ == "__main__":
    main()
