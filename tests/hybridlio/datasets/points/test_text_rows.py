"""Scans as text: separators, names, comments, and lines that are no points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.points.text_rows import read_text

ROWS = np.round(np.random.default_rng(0).uniform(-9, 9, (20, 5)), 4)
NAMES = ["x", "y", "z", "intensity", "t"]


def lines(mark: str, rows: Any = ROWS) -> str:
    return "".join(mark.join(f"{value:.4f}" for value in row) + "\n" for row in rows)


NAMED = {
    "csv": "x,y,z,intensity,t\n" + lines(","),
    "csv with spaces": "X, Y, Z, Intensity, t\n" + lines(", "),
    "units": "x [m],y [m],z [m],intensity,t\n" + lines(","),
    "quotes": '"x","y","z","intensity","t"\n' + lines(","),
    "CloudCompare": "//X Y Z Intensity t\n20\n" + lines(" "),
    "numpy": "# saved by numpy\n# x y z intensity t\n" + lines(" "),
    "ParaView": '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","intensity","t"\n' + lines(","),
    "decimal commas": "x;y;z;intensity;t\n" + lines(";").replace(".", ","),
    "tabs": "x\ty\tz\tintensity\tt\n" + lines("\t"),
    "byte order mark and CRLF": "\ufeff# made here\nx,y,z,intensity,t\n".replace("\n", "\r\n") + lines(","),
    "commas at the ends": "x,y,z,intensity,t,\n" + lines(",").replace("\n", ",\n"),
}
UNNAMED = {"xyz": lines(" "), "pts": "20\n" + lines(" "), "comments": "# made here\n" + lines(" ") + "# the end\n"}


@pytest.mark.parametrize("kind", NAMED)
def test_columns_are_read_by_name(tmp_path: Path, kind: str) -> None:
    (tmp_path / "scan.csv").write_bytes(NAMED[kind].encode())
    columns = read_text(tmp_path / "scan.csv")
    assert isinstance(columns, dict)
    assert list(columns) == NAMES
    np.testing.assert_array_equal(np.column_stack(list(columns.values())), ROWS)


@pytest.mark.parametrize("kind", UNNAMED)
def test_rows_without_names_are_numbers(tmp_path: Path, kind: str) -> None:
    (tmp_path / "scan.xyz").write_text(UNNAMED[kind])
    np.testing.assert_array_equal(read_text(tmp_path / "scan.xyz"), ROWS)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no points"),
        ("x,y,z\n", "holds no points"),
        ("1 2\n3 4\n", "holds no points"),
        (lines(" ") + "1 2 3\n", "cannot read a line as numbers"),
        (lines(",") + "1,2,3,4,five\n", "cannot read a line as numbers"),
        (lines(" ", np.zeros((3, 8))), "8 columns without names"),
        ("a b c d e f g h\n" + lines(" ", np.zeros((3, 8))), "8 columns without names"),
    ],
)
def test_what_is_no_scan_is_one_clear_error(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "scan.txt").write_text(text)
    with pytest.raises(DataError, match=says):
        read_text(tmp_path / "scan.txt")


@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".txt"])
def test_a_folder_of_text_scans_is_read_beside_its_other_text_files(
    recordings: Any, tmp_path: Path, suffix: str
) -> None:
    folder = recordings.write_folder(tmp_path, recordings.ride)
    whole = [frame.scan.points for frame in open_sequence(folder)]
    for path in (folder / "scans").glob("*.npy"):
        np.savetxt(path.with_suffix(suffix), np.load(path))
        path.unlink()
    (folder / "timestamps.txt").rename(folder / "scans/timestamps.txt")
    for frame, points in zip(open_sequence(folder), whole, strict=True):
        np.testing.assert_allclose(frame.scan.points, points, atol=1e-5)
