"""Use PoseGraph and its online solver at random, for as long as is wanted.

    python tests/fuzz_graph.py [--steps 600000] [--seed 0]

Runs the state machine of tests/helpers/graph_machine.py with seeds from ``--seed`` on, prints the number of steps as it
goes, and ends at the first failure with the shortest history that hypothesis finds of it.
"""

from __future__ import annotations

import argparse
import logging
import resource
import sys
import time
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/helpers")]

import graph_machine  # noqa: E402

_EXAMPLES = 200  # about 9,000 steps, a few seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=600_000, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the first histories (default: %(default)s)")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    start_s, seed = time.monotonic(), options.seed
    while graph_machine.steps["steps"] < options.steps:
        graph_machine.run(seed, _EXAMPLES)
        seed += 1
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{graph_machine.steps['steps']} steps, {time.monotonic() - start_s:.0f} s, {memory:.0f} MiB", flush=True)
    print(", ".join(f"{count} {name}" for name, count in graph_machine.steps.most_common()))


if __name__ == "__main__":
    main()
