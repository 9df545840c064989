"""Damage of files: cut off, bits and numbers changed, words exchanged, files in each other's place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

_HEADER = 600  # bytes: headers of all formats are shorter
_NUMBERS = [
    b"\0\0\0\0",
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\0\0\xc0\x7f",  # NaN
    b"\0\0\x80\x7f",  # infinity
    b"\xff\xff\xff\xff\xff\xff\xff\x7f",
    b"\0\0\0\0\0\0\xf8\x7f",
    b"\x01\0\0\0\0\0\0\0",
]
_WORDS = [
    *("nan", "inf", "-1", "0", "1e309", "9" * 30, "abc", "", "null", "{}", "[[[["),
    '"',
    "1970-13-45",
    "-",
    "é",
    "1,2",
]

Damage = Callable[[bytes, np.random.Generator], bytes]


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _bytes(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    reach = min(len(out), _HEADER) if rng.random() < 0.5 else len(out)
    for _ in range(rng.integers(1, 8) if out else 0):
        out[rng.integers(reach)] = rng.integers(256)
    return bytes(out)


def _bits(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(rng.integers(1, 4) if out else 0):
        out[rng.integers(len(out))] ^= 1 << rng.integers(8)
    return bytes(out)


def _numbers(data: bytes, rng: np.random.Generator) -> bytes:
    """Write an extreme number over one, as a header that lies."""
    number = _NUMBERS[rng.integers(len(_NUMBERS))]
    reach = max(min(len(data), _HEADER) if rng.random() < 0.7 else len(data), 1)
    at = rng.integers(reach)
    return data[:at] + number + data[at + len(number) :]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    at, start = rng.integers(len(data) + 1, size=2)
    return data[:at] + data[start : start + rng.integers(1, 60)] + data[at:]


def _words(data: bytes, rng: np.random.Generator) -> bytes:
    """Exchange words of a text, or put strange ones in their place; other files get their bytes changed."""
    try:
        lines = data.decode().splitlines(keepends=True)
    except UnicodeDecodeError:
        return _bytes(data, rng)
    if not lines:
        return data
    for _ in range(rng.integers(1, 4)):
        k = int(rng.integers(len(lines)))
        separator = "," if "," in lines[k] else " "
        words = lines[k].split(separator)
        a, b = rng.integers(len(words), size=2)
        if rng.random() < 0.4:
            words[a], words[b] = words[b], words[a]
        else:
            words[a] = _WORDS[rng.integers(len(_WORDS))]
        lines[k] = separator.join(words)
    return "".join(lines).encode()


def _lines(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    a, b = rng.integers(len(lines), size=2)
    kind = rng.integers(3)
    if kind == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 1:
        del lines[a]
    else:
        lines.insert(b, lines[a])
    return b"".join(lines)


KINDS: tuple[Damage, ...] = (_cut, _bytes, _bits, _numbers, _repeat, _words, _words, _lines)


def damage(root: Path, rng: np.random.Generator) -> list[Path]:
    """Damage one or two files below a folder; return those that were changed or removed.

    Files of each kind (by suffix) are as likely as those of another, or scans would hide the rest.
    """
    files = sorted(path for path in root.rglob("*") if path.is_file())
    suffixes = sorted({path.suffix for path in files})
    changed = []
    for _ in range(rng.integers(1, 3)):
        suffix = suffixes[rng.integers(len(suffixes))]
        group = [path for path in files if path.suffix == suffix]
        path = group[rng.integers(len(group))]
        changed.append(path)
        kind = rng.random()
        if kind < 0.05:
            path.unlink(missing_ok=True)
        elif kind < 0.1 and path.is_file():
            other = files[rng.integers(len(files))]
            if other.is_file():
                first, second = path.read_bytes(), other.read_bytes()
                path.write_bytes(second)
                other.write_bytes(first)
                changed.append(other)
        elif path.is_file():
            path.write_bytes(KINDS[rng.integers(len(KINDS))](path.read_bytes(), rng))
    return changed
