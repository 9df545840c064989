"""Measure how quickly bags are read: ``python benchmarks/bags.py BAG… [--repeats 3] [--longer 10 --to FOLDER]``.

Compares hybridlio with the library ``rosbags`` alone, which iterates over all messages and deserialises each. Prints
seconds of processor time, the least of the repeats; of hybridlio those of opening, which passes over the bag once, and
of loading every scan in order; and the process's largest memory. ``--longer N`` first writes each bag again, to FOLDER,
with all its messages repeated N times.
"""

from __future__ import annotations

import argparse
import resource
import struct
import time
from collections.abc import Callable
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from hybridlio.datasets import Sequence, open_sequence

MCAP = StoragePlugin.MCAP


def iterate(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def load(sequence: Sequence) -> None:
    for k in range(len(sequence)):
        sequence.load_scan(k)


def lengthened(bag: Path, folder: Path, times: int) -> Path:
    """Write a bag's messages several times, with later stamps each time; ROS 1 for a ``.bag``, else MCAP."""
    is_ros1 = bag.suffix == ".bag"
    path = folder / (f"{bag.stem}-{times}" + (".bag" if is_ros1 else ""))
    if path.exists():
        return path
    with AnyReader([bag]) as reader, Writer1(path) if is_ros1 else Writer2(path, version=9, storage_plugin=MCAP) as out:
        store, to = reader.typestore, {}
        for c in reader.connections:
            to[c.id] = out.add_connection(c.topic, c.msgtype, typestore=store)
        for k in range(times):
            shift_ns = k * reader.duration
            for connection, received_ns, raw in reader.messages():
                later = bytearray(raw)
                if "tf" not in connection.topic:  # all others begin with a header, whose stamp is behind four bytes
                    seconds_, ns = struct.unpack_from("<II", raw, 4)
                    struct.pack_into("<II", later, 4, *divmod(seconds_ * 10**9 + ns + shift_ns, 10**9))
                out.write(to[connection.id], received_ns + shift_ns, bytes(later))
    return path


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
    parser.add_argument("--longer", type=int, default=1, help="repeat each bag's messages (default: %(default)s)")
    parser.add_argument("--to", type=Path, default=Path(), help="folder for longer bags (default: the current one)")
    options = parser.parse_args()
    for given in options.bags:
        bag = given if options.longer == 1 else lengthened(given, options.to, options.longer)
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
