"""No command writes to a recording or replaces a file that it did not write; a killed run loses no result."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused

from hybridlio.datasets.registry import open_sequence
from hybridlio.runs.folder import is_run_folder
from hybridlio.runs.whole_folder import held

pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")
QUICK = ("--residual", "none", "--frames", ":4")


def snapshot(root: Path) -> dict[str, str]:
    files = (p for p in root.rglob("*") if p.is_file())
    return {str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture
def recording(tiny_drive: Path, tmp_path: Path) -> Path:
    """A plain folder ``D/a`` with its truth in ``poses_tum.txt``."""
    sequence = open_sequence(tiny_drive)
    folder = tmp_path / "D" / "a"
    (folder / "scans").mkdir(parents=True)
    for k in range(4):
        np.save(folder / "scans" / f"{k}.npy", sequence[k].scan.points)
    (folder / "timestamps.txt").write_text("".join(f"{stamp / 1e9:.9f}\n" for stamp in sequence.stamps_ns[:4]))
    identity = " 0 0 0 0 0 0 1\n"
    (folder / "poses_tum.txt").write_text("".join(f"{s / 1e9:.9f}{identity}" for s in sequence.stamps_ns[:4]))
    return folder


@pytest.mark.parametrize("words", [("odometry",), ("localize", "--map", "nowhere")])
def test_a_folder_that_is_not_free_is_refused_before_anything_is_read(words, finished_run, tmp_path):
    text = refused(2, words[0], tmp_path / "no-such-recording", *words[1:], "-o", finished_run)
    assert "already holds a run" in text


def test_no_command_writes_to_a_folder_that_is_holds_or_lies_inside_a_recording(recording, finished_run, tmp_path):
    before, other = snapshot(tmp_path / "D"), shutil.copytree(finished_run, tmp_path / "other")
    for out in (recording, recording / "run", recording.parent):
        for words in (
            ("odometry", recording, "-o", out),
            ("odometry", recording, "-o", out, "--overwrite"),
            ("batch", recording, "-o", out),
            ("batch", recording, "-o", out, "--overwrite"),
            ("compare", recording, "-o", out),
            ("smooth", finished_run, "-o", out, "--overwrite"),
            ("georeference", finished_run, "-o", out),
            ("train", recording, "-o", out, "--overwrite"),
            ("train", recording, "-o", tmp_path / "training", "--cache", out),
            ("ablate", recording, "--table", 1, "--test", recording, "-o", out),
            ("localize", recording, "--map", finished_run, "-o", out),
            ("merge", finished_run, other, "-o", out),
        ):
            assert "recordings are never written to" in refused(2, *words)
    for out in (recording, recording / "scans"):
        assert "recordings are never written to" in refused(2, "simulate", out, "--seconds", 1)
        for words in (
            ("map", finished_run, "-o", out / "map.ply"),
            ("report", finished_run, "-o", out / "report.html"),
            ("optimize", finished_run / "graph.g2o", "-o", out / "graph.g2o"),
            ("calibrate", recording, "-o", out / "calibration.yaml", "--overwrite"),
        ):
            assert "recordings are never written to" in refused(2, *words)
    assert snapshot(tmp_path / "D") == before


def test_a_batch_beside_the_recordings_is_allowed(recording, tmp_path):
    before = snapshot(recording)
    ok("batch", recording, "-o", recording.parent / "results", "--residual", "none", "--engine", "threading")
    assert is_run_folder(recording.parent / "results" / "a")
    assert snapshot(recording) == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("batch.md", ("batch", "DATA", "-o", "OUT")),
        ("batch.json", ("batch", "DATA", "-o", "OUT", "--overwrite")),
        ("a/poses_tum.txt", ("batch", "DATA", "-o", "OUT", "--overwrite")),
        ("compare.md", ("compare", "DATA", "-o", "OUT")),
        ("checkpoint.pt", ("train", "DATA", "-o", "OUT", "--overwrite")),
        ("table-1.md", ("ablate", "DATA", "--table", "1", "--test", "DATA", "-o", "OUT")),
        ("map.ply", ("map", "RUN", "-o", "OUT/map.ply")),
        ("report.html", ("report", "RUN", "-o", "OUT/report.html")),
        ("graph.g2o", ("optimize", "RUN/graph.g2o", "-o", "OUT/graph.g2o")),
        ("picture.png", ("optimize", "RUN/graph.g2o", "--plot", "OUT/picture.png")),
        ("calibration.yaml", ("calibrate", "DATA", "-o", "OUT/calibration.yaml")),
        ("merge.json", ("merge", "RUN", "OTHER", "-o", "OUT")),
        ("poses_tum.txt", ("localize", "DATA", "--map", "RUN", "-o", "OUT", "--overwrite")),
        ("poses_tum.txt", ("odometry", "DATA", "-o", "OUT", "--overwrite")),
        ("2026_01_01/calib_cam_to_cam.txt", ("simulate", "OUT", "--seconds", "0.3", "--lidar", "16-beam")),
    ],
)
def test_a_file_that_the_program_did_not_write_is_not_replaced(recording, finished_run, tmp_path, name, words):
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    other = shutil.copytree(finished_run, tmp_path / "other") if "OTHER" in words else None
    places = {"DATA": recording, "OUT": out, "RUN": finished_run, "OTHER": other}
    parts = (word.partition("/") for word in words)
    line = refused(2, *(f"{places.get(first, first)}{slash}{rest}" for first, slash, rest in parts))
    assert str(out) in line
    assert (out / name).read_text() == "mine"


def test_a_simulation_is_not_written_into_a_run(finished_run, tmp_path):
    folder = shutil.copytree(finished_run, tmp_path / "run")
    before = snapshot(folder)
    for out in (folder, folder / "drive"):
        assert "run folder" in refused(2, "simulate", out, "--seconds", 1)
    assert snapshot(folder) == before


def test_a_second_writer_is_refused(recording, finished_run, tmp_path):
    folder = shutil.copytree(finished_run, tmp_path / "run")
    other_folders = [
        tmp_path / name
        for name in ("comparison", "batch", "training", "table", "town/drive-0001", "map.ply", "localized", "merged")
    ]
    compared, batched, trained, table, drive, cloud, localized, merged = other_folders
    code = """import sys
