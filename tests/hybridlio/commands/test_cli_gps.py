"""Options of the commands about GPS fixes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused

from hybridlio.core import se3
from hybridlio.core.sensors import NS_PER_S, GpsFix
from hybridlio.graph.run import smooth as offline
from hybridlio.record.record import Record
from hybridlio.smoothing import georeference

pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")
LEVER_M = np.array([-0.5, 0.4, 1.2])
OPTIONS = ("--antenna", "-0.5,0.4,1.2", "--max-shift", 0)


@pytest.fixture
def with_fixes(finished_run: Path, tmp_path: Path) -> Path:
    """Return a run with a GPS fix at every second scan, of an antenna that is not at the IMU."""
    folder = shutil.copytree(finished_run, tmp_path / "run")
    record = Record.load(folder / "odometry.npz")
    lever = se3.transform(se3.inverse(record.calibration.T_imu_lidar), LEVER_M[None])
    rows = slice(None, None, 2)
    fixes = (
        GpsFix(int(stamp), se3.transform(pose, lever)[0], 0.01 * np.eye(3))
        for stamp, pose in zip(record.online.stamps_ns[rows], record.online.poses[rows], strict=True)
    )
    replace(record, gps=tuple(fixes)).save(folder / "odometry.npz")
    return folder


def test_smooth_passes_on_antenna_clock_and_outages(with_fixes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, smooth = [], offline.smooth
    monkeypatch.setattr(offline, "smooth", lambda *a, gps, **k: (given.append(gps), smooth(*a, gps=gps, **k))[1])
    output = ok("smooth", with_fixes, "--gps", *OPTIONS, "--outage", "0.55:0.85", "--outage", "1.95:9")
    assert "8 of 13 fixes used" in output  # those at 0.6, 0.8, 2.0, 2.2 and 2.4 s are ignored
    start_ns = Record.load(with_fixes / "odometry.npz").online.stamps_ns[0]
    (options,) = given
    assert options.antenna_m.tolist() == LEVER_M.tolist()
    assert options.max_shift_s == 0
    spans = (np.array(options.outages) - start_ns) / NS_PER_S
    np.testing.assert_allclose(spans, [[0.55, 0.85], [1.95, 9]])
    assert json.loads((with_fixes / "smoothed/metrics.json").read_text())["gps"]["shift_s"] == pytest.approx(
        0, abs=1e-5
    )


def test_georeference_passes_on_antenna_and_clock(with_fixes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, place = [], georeference.georeference
    monkeypatch.setattr(georeference, "georeference", lambda *a, **k: (given.append(k), place(*a, **k))[1])
    assert "13 of 13 fixes are inliers" in ok("georeference", with_fixes, *OPTIONS)
    assert given[0]["antenna_m"].tolist() == LEVER_M.tolist()
    assert given[0]["max_shift_s"] == 0


def test_georeference_replaces_its_files_only_when_it_is_asked_to(with_fixes: Path) -> None:
    ok("georeference", with_fixes, *OPTIONS, "--origin", "49,8,100")
    assert "georeferenced.csv" in ok("georeference", with_fixes, *OPTIONS, "--origin", "49,8,100", "--overwrite")
    assert "poses_enu_tum.txt exists" in refused(2, "georeference", with_fixes, *OPTIONS)
    ok("georeference", with_fixes, *OPTIONS, "--overwrite")
    assert not (with_fixes / "georeferenced.csv").exists(), "written for an origin that is no longer stated"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--gps", "--antenna", "1,2"), "--antenna '1,2': give X,Y,Z"),
        (("--gps", "--antenna", "1,2,nan"), "antenna_m: must be three finite numbers"),
        (("--gps", "--outage", "30"), "--outage '30': give seconds"),
        (("--gps", "--outage", "9:8"), "--outage '9:8': the end must be after the start"),
        (("--antenna", "1,2,3"), "give --gps too"),
        (("--outage", "1:2"), "give --gps too"),
    ],
)
def test_malformed_gps_options_are_an_error(finished_run: Path, options: tuple[str, ...], message: str) -> None:
    assert message in refused(2, "smooth", finished_run, *options)
    assert not (finished_run / "smoothed").exists()
