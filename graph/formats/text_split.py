"""A pose graph's text sorted by tag, before any number of a pose is parsed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, HybridLioError
from hybridlio.graph.formats.g2o import LEFT_OUT_TAGS, ROW_FORMATS
from hybridlio.graph.formats.load_report import LoadOptions
from hybridlio.graph.formats.text_rows import TextTable, check_ids, check_numbers, check_quaternions
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.noise import Robust, make_robust

_OFFSET_TAG = "PARAMS_SE3OFFSET"


@dataclass(eq=False)
class FileContent:
    """A text file sorted by tag.

    Attributes:
        tables: rows of poses and factors by tag.
        fixed: ids of fixed poses.
        offsets: coordinates of a sensor in the body frame, by the offset's id.
        left_out: number of rows left out, by tag.
        without_information: number of rows that lack their information matrix.
    """

    tables: dict[str, TextTable] = field(default_factory=dict)
    fixed: list[int] = field(default_factory=list)
    offsets: dict[int, Array] = field(default_factory=dict)
    left_out: Counter[str] = field(default_factory=Counter)
    without_information: int = 0


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file, without a byte order mark.

    Raises:
        DataError: the file cannot be read, or is not UTF-8; names the row.
    """
    try:
        data = path.read_bytes()
        return data.decode("utf-8-sig").splitlines()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error}") from error
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise DataError(f"{path}, row {row}: cannot read it as UTF-8 text: {error}") from error


def split_by_tag(path: Path, lines: list[str], options: LoadOptions) -> FileContent:
    """Sort the rows by tag; a kernel in a comment belongs to the next factor.

    Raises:
        DataError: a row has an unknown tag, or one that the options refuse; names it.
    """
    content, kernel = FileContent(), None
    usual: dict[str, TextTable] = {}  # of the tags whose rows need no look at their text
    for number, line in enumerate(lines, 1):
        tag, _, rest = line.partition(" ")
        table = usual.get(tag)
        if table is not None and kernel is None:
            table.lines.append(number)
            table.rests.append(rest)
            continue
        tag, rest = (*line.split(None, 1), "", "")[:2]
        if tag in options.drop or (tag in LEFT_OUT_TAGS and not options.strict):
            content.left_out[tag] += 1
        elif tag in ROW_FORMATS:
            table = content.tables.setdefault(tag, TextTable())
            if kernel is not None:
                table.kernels[len(table.lines)], kernel = kernel, None
            table.lines.append(number)
            table.rests.append(_complete(path, number, content, tag, rest, options))
            if not ROW_FORMATS[tag].optional_information:
                usual[tag] = table
        elif tag:
            kernel = _read_other_row(path, number, content, tag, rest.split()) or kernel
    return content


def _complete(path: Path, line: int, content: FileContent, tag: str, rest: str, options: LoadOptions) -> str:
    """Return the row's text, with the identity where its information matrix may be and is missing."""
    row_format = ROW_FORMATS[tag]
    if not row_format.optional_information or len(rest.split(None, row_format.head)) != row_format.head:
        return rest
    if options.strict:
        raise DataError(f"{path}, row {line}: {tag} has no information matrix; strict=False gives it the identity")
    content.without_information += 1
    return f"{rest} {' '.join('1' if i == j else '0' for i, j in row_format.triangle)}"


def _read_other_row(path: Path, line: int, content: FileContent, tag: str, words: list[str]) -> Robust | None:
    """Read a row that is neither pose nor factor; return the kernel that it gives the next factor, if any."""
    if tag == "#" and words[:1] == ["robust"]:
        return _read_kernel(path, line, words)
    if tag == "FIX":
        content.fixed.extend(int(word) for word in check_ids(path, line, words))
    elif tag == _OFFSET_TAG:
        _read_offset(path, line, content, words)
    elif not tag.startswith("#"):
        what = "unsupported" if tag in LEFT_OUT_TAGS else "unknown"
        raise DataError(f"{path}, row {line}: {what} tag {tag!r}; drop=({tag!r},) leaves such rows out")
    return None


def _read_kernel(path: Path, line: int, words: list[str]) -> Robust | None:
    try:
        return make_robust((words[1], float(words[2])), 1, "kernel")
    except (IndexError, ValueError, HybridLioError) as error:
        raise DataError(f"{path}, row {line}: expected a kernel '# robust NAME WIDTH' ({error})") from error


def _read_offset(path: Path, line: int, content: FileContent, words: list[str]) -> None:
    if len(words) != 1 + len(co.IDENTITY[3]):
        raise DataError(f"{path}, row {line}: {_OFFSET_TAG} takes 8 values, got {len(words)}")
    check_ids(path, line, words[:1])
    values = check_numbers(path, line, words[1:])
    check_quaternions(path, [line], values[None])
    content.offsets[int(words[0])] = values
