"""Headerless scans: number, type and meaning of the columns, found from values or stated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout, find_layout, stated_layout
from hybridlio.datasets.points.point_files import open_point_files, read_scan

STEP_NS = 100_000_000


def scene(seed: int, count: int, order: str) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a scan of a room by a 16-beam lidar, in the order of firing, of rings, or of chance."""
    rng = np.random.default_rng(seed)
    ring = np.tile(np.arange(16.0), -(-count // 16))[:count]
    turn = np.arange(count) / count
    azimuth, elevation = 2 * np.pi * turn, np.radians(ring * 2 - 15)
    distance = rng.uniform(4, 30) * (1.2 + np.cos(3 * azimuth)) + 2 + rng.normal(0, 0.02, count)
    columns = {
        "x": distance * np.cos(azimuth) * np.cos(elevation),
        "y": distance * np.sin(azimuth) * np.cos(elevation),
        "z": distance * np.sin(elevation),
        "intensity": rng.gamma(2, 20, count).clip(0, 255),
        "ring": ring,
        "time": turn * 0.0999,
        "distance": distance,
    }
    rows = {"firing": np.arange(count), "rings": np.argsort(ring, kind="stable"), "chance": rng.permutation(count)}[
        order
    ]
    return {name: values[rows] for name, values in columns.items()}


def write(folder: Path, names: list[str], dtype: str, count: int, order: str = "firing", scans: int = 3) -> list[Path]:
    paths = []
    for k in range(scans):
        columns = scene(k, count + k, order)
        paths.append(folder / f"{k}.bin")
        np.column_stack([columns[name] for name in names]).astype(dtype).tofile(paths[-1])
    return paths


LAYOUTS = [
    ["x", "y", "z"],
    ["x", "y", "z", "intensity"],
    ["x", "y", "z", "intensity", "ring"],
    ["x", "y", "z", "intensity", "time"],
    ["x", "y", "z", "intensity", "ring", "time"],
    ["x", "y", "z", "intensity", "time", "ring"],
    ["x", "y", "z", "intensity", "ring", "time", "distance"],
]


@pytest.mark.parametrize("names", LAYOUTS, ids=" ".join)
@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
@pytest.mark.parametrize("order", ["firing", "rings", "chance"])
@pytest.mark.parametrize(("count", "scans"), [(300, 3), (5000, 1)])
def test_columns_are_found_from_the_values(
    tmp_path: Path, names: list[str], dtype: str, order: str, count: int, scans: int
) -> None:
    notes = Notes("ride")
    layout = find_layout(write(tmp_path, names, dtype, count, order, scans), STEP_NS, notes)
    assert [name for name, _ in layout.fields] == ["_7" if name == "distance" else name for name in names]
    assert {kind for _, kind in layout.fields} == {dtype}
    assert f"{len(names)} columns of {'float32' if dtype == '<f4' else 'float64'}" in notes.texts[0]


@pytest.mark.parametrize(("name", "count"), [("bin_3_columns", 3), ("bin_5_columns", 5), ("bin_6_columns", 6)])
def test_the_known_files_hold_2000_points(cases: Path, name: str, count: int) -> None:
    path = cases / f"{name}.bin"
    scan = read_scan(path, 0)
    np.testing.assert_array_equal(scan.points, np.fromfile(path, "<f4").reshape(-1, count)[:, :3])
    assert len(scan) == 2000
    assert (scan.intensity is None) == (count == 3)
    assert (scan.time_offsets_ns is None) == (count != 6)


def test_points_times_and_intensities_come_from_their_columns(tmp_path: Path) -> None:
    paths = write(tmp_path, ["x", "y", "z", "intensity", "time", "ring"], "<f4", 500)
    loader = open_point_files(tuple(paths), np.arange(3) * STEP_NS, Notes("ride"))
    for k in range(3):
        true, scan = scene(k, 500 + k, "firing"), loader(k)
        np.testing.assert_allclose(scan.points, np.column_stack([true[axis] for axis in "xyz"]), rtol=1e-6)
        np.testing.assert_allclose(scan.intensity, true["intensity"] / 255, rtol=1e-6)
        np.testing.assert_allclose(scan.time_offsets_ns, true["time"] * 1e9, atol=10)


def test_a_truncated_scan_among_whole_ones_is_refused_alone(tmp_path: Path) -> None:
    paths = write(tmp_path, ["x", "y", "z", "intensity"], "<f4", 500)
    paths[1].write_bytes(paths[1].read_bytes()[:-3])
    loader = open_point_files(tuple(paths), np.arange(3) * STEP_NS, Notes("ride"))
    assert len(loader(2)) == 502
    with pytest.raises(DataError, match=r"frame 1: .*1\.bin: truncated scan, 8013 bytes is no multiple of 16"):
        loader(1)


@pytest.mark.parametrize("kind", ["noise", "zeros", "integers", "text", "empty"])
def test_values_that_are_no_points_are_refused_with_the_option_to_give(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(3)
    data = {
        "noise": rng.bytes(84_000),
        "zeros": bytes(84_000),
        "integers": rng.integers(-30_000, 30_000, 21_000).astype("<i4").tobytes(),
        "text": b"1.0 2.0 3.0\n" * 7000,
        "empty": b"",
    }[kind]
    (tmp_path / "0.bin").write_bytes(data)
    with pytest.raises(DataError, match=r"can hold no x y z that makes sense; state the columns .*'columns: \[x, y, z"):
        find_layout([tmp_path / "0.bin"], None, Notes("ride"))


def test_between_too_few_points_for_four_columns_and_enough_two_layouts_are_refused(tmp_path: Path) -> None:
    found, refusals = [], []
    for count in range(12, 240, 12):
        rows = np.random.default_rng(4).uniform(1, 20, (count, 4))
        rows[:, 3] *= 2
        rows.astype("<f4").tofile(tmp_path / "0.bin")
        try:
            found.append(len(find_layout([tmp_path / "0.bin"], None, Notes("ride")).fields))
        except DataError as error:
            refusals.append(str(error))
    assert found[-1] == 4
    assert refusals
    assert all("can hold" in text and "3 columns" in text and "4 columns" in text for text in refusals)


@pytest.mark.parametrize(
    ("stated", "types"),
    [
        (["x", "y", "z", "_", "_", "t"], {"x": "<f4", "y": "<f4", "z": "<f4", "t": "<f4"}),
        ({"x": "float64", "y": "float64", "z": "float64", "_1": "uint8", "t": "uint32"}, {"x": "<f8", "t": "<u4"}),
        ({"z": "int16", "y": "int16", "x": "int16"}, {"z": "<i2", "y": "<i2", "x": "<i2"}),
    ],
)
def test_stated_columns_are_read_as_stated(tmp_path: Path, stated: Any, types: dict[str, str]) -> None:
    layout = stated_layout(stated)
    rows = np.zeros(7, layout.dtype)
    rows["x"], rows["y"] = np.arange(7), 3
    rows.tofile(tmp_path / "0.bin")
    columns = layout.read(tmp_path / "0.bin")
    assert not any(name.startswith("_") for name in columns)
    assert types.items() <= {name: values.dtype.str for name, values in columns.items()}.items()
    np.testing.assert_array_equal(columns["x"], np.arange(7))


@pytest.mark.parametrize(
    "stated", [["x", "y"], ["x", "y", "z", "x"], "x y z", 4, {"x": "f", "y": "f", "z": "word"}, {}, [1]]
)
def test_malformed_statements_are_refused(stated: Any) -> None:
    with pytest.raises(DataError, match="columns:"):
        stated_layout(stated)


def test_kittis_four_columns_are_the_default_layout() -> None:
    assert BinLayout().dtype.itemsize == 16
