"""The recordings of a batch: expand paths, patterns and list files to one named entry per recording."""

from __future__ import annotations

import glob
import hashlib
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from hybridlio.core.errors import ConfigError, DataError, HybridLioError
from hybridlio.core.files import read_yaml, user_path
from hybridlio.datasets.registry import check_options, open_sequence, sequence_names
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics
from hybridlio.datasets.sequence import Sequence, frame_range, part_of

_YAML, _TEXT = (".yaml", ".yml"), (".txt", ".list")
_ANGLE, _TOPICS = "vertical_angle_deg", "topics"


@dataclass(frozen=True)
class Recording:
    """One recording to run, described so that another process or machine can open it.

    Attributes:
        path: its folder, or one above it.
        sequence: its name, if the path contains several recordings.
        reader: a name of :data:`hybridlio.datasets.registry.READERS`; None to detect it.
        raw_root: KITTI raw data that provide the IMU of KITTI odometry sequences.
        frames: the range ``A:B`` to use; None for all.
        vertical_angle_deg: correction of the points' elevation; None for the recording's default.
        topics: topics and frames of a bag; in a list file, a mapping such as ``{lidar: /points}``.
        name: the name of its run folder.

    Raises:
        ConfigError: the reader is unknown, ``frames`` is not a range, or the angle exceeds 5°.
    """

    path: str
    sequence: str | None = None
    reader: str | None = None
    raw_root: str | None = None
    frames: str | None = None
    vertical_angle_deg: float | None = None
    name: str = ""
    topics: BagTopics = NO_CHOICE

    def __post_init__(self) -> None:
        check_options(self.reader, vertical_angle_deg=self.vertical_angle_deg)
        if self.frames is not None:
            frame_range(self.frames)

    def open(self) -> Sequence:
        """Open the recording, or the part of it in ``frames``.

        Raises:
            DataError: the recording is missing or malformed, or the range contains no scan.
        """
        found = open_sequence(
            self.path,
            sequence=self.sequence,
            reader=self.reader,
            raw_root=self.raw_root,
            vertical_angle_deg=self.vertical_angle_deg,
            topics=self.topics,
        )
        return part_of(found, self.frames)

    def to_json_dict(self) -> dict[str, Any]:
        """Return all attributes except the name as plain values; topics only if some are chosen."""
        left_out = {"name", "topics"} if self.topics == NO_CHOICE else {"name"}
        return {key: value for key, value in asdict(self).items() if key not in left_out}


def find_recordings(
    data: str | Path | Recording | Iterable[str | Path | Recording],
    sequence: str | None = None,
    reader: str | None = None,
    raw_root: str | Path | None = None,
    frames: str | None = None,
    vertical_angle_deg: float | None = None,
    topics: BagTopics = NO_CHOICE,
) -> tuple[Recording, ...]:
    """Return every recording in ``data`` once, with unique names.

    A path that contains several recordings stands for all of them. A path that contains none is kept: it fails when
    it is opened, and does not stop the others.

    Args:
        data: one or more of: paths; patterns (``drives/*``); files that list recordings. A ``.yaml`` file lists paths
            or mappings with :class:`Recording`'s attributes except ``name``; a text file has a path, optionally
            followed by a sequence, per line. Paths in a file are relative to its folder.
        sequence: comma-separated names of the recordings to use from a path that contains several.
        reader, raw_root, frames, vertical_angle_deg, topics: defaults for entries that do not set their own.

    Raises:
        ConfigError: there is no recording, a pattern matches nothing, a list file, ``reader`` or ``raw_root`` does
            not exist, ``frames`` is not a range, or the angle exceeds 5°.
        DataError: a list file cannot be read, or is malformed.
    """
    check_options(raw_root=raw_root)
    data = [data] if isinstance(data, str | Path | Recording) else data
    root = None if raw_root is None else str(raw_root)
    defaults = Recording("", sequence, reader, root, frames, vertical_angle_deg, topics=topics)
    entries = [_with_defaults(entry, defaults) for argument in data for entry in _expand(argument)]
    found = list(dict.fromkeys(one for entry in entries for one in _split(entry)))
    if not found:
        raise ConfigError("no recording to run; give paths, patterns or a list file")
    return tuple(_with_unique_names(found))


def _expand(argument: str | Path | Recording) -> Iterator[Recording]:
    """Yield the entries of a list file, the matches of a pattern, or the argument itself."""
    if isinstance(argument, Recording):
        yield argument
        return
    path = user_path(argument)
    if path.is_file() and path.suffix in _YAML + _TEXT:
        yield from _read_list(path)
    elif not path.exists() and path.suffix in _YAML + _TEXT:
        raise ConfigError(f"{path}: no such list file")
    elif not path.exists() and glob.has_magic(str(path)):
        matches = sorted(glob.glob(str(path)))
        if not matches:
            raise ConfigError(f"{path}: no path matches this pattern")
        yield from map(Recording, matches)
    else:
        yield Recording(str(path))


