"""CSV files with a header, separated by commas, semicolons or tabs, as rows of text with their line numbers.

Where semicolons or tabs separate and no value has a point, as spreadsheets write in half of the world, a comma inside a
number is a decimal one. Where each comma stands before just three digits, it could as well part thousands, and stays.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

from hybridlio.core.errors import DataError

_WITH_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")
_PERHAPS_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")


def read_csv(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Read a CSV file with a header.

    Returns:
        The column names, without a leading ``#``; and the rows that are not blank, as ``(line number, fields)``.

    Raises:
        DataError: the file is missing, not UTF-8 or not CSV, or a row has more or fewer columns than the header; the
            message names file and line.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            head = file.readline()
            file.seek(0)
            delimiter = "," if "," in head else next((sign for sign in ";\t" if sign in head), ",")
            reader = csv.reader(file, skipinitialspace=True, delimiter=delimiter)
            header = [name.strip().lstrip("# ") for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    except UnicodeDecodeError:
        raise DataError(f"{path}: not UTF-8 text; save the file as UTF-8") from None
    except (OSError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read as CSV ({error})") from None
    for line, row in rows:
        if len(row) != len(header):
            raise DataError(f"{path}, line {line}: {len(row)} columns, but the header has {len(header)}")
    return header, rows if delimiter == "," else _with_points(rows)


def _with_points(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return the rows with decimal commas as points."""
    commas = [field for _, row in rows for field in row if "," in field]
    told = any(not _PERHAPS_THOUSANDS.fullmatch(field) for field in commas)
    if not told or not all(map(_WITH_COMMA.fullmatch, commas)) or any("." in field for _, row in rows for field in row):
        return rows
    return [(line, [field.replace(",", ".") for field in row]) for line, row in rows]
