"""Estimate the errors of a recording's own reference from two systems that do not share them.

    python benchmarks/references.py DATA [--sequence 0048] [--frames 0:60] [--peers small_gicp,rko_lio] [--steps 1,5,10]

The pairwise differences of three estimates with independent errors give the variance of each (three-cornered hat, Gray
and Allan, 1974). The three are the reference, hybridlio and a peer. The last column is the effect on drift: the truth
is placed midway between the two systems, references are drawn around it with the estimated error, and the standard
deviation of the difference between the two systems' drifts is reported.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from common import drift_of, forward_error, open_part
from lockstep import Pass, run_in_lockstep
from numpy.typing import NDArray
from systems import our_systems, peer_systems

from hybridlio.commands.terminal import progress
from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.evaluate import evaluate

_DRAWS = 200  # of references; their standard deviation is then known to 5 %


def difference(a: Array, b: Array, steps: int) -> Array:
    """Return the RMS difference of the motions over ``steps`` scans: rotation in degrees, translation in metres."""
    ours, theirs = (se3.between(poses[:-steps], poses[steps:]) for poses in (a, b))
    square = (se3.log(se3.between(ours, theirs)) ** 2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    return np.asarray(np.sqrt(square) * [180 / np.pi, 1.0])


def error_of_reference(reference: Array, a: Array, b: Array, steps: int) -> Array:
    """Return the reference's error over ``steps`` scans; 0 if the systems' errors are correlated or dominate."""
    return three_cornered_hat(*(difference(x, y, steps) for x, y in ((reference, a), (reference, b), (a, b))))


def three_cornered_hat(to_a: Array, to_b: Array, a_to_b: Array) -> Array:
    """Return the error of an estimate from its differences to two others and their difference from each other."""
    return np.sqrt(np.maximum((to_a**2 + to_b**2 - a_to_b**2) / 2, 0.0))


def forward_table(sequence: Sequence, passes: dict[str, Pass], lengths: list[int]) -> list[dict[str, str]]:
    """Return the same figures for the distance travelled forward alone, with the recorded forward speed as reference.

    Standard deviations: a constant error of the speed is left out.
    """
    excess = {name: forward_error(run.trajectory(), sequence)[0] for name, run in passes.items() if run.error is None}
    (_, ours), *peers = excess.items()
    rows = []
    for steps in lengths:
        for peer, theirs in peers:
            we_speed, it_speed, we_it = (
                1000 * np.std(error[steps:] - error[:-steps], keepdims=True) for error in (ours, theirs, ours - theirs)
            )
            values = {
                "hybridlio − speed": we_speed,
                "peer − speed": it_speed,
                "hybridlio − peer": we_it,
                "error of the speed": three_cornered_hat(we_speed, it_speed, we_it),
                "error of hybridlio": three_cornered_hat(we_speed, we_it, it_speed),
                "error of the peer": three_cornered_hat(it_speed, we_it, we_speed),
            }
            row = {"steps": str(steps), "peer": peer}
            rows.append(row | {name: f"{value.item():.0f} mm" for name, value in values.items()})
    return rows


def scatter_of_drift(stamps_ns: NDArray[np.int64], a: Array, b: Array, error: Array) -> Array:
    """Return σ of the difference of two systems' (t_rel, r_rel) caused by errors ``(2,)`` of the reference's steps."""
    rng, found = np.random.default_rng(0), []
    midway = a @ se3.exp(0.5 * se3.log(se3.between(a, b)))
    # a step has the errors of two poses, each on three axes
    sigmas = np.repeat(error / np.sqrt(6) * [np.pi / 180, 1.0], 3)
    for _ in range(_DRAWS):
        noisy = midway @ se3.exp(sigmas * rng.standard_normal((len(midway), 6)))
        reference = Trajectory(stamps_ns, se3.between(noisy[0], noisy))
        one, other = (np.array(drift_of(evaluate(Trajectory(stamps_ns, poses), reference)), float) for poses in (a, b))
        found.append(one - other)
    return np.asarray(np.std(found, axis=0))


def table(reference: Trajectory, passes: dict[str, Pass], lengths: list[int]) -> list[dict[str, str]]:
    """Return a row for each number of scans and peer."""
    (name, ours), *peers = [(name, run.trajectory().poses) for name, run in passes.items() if run.error is None]
    rows = []
    for steps in lengths:
        print(f"over {steps} scans, {name} − reference: {text(difference(reference.poses, ours, steps))}")
        for peer, theirs in peers:
            error = error_of_reference(reference.poses, ours, theirs, steps)
            row = {
                "steps": str(steps),
                "peer": peer,
                "peer − reference": text(difference(reference.poses, theirs, steps)),
                "peer − hybridlio": text(difference(ours, theirs, steps)),
                "error of the reference": text(error),
            }
            if steps == 1 and reference.length_m > 1:
                t_rel, r_rel = scatter_of_drift(reference.stamps_ns, ours, theirs, error)
                row["σ of the drifts' difference"] = f"{t_rel:.2f} %, {r_rel:.2f} °/100 m"
            rows.append(row)
    return rows


def text(size: Array) -> str:
    return f"{size[0]:.3f}°, {1000 * size[1]:.0f} mm"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a recording with a reference")
    parser.add_argument("--sequence", help="which one, if the folder holds several")
    parser.add_argument("--frames", metavar="A:B", help="a part of the recording")
    parser.add_argument("--peers", default="small_gicp,rko_lio", metavar="A,B,…")
    parser.add_argument("--steps", default="1,5,10", metavar="A,B,…", help="lengths of the motions, in scans")
    options = parser.parse_args()
    opened = partial(open_part, options.data, options.sequence, options.frames)
    sequence = opened()
    if sequence.reference is None:
        parser.error(f"{options.data} has no reference; give a recording that has one")
    systems = our_systems("preintegration", "scan-matching", "fixed-lag") | peer_systems(options.peers, sequence)
    with progress(sequence.name) as tick:
        passes = run_in_lockstep(systems, opened, len(sequence), 1, tick)
    lengths = [int(length) for length in options.steps.split(",")]
    rows = table(sequence.reference, passes, lengths)
    print("\n" + tables.to_markdown(rows, ("steps", "peer")))
    if sequence.forward_speed_m_s is not None:
        forward = forward_table(sequence, passes, lengths)
        print("\ndistance travelled forward, mean removed:\n\n" + tables.to_markdown(forward, ("steps", "peer")))


if __name__ == "__main__":
    main()
