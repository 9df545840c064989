"""Files other than recordings that hybridlio reads, to be damaged: how each is written and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rides
from fuzz_input import Input

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.trajectory import Trajectory, read_pair, write_kitti, write_tum
from hybridlio.datasets import open_sequence
from hybridlio.datasets.calibration_yaml import read_calibration_yaml
from hybridlio.datasets.gps_csv import read_gps_csv
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_files import read_scan
from hybridlio.evaluation.evaluate import evaluate
from hybridlio.graph import PoseGraph
from hybridlio.localization.open_map import open_prior_map
from hybridlio.mapping.files import write_map
from hybridlio.mapping.point_map import PointMap
from hybridlio.odometry.config import Config, config_to_yaml, load_config
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.runs.folder import KEYFRAMES, PICTURE, RECORD, REPORT, STATES, read_run
from hybridlio.runs.recordings import find_recordings
from hybridlio.runs.results.states import States
from hybridlio.runs.run import Run, finish_run, run_odometry
from hybridlio.runs.unfinished.keeper import Keeper
from hybridlio.runs.unfinished.kept import read_unfinished
from hybridlio.runs.whole_folder import partial_folder
from hybridlio.runs.write import write_run_files

GRAPHS, MAPS = ("g2o", "graph", "npz"), ("ply", "pcd", "npz", "las")


def circle(count: int = 12) -> Trajectory:
    """Return poses on a circle."""
    ride = rides.Ride(count)
    poses = np.array([se3.exp(np.array([0, 0, 0.1, 1.0, 0, 0]) * k) for k in range(count)])
    return Trajectory(ride.stamps_ns, poses)


def written_trajectory(root: Path, is_tum: bool) -> tuple[Path, Path]:
    root.mkdir(parents=True)
    write_tum(root / "truth.txt", circle())
    (write_tum if is_tum else write_kitti)(root / "estimate.txt", circle())
    return root / "estimate.txt", root / "truth.txt"


def evaluated(paths: tuple[Path, Path]) -> None:
    evaluate(*read_pair(*paths))


def written_run(root: Path) -> Path:
    """Write the folder of a run over a few scans, without its pages, which nothing reads."""
    root.mkdir(parents=True)
    sequence = open_sequence(rides.write_folder(root.parent / "recording", rides.Ride(6)))
    write_run_files(root, run_odometry(sequence, Odometry()), Config())
    for page in (REPORT, PICTURE):
        (root / page).unlink()
    return root


def smoothed_run(folder: Path) -> None:
    """Read what `smooth`, `evaluate` and `map` read of a run, and smooth it."""
    stored, record = read_run(folder), Record.load(folder / RECORD)
    LoopKeyframes.load(folder / KEYFRAMES)
    States.load(folder / STATES)
    if stored.reference is not None:
        evaluate(stored.trajectory, stored.reference, steps=stored.steps)
    hl.smooth(record)


def written_killed_run(root: Path) -> Path:
    """Write the hidden folder of a run that was killed."""
    sequence = open_sequence(rides.write_folder(root.parent / "recording", rides.Ride(6)))
    run = Run(sequence, Odometry())
    with Keeper(partial_folder(root / "run"), run, Config()) as keeper:
        finish_run(run, keeper=keeper)
    return root / "run"


def pose_graph(landmarks: bool) -> PoseGraph:
    """Return a small graph with some of all kinds that files hold."""
    graph, poses, rng = PoseGraph(), circle(8).poses, np.random.default_rng(0)
    graph.add_pose(0, poses[0])
    graph.fix(0)
    for k in range(7):
        step = se3.between(poses[k], poses[k + 1]) @ se3.exp(rng.normal(0, 0.01, 6))
        graph.add_between(k, k + 1, step, sigmas=0.1, robust="huber" if k == 3 and landmarks else None)
    graph.add_between(7, 0, se3.between(poses[7], poses[0]), sigmas=0.1)
    for key in (2, 4) if landmarks else ():
        graph.add_point_observation(
            key, 100, se3.transform(se3.inverse(poses[key]), np.array([[3.0, 4, 5]]))[0], sigmas=0.1
        )
    return graph


def written_graph(root: Path, suffix: str) -> Path:
    root.mkdir(parents=True)
    graph, path = pose_graph(landmarks=suffix != "graph"), root / f"graph.{suffix}"
    if suffix == "npz":
        graph.add_prior(0, circle(8).poses[0], sigmas=0.1)
        graph.add_gps(3, circle(8).poses[3, :3, 3], 0.1)
        graph.add_altitude(5, 0.0, 0.1)
    graph.save(path, graph.optimize() if suffix != "npz" else None)
    return path


def solved(path: Path) -> None:
    PoseGraph.load(path).optimize()


def written_map(root: Path, suffix: str) -> Path:
    root.mkdir(parents=True)
    rng = np.random.default_rng(0)
    points = rng.uniform(-10, 10, (60, 3))
    normals = np.tile(np.float32([0, 0, 1]), (60, 1))
    times = np.arange(60, dtype=np.float32)
    cloud = PointMap(points, times / 60, normals, times, times + 1, np.ones(60, np.uint16))
    write_map(root / f"map.{suffix}", cloud)
    return root / f"map.{suffix}"


def written_text(root: Path, name: str, text: str) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(text)
    return root / name


def written_list(root: Path) -> Path:
    for name in ("a", "b"):
        written_text(root / name, "timestamps.txt", "0\n")
    entries = "- a\n- {path: b, frames: '0:3', sequence: '04'}\n- path: a\n  vertical_angle_deg: 0.2\n"
    return written_text(root, "list.yaml", entries)


_CALIBRATION = """
antenna_imu_m: [0.1, 0.2, 0.3]
imu_time_offset_s: 0.003
lidar: {model: 16-beam, min_range_m: 1.0, max_range_m: 80.0}
imu_noise: {gyro_rad_s_sqrt_hz: 0.001}
vehicle: {min: [-1, -1, -1], max: [1, 1, 1]}
"""
_GPS = "t_s,latitude,longitude,height,sigma\n" + "".join(f"{k},{49 + k * 1e-5},8.4,110.0,0.5\n" for k in range(20))
_ASCII_PCD = (
    "VERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 20\nHEIGHT 1\nPOINTS 20\n"
    "DATA ascii\n"
)
_ASCII_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 20\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)


def rows(columns: int, before: str = "") -> str:
    numbers = np.random.default_rng(0).uniform(1, 20, (20, columns)).round(3)
    return "".join(" ".join([before, *map(str, row)]).strip() + "\n" for row in numbers.tolist())


def read_imu(path: Path) -> None:
    read_imu_csv(path, Notes(path.name))


def read_points(path: Path) -> None:
    read_scan(path, 10**18)


FILES = {
    "trajectory-tum": Input(lambda root: written_trajectory(root, True), evaluated),
    "trajectory-kitti": Input(lambda root: written_trajectory(root, False), evaluated),
    "run": Input(written_run, smoothed_run),
    "killed-run": Input(written_killed_run, read_unfinished),
    **{f"graph-{name}": Input(lambda root, name=name: written_graph(root, name), solved) for name in GRAPHS},
    **{f"map-{name}": Input(lambda root, name=name: written_map(root, name), open_prior_map) for name in MAPS},
    "points-pcd": Input(lambda root: written_text(root, "scan.pcd", _ASCII_PCD + rows(4)), read_points),
    "points-ply": Input(lambda root: written_text(root, "scan.ply", _ASCII_PLY + rows(3)), read_points),
    "points-obj": Input(lambda root: written_text(root, "scan.obj", rows(3, "v")), read_points),
    "points-off": Input(lambda root: written_text(root, "scan.off", "OFF\n20 0 0\n" + rows(3)), read_points),
    "points-stl": Input(lambda root: written_text(root, "scan.stl", "solid scan\n" + rows(3, "vertex")), read_points),
    "config": Input(lambda root: written_text(root, "config.yaml", config_to_yaml(Config())), load_config),
    "calibration": Input(
        lambda root: written_text(root, "calibration.yaml", rides.calibration_yaml(rides.Ride()) + _CALIBRATION),
        read_calibration_yaml,
    ),
    "list": Input(written_list, find_recordings),
    "gps": Input(lambda root: written_text(root, "gps.csv", _GPS), read_gps_csv),
    "imu": Input(
        lambda root: written_text(root, "imu.csv", rides.imu_csv(rides.Ride().imu(rides.Ride().imu_stamps_ns(10)))),
        read_imu,
    ),
}
