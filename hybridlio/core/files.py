"""Atomic writes, folder locks and YAML. A file is written under a temporary name beside its place, then renamed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import uuid
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from hybridlio.core.errors import DataError, HybridLioError

# raised when an .npz file is damaged or holds something else
UNREADABLE_NPZ = (
    OSError, ValueError, KeyError, IndexError, TypeError, EOFError, BadZipFile, zlib.error, HybridLioError
)  # fmt: skip


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
def locked(lock_file: Path, wait: bool = True) -> Iterator[bool]:
    """Hold an exclusive lock between processes for the length of the block.

    Args:
        lock_file: created with its folder where missing; it stays.
        wait: wait for another process that holds the lock; otherwise return at once.

    Yields:
        Whether the lock is held; always True with ``wait``.

    Raises:
        DataError: the file cannot be created.
    """
    make_folder(lock_file.parent)
    try:
        file = lock_file.open("w")
    except OSError as error:
        raise DataError(f"cannot create the lock file {lock_file}: {error.strerror}; choose another folder") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True


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


def write_atomically(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write ``data`` (text as UTF-8, newlines unchanged) to ``path`` completely or not at all.

    Raises:
        DataError: the place cannot be written to.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def read_yaml(path: str | os.PathLike[str], error: type[HybridLioError] = DataError) -> Any:
    """Return the content of a YAML or JSON file, None for an empty one. Tags cannot execute code.

    Args:
        path: the file.
        error: the error to raise.

    Raises:
        DataError: or ``error``; the file cannot be read or is not YAML. Names the file and, if known, the line.
    """
    import yaml  # late: this module is imported by most others

    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as trouble:
        raise error(f"{path}: cannot be read ({trouble.strerror})") from trouble
    except yaml.MarkedYAMLError as trouble:
        line = "" if trouble.problem_mark is None else f" at line {trouble.problem_mark.line + 1}"
        raise error(f"{path}: not YAML{line}: {trouble.problem or trouble.context}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as trouble:
        raise error(f"{path}: not YAML: {' '.join(str(trouble).split())}") from None
