"""Make the pictures: of the README, the map and path of a simulated drive and one scan; of a map file; of the viewer.

python docs/make_pictures.py [FOLDER]
python docs/make_pictures.py --map map.laz
python docs/make_pictures.py --viewer RUN     # needs xvfb-run and a Vulkan driver, such as mesa-vulkan-drivers

The viewer's is a screenshot of Rerun at the end of a run.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from scipy.spatial import cKDTree

import hybridlio as hl
from hybridlio.cloud.map_geometry import map_geometry
from hybridlio.cloud.projection import vertex_map
from hybridlio.cloud.voxel import voxel_average
from hybridlio.core import se3

IMAGES = Path(__file__).resolve().parent / "images"
CONFIG = hl.SimulationConfig(seconds=60, seed=5, speed_m_s=9.0)
LIDAR_HEIGHT_M = 1.73  # above the road, as on KITTI's car, which the simulator models
BACKGROUND = "#0d1117"
HEIGHTS = LinearSegmentedColormap.from_list("heights", ["#222b3a", "#2f6f9f", "#5fd0c0", "#ffe08a"])


def run(sequence: hl.Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimated poses ``(N, 4, 4)`` and the thinned map of every fifth scan, ``(M, 3)``."""
    odometry = hl.Odometry()
    poses, clouds = [], []
    for frame in sequence:
        estimate = odometry.step(frame)
        poses.append(estimate.pose)
        if frame.index % 5 == 0:
            near = frame.scan.points[np.linalg.norm(frame.scan.points, axis=1) < 50]
            clouds.append(se3.transform(estimate.pose, near))
    cloud, _ = voxel_average(np.concatenate(clouds).astype(np.float32), None, 0.25)
    return np.array(poses), cloud


def draw_map(ax: Axes, cloud: np.ndarray, poses: np.ndarray, reference: np.ndarray) -> None:
    """Draw the map from above, coloured by height over the road, with the true and the estimated path."""
    _, nearest = cKDTree(poses[:, :2, 3]).query(cloud[:, :2])
    above_road_m = cloud[:, 2] - poses[nearest, 2, 3] + LIDAR_HEIGHT_M
    order = np.argsort(above_road_m)
    height = np.clip(above_road_m[order], 0.0, 5.0)
    ax.scatter(*cloud[order, :2].T, c=height, s=0.35, lw=0, cmap=HEIGHTS, vmin=0, vmax=5, rasterized=True)
    ax.plot(reference[:, 0, 3], reference[:, 1, 3], color="white", lw=3.2, label="true path")
    ax.plot(poses[:, 0, 3], poses[:, 1, 3], color="#ff5c5c", lw=1.2, label="hybridlio")
    legend = ax.legend(loc="upper left", frameon=False, fontsize=11)
    plt.setp(legend.get_texts(), color="white")
    ax.set_aspect("equal")
    x, y = ax.get_xlim()[0], ax.get_ylim()[0]
    ax.plot([x + 10, x + 60], [y + 6, y + 6], color="white", lw=2)
    ax.text(x + 35, y + 9, "50 m", color="white", ha="center", fontsize=10)
    ax.axis("off")


def draw_scan(ax: Axes, scan: hl.Scan) -> None:
    """Draw a scan as a range image."""
    ranges = np.linalg.norm(vertex_map(scan.points, map_geometry("hdl-64e")), axis=0)
    ax.imshow(np.where(ranges > 0, ranges, np.nan), aspect="auto", cmap="magma_r", vmin=2, vmax=50)
    ax.set_title("one scan as a range image: distance by elevation and azimuth", color="white", fontsize=10)
    ax.axis("off")


def draw_map_file(path: Path) -> None:
    """Draw a coloured ``.las`` or ``.laz`` map from above, by its colours, brighter where they are dark."""
    import laspy

    las = laspy.read(path)
    points, colours = np.column_stack([las.x, las.y, las.z]), np.column_stack([las.red, las.green, las.blue])
    centre, reach_m = np.median(points[:, :2], axis=0), np.percentile(np.ptp(points[:, :2], axis=0), 50) / 3
    near = np.abs(points[:, :2] - centre).max(axis=1) < reach_m
    order = np.flatnonzero(near)[np.argsort(points[near, 2])][::2]
    figure, ax = plt.subplots(figsize=(9, 8), facecolor=BACKGROUND, layout="constrained")
    shade = (colours[order] / np.iinfo(np.uint16).max) ** 0.5
    ax.scatter(*points[order, :2].T, c=shade, s=0.25, lw=0, rasterized=True)
    ax.set_aspect("equal")
    ax.axis("off")
    figure.savefig(IMAGES / "map.png", dpi=75, facecolor=BACKGROUND)


def take_viewer_picture(run: Path) -> None:
    """Save a screenshot of Rerun, as `hybridlio view` opens it, at the end of a run."""
    import rerun.blueprint as rrb
    from PIL import Image

    from hybridlio.viewing.rerun_layout import TIME, layout

    with tempfile.TemporaryDirectory() as folder:
        recording, blueprint, shot = (Path(folder) / name for name in ("run.rrd", "run.rbl", "shot.png"))
        hl.view(run, save=recording)
        at_the_end = layout()
        at_the_end.time_panel = rrb.TimePanel(timeline=TIME, state="collapsed", play_state="following")
        at_the_end.save("hybridlio", str(blueprint))
        # a larger screen keeps the pointer, which is in its middle, out of the window
        screen = ["xvfb-run", "-a", "-s", "-screen 0 5400x3400x24", "rerun", str(recording), str(blueprint)]
        options = ["--screenshot-to", str(shot), "--window-size", "1280x800", "--renderer", "vulkan"]
        subprocess.run([*screen, *options], check=True, timeout=600)
        picture = Image.open(shot).convert("RGB").resize((1280, 800), Image.Resampling.LANCZOS)
        picture.quantize(256, kmeans=3).save(IMAGES / "viewer.png", optimize=True)


def main() -> None:
    """Simulate the drive, run odometry and save the picture, or draw a map, or the viewer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="for the simulated drive (default: a temporary folder)")
    parser.add_argument("--map", type=Path, help="a .las or .laz file to draw instead")
    parser.add_argument("--viewer", type=Path, help="a run folder to show in the viewer instead")
    options = parser.parse_args()
    if options.viewer is not None:
        take_viewer_picture(options.viewer)
        return
    if options.map is not None:
        draw_map_file(options.map)
        return
    root = options.folder or Path(tempfile.mkdtemp(prefix="hybridlio-"))
    sequence = hl.open_sequence(hl.simulate(root, CONFIG))
    poses, cloud = run(sequence)
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(10, 7), height_ratios=[6, 1], facecolor=BACKGROUND, layout="constrained"
    )
    draw_map(above, cloud, poses, sequence.reference.poses)
    draw_scan(below, sequence[len(sequence) // 2].scan)
    IMAGES.mkdir(exist_ok=True)
    figure.savefig(IMAGES / "drive.png", dpi=110, facecolor=BACKGROUND)
    evaluation = hl.evaluate(hl.Trajectory(sequence.stamps_ns, poses), sequence.reference)
    print(f"{IMAGES / 'drive.png'}: {evaluation.length_m:.0f} m, error at the end {evaluation.end_error_m:.2f} m")


if __name__ == "__main__":
    main()
