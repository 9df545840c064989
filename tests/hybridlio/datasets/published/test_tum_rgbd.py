"""Depth images of TUM RGB-D as scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence

FOLDER = "rgbd_dataset_freiburg1_xyz"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A wall that is 2 m ahead and comes 0.1 m nearer from frame to frame, with a hole in the image's lower right."""
    folder = tmp_path / FOLDER
    (folder / "depth").mkdir(parents=True)
    rows, poses = ["# depth maps\n# timestamp filename\n"], ["# ground truth trajectory\n"]
    for k in range(5):
        depth = np.full((480, 640), round(5000 * (2 - 0.1 * k)), np.uint16)
        depth[300:, 400:] = 0
        Image.fromarray(depth).save(folder / f"depth/{k}.png")
        rows.append(f"{1305031102.160407 + k / 30:.6f} depth/{k}.png\n")
        poses.append(f"{1305031102.160407 + k / 30:.6f} 0 0 {0.1 * k} 0 0 0 1\n")
    (folder / "depth.txt").write_text("".join(rows))
    (folder / "groundtruth.txt").write_text("".join(poses))
    return folder


def test_a_depth_image_is_a_scan_with_x_ahead_and_z_up(recording: Path) -> None:
    sequence = open_sequence(recording)
    assert sequence.name == FOLDER
    assert sequence.stamps_ns[0] == 1305031102160407000
    points = sequence[1].scan.points
    assert len(points) == 480 * 640 - 180 * 240
    np.testing.assert_allclose(points[:, 0], 1.9, atol=1e-4)
    # the first pixel is the upper left one
    np.testing.assert_allclose(points[0, 1:], [319.5 / 525 * 1.9, 239.5 / 525 * 1.9], atol=1e-4)


def test_reference_poses_are_those_of_the_turned_camera(recording: Path) -> None:
    reference = open_sequence(recording).reference
    assert reference is not None
    walls = [T @ [2 - 0.1 * k, 0, 0, 1] for k, T in enumerate(reference.poses)]
    np.testing.assert_allclose(walls, [walls[0]] * 5, atol=1e-9)


def test_images_that_are_no_depth_images_raise_one_line(recording: Path) -> None:
    sequence = open_sequence(recording)
    (recording / "depth/3.png").write_bytes(b"\x89PNG no more")
    with pytest.raises(DataError, match=r"frame 3: .*3\.png: cannot be read as an image"):
        sequence[3]
    Image.fromarray(np.zeros((10, 10), np.uint16)).save(recording / "depth/3.png")
    with pytest.raises(DataError, match=r"expected an image of 480 x 640"):
        sequence[3]
