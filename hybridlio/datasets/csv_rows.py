"""CSV files with a header, as rows of text that know their line."""

from __future__ import annotations

import csv
from pathlib import Path

from hybridlio.core.errors import DataError


def read_csv(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header's names, without a leading ``#``, and each row that is not blank with its line.

    Raises:
        DataError: no text in UTF-8, no CSV, or a row with another number of columns than the header; names the place.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            header = [name.strip().lstrip("# ") for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    except UnicodeDecodeError:
        raise DataError(f"{path}: not a text file in UTF-8; save it as such") from None
    except (OSError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read as CSV ({error})") from None
    for line, row in rows:
        if len(row) != len(header):
            raise DataError(f"{path}, line {line}: {len(row)} columns where the header has {len(header)}")
    return header, rows
