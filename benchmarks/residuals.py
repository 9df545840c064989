"""Compare residual sources step by step: error left, consistency of covariances, failures, time.

    python benchmarks/residuals.py DATA… [--residual network,scan-matching] [--refine-steps 0,2] [--noise-m 0.083]
        [--noise-deg 0.24] [--reference small_gicp] [--weights FILE] [--scale S] [--frames 0:100] [-o FILE.json]

Every source refines the same initial poses: the reference's steps, with independent noise of the given standard
deviation on each axis. ANEES is the mean of eᵀΣ⁻¹e / n over the steps that did not fail: 1 is consistent, more is
overconfident. `--reference small_gicp` takes that library's registration of consecutive scans as the truth, for
recordings whose own reference is too coarse for single steps. Times are medians; sources take turns scan by scan.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import small_gicp

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, ResidualSource
from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import ImuNoise
from hybridlio.datasets.registry import open_sequence, sequence_names
from hybridlio.datasets.sequence import Sequence, part_of
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import RESIDUAL_SOURCES
from hybridlio.odometry.setup import Setup

_INITIAL = "(initial poses)"


@dataclass
class Answers:
    """A source's answers on all recordings.

    Attributes:
        name: of the source.
        errors: ``(6,)`` of each step.
        normalised: normalised errors squared of each step that did not fail: pose, rotation, translation.
        degenerate: number of steps with a degenerate direction.
        failed: number of steps that failed.
        seconds: of each step.
    """

    name: str
    errors: list[Array] = field(default_factory=list)
    normalised: list[Array] = field(default_factory=list)
    degenerate: int = 0
    failed: int = 0
    seconds: list[float] = field(default_factory=list)

    def add(self, answer: RelativePose, truth: Array, seconds: float) -> None:
        """Add the answer for a step whose true relative pose is given."""
        error = se3.log(se3.between(answer.pose, truth))
        self.errors.append(error)
        self.seconds.append(seconds)
        self.failed += not answer.ok
        self.degenerate += len(answer.degenerate) > 0
        if answer.ok:
            C = answer.covariance
            parts = (slice(None), slice(0, 3), slice(3, 6))
            self.normalised.append(
                np.array([error[p] @ np.linalg.solve(C[p, p], error[p]) / len(error[p]) for p in parts])
            )

    def row(self) -> dict[str, float | str]:
        """Return the source's row of the table."""
        errors = np.array(self.errors)
        size_m, size_deg = np.linalg.norm(errors[:, 3:], axis=1), np.rad2deg(np.linalg.norm(errors[:, :3], axis=1))
        anees = np.mean(self.normalised, axis=0) if self.normalised else np.full(3, np.nan)
        return {
            "residual": self.name,
            "steps": len(errors),
            "rms [mm]": 1e3 * float(np.sqrt((size_m**2).mean())),
            "rms [°]": float(np.sqrt((size_deg**2).mean())),
            "median [mm]": 1e3 * float(np.median(size_m)),
            "ANEES": float(anees[0]),
            "ANEES rot.": float(anees[1]),
            "ANEES trans.": float(anees[2]),
            "failed": self.failed,
            "degenerate": self.degenerate,
            "ms": 1e3 * float(np.median(self.seconds)),
        }


def sources(options: argparse.Namespace, sequence: Sequence) -> dict[str, ResidualSource]:
    config = Config()
    made: dict[str, ResidualSource] = {}
    network = replace(config.network, **({"weights": options.weights} if options.weights else {}))
    if options.scale:
        network = replace(network, covariance_scale=options.scale)
    for name in options.residual.split(","):
        for steps in [int(n) for n in options.refine_steps.split(",")] if "network" in name else [None]:
            chosen = network if steps is None else replace(network, refine_steps=steps)
            setup = Setup(config.model_copy(update={"network": chosen}), sequence.calibration, ImuNoise())
            made[name if steps is None else f"{name}, {steps} refined"] = RESIDUAL_SOURCES[name](setup)
    return made


def true_steps(sequence: Sequence, reference: str | None) -> Array:
    if reference is None and sequence.reference is not None:
        return se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    steps, guess = [], np.eye(4)
    for k in range(1, len(sequence)):
        last, current = (sequence[i].scan.points.astype(np.float64) for i in (k - 1, k))
        found = small_gicp.align(
            last, current, init_T_target_source=guess, downsampling_resolution=0.25, max_correspondence_distance=2.0
        )
        guess = se3.orthonormalise(found.T_target_source)
        steps.append(guess)
    return np.array(steps)


def recordings(options: argparse.Namespace) -> Iterator[Sequence]:
    for path in options.data:
        for name in sequence_names(path):
            yield part_of(open_sequence(path, sequence=name), options.frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", type=Path, help="recordings")
    parser.add_argument("--residual", default="network,network+scan-matching,scan-matching", metavar="A,B,…")
    parser.add_argument("--refine-steps", default="0,2", metavar="A,B,…", help="of the network (default: %(default)s)")
    parser.add_argument("--noise-m", type=float, default=0.083, help="by axis (default: %(default)s)")
    parser.add_argument("--noise-deg", type=float, default=0.24, help="by axis (default: %(default)s)")
    parser.add_argument("--reference", choices=["small_gicp"], help="in place of the recording's own")
    parser.add_argument("--weights", help="of the network")
    parser.add_argument("--scale", type=float, help="of the network's covariance")
    parser.add_argument("--frames", metavar="A:B", help="a part of each recording")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="for the table as JSON")
    options = parser.parse_args()
    sigmas = np.r_[np.full(3, np.deg2rad(options.noise_deg)), np.full(3, options.noise_m)]
    rng, found = np.random.default_rng(0), {_INITIAL: Answers(_INITIAL)}
    for sequence in recordings(options):
        steps, made = true_steps(sequence, options.reference), sources(options, sequence)
        for source in made.values():
            source.start(sequence[0])
        for k in range(1, len(sequence)):
            frame, truth = sequence[k], steps[k - 1]
            pose = truth @ se3.exp(rng.normal(size=6) * sigmas)
            initial = RelativePose(pose, np.diag(sigmas**2 + 1e-10), _INITIAL)
            found[_INITIAL].add(initial, truth, 0.0)
            for name, source in made.items():
                start = time.perf_counter()
                answer = source.refine(frame, initial)
                found.setdefault(name, Answers(name)).add(answer, truth, time.perf_counter() - start)
    rows = [answers.row() for answers in found.values()]
    print(" | ".join(rows[0]))
    for row in rows:
        print(" | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()))
    if options.out:
        write_atomically(options.out, json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
