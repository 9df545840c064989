"""Readers of recordings, one file each, and the sequence that they return."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridlio.datasets.registry import READERS, Reader, open_sequence, sequence_names
    from hybridlio.datasets.sequence import Sequence

__all__ = ["READERS", "Reader", "Sequence", "open_sequence", "sequence_names"]


def __getattr__(name: str) -> Any:
    # loaded on first use: readers import SciPy, and every import of a submodule runs this file
    if name == "Sequence":
        from hybridlio.datasets.sequence import Sequence

        return Sequence
    if name in __all__:
        from hybridlio.datasets import registry

        return getattr(registry, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
