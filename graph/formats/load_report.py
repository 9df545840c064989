"""What a reader of pose graphs did besides reading what it was given."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class LoadOptions:
    """How to read a file that holds more than a pose graph, or a faulty one.

    Attributes:
        repair: whether to replace an information matrix that is not positive definite by the nearest one that is.
        strict: whether to refuse rows that are otherwise left out or completed.
        drop: tags of rows to leave out.
    """

    repair: bool = False
    strict: bool = False
    drop: Collection[str] = ()


@dataclass(frozen=True)
class LoadReport:
    """Counts of what was changed or left out while reading a file; false where nothing was.

    Attributes:
        left_out: number of rows left out, by tag.
        repaired: number of rows whose information matrix was replaced by the nearest positive definite one.
        without_information: number of rows without an information matrix, which were given the identity.
    """

    left_out: Mapping[str, int] = field(default_factory=dict)
    repaired: int = 0
    without_information: int = 0

    def __bool__(self) -> bool:
        return bool(self.left_out or self.repaired or self.without_information)

    def __str__(self) -> str:
        rows = ", ".join(f"{count} × {tag}" for tag, count in self.left_out.items())
        parts = [f"left out {rows}"] if rows else []
        if self.repaired:
            parts.append(f"made {self.repaired} information matrices positive definite")
        if self.without_information:
            parts.append(f"gave {self.without_information} rows without information the identity")
        return "; ".join(parts) or "read everything as it is"