def _read_list(file: Path) -> Iterator[Recording]:
    entries = read_yaml(file) if file.suffix in _YAML else _read_lines(file)
    if not isinstance(entries, list):
        raise DataError(f"{file}: expected a list of recordings, got {type(entries).__name__}")
    for number, entry in enumerate(entries, 1):
        parsed = _parse_entry(entry, f"{file}, entry {number}")
        try:
            absolute = _relative_to(file.parent, parsed)
        except DataError as error:
            raise DataError(f"{file}, entry {number}: {error}") from None
        is_list = Path(absolute.path).suffix in _YAML + _TEXT
        found = [absolute] if is_list else list(_expand(absolute.path))  # list files are not nested
        yield from (replace(absolute, path=one.path) for one in found)


def _read_lines(file: Path) -> list[dict[str, str]]:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{file}: cannot be read as a list of recordings: {error}") from error
    entries = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise DataError(f"{file}, line {number}: {error}") from None
        if len(words) > 2:
            raise DataError(
                f"{file}, line {number}: expected a path and an optional sequence, found {len(words)} words; "
                "quote paths that contain spaces"
            )
        entries += [dict(zip(("path", "sequence"), words, strict=False))] if words else []
    return entries


def _parse_entry(entry: Any, place: str) -> Recording:
    known = [f.name for f in fields(Recording) if f.name != "name"]
    values = {"path": entry} if isinstance(entry, str) else entry
    if not isinstance(values, dict) or not values.get("path"):
        raise DataError(f"{place}: expected a path, or a mapping with the key path")
    unknown = [key for key in values if key not in known]
    if unknown:
        raise DataError(f"{place}: unknown key {unknown[0]!r}; choose from {', '.join(known)}")
    angle = values.get(_ANGLE)
    if angle is not None and (isinstance(angle, bool) or not isinstance(angle, int | float)):
        raise DataError(f"{place}: {_ANGLE} {angle!r}: give a number of degrees")
    texts = {key: str(value) for key, value in values.items() if value is not None and key not in (_ANGLE, _TOPICS)}
    topics = _parse_topics(values.get(_TOPICS), place)
    try:
        return Recording(**texts, vertical_angle_deg=angle, topics=topics)
    except ConfigError as error:
        raise DataError(f"{place}: {error}") from None


def _topic_text(name: Any) -> str:
    """Return a topic's name; several, as a list of lidars, are separated by commas."""
    return ",".join(map(str, name)) if isinstance(name, list) else str(name)


def _parse_topics(value: Any, place: str) -> BagTopics:
    known = [f.name for f in fields(BagTopics)]
    if value is None:
        return NO_CHOICE
    if not isinstance(value, dict) or any(key not in known for key in value):
        raise DataError(f"{place}: {_TOPICS} {value!r}: give a mapping with keys of {', '.join(known)}")
    try:
        return BagTopics(**{key: None if name is None else _topic_text(name) for key, name in value.items()})
    except ConfigError as error:
        raise DataError(f"{place}: {error}") from None


def _relative_to(folder: Path, entry: Recording) -> Recording:
    """Return the entry with its relative paths resolved from a folder."""
    root = entry.raw_root and str(folder / user_path(entry.raw_root))
    return replace(entry, path=str(folder / user_path(entry.path)), raw_root=root)


def _with_defaults(entry: Recording, defaults: Recording) -> Recording:
    own = {key: value for key, value in vars(entry).items() if value not in (None, "", NO_CHOICE)}
    return replace(defaults, **own)


def _split(entry: Recording) -> Iterator[Recording]:
    """Yield the entry once per recording that its path and sequence names stand for, with an absolute path."""
    entry = _relative_to(Path.cwd(), entry)
    try:
        names = sequence_names(entry.path, reader=entry.reader)
    except HybridLioError:
        yield replace(entry, name=Path(entry.path).name)
        return
    for chosen in (word.strip() for word in entry.sequence.split(",")) if entry.sequence else names:
        yield replace(entry, sequence=chosen, name=_full_name(chosen, names))


def _full_name(chosen: str, names: tuple[str, ...]) -> str:
    """Return the recording's full name if it was chosen by its number."""
    if chosen.isdigit() and chosen not in names:
        matches = [name for name in names if (tail := re.search(r"\d+$", name)) and int(tail[0]) == int(chosen)]
        return matches[0] if len(matches) == 1 else chosen
    return chosen


def _with_unique_names(found: list[Recording]) -> Iterator[Recording]:
    """Yield the recordings with names fit for folders; recordings with equal names get a hash appended."""
    safe = [re.sub(r"[^\w.-]+", "_", entry.name).lstrip(".") or "recording" for entry in found]
    count = Counter(safe)
    for entry, name in zip(found, safe, strict=True):
        digest = hashlib.sha256(repr(entry.to_json_dict()).encode()).hexdigest()[:6]
        yield replace(entry, name=name if count[name] == 1 else f"{name}-{digest}")
