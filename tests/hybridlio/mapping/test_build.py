"""Maps of a simple world with known surfaces: accuracy, motion compensation, moving objects, what is left out."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Calibration, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.mapping.build import build_map, map_tiles
from hybridlio.mapping.settings import MapSettings

PERIOD_NS, SCANS = 100_000_000, 20
HALF_M = 10.0  # of the room's sides; the floor is 1 m below the lidar, the ceiling 3 m above
T_IMU_LIDAR = se3.make(se3.so3_exp([0.1, -0.2, 1.0]), [0.1, 0.0, -0.05])


def pose(time_s: float) -> Array:
    """Return the lidar's pose: along x at 2 m/s, turning about all axes at up to 1 rad/s."""
    angles = [0.1 * np.sin(4 * time_s), 0.1 * np.sin(5 * time_s), 0.5 * np.sin(2 * time_s)]
    return se3.make(se3.so3_exp(angles), [-4 + 2 * time_s, 0.3 * np.sin(time_s), 0.0])


def cast(origins: Array, directions: Array, box: Array | None = None) -> Array:
    """Return the distances at which rays from inside the room hit its walls or, if it is nearer, a box."""
    low, high = np.array([-HALF_M, -HALF_M, -1.0]), np.array([HALF_M, HALF_M, 3.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(directions > 0, (high - origins) / directions, (low - origins) / directions).min(axis=1)
        if box is not None:
            a, b = (box[0] - origins) / directions, (box[1] - origins) / directions
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (enter > 0) & (enter < leave)
            out[hit] = np.minimum(out[hit], enter[hit])
    return out


def room(distort: bool = True, moving_box: bool = False) -> Sequence:
    """Return a recording of the room by a lidar of 40 beams; a box crosses it at first."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 360, endpoint=False), np.radians(np.linspace(-20, 20, 40))
    )
    rays = np.column_stack([np.cos(elevation.ravel()) * f(azimuth.ravel()) for f in (np.cos, np.sin)])
    rays = np.column_stack([rays, np.sin(elevation.ravel())])
    shares = (azimuth.ravel() + np.pi) / (2 * np.pi)

    def load(k: int) -> Scan:
        offsets = np.round((shares - 1) * PERIOD_NS).astype(np.int64) * distort
        times, labels = np.unique(offsets, return_inverse=True)
        poses = np.array([pose((k * PERIOD_NS + t) / 1e9) for t in times])[labels]
        directions, origins = (poses[:, :3, :3] @ rays[:, :, None])[..., 0], poses[:, :3, 3]
        corner = np.array([-3.0 + 0.6 * k, 3.0, -0.8])
        box = np.stack([corner, corner + np.array([0.8, 0.8, 1.6])]) if moving_box and k < 8 else None
        points = rays * cast(origins, directions, box)[:, None]
        return Scan(k * PERIOD_NS, points.astype(np.float32), None, offsets if distort else None)

    stamps = np.arange(SCANS, dtype=np.int64) * PERIOD_NS
    reference = Trajectory(stamps, np.array([pose(t / 1e9) for t in stamps]))
    return Sequence("room", stamps, load, _imu(), Calibration(T_IMU_LIDAR), reference)


def _imu() -> ImuSamples:
    stamps = np.arange(-20, SCANS * 20 + 20, dtype=np.int64) * 5_000_000
    R = np.array([pose(t / 1e9)[:3, :3] for t in np.r_[stamps - 500_000, stamps + 500_000]])
    rates = se3.so3_log(np.swapaxes(R[: len(stamps)], 1, 2) @ R[len(stamps) :]) / 1e-3
    bias = np.array([0.02, -0.01, 0.03])
    return ImuSamples(stamps, rates @ T_IMU_LIDAR[:3, :3].T + bias, np.tile([0.0, 0.0, 9.81], (len(stamps), 1)))


def distance_to_room(points: Array) -> Array:
    sides = np.abs(np.abs(points[:, :2]) - HALF_M)
    return np.column_stack([sides, np.abs(points[:, 2] + 1), np.abs(points[:, 2] - 3)]).min(axis=1)


KEEP = MapSettings(remove_moving=False, min_range_m=0.5)


def test_points_of_a_moving_lidar_lie_on_the_surfaces() -> None:
    built = build_map(room(), room().reference, KEEP)
    assert len(built) > 10_000
    assert np.quantile(distance_to_room(built.points), 0.99) < 0.03  # mean of a voxel across an edge: 5 cm


def test_without_an_imu_the_poses_alone_compensate_most_of_the_motion() -> None:
    sequence = replace(room(), imu=ImuSamples.empty())
    skewed = replace(sequence, load_scan=lambda k: replace(sequence.load_scan(k), time_offsets_ns=None))
    rms = [
        float(np.sqrt((distance_to_room(build_map(s, room().reference, KEEP).points) ** 2).mean()))
        for s in (room(), sequence, skewed)
    ]
    assert rms[0] <= rms[1] < 0.3 * rms[2]


def test_a_bias_of_the_gyroscope_does_not_reach_the_map() -> None:
    # without the correction 0.04 rad/s over 0.2 s would move points at 10 m by 8 cm
    built = build_map(room(), room().reference, replace(KEEP, min_range_m=8.0))
    assert np.quantile(distance_to_room(built.points), 0.95) < 0.03


def test_what_later_scans_see_through_is_removed_and_the_rest_stays() -> None:
    sequence = room(moving_box=True)
    with_ghosts, cleaned = (
        build_map(sequence, sequence.reference, replace(KEEP, remove_moving=remove)) for remove in (False, True)
    )
    ghosts = [int((distance_to_room(built.points) > 0.3).sum()) for built in (with_ghosts, cleaned)]
    static = [len(built) - ghost for built, ghost in zip((with_ghosts, cleaned), ghosts, strict=True)]
    assert ghosts[0] > 500
    assert ghosts[1] < 0.1 * ghosts[0]  # what remains stands less than a pixel above the floor
    assert static[1] > 0.99 * static[0]


def test_normals_point_into_the_room() -> None:
    built = build_map(room(), room().reference, KEEP)
    assert built.normals is not None
    wall = (np.abs(built.points[:, 0] - HALF_M) < 0.05) & (np.abs(built.points[:, 1]) < 5) & (built.points[:, 2] > 0)
    assert (built.normals[wall, 0] < -0.95).mean() > 0.95


def test_joined_tiles_are_the_whole_map_within_little_memory() -> None:
    whole = build_map(room(), room().reference, KEEP)
    small = replace(KEEP, tile_m=5.0, max_resident_voxels=2000)
    with map_tiles(room(), room().reference, small) as tiles:
        parts = [tiles.points(name) for name in tiles.names]
        assert len(tiles.names) > 16
    assert sum(map(len, parts)) == len(whole)
    np.testing.assert_allclose(
        np.sort(np.concatenate([part.points for part in parts]), axis=0), np.sort(whole.points, axis=0), atol=1e-7
    )


def test_unreadable_and_skipped_scans_and_scans_without_a_pose_are_left_out_and_counted() -> None:
    sequence = room()

    def load(k: int) -> Scan:
        if k == 4:
            raise DataError("frame 4: truncated")
        return sequence.load_scan(k)

    reference = sequence.reference
    assert reference is not None
    poses = Trajectory(reference.stamps_ns[:15], reference.poses[:15])
    with map_tiles(replace(sequence, load_scan=load), poses, KEEP, skip={7, 8}) as tiles:
        assert (tiles.scans, tiles.left_out) == (12, 8)


def test_poses_of_another_time_are_refused() -> None:
    reference = room().reference
    assert reference is not None
    with pytest.raises(DataError, match="no scan has a pose"):
        build_map(room(), Trajectory(reference.stamps_ns + 10**12, reference.poses))
    with pytest.raises(DataError, match="give the trajectory"):
        build_map(room())


def test_something_else_than_a_run_is_an_error_that_says_what_a_map_is_made_of() -> None:
    with pytest.raises(DataError, match=r"a run or of a recording with its poses, got str.*hl\.open_sequence"):
        build_map("run")  # type: ignore[arg-type]


def test_a_map_far_from_the_origin_is_the_same_map_there() -> None:
    poses, far = room().reference, np.array([456_000.0, 5_427_000.0, 110.0])
    assert poses is not None
    moved = poses.poses.copy()
    moved[:, :3, 3] += far
    here, there = build_map(room(), poses, KEEP), build_map(room(), Trajectory(poses.stamps_ns, moved), KEEP)
    assert len(there) == pytest.approx(len(here), rel=0.02)
    np.testing.assert_allclose(there.points.min(axis=0) - far, here.points.min(axis=0), atol=0.02)
    np.testing.assert_allclose(there.points.mean(axis=0) - far, here.points.mean(axis=0), atol=0.02)
