"""Reader of Apollo-SouthBay (Lu et al., "L3-Net", CVPR 2019), in the layout that kiss-icp reads.

<recording>/pcds/N.pcd              one scan each
<recording>/poses/gt_poses.txt      number, seconds, x y z, qx qy qz qw; one row a scan
"""

from __future__ import annotations

from pathlib import Path

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import numbered_files, read_poses, read_table, stamps_of


def _is_recording(path: Path) -> bool:
    return (path / "pcds").is_dir() and (path / "poses/gt_poses.txt").is_file()


def _gather(folder: Path, notes: Notes) -> Recording:
    file, paths = folder / "poses/gt_poses.txt", numbered_files(folder / "pcds", ".pcd")
    times, _ = read_table(file, 1, (0,))
    if len(times) != len(paths):
        raise DataError(f"{file}: {len(times)} rows for {len(paths)} scans; each scan needs one")
    notes.add("no inertial data: Apollo-SouthBay publishes none with its scans")
    notes.add("reference poses are taken for the lidar's, as kiss-icp takes them; the publisher does not say")
    return Recording(
        folder=folder,
        paths=paths,
        stamps_ns=stamps_of(file, times, NS_PER_S),
        poses=read_poses(file, notes, NS_PER_S, time=1, first=2),
    )


LAYOUT = Layout("Apollo-SouthBay: a folder with pcds/ and poses/gt_poses.txt", _is_recording, _gather)
