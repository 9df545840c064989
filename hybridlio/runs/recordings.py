"""Which recordings a batch runs: from paths, patterns and list files to one entry a recording, each with a name."""

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
from hybridlio.core.files import read_yaml
from hybridlio.datasets.registry import check_options, open_sequence, sequence_names
from hybridlio.datasets.sequence import Sequence, frame_range, part_of

_YAML, _TEXT = (".yaml", ".yml"), (".txt", ".list")
_ANGLE = "vertical_angle_deg"


@dataclass(frozen=True)
class Recording:
    """One recording to run, in words that mean the same in another process and on another machine.

    Attributes:
        path: its folder, or one above it.
        sequence: which one, where there are several.
        reader: a name of :data:`hybridlio.datasets.registry.READERS`; guessed without it.
        raw_root: for KITTI odometry, where inertial data are.
        frames: the part ``A:B`` of it.
        vertical_angle_deg: raise its points by this angle; None for what the recording needs.
        name: what its run folder is called.

    Raises:
        ConfigError: no such reader, ``frames`` is no range, or the angle is over 5°.
    """

    path: str
    sequence: str | None = None
    reader: str | None = None
    raw_root: str | None = None
    frames: str | None = None
    vertical_angle_deg: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        check_options(self.reader, vertical_angle_deg=self.vertical_angle_deg)
        if self.frames is not None:
            frame_range(self.frames)

    def open(self) -> Sequence:
        """Open it, or the part of it that is wanted.

        Raises:
            DataError: there is no such recording, or it is malformed, or none of its scans is wanted.
        """
        found = open_sequence(
            self.path,
            sequence=self.sequence,
            reader=self.reader,
            raw_root=self.raw_root,
            vertical_angle_deg=self.vertical_angle_deg,
        )
        return part_of(found, self.frames)

    def to_json_dict(self) -> dict[str, str | float | None]:
        """What tells it from others, as plain values."""
        return {key: value for key, value in asdict(self).items() if key != "name"}


def find_recordings(
    data: str | Path | Recording | Iterable[str | Path | Recording],
    sequence: str | None = None,
    reader: str | None = None,
    raw_root: str | Path | None = None,
    frames: str | None = None,
    vertical_angle_deg: float | None = None,
) -> tuple[Recording, ...]:
    """Every recording that is meant, once, under names of their own.

    A path that holds several recordings stands for all of them. One that holds none is kept: it fails when it is
    opened, and the others do not have to wait for that.

    Args:
        data: one or more of: paths, patterns (``drives/*``), or files that list them: ``.yaml`` with paths, or with
            mappings of :class:`Recording`'s attributes but ``name``; or text with a path, and perhaps a sequence, a
            line. Paths in a file start from its folder.
        sequence: which recordings, with commas between, where a path holds several.
        reader, raw_root, frames, vertical_angle_deg: for all that do not say their own.

    Raises:
        ConfigError: there is not a single one, a pattern matches nothing, there is no such list file, ``reader`` or
            ``raw_root``, ``frames`` is no range, or the angle is over 5°.
        DataError: a list file cannot be read, or is malformed.
    """
    check_options(raw_root=raw_root)
    data = [data] if isinstance(data, str | Path | Recording) else data
    root = None if raw_root is None else str(raw_root)
    given = Recording("", sequence, reader, root, frames, vertical_angle_deg)
    wanted = [_with_defaults(item, given) for entry in data for item in _listed(entry)]
    found = list(dict.fromkeys(one for item in wanted for one in _each(item)))
    if not found:
        raise ConfigError("no recording to run; give paths, patterns or a list file")
    return tuple(_named(found))


