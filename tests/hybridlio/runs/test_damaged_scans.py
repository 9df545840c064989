"""One damaged scan file among good ones is bridged with a note, whatever its format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.run import run_odometry

PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary\n"
PLY = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n"
)


def encoded(points: np.ndarray, suffix: str) -> bytes:
    if suffix == ".bin":
        return np.column_stack([points, np.zeros(len(points))]).astype("<f4").tobytes()
    header = PCD if suffix == ".pcd" else PLY
    return header.format(n=len(points)).encode() + points.astype("<f4").tobytes()


def damaged(data: bytes, how: str) -> bytes:
    if how == "cut in the points":
        return data[: len(data) // 2 + 1]
    return {"cut at the start": data[:7], "empty": b"", "noise": bytes(range(256)) * 3 + b"\xff"}[how]


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply"])
@pytest.mark.parametrize("how", ["cut in the points", "cut at the start", "empty", "noise"])
def test_a_damaged_scan_is_bridged_with_a_note(sequence: Sequence, tmp_path: Path, suffix: str, how: str) -> None:
    (tmp_path / "scans").mkdir()
    for k in range(5):
        data = encoded(sequence[k].scan.points, suffix)
        (tmp_path / "scans" / f"{k}{suffix}").write_bytes(damaged(data, how) if k == 3 else data)
    (tmp_path / "timestamps.txt").write_text("".join(f"{stamp / 1e9:.9f}\n" for stamp in sequence.stamps_ns[:5]))
    run = run_odometry(open_sequence(tmp_path), Odometry("constant-velocity", "scan-matching", "none"))
    assert run.stopped is None
    assert run.done == 5
    assert run.bridged == [3]
    assert f"3{suffix}" in run.unreadable[3]
    assert "\n" not in run.unreadable[3]
