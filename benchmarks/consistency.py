"""Whether covariances tell the truth: ANEES over simulated drives of known noise, online and smoothed.

python benchmarks/consistency.py [--runs 50] [--steps 100] [--seed 1000]

Each drive is a smooth path with an IMU on it (bias, bias walk and white noise as its `ImuNoise` says) and relative
poses whose errors have exactly the covariances they claim: independent from step to step, or those of matching to a
map, which scatter about it and drift. They go through `Odometry` with each backend, and through `smooth`. 1 is
consistent.
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

KINDS = {"independent steps": None, "matched to a map": 0.02}
BACKENDS = ("incremental", "fixed-lag")


class Standstill:
    """An initial pose that knows nothing; the residual source below does without."""

    name = "standstill"

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """No motion, as unsure as a vehicle is free to move."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Nothing to learn."""


class Simulated:
    """A residual source that answers with the drive's relative poses."""

    name = "simulated"

    def __init__(self, drive: Chain) -> None:
        self._drive = drive

    def start(self, frame: Frame) -> None:
        """Nothing to prepare."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """The relative pose of this step."""
        del initial
        return self._drive.relative[frame.index - 1]


@dataclass
class Errors:
    """What many runs of one kind came to."""

    errors: list[np.ndarray] = field(default_factory=list)
    covariances: list[np.ndarray] = field(default_factory=list)

    def add(self, true: np.ndarray, poses: np.ndarray, covariances: np.ndarray) -> None:
        """Take in a run's poses beside the true ones, all ``(M, 4, 4)``."""
        self.errors.append(se3.log(se3.between(poses, true)))
        self.covariances.append(covariances)

    @property
    def consistency(self) -> PoseConsistency:
        """Of all of them together."""
        return pose_consistency(np.concatenate(self.errors), np.concatenate(self.covariances))


def run(drive: Chain, backend: str) -> tuple[hl.Odometry, list[hl.Estimate]]:
    odometry = hl.Odometry(Standstill(), Simulated(drive), backend)
    return odometry, [odometry.step(frame) for frame in drive.frames]


def measure(seeds: range, steps: int, drift_share: float | None) -> dict[str, tuple[Errors, Errors]]:
    """Errors of poses relative to the first, and of steps, by what estimated them."""
    out = {name: (Errors(), Errors()) for name in (*BACKENDS, "smoothed")}
    for seed in seeds:
        drive = make_chain(seed, ChainSettings(steps=steps, drift_share=drift_share))
        true = drive.lidar_poses
        true_steps = se3.between(true[:-1], true[1:])
        for backend in BACKENDS:
            odometry, estimates = run(drive, backend)
            poses, step = out[backend]
            poses.add(
                true[1:], *(np.array([getattr(e, what) for e in estimates[1:]]) for what in ("pose", "covariance"))
            )
            told = [e.step for e in estimates[1:]]
            step.add(true_steps, np.array([s.pose for s in told]), np.array([s.covariance for s in told]))
        smoothed = hl.smooth(odometry.record())
        poses, step = out["smoothed"]
        found = smoothed.trajectory.poses
        poses.add(true[1:], found[1:], smoothed.trajectory.covariances[1:])
        step.add(true_steps, se3.between(found[:-1], found[1:]), smoothed.step_covariances)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.runs)
    print(f"{options.runs} drives of {options.steps} steps, seeds {seeds.start} to {seeds.stop - 1}; ANEES")
    print(f"{'':34s} {'rotation':>9s} {'position':>9s} {'step rot.':>9s} {'step pos.':>9s}")
    for kind, share in KINDS.items():
        begin = time.process_time()
        for name, (poses, steps) in measure(seeds, options.steps, share).items():
            values = [
                part for found in (poses, steps) for part in (found.consistency.rotation, found.consistency.position)
            ]
            print(f"{kind:20s} {name:13s} " + " ".join(f"{part.value:9.3f}" for part in values), flush=True)
        print(f"{'':20s} {time.process_time() - begin:.0f} s of one core")


if __name__ == "__main__":
    main()
