"""Test cases that are kept: the first byte chooses a file of an input, by name, and the others take its place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CORPORA = Path(__file__).resolve().parents[1] / "corpora"
MOST_BYTES, MOST_CASES = 2048, 12  # of a case; of an input: what a search finds is kept small


class Corpus:
    """The kept cases of an input.

    Args:
        name: of the input.
        root: the folder that holds its whole files.
    """

    def __init__(self, name: str, root: Path) -> None:
        self._name = name
        self._files = sorted(path for path in root.rglob("*") if path.is_file())
        self._whole = [path.read_bytes() for path in self._files]

    def cases(self) -> dict[str, bytes]:
        """Return the kept cases by the names of their files."""
        return {path.name: path.read_bytes() for path in sorted((CORPORA / self._name).glob("*"))}

    def write_seeds(self, folder: Path) -> None:
        """Write a case for each whole file that is small enough, and for the beginnings of larger ones."""
        folder.mkdir()
        for number, content in enumerate(self._whole[:256]):
            (folder / str(number)).write_bytes(bytes([number]) + content[: MOST_BYTES - 1])

    @contextmanager
    def applied(self, case: bytes) -> Iterator[None]:
        """Put a case in its file's place for a while."""
        number = (case[0] if case else 0) % len(self._files)
        self._files[number].write_bytes(case[1:])
        try:
            yield
        finally:
            self._files[number].write_bytes(self._whole[number])
