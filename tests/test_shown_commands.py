"""The commands that pages show run as they stand, one page's in one folder, on short recordings in place of DATA.

What would take minutes is shortened: fewer seconds, steps and frames. What cannot run here is listed with the reason.
"""

from __future__ import annotations

import re
import shlex
import shutil
from glob import glob
from pathlib import Path

import bags
import pytest
from command_line import ok
from odometry_files import write_files
from streams import thinned

import hybridlio as hl

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
HOW_TO = sorted((DOCS / "how_to").glob("*.md"))
PAGES = [*HOW_TO, DOCS / "index.md", DOCS / "own_robot.md", ROOT / "README.md"]

# What stands for something of the reader's, and what it is here.
STAND_INS = {
    "DATA": "drive", "DRIVES": "drive", "OUT": "out", "MONDAY": "drive", "TUESDAY": "second", "RUN": "run",
    "monday": "run", "tuesday": "later", "EST": "run", "GT": "drive", "POSES": "run/poses_tum.txt", "MAP": "joined",
    "drive_folder": "recording", "/os_cloud_node/points": "/points", "/os_cloud_node/imu": "/imu/data",
}  # fmt: skip
SHORTER = {"--seconds": "1", "--length-m": "10", "--steps": "1", "--simulate": "1", "--jobs": "1"}
ADDED = {"compare": ["--frames", ":2"], "train": ["--steps", "1"]}
# Commands by what they contain; each has tests of its own.
NOT_RUN = {
    "torchrun": "needs several processes",
    "dask": "needs a scheduler on another machine",
    "KITTI": "needs the whole data set",
    "capture.pcap": "needs a capture and an optional package",
    "hybridlio ablate": "trains every row of a table",
    "--preset paper": "the published network takes a quarter of a minute a step on a CPU",
    "--preset published": "simulates and trains for a minute",
    "--init-from": "trains once more",
    "hybridlio calibrate": "needs a recording of ten seconds with turns",
    "--view": "opens a window; --save writes what it shows",
    "view RUN ": "opens a window",
    "view run ": "opens a window, or a browser",
    "merge RUN RUN": "RUN stands for two runs; the how-to names them",
    "--resume": "goes on with a run that was killed",
}


def commands(page: Path) -> list[str]:
    """The lines of a page's shell blocks that call hybridlio, one space between words, without comments."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    lines = (shlex.split(line, comments=True) for line in "".join(blocks).replace("\\\n", " ").splitlines())
    return [" ".join(words) for words in lines if words and words[0] in ("hybridlio", "torchrun")]


def not_run(line: str) -> str | None:
    """Why a command is not run; None if it is."""
    return next((why for part, why in NOT_RUN.items() if part in line + " "), None)


def new_commands() -> dict[Path, list[str]]:
    """The commands of each page that run here and that no earlier page shows."""
    seen: set[str] = set()
    out: dict[Path, list[str]] = {}
    for page in PAGES:
        for line in commands(page):
            if line not in seen and not not_run(line):
                out.setdefault(page, []).append(line)
            seen.add(line)
    return out


def run_shown(line: str) -> None:
    """Run a command in the current folder, with stand-ins, shortened; what it is to make is removed before."""
    shown, _, redirected = line.partition(" > ")
    words = [STAND_INS.get(word.rstrip("…"), word) for word in shown.split()[1:]]
    for option, value in SHORTER.items():
        if option in words:
            words[words.index(option) + 1] = value
    words += ADDED.get(words[0], [])
    if words[0] == "simulate" and not {"--seconds", "--length-m"} & set(words):
        words += ["--seconds", SHORTER["--seconds"]]
    made = words[1] if words[0] == "simulate" else words[words.index("-o") + 1] if "-o" in words else ""
    if made and Path(made).is_dir():
        shutil.rmtree(made)
    words = [path for word in words for path in (sorted(glob(word)) if "*" in word else [word])]
    said = ok(*words)
    if redirected:
        Path(redirected).write_text(said)


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that commands find: recordings, runs, bags, files of another odometry, trained weights."""
    folder = tmp_path_factory.mktemp("material")
    config = hl.SimulationConfig(seconds=2.1, gps=True, gps_rate_hz=4.0)
    for name, drive_seed in (("drive", None), ("second", 77)):
        hl.simulate(folder / name, config.model_copy(update={"drive_seed": drive_seed}))
    for drive, run in (("drive", "run"), ("second", "later")):
        ok("odometry", folder / drive, "-o", folder / run)
    shutil.copytree(folder / "run", folder / "robot2")
    (folder / "drives").mkdir()
    (folder / "drives" / "one").symlink_to(folder / "drive")
    write_bags(folder, hl.open_sequence(folder / "drive"))
    write_files(folder)
    (folder / "times.txt").unlink()  # with a map beside it, the folder would be a recording
    shutil.copy(folder / "run" / "graph.g2o", folder / "map.g2o")
    (folder / "list.yaml").write_text("- drive\n")
    return folder


def write_bags(folder: Path, drive: hl.Sequence) -> None:
    """Write the first second of a drive as a bag of either ROS."""
    scans = [thinned(drive, 4).load_scan(k) for k in range(10)]
    imu = drive.imu.between(0, int(drive.stamps_ns[10]))
    for name, is_ros2, storage in (("recording", True, "mcap"), ("drive.bag", False, "")):
        messages = bags.Messages(is_ros2)
        content = bags.drive_messages(messages, scans, imu, drive.calibration.T_imu_lidar)
        bags.write(folder / name, messages, content, storage)


@pytest.mark.parametrize("page", new_commands(), ids=lambda page: str(page.relative_to(ROOT)))
def test_the_commands_of_a_page_run(
    page: Path, material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(material, tmp_path, dirs_exist_ok=True, symlinks=True)
    for block in re.findall(r"^```yaml\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE):
        if named := re.match(r"# (\S+\.yaml)", block):
            Path(named[1]).write_text(block)
    for line in new_commands()[page]:
        run_shown(line)


def test_every_reason_not_to_run_a_command_is_needed() -> None:
    shown = [line + " " for page in PAGES for line in commands(page)]
    assert [part for part in NOT_RUN if not any(part in line for line in shown)] == []
