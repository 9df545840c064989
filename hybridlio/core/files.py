"""Files that appear whole: written beside their place under a temporary name, then renamed into it. And YAML, read."""

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

# what reading an .npz file that is damaged, or holds something else, can raise
UNREADABLE_NPZ = (
    OSError, ValueError, KeyError, IndexError, TypeError, EOFError, BadZipFile, zlib.error, HybridLioError
)  # fmt: skip


def make_folder(path: Path) -> None:
    """Make a folder, with those above it, unless it is there.

    Raises:
        DataError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot make the folder {path}: {error.strerror}; choose another") from None


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
def writing_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the same folder that takes ``path``'s place when the block ends well.

    The folder is made where it is missing. The temporary name keeps the suffix, as some writers choose a format by it.
    When the block raises, or is interrupted, what was written is removed and the file at ``path`` stays as it was.

    Raises:
        DataError: the place cannot be written to; names ``path`` and the system's reason.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename not in (None, str(temporary), str(path.parent), *map(str, path.parents)):
            raise  # another file's trouble, met inside the block
        raise DataError(
            f"cannot write {path}: {error.strerror or error}; choose a place with room and rights"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_whole(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write ``data`` (text as UTF-8, newlines as given) to ``path``, whole or not at all.

    Raises:
        DataError: the place cannot be written to.
    """
    with writing_whole(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def read_yaml(path: str | os.PathLike[str], error: type[HybridLioError] = DataError) -> Any:
    """The tree of a YAML (or JSON) file; None for an empty one. Nothing in it is executed.

    Args:
        path: the file.
        error: what to raise.

    Raises:
        DataError, or what ``error`` says: it cannot be read or is not YAML; names the file and, if known, the line.
    """
    import yaml  # here, as it is on the way of every import

    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as trouble:
        raise error(f"{path}: cannot be read ({trouble.strerror})") from trouble
    except yaml.MarkedYAMLError as trouble:
        line = "" if trouble.problem_mark is None else f" at line {trouble.problem_mark.line + 1}"
        raise error(f"{path}: not YAML{line}: {trouble.problem or trouble.context}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as trouble:
        raise error(f"{path}: not YAML: {' '.join(str(trouble).split())}") from None
