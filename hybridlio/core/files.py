"""Atomic writes, folder locks, archives of arrays and YAML.

A file is written under a temporary name beside its place, then renamed.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import glob
import math
import os
import socket
import uuid
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from zipfile import BadZipFile

if TYPE_CHECKING:
    from numpy.lib.npyio import NpzFile

from hybridlio.core.errors import DataError, HybridLioError, shown

# raised when an .npz file is damaged or holds something else
UNREADABLE_NPZ = (
    OSError, ValueError, KeyError, IndexError, TypeError, EOFError, RuntimeError, BadZipFile, zlib.error, HybridLioError
)  # fmt: skip

# Of the unpacked arrays of an .npz file to the file, and the size up to which that does not matter. Records and graphs
# of real recordings take 0.9 to 1.6 times their file; equal numbers in all rows, as of a made-up graph, more.
_MAX_UNPACKED_RATIO, _MAX_UNPACKED_BYTES = 100, 256 << 20
_MAX_PATH_BYTES = 4096  # PATH_MAX of Linux; a part of a path has at most 255 (NAME_MAX)
# Limits of a YAML file. A list of 10,000 recordings with all keys has 2 MiB and 140,000 values; settings are 4 deep.
_MAX_YAML_BYTES, _MAX_YAML_DEPTH, _MAX_YAML_VALUES = 8 << 20, 50, 500_000


def user_path(path: str | os.PathLike[str]) -> Path:
    """Return the path that somebody gave, with ``~`` expanded.

    Raises:
        DataError: it is no path on any system: it has a NUL character, is too long, or names an unknown user.
    """
    if not isinstance(path, str | os.PathLike):
        raise DataError(f"expected a path, got {type(path).__name__} {shown(path)}")
    text = os.fspath(path)
    if "\0" in text:
        raise DataError(f"{_shortened(text)!r}: a path cannot contain a NUL character")
    if len(os.fsencode(text)) > _MAX_PATH_BYTES or any(len(os.fsencode(part)) > 255 for part in Path(text).parts):
        raise DataError(f"{_shortened(text)}: the path is too long")
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise DataError(
            f"{_shortened(text)}: unknown user in this path; write ./~… for a folder of that name"
        ) from None


def _shortened(text: str) -> str:
    return text if len(text) < 80 else f"{text[:60]}…"


def make_folder(path: Path) -> None:
    """Make a folder and its parents if they do not exist.

    Raises:
        DataError: the folder cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot make the folder {path}: {error.strerror}; choose another place") from None


@contextlib.contextmanager
def locked(lock_file: Path, wait: bool = True) -> Iterator[str | None]:
    """Hold an exclusive lock between processes for the length of the block. That of a process that died is free.

    Args:
        lock_file: names the process that holds the lock; created with its folder where missing, and removed at the end.
        wait: wait for another process that holds the lock; otherwise return at once.

    Yields:
        None if the lock is held, as always with ``wait``; else the process that holds it.

    Raises:
        DataError: the file cannot be created or written.
    """
    while True:
        make_folder(lock_file.parent)
        try:
            file = lock_file.open("a+", encoding="utf-8")
        except FileNotFoundError:
            continue  # the process that held the lock has removed the folder meanwhile
        except OSError as error:
            raise DataError(f"cannot write to {lock_file.parent}: {error.strerror}; choose another folder") from None
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError:
                file.seek(0)
                yield file.read().strip() or "another process"
                return
            if not _is_same_file(file, lock_file):
                continue  # the process that held the lock has removed the file meanwhile
            try:
                _sign(file, lock_file)
                yield None
            finally:
                lock_file.unlink(missing_ok=True)  # before it is released: nobody acquires a lock that is then removed
            return


def _sign(file: IO[str], lock_file: Path) -> None:
    try:
        file.truncate(0)
        os.write(file.fileno(), f"process {os.getpid()} on {socket.gethostname()}\n".encode())  # at once, or not at all
    except OSError as error:
        raise DataError(f"cannot write to {lock_file.parent}: {error.strerror}; choose another folder") from None


