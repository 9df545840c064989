"""Reader of ROS bags: scans, inertial samples, GPS fixes, reference poses and extrinsics by the tree of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Calibration, ImuSamples, Scan
from hybridlio.core.tables import counted
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.calibration_yaml import StatedCalibration, read_calibration_yaml
from hybridlio.datasets.gps_csv import note_fixes
from hybridlio.datasets.imu_mounting import as_stated, note_mounting
from hybridlio.datasets.kitti.vertical_angle import raised
from hybridlio.datasets.merged_lidars import MergedScans, OtherLidar, nearest_scans
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.reference import poses_at
from hybridlio.datasets.rosbag import measurements
from hybridlio.datasets.rosbag.bag import METADATA, ROS_1, ROS_2_FILES, Bag, Topic, bag_files, part_number, readable
from hybridlio.datasets.rosbag.choices import BagTopics
from hybridlio.datasets.rosbag.extrinsics import Mounting, calibration_file
from hybridlio.datasets.rosbag.heads import Message
from hybridlio.datasets.rosbag.known import known_bag
from hybridlio.datasets.rosbag.measurements import Log
from hybridlio.datasets.rosbag.scans import BagScans
from hybridlio.datasets.rosbag.topics import OTHER_LIDAR, TRANSFORM_TYPES, choose
from hybridlio.datasets.rosbag.transforms import FrameTree
from hybridlio.datasets.rosbag.wire import Header, read_header, read_imu
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.stamps import SCAN_GAP_FACTOR, note_coverage, note_gaps, usable_scans

LAYOUT = "a .bag, .mcap or .db3 file, or a folder of ROS 2 with metadata.yaml"
_MIN_SCANS_OF_DAMAGED = 2  # fewer scans before the damage are no recording
SUFFIXES = (ROS_1, *ROS_2_FILES)


def find(path: Path) -> dict[str, Path]:
    """Find the bag at ``path``, or those directly below: files and folders by name without suffix.

    Numbered parts ``NAME_0.mcap NAME_1.mcap …`` that are alone in a folder are one bag, the folder.
    """
    if path.is_file():
        return {path.stem: path} if path.suffix in SUFFIXES else {}
    if _is_whole(path):
        return {path.resolve().name: path}
    below = [p for p in sorted(path.glob("*")) if p.suffix in SUFFIXES or (p.is_dir() and _is_whole(p))]
    return {p.stem if p.is_file() else p.name: p for p in below}


def _is_whole(folder: Path) -> bool:
    """Return whether a folder is one bag."""
    if (folder / METADATA).is_file():
        return "rosbag2_bagfile_information" in (folder / METADATA).read_text(encoding="utf-8", errors="replace")
    files = [p for p in folder.glob("*") if p.suffix in SUFFIXES]
    return (
        len(files) > 1
        and len({p.suffix for p in files}) == 1
        and sorted(part_number(p)[0] for p in files) == list(range(len(files)))
    )


@dataclass
class _Contents:
    """What one pass over a bag collects."""

    logs: dict[str, Log]
    tree: FrameTree = field(default_factory=FrameTree)
    body_frame: str = ""  # of the reference poses


def open_bag(path: Path, topics: BagTopics | None = None, vertical_angle_deg: float | None = None) -> Sequence:
    """Open a bag.

    All messages are passed once: stamps of scans, and the other sensors' measurements, are kept; scans are read when
    they are asked for.

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, a ROS 2 folder, or a folder with the parts of one bag.
        topics: topics and frames to use; by default chosen by type.
        vertical_angle_deg: angle by which points are raised; none by default.

    Raises:
        DataError: the bag is damaged, topics are ambiguous or missing, or no transform between the frames of lidar and
            IMU is known; the message says which option or file gives it.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    path = path.resolve()
    try:
        return _open(path, topics or BagTopics(), vertical_angle_deg)
    except DataError as error:
        if str(path.parent) in str(error):
            raise
        raise DataError(f"{path}: {error}") from None


