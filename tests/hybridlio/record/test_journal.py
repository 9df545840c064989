"""The journal: however it is cut or damaged, the blocks before the damage are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.record.journal import append_block, blocks

CONTENTS = [b"header", b"", bytes(range(256)) * 40]
LARGE = bytes(range(251)) * 5000  # too large to be compressed


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    path = tmp_path / "journal.bin"
    with path.open("ab") as file:
        for content in CONTENTS:
            append_block(file, content)
    return path


def test_blocks_come_back_in_order_with_their_ends(journal: Path) -> None:
    found = list(blocks(journal))
    assert [content for _, content in found] == CONTENTS
    assert found[-1][0] == journal.stat().st_size


def test_a_journal_cut_anywhere_holds_the_whole_blocks_before_the_cut(journal: Path, tmp_path: Path) -> None:
    data, ends = journal.read_bytes(), [end for end, _ in blocks(journal)]
    cut = tmp_path / "cut"
    for length in range(len(data) + 1):
        cut.write_bytes(data[:length])
        assert [content for _, content in blocks(cut)] == CONTENTS[: sum(end <= length for end in ends)]


def test_a_flipped_bit_ends_the_journal_before_its_block(journal: Path, rng: np.random.Generator) -> None:
    data, ends = bytearray(journal.read_bytes()), [end for end, _ in blocks(journal)]
    for at in rng.integers(0, len(data), 50):
        damaged = data.copy()
        damaged[at] ^= 16
        journal.write_bytes(damaged)
        assert [content for _, content in blocks(journal)] == CONTENTS[: sum(end <= at for end in ends)]


def test_a_large_block_is_not_compressed_and_comes_back(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        append_block(file, LARGE)
    assert (tmp_path / "large").stat().st_size > len(LARGE)
    assert [content for _, content in blocks(tmp_path / "large")] == [LARGE]


def test_a_missing_journal_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.bin: cannot be read"):
        list(blocks(tmp_path / "none.bin"))
