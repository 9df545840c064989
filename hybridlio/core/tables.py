"""Tables of text, as Markdown and for the terminal."""

from __future__ import annotations

from collections.abc import Container, Mapping
from collections.abc import Sequence as Items
from typing import TYPE_CHECKING

from hybridlio.core.errors import strip_control

if TYPE_CHECKING:
    from rich.table import Table

NOTHING = "–"

Row = Mapping[str, str]


def number(value: float | None, decimals: int) -> str:
    """Format a number with this many decimals; a dash for None."""
    return NOTHING if value is None else f"{value:.{decimals}f}"


def counted(count: int, what: str, several: str | None = None) -> str:
    """Return a count with its noun in singular or plural, which is ``several`` or with s: ``1 scan``, ``2 scans``."""
    return f"{count} {what if count == 1 else several or what + 's'}"


def headings(rows: Items[Row]) -> list[str]:
    """Return the headings of all rows in order of appearance, without columns of dashes only."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [name for name in names if any(row.get(name, NOTHING) != NOTHING for row in rows)]


def to_markdown(rows: Items[Row], words: Container[str] = ()) -> str:
    """Format rows as a Markdown table. Columns named in ``words`` are aligned left, the others, numbers, right."""
    names = headings(rows)
    lines = [names, ["---" if name in words else "---:" for name in names]]
    lines += [[row.get(name, NOTHING).replace("|", "\\|").replace("\n", " ") for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def for_terminal(rows: Items[Row], words: Container[str] = (), title: str = "", caption: str = "") -> Table:
    """Format rows as a table for the terminal. A heading of numbers breaks before its last word, the unit."""
    from rich import box
    from rich.table import Table
    from rich.text import Text  # plain text: in markup "[m]" would be a style

    table = Table(title=Text(strip_control(title)) if title else None, caption=Text(caption) if caption else None)
    table.box, table.padding = box.SIMPLE_HEAD, 0
    for name in headings(rows):
        is_word = name in words
        table.add_column(
            Text(name if is_word else "\n".join(name.rsplit(" ", 1))), justify="left" if is_word else "right"
        )
    for row in rows:
        table.add_row(*(Text(strip_control(row.get(name, NOTHING))) for name in headings(rows)))
    return table
