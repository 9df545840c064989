"""Test cases of an input: the first byte chooses one of its files, by name, and the others take the file's place.

Cases that a search found are kept in tests/corpora. Others are made of the whole files where they are needed: the first
file of each kind (by suffix) becomes empty, or is cut off, or holds zeros, or another file's content, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CORPORA = Path(__file__).resolve().parents[1] / "corpora"
MOST_BYTES, MOST_CASES = 2048, 12  # of a case; of an input: what a search finds is kept small


def _changed(whole: bytes) -> dict[str, bytes]:
    half = len(whole) // 2
    return {
        "empty": b"",
        "cut at its half": whole[:half],
        "without its last byte": whole[:-1],
        "twice": whole + whole,
        "of zeros": bytes(len(whole)),
        "with a header of ones": b"\xff" * min(len(whole), 64) + whole[64:],
        "with text that is no UTF-8": whole[:half] + b"\x1b[31m\xff\n" + whole[half:],
    }


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
        """Return the kept cases by the names of their files, and those that are made of the whole files."""
        kept = {path.name: path.read_bytes() for path in sorted((CORPORA / self._name).glob("*"))}
        return kept | self._made()

    def _made(self) -> dict[str, bytes]:
        firsts = {path.suffix: number for number, path in reversed(list(enumerate(self._files[:256])))}
        cases = {}
        for number in sorted(firsts.values()):
            for kind, content in _changed(self._whole[number]).items():
                cases[f"{self._files[number].name} {kind}"] = bytes([number]) + content
            other = self._whole[(number + 1) % len(self._whole)]
            cases[f"{self._files[number].name} with another's content"] = bytes([number]) + other
        return cases

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
