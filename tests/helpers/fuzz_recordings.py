"""Recordings in the layout of every reader, to be damaged: how each is written and read."""

from __future__ import annotations

import os
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import published_data
import rides
from fuzz_input import Input
from PIL import Image

from hybridlio.core.errors import HybridLioError
from hybridlio.datasets import open_sequence

PACKETS = Path(os.environ.get("HYBRIDLIO_SHARED_DATA", "no such folder")) / "other_lidars"
BAGS = ("sqlite3", "mcap", "zstd", "ros1", "lz4")
UNCLEAR = "the scan cannot be read ("  # an error that no reader foresaw, turned into one by the sequence


def open_and_read(arguments: dict[str, Any]) -> None:
    """Open a recording and its scans; raise the last error if none can be read."""
    sequence, last, read = open_sequence(**arguments), None, 0
    for k in range(len(sequence)):
        try:
            frame = sequence[k]
        except HybridLioError as error:
            if UNCLEAR in str(error):
                raise AssertionError(f"unclear: {error}") from error
            last = error
        else:
            assert np.isfinite(frame.scan.points).all(), f"frame {k} has points that are not finite"
            read += 1
    if last is not None and not read:
        raise last


def written_bag(root: Path, name: str) -> dict[str, Any]:
    """Write the ride as a bag of ROS 1, or of ROS 2 in one of its storages."""
    return {"path": rides.write_bag(root, rides.Ride(), name)}


def written_cut_bag(root: Path, name: str) -> dict[str, Any]:
    """Write the ride as a bag without the end of its index, as where its recorder was killed."""
    path = rides.write_bag(root, rides.Ride(), name)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    cut = file.rename(root / f"cut{file.suffix}")
    cut.write_bytes(cut.read_bytes()[:-40])
    return {"path": cut}


def written_depth(root: Path) -> dict[str, Any]:
    """Write a recording of depth images."""
    folder = root / "rgbd_dataset_ride"
    (folder / "depth").mkdir(parents=True)
    for k in range(4):
        depth = np.full((480, 640), 6000 + 100 * k, np.uint16)
        depth[:, ::7] += 4000
        Image.fromarray(depth).save(folder / f"depth/{k}.png")
    (folder / "depth.txt").write_text("".join(f"{10 + 0.1 * k:.2f} depth/{k}.png\n" for k in range(4)))
    (folder / "groundtruth.txt").write_text("".join(f"{10 + 0.1 * k:.2f} 0 0 {k} 0 0 0 1\n" for k in range(4)))
    return {"path": folder}


def copied_packets(root: Path, name: str, *beside: str) -> dict[str, Any]:
    """Copy a real capture, and the files beside it."""
    root.mkdir(parents=True)
    for file in (name, *beside):
        shutil.copyfile(PACKETS / file, root / file)
    return {"path": root / name}


def written_odometry(root: Path) -> dict[str, Any]:
    return {
        "path": rides.write_odometry(root / "odometry", rides.Ride()),
        "raw_root": rides.write_raw(root / "raw", rides.Ride()).parents[1],
    }


def written_published(root: Path, name: str) -> dict[str, Any]:
    return {"path": published_data.WRITERS[name](root).path}


WRITERS = {
    "kitti-raw": lambda root: {"path": rides.write_raw(root, rides.Ride())},
    "kitti-odometry": written_odometry,
    "folder": lambda root: {"path": rides.write_folder(root, rides.Ride())},
    **{f"rosbag-{kind}": lambda root, kind=kind: written_bag(root, kind) for kind in BAGS},
    **{f"rosbag-cut-{kind}": lambda root, kind=kind: written_cut_bag(root, kind) for kind in ("ros1", "mcap")},
    **{name: lambda root, name=name: written_published(root, name) for name in published_data.WRITERS},
    "tum-rgbd": written_depth,
}
if PACKETS.is_dir():  # real captures; there is none that tests could write
    OUSTER = "OS-1-128_v2.3.0_1024x10"
    if find_spec("ouster") is not None:
        WRITERS["ouster"] = lambda root: copied_packets(root, f"{OUSTER}_lb_n3.pcap", f"{OUSTER}.json")
    if find_spec("velodyne_decoder") is not None:
        WRITERS["velodyne"] = lambda root: copied_packets(root, "sample_velodyne_vlp16_gps.pcap")

RECORDINGS = {name: Input(write, open_and_read) for name, write in WRITERS.items()}
