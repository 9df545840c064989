"""Measure how quickly bags are read: ``python benchmarks/bags.py BAG… [--repeats 7] [--longer 10 --to FOLDER]``.

Compares hybridlio with the library ``rosbags`` alone, which iterates over all messages and deserialises each. Prints
seconds of processor time, the least of the repeats, which take turns; of hybridlio those of opening, and of loading
every scan in order; and the process's largest memory. ``--longer N`` first writes each bag again, to FOLDER, with all
its messages repeated N times. ``--types`` prints a table of each topic instead: messages a second, of its type, by
``rosbags`` alone, by hybridlio, and clouds by KISS-ICP's loaders too.
"""

from __future__ import annotations

import argparse
import resource
import struct
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from hybridlio.datasets import Sequence, open_sequence
from hybridlio.datasets.rosbag import measurements
from hybridlio.datasets.rosbag.bag import Bag, Topic
from hybridlio.datasets.rosbag.topics import TYPES
from hybridlio.datasets.rosbag.wire import read_header, read_imu

MCAP = StoragePlugin.MCAP


def iterate(reader: AnyReader, topic: str | None = None) -> None:
    """Read and deserialise all messages, or those of one topic."""
    connections = [c for c in reader.connections if topic in (None, c.topic)]
    for connection, _, raw in reader.messages(connections):
        reader.deserialize(raw, connection.msgtype)


def open_and_iterate(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        iterate(reader)


def load(sequence: Sequence) -> None:
    for k in range(len(sequence)):
        sequence.load_scan(k)


def measure(bag: Bag, topic: Topic) -> None:
    """Read what hybridlio takes from the messages of a topic that is no cloud."""
    for _, _, raw in bag.messages([topic.name]):
        header = read_header(raw, bag.is_ros2)
        if topic.type in TYPES["imu"]:
            read_imu(raw, header, bag.is_ros2)
        elif topic.type in TYPES["gps"]:
            measurements.fix_values(bag.decode(topic.name, raw))
        else:
            measurements.body_pose(bag.decode(topic.name, raw), topic.type)


def kiss_icp(loader: Any) -> None:
    """Load all clouds by KISS-ICP's loader, with their times."""
    loader.reset()
    for k in range(len(loader)):
        loader[k]


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


def seconds(tasks: Iterable[Callable[[], object]], repeats: int) -> list[float]:
    """Return the least processor time of each task; the tasks take turns, so that other work meets all of them."""
    tasks = list(tasks)
    spent = [float("inf")] * len(tasks)
    for _ in range(repeats):
        for k, task in enumerate(tasks):
            start = time.process_time()
            task()
            spent[k] = min(spent[k], time.process_time() - start)
    return spent


def print_times(bag: Path, repeats: int) -> None:
    sequence = open_sequence(bag)
    alone, opening, loading = seconds(
        [lambda: open_and_iterate(bag), lambda: open_sequence(bag), lambda: load(sequence)], repeats
    )
    print(
        f"{bag.name}: {len(sequence)} scans; rosbags {alone:.2f} s; hybridlio opens in {opening:.2f} s "
        f"({opening / alone:.2f} times), loads scans in {loading:.2f} s ({loading / alone:.2f} times)"
    )


def print_types(path: Path, repeats: int) -> None:
    from kiss_icp.datasets.rosbag import RosbagDataset

    bag, sequence, reader = Bag(path), open_sequence(path), AnyReader([path])
    reader.open()
    kinds = {name: kind for kind, names in TYPES.items() for name in names}
    for topic in (topic for topic in bag.topics.values() if topic.type in kinds):
        tasks: list[Callable[[], object]] = [partial(iterate, reader, topic.name)]
        is_cloud = kinds[topic.type] == "lidar"
        tasks.append(partial(load, sequence) if is_cloud else partial(measure, bag, topic))
        if topic.type == "sensor_msgs/PointCloud2":
            tasks.append(partial(kiss_icp, RosbagDataset(path, topic.name)))
        rates = [f"{topic.count / spent:,.0f}" for spent in seconds(tasks, repeats)]
        print(f"| {path.name} | `{topic.type}` | {' | '.join([*rates, '–'][:3])} |")
    reader.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    parser.add_argument("--repeats", type=int, default=7, help="the least is printed (default: %(default)s)")
    parser.add_argument("--longer", type=int, default=1, help="repeat each bag's messages (default: %(default)s)")
    parser.add_argument("--to", type=Path, default=Path(), help="folder for longer bags (default: the current one)")
    parser.add_argument("--types", action="store_true", help="a table of the types of messages")
    options = parser.parse_args()
    if options.types:
        print(
            "| bag | type | rosbags alone, 1/s | hybridlio, 1/s | KISS-ICP, 1/s |\n| --- | --- | ---: | ---: | ---: |"
        )
    for given in options.bags:
        bag = given if options.longer == 1 else lengthened(given, options.to, options.longer)
        (print_types if options.types else print_times)(bag, options.repeats)
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
