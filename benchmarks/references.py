"""How much a recording's own reference can tell: its errors, found from systems that do not share them.

    python benchmarks/references.py DATA [--sequence 0048] [--frames 0:60] [--peers small_gicp,rko_lio] [--steps 1,5,10]

Three estimates of the same steps whose errors are independent tell each one's variance by their differences (the
three-cornered hat of Gray and Allan, 1974): here the reference, hybridlio and a peer. The last columns are what that
means for drift: the truth is put midway between the two systems, the reference beside it by its error, and the drift
of both computed; how far the two come apart by the reference alone.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from lockstep import Pass, run_in_lockstep
from numpy.typing import NDArray
from peers import ahead_of_speed, drift_of, opened, trajectory_of
from systems import our_systems, peer_systems

from hybridlio.commands.terminal import progress
from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.evaluate import evaluate

_DRAWS = 200


def apart(a: Array, b: Array, steps: int) -> Array:
    """Root mean square difference of the motions over ``steps`` scans: rotation in degrees, translation in metres."""
    ours, theirs = (se3.between(poses[:-steps], poses[steps:]) for poses in (a, b))
    square = (se3.log(se3.between(ours, theirs)) ** 2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    return np.sqrt(square) * [180 / np.pi, 1.0]


def of_reference(reference: Array, a: Array, b: Array, steps: int) -> Array:
    """The reference's own part; 0 where the systems' errors are too much alike, or too large, to tell."""
    return own_part(*(apart(x, y, steps) for x, y in ((reference, a), (reference, b), (a, b))))


def own_part(to_a: Array, to_b: Array, between: Array) -> Array:
    """The error of one whose difference from two others is known, and the others' from each other."""
    return np.sqrt(np.maximum((to_a**2 + to_b**2 - between**2) / 2, 0.0))


def forward_table(sequence: Sequence, passes: dict[str, Pass], lengths: list[int]) -> list[dict[str, str]]:
    """The same of the way forward alone, beside the forward speed's, with what each of the three errs by itself."""
    ahead = {name: ahead_of_speed(trajectory_of(one), sequence)[0] for name, one in passes.items() if one.error is None}
    (_, ours), *peers = ahead.items()
    rows = []
    for steps in lengths:
        for peer, theirs in peers:
            to_ours, to_theirs, between = (
                1000 * np.std(ways[steps:] - ways[:-steps], keepdims=True) for ways in (ours, theirs, ours - theirs)
            )
            differences = (to_ours, to_theirs, between)
            own = (to_ours, to_theirs, between), (to_ours, between, to_theirs), (to_theirs, between, to_ours)
            names = "ours to the speed", "its to the speed", "ours to its", "the speed's own", "ours", "its"
            values = [*differences, *(own_part(*three) for three in own)]
            row = {"steps": str(steps), "peer": peer}
            rows.append(row | {name: f"{value.item():.0f} mm" for name, value in zip(names, values, strict=True)})
    return rows


def scatter_of_drift(stamps_ns: NDArray[np.int64], a: Array, b: Array, error: Array) -> Array:
    """How far two systems come apart in t_rel and r_rel (σ) by errors ``(2,)`` of the reference's steps."""
    rng, found = np.random.default_rng(0), []
    midway = a @ se3.exp(0.5 * se3.log(se3.between(a, b)))
    sigmas = np.repeat(error / np.sqrt(6) * [np.pi / 180, 1.0], 3)  # of a pose on one axis: a step has two, each three
    for _ in range(_DRAWS):
        noisy = midway @ se3.exp(sigmas * rng.standard_normal((len(midway), 6)))
        reference = Trajectory(stamps_ns, se3.between(noisy[0], noisy))
        one, other = (drift_of(evaluate(reference, Trajectory(stamps_ns, poses))) for poses in (a, b))
        found.append(np.subtract(one, other))
    return np.asarray(np.std(found, axis=0))


def table(reference: Trajectory, passes: dict[str, Pass], lengths: list[int]) -> list[dict[str, str]]:
    """A row for each peer and number of scans."""
    (name, ours), *peers = [(name, trajectory_of(one).poses) for name, one in passes.items() if one.error is None]
    rows = []
    for steps in lengths:
        print(f"over {steps}: {name} differs from the reference by {words(apart(reference.poses, ours, steps))}")
        for peer, theirs in peers:
            error = of_reference(reference.poses, ours, theirs, steps)
            row = {
                "steps": str(steps),
                "peer": peer,
                "from the reference": words(apart(reference.poses, theirs, steps)),
                "from hybridlio": words(apart(ours, theirs, steps)),
                "the reference's own": words(error),
            }
            if steps == 1 and reference.length_m > 1:
                t_rel, r_rel = scatter_of_drift(reference.stamps_ns, ours, theirs, error)
                row["drifts come apart by"] = f"{t_rel:.2f} %, {r_rel:.2f} °/100 m"
            rows.append(row)
    return rows


def words(difference: Array) -> str:
    return f"{difference[0]:.3f}°, {1000 * difference[1]:.0f} mm"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sequence")
    parser.add_argument("--frames", metavar="A:B")
    parser.add_argument("--peers", default="small_gicp,rko_lio", metavar="A,B,…")
    parser.add_argument("--steps", default="1,5,10", metavar="A,B,…", help="scans from start to end of a motion")
    options = parser.parse_args()
    again = partial(opened, options.data, options.sequence, options.frames)
    sequence = again()
    if sequence.reference is None:
        parser.error(f"{options.data}: there is no reference")
    systems = our_systems("preintegration", "scan-matching", "fixed-lag") | peer_systems(options.peers, sequence)
    with progress(sequence.name) as tick:
        passes = run_in_lockstep(systems, again, len(sequence), 1, tick)
    lengths = [int(text) for text in options.steps.split(",")]
    rows = table(sequence.reference, passes, lengths)
    print("\n" + tables.to_markdown(rows, ("steps", "peer")))
    if sequence.forward_speed_m_s is not None:
        forward = forward_table(sequence, passes, lengths)
        print("\nthe way forward, but for what is off on average:\n\n" + tables.to_markdown(forward, ("steps", "peer")))


if __name__ == "__main__":
    main()