def _open(path: Path, wanted: BagTopics, vertical_angle_deg: float | None) -> Sequence:
    notes, bag = Notes(path.stem if path.is_file() else path.name), Bag(path)
    _note_part(path, notes)
    for text in bag.recovered:
        notes.add(text)
    stated = read_calibration_yaml(calibration_file(path))
    known = known_bag(bag, wanted, notes)
    wanted = wanted if known is None else known.filled(wanted)
    chosen = choose(bag, wanted, notes)
    contents = _read(bag, chosen, notes)
    frames = {kind: log.frame for kind, log in contents.logs.items()}
    mounting = Mounting(bag, contents.tree, wanted, frames, notes, known)
    scans = _scans(bag, chosen["lidar"], contents.logs["lidar"], notes)
    scans.learn(stated.format, notes)
    others = _other_scans(bag, chosen, contents, stated, notes)
    imu = _imu(chosen.get("imu"), contents.logs, notes)
    calibration = mounting.calibration(stated, has_imu=len(imu) > 0, has_gps="gps" in chosen)
    if len(imu):
        imu = as_stated(imu, stated.imu_scale, stated.imu_time_offset_s, notes)
        note_mounting(imu, calibration.T_imu_lidar, notes)
    note_coverage(imu.stamps_ns, scans.stamps_ns, "inertial data", notes)
    gps = measurements.gps_fixes(contents.logs["gps"], chosen["gps"].name, notes) if "gps" in chosen else ()
    note_fixes(gps, scans.stamps_ns, notes)
    reference = _reference(chosen.get("reference"), contents, mounting, calibration, scans, notes)
    return Sequence(
        name=notes.name,
        stamps_ns=scans.stamps_ns,
        load_scan=_with_others(raised(scans, vertical_angle_deg), scans, others, mounting, stated, vertical_angle_deg),
        imu=imu,
        calibration=calibration,
        reference=reference,
        gps=gps,
        lidar=stated.lidar,
        imu_noise=stated.imu_noise,
        imu_time_offset_s=stated.imu_time_offset_s,
        imu_scale=stated.imu_scale,
        notes=tuple(notes.texts),
    )


def _note_part(path: Path, notes: Notes) -> None:
    """Note if the file is one of several parts of a bag."""
    number, _ = part_number(path)
    if path.is_file() and number >= 0 and _is_whole(path.parent):
        others = len(bag_files(path.parent)) if not (path.parent / METADATA).is_file() else 2
        if others > 1:
            notes.add(f"part {number} of a split bag; give the folder {path.parent} to use all parts")


def _read(bag: Bag, chosen: dict[str, Topic], notes: Notes) -> _Contents:
    """Pass over the messages of the chosen topics and of the frames, once."""
    contents = _Contents({kind: Log() for kind in chosen})
    kinds = {topic.name: kind for kind, topic in chosen.items()}
    static = [t.name for t in bag.topics.values() if t.type in TRANSFORM_TYPES and t.name.endswith("_static")]
    clouds = [topic.name for kind, topic in chosen.items() if kind == "lidar" or kind.startswith(OTHER_LIDAR)]
    messages = bag.messages_and_heads([*kinds, *static], clouds)
    for name, received_ns, raw in _until_damage(bag, messages, contents.logs["lidar"], notes):
        if name not in kinds:
            with readable(bag.path):
                contents.tree.add(bag.decode(name, raw))
            continue
        kind = kinds[name]
        header = _header(raw, bag.is_ros2)
        values: tuple[float, ...] = ()
        if kind == "imu":
            values = read_imu(raw, header, bag.is_ros2)
        elif kind == "gps":
            with readable(bag.path):
                values = measurements.fix_values(bag.decode(name, raw))
        elif kind == "reference":
            with readable(bag.path):
                child, values = measurements.body_pose(bag.decode(name, raw), chosen[kind].type)
            contents.body_frame = contents.body_frame or child
        contents.logs[kind].add(header, received_ns)
        contents.logs[kind].values.extend(values)
    return contents


