"""``hybridlio info``."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.terminal import notes_held_back, print_result, progress
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics

if TYPE_CHECKING:
    from hybridlio.datasets.sequence import Sequence

_WIDTH, _INDENT = 80, 14  # columns of a plain terminal, and of the labels


@guarded
@common.with_topic_options
def info(
    data: common.Data,
    sequence: common.SequenceName = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    rate: common.Rate = None,
    check: common.Check = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Show what a recording holds: topics, sensors, rates, gaps, clocks, point times, extrinsics and notes."""
    from hybridlio.datasets.registry import locate
    from hybridlio.datasets.summary import summarise

    name, path = locate(data, sequence, reader)
    found = _topics(path) if name == "rosbag" else None
    if found is not None and not as_json:
        _print_topics(path, found)  # before an error on which of them to use
    with notes_held_back():
        recording = common.open_data(data, sequence, reader, raw_root, None, None, topics, rate)
        summary = {"path": str(path), "reader": name, "topics": found, **summarise(recording)}
        if check:
            _add_check(summary, recording)
    if as_json:
        print_result(json.dumps(summary, indent=2, ensure_ascii=False))
        return
    for label, text in _lines(summary):
        wrapped = textwrap.wrap(text, _WIDTH - _INDENT, break_long_words=False, break_on_hyphens=False) or [""]
        for row, line in enumerate(wrapped):
            print_result(f"{label if row == 0 else '':<{_INDENT}}{line}")


def _add_check(summary: dict[str, Any], recording: Sequence) -> None:
    """Add the comparison of IMU and scans: the offset of the clocks, and notes."""
    from hybridlio.runs.recording_check import examine, is_checked

    if not is_checked(recording):
        return
    with progress("checking the IMU") as report:
        found = examine(recording, report)
    if (offset := found.offset) is not None:
        figures = {"offset_s": round(offset.offset_s, 6), "sigma_s": round(offset.sigma_s, 6)}
        summary["imu_clock"] = figures | {"is_significant": offset.is_significant}
    for kind, texts in (("wrong", found.wrong), ("corrected", found.corrected), ("doubtful", found.doubtful)):
        summary["notes"] += [f"{kind}: {text}" for text in texts]


def _topics(path: Path) -> list[dict[str, Any]]:
    from hybridlio.datasets.rosbag.bag import Bag

    return [vars(topic) for topic in Bag(path).topics.values()]


def _print_topics(path: Path, topics: list[dict[str, Any]]) -> None:
    from hybridlio.datasets.rosbag.bag import Topic
    from hybridlio.datasets.rosbag.topics import table

    print_result(f"topics of {path.name}")
    print_result(table(Topic(**topic) for topic in topics) + "\n")


def _lines(summary: dict[str, Any]) -> list[tuple[str, str]]:
    lidar, imu, gps, reference = (summary[key] for key in ("lidar", "imu", "gps", "reference"))
    lines = [("recording", f"{summary['name']} (reader {summary['reader']})")]
    lines += [("lidar", f"{lidar['count']} scans in {lidar['duration_s']:.1f} s, {_rate(lidar)}")]
    if lidar["points_per_scan"] is not None:
        low, high = lidar["ranges_m"]
        model = "" if lidar["model"] is None else f", model {lidar['model']}"
        lines += [("", f"{lidar['points_per_scan']} points a scan, {low:g} to {high:g} m{model}")]
    lines += [("point fields", ", ".join(lidar["fields"]))] if lidar["fields"] else []
    times = lidar["point_times_ms"]
    lines += [("point times", "none" if times is None else f"{times[0]:g} to {times[1]:g} ms from the scan's stamp")]
    lines += [("imu", "none" if imu is None else f"{imu['count']} samples, {_rate(imu)}, {_clock(imu)}")]
    if imu is not None:
        force, rate = imu["median_force_m_s2"], imu["largest_rate_rad_s"]
        lines += [("", f"median specific force {force:.2f} m/s², up to {rate:.2f} rad/s")]
    if (clock := summary.get("imu_clock")) is not None:
        applied = "runs move the stamps by it" if clock["is_significant"] else "runs take the stamps as they are"
        lines += [("", f"clock offset {1e3 * clock['offset_s']:+.1f} ± {1e3 * clock['sigma_s']:.1f} ms, {applied}")]
    lines += [("gps", "none" if gps is None else f"{gps['count']} fixes, {_rate(gps)}, {_clock(gps)}")]
    lines += [("reference", "none" if reference is None else f"poses over {reference['length_m']:.1f} m")]
    for row, numbers in enumerate(summary["T_imu_lidar"] or []):
        lines.append(("T_imu_lidar" if row == 0 else "", " ".join(f"{number:9.5f}" for number in numbers)))
    lines += [("initial pose", summary["odometry"]["initial_pose"])]
    lines += [("compensation", summary["odometry"]["motion_compensation"])]
    lines += [("notes" if row == 0 else "", f"- {note}") for row, note in enumerate(summary["notes"])]
    return lines


def _rate(stream: dict[str, Any]) -> str:
    if stream["rate_hz"] is None:
        return "one only"
    return f"{stream['rate_hz']:.1f} Hz, longest gap {stream['longest_gap_s']:.3f} s"


def _clock(stream: dict[str, Any]) -> str:
    starts, ends = stream["starts_s"], stream["ends_s"]
    start = f"{abs(starts):.2f} s {'before' if starts < 0 else 'after'} the first scan"
    return f"starts {start}, ends {abs(ends):.2f} s {'before' if ends < 0 else 'after'} the last"
