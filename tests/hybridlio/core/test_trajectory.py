from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.trajectory import (
    Trajectory,
    _format_stamp,
    read_kitti,
    read_pair,
    read_trajectory,
    read_tum,
    write_kitti,
    write_tum,
)

T_CAMERA_LIDAR = se3.make(se3.so3_exp([1.2, -1.2, 1.2]), [0.0, -0.08, -0.27])


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(3)
    stamps = 1_317_384_506_123_456_789 + np.cumsum(rng.integers(1, 200_000_000, 50))
    poses = se3.make(se3.so3_exp(rng.normal(0, 1.5, (50, 3))), rng.normal(0, 3000, (50, 3)))
    return Trajectory(stamps, poses)


def test_a_trajectorys_repr_is_one_line() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 3.0]
    stamps = np.arange(3) * 100_000_000
    assert repr(Trajectory(stamps, poses)) == "Trajectory(3 poses, 0.2 s, 3.0 m)"
    assert repr(Trajectory(stamps, poses, np.tile(np.eye(6), (3, 1, 1)))).endswith("3.0 m, with covariances)")
    assert repr(Trajectory(stamps[:0], poses[:0])) == "Trajectory(0 poses)"


def test_tum_files_keep_stamps_exactly_and_poses_to_a_nanometre(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "t.txt", trajectory)
    back = read_tum(tmp_path / "t.txt")
    assert (back.stamps_ns == trajectory.stamps_ns).all()
    np.testing.assert_allclose(back.poses, trajectory.poses, rtol=0, atol=1e-9)


@given(st.integers(-(2**62), 2**62))
def test_a_stamp_of_any_size_survives_formatting(stamp_ns: int) -> None:
    seconds, decimals = _format_stamp(stamp_ns).split(".")
    assert len(decimals) == 9
    assert int(seconds + decimals) == stamp_ns


def test_kitti_files_keep_poses_in_the_lidar_and_in_the_camera_frame(tmp_path: Path, trajectory: Trajectory) -> None:
    for T in (None, T_CAMERA_LIDAR):
        write_kitti(tmp_path / "t.txt", trajectory, T)
        back = read_kitti(tmp_path / "t.txt", trajectory.stamps_ns, T)
        np.testing.assert_allclose(back.poses, trajectory.poses, rtol=0, atol=2e-9)
        assert (back.stamps_ns == trajectory.stamps_ns).all()


def test_camera_poses_move_points_of_the_camera_as_lidar_poses_move_those_of_the_lidar(
    tmp_path: Path, trajectory: Trajectory
) -> None:
    write_kitti(tmp_path / "t.txt", trajectory, T_CAMERA_LIDAR)
    camera = read_kitti(tmp_path / "t.txt").poses
    p_lidar = np.array([[10.0, -3.0, 1.0]])
    in_first_camera = se3.transform(camera[7], se3.transform(T_CAMERA_LIDAR, p_lidar))
    expected = se3.transform(T_CAMERA_LIDAR, se3.transform(trajectory.poses[7], p_lidar))
    np.testing.assert_allclose(in_first_camera, expected, atol=1e-8)


def test_evo_opens_our_files_and_reads_the_same_numbers(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "tum.txt", trajectory)
    write_kitti(tmp_path / "kitti.txt", trajectory)
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "kitti.txt"))
    np.testing.assert_allclose(np.array(tum.poses_se3), trajectory.poses, atol=1e-9)
    np.testing.assert_allclose(np.array(kitti.poses_se3), trajectory.poses, atol=1e-9)
    np.testing.assert_allclose(tum.timestamps, trajectory.stamps_ns / 1e9, rtol=1e-15)


def test_files_written_by_evo_are_read(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "tum.txt", trajectory)
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt"))
    file_interface.write_tum_trajectory_file(str(tmp_path / "evo.txt"), theirs)
    np.testing.assert_allclose(read_trajectory(tmp_path / "evo.txt").poses, trajectory.poses, atol=1e-6)


def test_the_format_is_recognised_by_its_columns(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "tum.txt", trajectory)
    write_kitti(tmp_path / "kitti.txt", trajectory)
    assert (read_trajectory(tmp_path / "tum.txt").stamps_ns == trajectory.stamps_ns).all()
    assert (np.diff(read_trajectory(tmp_path / "kitti.txt").stamps_ns) == 100_000_000).all()


