"""Tests that benchmarks run; the figures that they print are not tested."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from hybridlio.odometry.config import Config

ROOT = Path(__file__).resolve().parents[1]
OURS = f"{Config().initial_pose} + none + {Config().backend}"


def python(*words: object) -> subprocess.CompletedProcess[str]:
    """Run Python with this checkout's package and benchmarks."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False)


def run(script: str, *words: object) -> subprocess.CompletedProcess[str]:
    return python(ROOT / "benchmarks" / script, *words)


def test_ours_is_compared_with_the_installed_peers(tiny_drive, tmp_path):
    options = ("--frames", ":6", "--residual", "none", "--peers", "kiss-icp,rko_lio,small_gicp", "--repeats", "2")
    done = run("peers.py", tiny_drive, *options, "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    ((found,),) = [json.loads((tmp_path / "peers.json").read_text())["recordings"].values()]
    assert found["scans"] == 6
    (first, ours), *peers = found["systems"].items()
    assert first == OURS
    assert ours["times ours"] == 1
    for name, row in found["systems"].items():
        assert row["median [ms]"] > 0
        assert row["least"] <= row["times ours"] <= row["most"]
        assert row["start to first pose [s]"] > 0
        assert row["peak memory [MiB]"] > 10
        assert name in (tmp_path / "peers.md").read_text()
    for peer in ("kiss-icp", "rko_lio"):
        assert peer in dict(peers) or f"{peer} is not installed" in done.stdout
    assert "small_gicp" in dict(peers)


def test_scenarios_include_the_normal_drive_and_report_uncertainty(tmp_path):
    options = ("--scenarios", "imu-gap", "--seeds", "3", "--length-m", "12", "--peers", "small_gicp")
    done = run("scenarios.py", tmp_path / "drives", *options, "--residual", "none", "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "scenarios.json").read_text())["scenarios"]
    assert set(found) == {"normal", "imu-gap"}
    for systems in found.values():
        ours = systems[OURS][0]
        assert ours["completed"]
        assert ours["end_sigma_m"] > 0
        assert "end_sigma_m" not in systems["small_gicp"][0]
    assert "small_gicp" in (tmp_path / "imu-gap.md").read_text()


def test_small_gicp_odometry_does_not_move_on_sixty_copies_of_one_scan(tiny_drive):
    program = (
        "import sys; import numpy as np; from pathlib import Path;"
        "from systems import small_gicp_odometry; from hybridlio.datasets.registry import open_sequence;"
        "sequence = open_sequence(Path(sys.argv[1])); step = small_gicp_odometry(sequence, 1);"
        "poses = [step(sequence[0]).pose for _ in range(60)]; print(np.abs(poses[-1] - np.eye(4)).max())"
    )
    done = python("-c", program, tiny_drive)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 0.01


def test_a_diverging_system_is_stopped_and_not_evaluated_and_what_it_compiles_first_is_not_timed(tiny_drive, tmp_path):
    program = (
        "import sys, common, peers, systems, lockstep, time; from functools import partial;"
        "from pathlib import Path; import numpy as np\n"
        "lockstep._LONGEST_S = 1\n"
        "def make(sequence, threads):\n"
        "    time.sleep(1.5)\n"
        "    return lambda frame: systems.Answer(np.eye(4) * 50.0**frame.index, frame.scan.stamp_ns)\n"
        "if __name__ == '__main__':\n"
        "    opened = partial(common.open_part, Path(sys.argv[1]), None, None)\n"
        "    found = lockstep.run_in_lockstep({'diverging': make}, opened, 10, 1)['diverging']\n"
        "    print(found.error, peers.accuracy(found, opened()))\n"
    )
    (tmp_path / "diverging.py").write_text(program)
    done = python(tmp_path / "diverging.py", tiny_drive)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "scan 4: OverflowError: diverged {}"


def test_repeated_laps_have_no_gap():
    program = (
        "import numpy as np; "
        "from hybridlio.core.sensors import Frame, ImuSamples, Scan; import long_run;"
        "stamps = 10**12 + np.arange(long_run.LAP + 1) * 10**8;"
        "samples = lambda k: ImuSamples(np.arange(stamps[k] - 10**8, stamps[k] + 1, 10**7), *np.zeros((2, 11, 3)));"
        "points = lambda k: np.full((1, 3), k, np.float32);"
        "frames = [Frame(k, Scan(int(stamps[k]), points(k)), samples(k)) for k in range(len(stamps))];"
        "lap = type('Lap', (list,), {'stamps_ns': stamps})(frames);"
        "found = list(long_run.laps(lap, 0, 2 * long_run.LAP + 2));"
        "assert [f.index for f in found] == list(range(len(found)));"
        "assert (np.diff([f.scan.stamp_ns for f in found]) == 10**8).all();"
        "assert all(f.imu.stamps_ns[-1] == f.scan.stamp_ns for f in found);"
        "seam = [int(f.scan.points[0, 0]) for f in found[long_run.LAP - 1 :][:4]];"
        "assert seam == [long_run.LAP - 1, long_run.LAP, 1, 2];"
        "later = list(long_run.laps(lap, 5, 8));"
        "assert [f.scan.stamp_ns for f in later] == [f.scan.stamp_ns for f in found[5:8]]"
    )
    done = python("-c", program)
    assert done.returncode == 0, done.stderr


def test_the_help_of_training_drives_simulates_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("training_drives.py", "--help")
    assert (done.returncode, list(tmp_path.iterdir())) == (0, [])
    assert "shipped weights" in done.stdout


def test_the_table_of_constants_names_constants_that_exist():
    done = run("constants.py", "--list")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 60


def test_the_cost_of_keeping_a_run_is_printed(tiny_drive):
    done = run("keeping.py", tiny_drive, "--frames", ":12")
    assert done.returncode == 0, done.stderr
    assert "12 scans" in done.stdout
    assert "kB a scan" in done.stdout


def test_the_latency_of_a_stream_is_measured(tiny_drive, tmp_path):
    done = run("stream_latency.py", tiny_drive, "--frames", ":8", "--speed", "0.5", "-o", tmp_path / "found.json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["scans"] == 8
    assert 0 < found["latency, median [ms]"] <= found["latency, 99th percentile [ms]"]
    assert found["predict, median [ms]"] > 0


def test_a_soak_goes_on_from_lap_to_lap():
    program = (
        "import numpy as np, soak; from long_run import LAP;"
        "from hybridlio.core.sensors import Calibration, Frame, ImuSamples, Scan;"
        "step, cloud = 10**8, np.zeros((1, 3), np.float32);"
        "samples = lambda t: ImuSamples(np.arange(t - step, t + 1, 10**7), *np.ones((2, 11, 3)));"
        "frame = lambda k: Frame(k, Scan(k * step, cloud), samples(k * step), calibration=Calibration());"
        "frames = [frame(k) for k in range(LAP + 1)];"
        "laps = soak.Laps(frames);"
        "stamps = [laps[k].scan.stamp_ns for k in range(2 * LAP + 2)];"
        "assert (np.diff(stamps) == step).all();"
        "assert all(laps[k].imu.stamps_ns[-1] == stamps[k] for k in range(len(stamps)));"
        "assert [laps[k].index for k in (0, 1, LAP, LAP + 1)] == [0, 1, LAP, 1]"
    )
    done = python("-c", program)
    assert done.returncode == 0, done.stderr