def _until_damage(bag: Bag, messages: Iterator[Message], scans: Log, notes: Notes) -> Iterator[Message]:
    """Yield messages of the bag; where it is damaged behind some scans, note it and end there.

    Raises:
        DataError: the bag is damaged before its second scan.
    """
    try:
        yield from messages
    except DataError as error:
        if len(scans) < _MIN_SCANS_OF_DAMAGED:
            raise
        text = str(error).removeprefix(f"{bag.path}: cannot be read, ")
        notes.add(f"{text}; the {counted(len(scans), 'scan')} before the damage are used")


def _header(raw: bytes, is_ros2: bool) -> Header:
    """Return a message's header; without a stamp if the message is too short, which is noted and dropped later."""
    try:
        return read_header(raw, is_ros2)
    except DataError:
        return Header(0, "", 0, "<")


def _scans(bag: Bag, topic: Topic, log: Log, notes: Notes) -> BagScans:
    """Return the scans whose stamps increase."""
    if not len(log):
        raise measurements.no_messages(f"{bag.path}: {topic.name}")
    stamps, known = measurements.stamps_of(log, topic.name, notes)
    rows = np.flatnonzero(known)
    rows = rows[usable_scans(stamps[rows], bag.path)]
    if len(rows) < known.sum():
        notes.corrected(
            f"{topic.name}: dropped {int(known.sum()) - len(rows)} scans whose stamps repeat or go backwards"
        )
    note_gaps(stamps[rows], topic.name, notes, SCAN_GAP_FACTOR)
    received = np.array(log.received_ns, dtype=np.int64)
    return BagScans(bag.path, topic.name, stamps[rows], rows, received, any(log.header_ns), bag)


def _other_scans(
    bag: Bag, chosen: dict[str, Topic], contents: _Contents, stated: StatedCalibration, notes: Notes
) -> dict[str, BagScans]:
    """Return the scans of further lidars by the kinds of their topics."""
    found = {}
    for kind, topic in chosen.items():
        if kind.startswith(OTHER_LIDAR):
            found[kind] = _scans(bag, topic, contents.logs[kind], notes)
            found[kind].learn(replace(stated.format, vehicle=None), notes)
    return found


def _with_others(
    load: Callable[[int], Scan],
    first: BagScans,
    others: dict[str, BagScans],
    mounting: Mounting,
    stated: StatedCalibration,
    vertical_angle_deg: float | None,
) -> Callable[[int], Scan]:
    """Return the loader of scans, merged with those of further lidars if there are any."""
    lidars = [
        OtherLidar(
            scans.topic,
            raised(scans, vertical_angle_deg),
            scans.stamps_ns,
            mounting.lidar_other(mounting.frames[kind], scans.topic, stated),
            nearest_scans(first.stamps_ns, scans.stamps_ns, scans.topic, mounting.notes),
        )
        for kind, scans in others.items()
    ]
    return MergedScans(load, tuple(lidars), stated.format.vehicle) if lidars else load


def _imu(topic: Topic | None, logs: dict[str, Log], notes: Notes) -> ImuSamples:
    if topic is None or not len(logs["imu"]):
        notes.add("no inertial data: no topic of type sensor_msgs/Imu is used")
        return ImuSamples.empty()
    measurements.note_clocks(logs["lidar"], logs["imu"], notes)
    return measurements.imu_samples(logs["imu"], topic.name, notes)


def _reference(
    topic: Topic | None,
    contents: _Contents,
    mounting: Mounting,
    calibration: Calibration,
    scans: BagScans,
    notes: Notes,
) -> Trajectory | None:
    """Return the lidar's reference poses at the scans' stamps."""
    if topic is None or not len(contents.logs["reference"]):
        return None
    stamps, poses = measurements.poses_of(contents.logs["reference"], topic.name, notes)
    T_body_lidar: Array = mounting.body_lidar(contents.body_frame, topic, calibration)
    return poses_at(scans.stamps_ns, stamps, poses @ T_body_lidar, f"messages of {topic.name}", notes)