def _is_same_file(file: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path in the same folder, and rename it to ``path`` when the block ends without an error.

    The folder is made if it is missing. The temporary name keeps the suffix, because some writers choose the format by
    it. If the block raises or is interrupted, the temporary file is removed and a file at ``path`` stays unchanged.

    Raises:
        DataError: the place cannot be written to.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename not in (None, str(temporary), str(path.parent), *map(str, path.parents)):
            raise  # concerns another file that the block uses
        raise DataError(
            f"cannot write {path}: {error.strerror or error}; choose a place with free space and write permission"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary files that killed processes left of ``path``. No other process may be writing it."""
    for left in path.parent.glob(f".{glob.escape(path.stem)}.{'[0-9a-f]' * 12}{glob.escape(path.suffix)}"):
        with contextlib.suppress(OSError):
            left.unlink()


def write_atomically(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write ``data`` (text as UTF-8, newlines unchanged) to ``path`` completely or not at all.

    The bytes of a folder's name that are not UTF-8 are written as escapes such as ``\\udcff``, which JSON reads back.

    Raises:
        DataError: the place cannot be written to.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data)


def read_yaml(path: str | os.PathLike[str], error: type[HybridLioError] = DataError) -> Any:
    """Return the content of a YAML or JSON file, None for an empty one. Tags cannot execute code.

    The content is limited in size, depth and aliases, so that no file exhausts memory or the stack.

    Args:
        path: the file.
        error: the error to raise.

    Raises:
        DataError: or ``error``; the file cannot be read, is not YAML, exceeds a limit, or has a value of an unusable
            type. Names the file and, if known, the line.
    """
    import yaml  # late: this module is imported by most others

    try:
        with Path(path).open("rb") as file:
            content = file.read(_MAX_YAML_BYTES + 1)
        if len(content) > _MAX_YAML_BYTES:
            raise error(f"{path}: over {_MAX_YAML_BYTES >> 20} MiB, too large for a YAML file")
        text = content.decode("utf-8-sig")
        _check_yaml(text)
        value = yaml.safe_load(text)
        _check_values(value)
    except OSError as trouble:
        raise error(f"{path}: cannot be read ({trouble.strerror})") from trouble
    except yaml.MarkedYAMLError as trouble:
        line = "" if trouble.problem_mark is None else f" at line {trouble.problem_mark.line + 1}"
        raise error(f"{path}: not YAML{line}: {trouble.problem or trouble.context}") from None
    except HybridLioError:
        raise
    except Exception as trouble:  # PyYAML lets those of its conversions through, such as of the date 2026-13-45
        what = f"unknown value {trouble}" if isinstance(trouble, KeyError) else " ".join(str(trouble).split())
        raise error(f"{path}: not YAML: {what}") from None
    return value


def _check_yaml(text: str) -> None:
    """Check depth, aliases and size of a YAML text before anything is built from it.

    Raises:
        ValueError: a limit is exceeded, or an alias refers to a collection that contains it; names the line.
        yaml.YAMLError: the text is not YAML.
    """
    import yaml

    sizes: dict[str, int | None] = {}  # values behind each anchor, aliases expanded; None while it is open
    counts, anchors = [0], [""]
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        place = "" if event.start_mark is None else f"line {event.start_mark.line + 1}: "
        if isinstance(event, yaml.AliasEvent):
            size = sizes.get(str(event.anchor), 0)
            if size is None:
                raise ValueError(f"{place}the alias *{event.anchor} contains itself")
            counts[-1] += size
        elif isinstance(event, yaml.CollectionStartEvent):
            sizes |= {event.anchor: None} if event.anchor else {}
            counts.append(1)
            anchors.append(event.anchor or "")
        elif isinstance(event, yaml.CollectionEndEvent):
            size, anchor = counts.pop(), anchors.pop()
            counts[-1] += size
            sizes |= {anchor: size} if anchor else {}
        elif isinstance(event, yaml.ScalarEvent):
            counts[-1] += 1
            sizes |= {event.anchor: 1} if event.anchor else {}
        if len(counts) > _MAX_YAML_DEPTH:
            raise ValueError(f"{place}nested more than {_MAX_YAML_DEPTH} deep")
        if counts[-1] > _MAX_YAML_VALUES:
            raise ValueError(f"{place}more than {_MAX_YAML_VALUES} values, aliases counted as often as they are used")


def _check_values(value: Any) -> None:
    """Check that a value consists of plain types, and that integers fit 64 bits."""
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            waiting += [*one.keys(), *one.values()]
        elif isinstance(one, list):
            waiting += one
        elif isinstance(one, int) and abs(one) >= 2**63:
            raise ValueError("an integer has more than 64 bits")
        elif one is not None and not isinstance(one, str | int | float | datetime.date):
            raise ValueError(f"values of the type {type(one).__name__} are not supported")


@contextlib.contextmanager
def opened_npz(path: str | os.PathLike[str]) -> Iterator[NpzFile]:
    """Open an archive of arrays, once it is known what they take; nothing in it is executed.

    Raises:
        ValueError: it unpacks to far more than its file, or an array announces more than it holds.
        Exception: others of :data:`UNREADABLE_NPZ`.
    """
    import numpy as np

    with np.load(path, allow_pickle=False) as file:
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("not an archive of arrays")
        assert file.zip is not None  # while the file is open
        sizes = {member.filename: member.file_size for member in file.zip.infolist()}
        packed, unpacked = os.stat(path).st_size, sum(sizes.values())
        if unpacked > max(_MAX_UNPACKED_BYTES, _MAX_UNPACKED_RATIO * packed):
            raise ValueError(f"{packed / 1e6:.1f} MB unpack to {unpacked / 1e6:.0f} MB, as no recorded data do")
        for name, size in sizes.items():
            with file.zip.open(name) as member:
                version = np.lib.format.read_magic(member)
                read_header = getattr(np.lib.format, f"read_array_header_{version[0]}_0", None)
                if read_header is None:
                    raise ValueError(f"{name} is of an unknown version of NumPy's format")
                shape, _, dtype = read_header(member)
            if math.prod(shape) * dtype.itemsize > size:
                raise ValueError(f"{name} announces more values than it holds")
        yield file