@pytest.mark.parametrize("stamped", ["reference", "estimate"])
def test_a_file_without_stamps_gets_those_of_the_other(tmp_path: Path, trajectory: Trajectory, stamped: str) -> None:
    for name in ("reference", "estimate"):
        (write_tum if name == stamped else write_kitti)(tmp_path / name, trajectory)
    estimate, reference = read_pair(tmp_path / "estimate", tmp_path / "reference")
    assert (reference.stamps_ns == estimate.stamps_ns).all()
    assert (reference.stamps_ns == trajectory.stamps_ns).all()


GOOD_TUM = "0.1 0 0 0 0 0 0 1\n"
GOOD_KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (GOOD_TUM + "0.2 0 0 0 0 0 1\n", "row 2 has 7 columns"),
        ("# note\n\n" + GOOD_TUM + "0.2 0 0 nan 0 0 0 1\n", "row 4 contains a value that is not finite"),
        (GOOD_TUM + "0.2 0 0 zero 0 0 0 1\n", "row 2: could not convert .*zero"),
        (GOOD_TUM + "0.1 0 0 0 0 0 0 1\n", "row 2: the stamp is not after"),
        (GOOD_TUM + "0.2 0 0 0 0 0 0 0.9\n", "row 2: the length of the quaternion"),
        ("1e30 0 0 0 0 0 0 1\n", "row 1: stamp 1e30 is beyond"),
        (GOOD_KITTI + GOOD_KITTI.strip() + " 1\n", "row 2 has 13 columns"),
        (GOOD_KITTI + "1 0 0 0 0 1 0 0 0 0 -1 0\n", "row 2: .*not a rotation"),
        (GOOD_KITTI + "2 0 0 0 0 2 0 0 0 0 2 0\n", "row 2: .*not a rotation"),
        (GOOD_TUM + "0.2 1e308 0 0 0 0 0 1\n", "row 2 contains a value that is not finite, or too large"),
        (GOOD_KITTI + "1 0 0 inf 0 1 0 0 0 0 1 0\n", "row 2 contains a value that is not finite"),
        ("1 2 3\n", "row 1 has 3 columns; expected one of TUM .* KITTI"),
        ("# only a comment\n", "contains no poses"),
    ],
)
def test_a_malformed_file_is_named_with_the_row_and_the_reason(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=rf"bad\.txt: {complaint}"):
        read_trajectory(path)


def test_missing_files_binary_files_and_missing_stamps_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.txt: cannot be read"):
        read_trajectory(tmp_path / "none.txt")
    (tmp_path / "scan.bin").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(DataError, match=r"scan\.bin: not a text file"):
        read_trajectory(tmp_path / "scan.bin")
    (tmp_path / "kitti.txt").write_text(GOOD_KITTI * 3)
    with pytest.raises(DataError, match=r"kitti\.txt: 3 poses, but 2 stamps"):
        read_trajectory(tmp_path / "kitti.txt", np.array([0, 1]))


def test_rotations_rounded_to_four_decimals_are_accepted(tmp_path: Path, trajectory: Trajectory) -> None:
    (tmp_path / "short.txt").write_text(
        "\n".join(" ".join(f"{v:.4f}" for v in row) for row in trajectory.poses[:, :3].reshape(-1, 12))
    )
    np.testing.assert_allclose(read_kitti(tmp_path / "short.txt").poses, trajectory.poses, atol=2e-4)


@pytest.mark.parametrize("format", ["tum", "kitti"])
def test_a_saved_trajectory_is_loaded_again(tmp_path: Path, trajectory: Trajectory, format: str) -> None:
    trajectory.save(tmp_path / "t.txt", format)
    back = Trajectory.load(tmp_path / "t.txt", trajectory.stamps_ns if format == "kitti" else None)
    assert (back.stamps_ns == trajectory.stamps_ns).all()
    assert np.allclose(back.poses, trajectory.poses, atol=1e-9)


def test_an_unknown_format_lists_the_known_ones(tmp_path: Path, trajectory: Trajectory) -> None:
    with pytest.raises(ConfigError, match="tum or kitti"):
        trajectory.save(tmp_path / "t.txt", "evo")
    assert not (tmp_path / "t.txt").exists()