from contextlib import ExitStack
from pathlib import Path
from hybridlio.runs.whole_folder import held
with ExitStack() as stack:
    for folder in sys.argv[1:]:
        stack.enter_context(held(Path(folder)))
    print(1, flush=True)
    sys.stdin.read()
"""
    words = [sys.executable, "-c", code, *map(str, (folder, folder / "smoothed", *other_folders))]
    commands = (
        ("odometry", recording, "-o", folder, "--overwrite"),
        ("smooth", folder),
        ("compare", recording, "-o", compared),
        ("batch", recording, "-o", batched, *QUICK),
        ("train", recording, "-o", trained),
        ("ablate", recording, "--table", 1, "--test", recording, "-o", table),
        ("simulate", drive.parent, "--seconds", 1),
        ("map", folder, "-o", cloud, "--voxel", 1),
        ("localize", recording, "--map", folder, "-o", localized),
        ("merge", folder, finished_run, "-o", merged),
    )
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=Path(__file__).parents[3]) as other:
        other.stdout.read(1)
        for command in commands:
            assert f"is being written by process {other.pid}" in refused(2, *command)
        other.stdin.close()
    ok("smooth", folder)  # the lock of a process that ended is free
    with held(folder):
        pass


def test_the_workers_of_a_killed_batch_end_and_the_next_one_goes_on(tiny_drive, tmp_path):
    both = [shutil.copytree(tiny_drive.parent, tmp_path / name / tiny_drive.parent.name) for name in ("a", "b")]
    command = ["batch", *map(str, (tmp_path / "a", tmp_path / "b")), "-o", str(tmp_path / "out"), "-j", "2"]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    program = [sys.executable, "-m", "hybridlio", *command]
    with subprocess.Popen(program, cwd=Path(__file__).parents[3], env=environment, stderr=-3, stdout=-3) as run:
        while not list((tmp_path / "out").glob(".*/journal.bin")) and run.poll() is None:
            time.sleep(0.01)
        workers = children_of(run.pid)
        run.send_signal(signal.SIGKILL)
    assert workers
    until = time.monotonic() + 20  # they look twice a second; the machine may be busy
    while any(Path(f"/proc/{worker}").exists() for worker in workers) and time.monotonic() < until:
        time.sleep(0.1)
    assert [worker for worker in workers if Path(f"/proc/{worker}").exists()] == []
    ok(*command)
    rows = json.loads((tmp_path / "out/batch.json").read_text())["recordings"]
    assert [row["status"] for row in rows] == ["done", "done"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir() if p.name.startswith(".")) == []
    assert len(both) == len(rows)


def children_of(process: int) -> list[int]:
    """Return the processes that a process has started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if parent == process:
            found.append(int(stat.parent.name))
    return found


def test_a_killed_run_or_smoothing_keeps_the_result_that_stood_there(tiny_drive, finished_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(finished_run, folder)
    ok("smooth", folder)
    before = snapshot(folder)
    program = [sys.executable, "-m", "hybridlio"]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    odometry = [*program, "odometry", str(tiny_drive), *QUICK, "-o", str(folder), "--overwrite"]
    smooth = [*program, "smooth", str(folder)]
    for command, part in ((odometry, tmp_path / ".run.partial"), (smooth, folder / ".smoothed.partial")):
        for name in ("covariances.npz", "report.html"):
            with subprocess.Popen(command, cwd=Path(__file__).parents[3], env=environment, stderr=-3, stdout=-3) as run:
                while not (part / name).exists() and run.poll() is None:
                    time.sleep(0.002)
                run.send_signal(signal.SIGKILL)
            assert run.returncode == -signal.SIGKILL
            left = {n: h for n, h in snapshot(folder).items() if not n.startswith(".")}
            assert left == before
    ok("smooth", folder)
    ok(*odometry[3:])
    assert json.loads((folder / "metrics.json").read_text())["frames"] == 4
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert not any(p.name.startswith(".") for p in folder.iterdir())
