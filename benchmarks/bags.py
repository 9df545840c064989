"""Measure how quickly bags are read: ``python benchmarks/bags.py BAG… [--repeats 3]``.

Compares hybridlio with the library ``rosbags`` alone, which iterates over all messages and deserialises each. Prints
seconds of processor time, the least of the repeats; of hybridlio those of opening, which passes over the bag once, and
of loading every scan in order; and the process's largest memory.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path

from rosbags.highlevel import AnyReader

from hybridlio.datasets import Sequence, open_sequence


def iterate(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def load(sequence: Sequence) -> None:
    for k in range(len(sequence)):
        sequence.load_scan(k)


def seconds(task: Callable[[], object], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        task()
        spent.append(time.process_time() - start)
    return min(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    parser.add_argument("--repeats", type=int, default=3, help="the least is printed (default: %(default)s)")
    options = parser.parse_args()
    for bag in options.bags:
        sequence = open_sequence(bag)
        alone, opening, loading = (
            seconds(task, options.repeats)
            for task in (
                lambda bag=bag: iterate(bag),
                lambda bag=bag: open_sequence(bag),
                lambda sequence=sequence: load(sequence),
            )
        )
        print(
            f"{bag.name}: {len(sequence)} scans; rosbags {alone:.2f} s; hybridlio opens in {opening:.2f} s "
            f"({opening / alone:.2f} times), loads scans in {loading:.2f} s ({loading / alone:.2f} times)"
        )
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
