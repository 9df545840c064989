"""CSV files with a header, separated by commas, semicolons or tabs, as rows of text with their line numbers."""

from __future__ import annotations

import csv
from pathlib import Path

from hybridlio.core.errors import DataError


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
    return header, rows