def _listed(entry: str | Path | Recording) -> Iterator[Recording]:
    """What an argument stands for: itself, or what its pattern matches or its file lists."""
    if isinstance(entry, Recording):
        yield entry
        return
    path = Path(entry).expanduser()
    if path.is_file() and path.suffix in _YAML + _TEXT:
        yield from _read_list(path)
    elif not path.exists() and path.suffix in _YAML + _TEXT:
        raise ConfigError(f"{path}: no such list file")
    elif not path.exists() and glob.has_magic(str(path)):
        matched = sorted(glob.glob(str(path)))
        if not matched:
            raise ConfigError(f"{path}: nothing matches this pattern")
        yield from map(Recording, matched)
    else:
        yield Recording(str(path))


def _read_list(file: Path) -> Iterator[Recording]:
    entries = read_yaml(file) if file.suffix in _YAML else _lines(file)
    if not isinstance(entries, list):
        raise DataError(f"{file}: expected a list of recordings, one an entry")
    for number, entry in enumerate(entries, 1):
        item = _entry(entry, f"{file}, entry {number}")
        below = _from(file.parent, item)
        found = list(_listed(below.path)) if Path(below.path).suffix not in _YAML + _TEXT else [below]
        yield from (replace(below, path=one.path) for one in found)


def _lines(file: Path) -> list[dict[str, str]]:
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
                f"{file}, line {number}: expected a path and perhaps a sequence, found {len(words)} words; "
                "put a path with spaces in quotes"
            )
        entries += [dict(zip(("path", "sequence"), words, strict=False))] if words else []
    return entries


def _entry(entry: Any, where: str) -> Recording:
    known = [f.name for f in fields(Recording) if f.name != "name"]
    values = {"path": entry} if isinstance(entry, str) else entry
    if not isinstance(values, dict) or not values.get("path"):
        raise DataError(f"{where}: expected a path, or a mapping with one")
    unknown = [key for key in values if key not in known]
    if unknown:
        raise DataError(f"{where}: unknown key {unknown[0]!r}; the keys are {', '.join(known)}")
    angle = values.get(_ANGLE)
    if angle is not None and (isinstance(angle, bool) or not isinstance(angle, int | float)):
        raise DataError(f"{where}: {_ANGLE} {angle!r}: give a number of degrees")
    said = {key: str(value) for key, value in values.items() if value is not None and key != _ANGLE}
    try:
        return Recording(**said, vertical_angle_deg=angle)
    except ConfigError as error:
        raise DataError(f"{where}: {error}") from None


def _from(folder: Path, item: Recording) -> Recording:
    """The item with its paths started from a folder."""
    root = item.raw_root and str(folder / Path(item.raw_root).expanduser())
    return replace(item, path=str(folder / Path(item.path).expanduser()), raw_root=root)


def _with_defaults(item: Recording, given: Recording) -> Recording:
    own = {key: value for key, value in asdict(item).items() if value not in (None, "")}
    return Recording(**(asdict(given) | own))


def _each(item: Recording) -> Iterator[Recording]:
    """The item once for every recording that it stands for, its path absolute."""
    item = _from(Path.cwd(), item)
    try:
        names = sequence_names(item.path, reader=item.reader)
    except HybridLioError:
        yield replace(item, name=Path(item.path).name)
        return
    for wanted in (word.strip() for word in item.sequence.split(",")) if item.sequence else names:
        yield replace(item, sequence=wanted, name=_full_name(wanted, names))


def _full_name(wanted: str, names: tuple[str, ...]) -> str:
    """The recording's whole name where it was picked by its number."""
    if wanted.isdigit() and wanted not in names:
        ends = [name for name in names if (tail := re.search(r"\d+$", name)) and int(tail[0]) == int(wanted)]
        return ends[0] if len(ends) == 1 else wanted
    return wanted


def _named(found: list[Recording]) -> Iterator[Recording]:
    """Names that can be folders, none given twice: where several recordings share one, each gets a mark of its own."""
    safe = [re.sub(r"[^\w.-]+", "_", item.name).lstrip(".") or "recording" for item in found]
    count = Counter(safe)
    for item, name in zip(found, safe, strict=True):
        mark = hashlib.sha256(repr(item.to_json_dict()).encode()).hexdigest()[:6]
        yield replace(item, name=name if count[name] == 1 else f"{name}-{mark}")
