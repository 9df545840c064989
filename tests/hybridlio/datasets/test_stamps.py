"""Time stamps: read exactly, and sorted with the fewest dropped."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.stamps import MISSING_STAMP, increasing, note_gaps, read_stamps, sorted_unique


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2011-09-26 13:04:32.349659964", [1317042272349659964]),
        ("2011-09-26 13:04:32", [1317042272000000000]),
        ("2011-09-26T13:04:32.5Z", [1317042272500000000]),
        ("2011-09-26 15:04:32.5+02:00", [1317042272500000000]),
        ("2011-09-26T09:34:32-0330", [1317042272000000000]),
        ("0.000000e+00\n1.037359e-01", [0, 103735900]),
        ("1317042272.349659964\n", [1317042272349659964]),
        ("1317042272349659964\n1317042272449659964", [1317042272349659964, 1317042272449659964]),
        ("-1.5\n2", [-1500000000, 2000000000]),
        ("# timestamp [s]\n1.0\n#\n2.0", [1000000000, 2000000000]),
        ("1.0\n\n3.0\n\n\n", [1000000000, MISSING_STAMP, 3000000000]),
    ],
)
def test_stamps_are_read_exactly(tmp_path: Path, text: str, expected: list[int]) -> None:
    path = tmp_path / "timestamps.txt"
    path.write_text(text)
    assert read_stamps(path).tolist() == expected


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "text",
    ["", "\n\n", "soon", "1.0\nlater", "2011-09-26 13:04:32\n5.0", "1\n2\n3", "1e400", "nan", "3000-01-01 00:00:00"],
)
def test_unreadable_stamps_raise_an_error_that_names_the_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "timestamps.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=r"timestamps\.txt"):
        read_stamps(path)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=9))
def test_the_fewest_possible_stamps_are_dropped(values: list[int]) -> None:
    stamps = np.array(values, dtype=np.int64)
    kept = increasing(stamps)
    assert (np.diff(kept) > 0).all()
    assert (np.diff(stamps[kept]) > 0).all()
    longer = combinations(range(len(values)), len(kept) + 1)
    assert not any((np.diff(stamps[list(other)]) > 0).all() for other in longer)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.integers(-5, 50), min_size=1, max_size=30))
def test_sorting_keeps_the_first_row_of_each_stamp(values: list[int]) -> None:
    stamps = np.array(values, dtype=np.int64)
    notes = Notes("test")
    order = sorted_unique(stamps, "rows", notes)
    assert stamps[order].tolist() == sorted(set(values))
    assert all(values.index(values[k]) == k for k in order)
    assert bool(notes.texts) == (values != sorted(set(values)))


def test_scans_many_seconds_apart_are_noted_as_a_wrong_unit() -> None:
    for step_s, count in ((100, 1), (0.1, 0)):
        notes = Notes("ride")
        note_gaps((np.arange(5) * step_s * 1e9).astype(np.int64), "scans", notes, factor=1.5)
        assert len([text for text in notes.texts if "are in seconds" in text]) == count


def test_of_equal_stamps_the_first_is_kept() -> None:
    assert increasing(np.array([0, 1, 2, 2, 4])).tolist() == [0, 1, 2, 4]
    assert increasing(np.array([0, 0, 0, 3])).tolist() == [0, 3]
