"""Records: saving and loading, versions of the format, and damaged files."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import EarlierScanPose, RelativePose, State
from hybridlio.core.sensors import Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.record import Record


def step(rng: np.random.Generator, k: int, source: str) -> RelativePose:
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T + np.eye(6)
    return RelativePose(
        se3.exp(rng.normal(size=6)),
        covariance,
        source,
        degenerate=rng.normal(size=(k % 3, 6)),
        ok=k % 2 == 0,
        from_imu=k % 3 == 0,
        drift=0.1 * covariance if k % 2 else None,
    )


def with_earlier_scans(relative: tuple[RelativePose, ...], stamps: np.ndarray) -> tuple[RelativePose, ...]:
    """Add poses relative to earlier scans to the third and fifth step."""
    near = {
        2: (EarlierScanPose(int(stamps[0]), se3.exp(np.full(6, 0.1)), 2 * np.eye(6)),),
        4: tuple(EarlierScanPose(int(stamps[k]), se3.exp(np.full(6, 0.2)), k * np.eye(6)) for k in (3, 1)),
    }
    return tuple(replace(step, earlier_scans=near.get(k, ())) for k, step in enumerate(relative))


def example(rng: np.random.Generator, imu: bool = True, camera: bool = True) -> Record:
    stamps = 1_700_000_000_123_456_789 + np.arange(6) * 100_000_001
    samples = ImuSamples(stamps[0] + np.arange(50) * 10_000_000, rng.normal(size=(50, 3)), rng.normal(size=(50, 3)))
    state = State(
        int(stamps[0]), se3.exp(rng.normal(size=6)), *rng.normal(size=(4, 3)), np.eye(15) * 0.3, np.eye(3) * 0.7, imu
    )
    return Record(
        online=Trajectory(stamps, se3.exp(rng.normal(size=(6, 6))), np.tile(np.eye(6), (6, 1, 1)) * 0.1),
        initial=tuple(step(rng, k, "preintegration") for k in range(5)),
        relative=with_earlier_scans(tuple(step(rng, k + 1, "scan-matching") for k in range(5)), stamps),
        imu=samples if imu else ImuSamples.empty(),
        gps=tuple(GpsFix(int(t), rng.normal(size=3), np.eye(3) * 2) for t in stamps[:2]) if imu else (),
        start=state,
        calibration=Calibration(se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6)) if camera else None),
        imu_noise=ImuNoise(1e-4, 2e-3, 3e-6, 4e-5, 5e-3, 6e-2),
    )


def same(a: object, b: object) -> None:
    """Assert that two values are equal to the last bit, field by field."""
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, strict=True)
    elif isinstance(a, tuple):
        assert isinstance(b, tuple)
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif hasattr(a, "__dataclass_fields__"):
        assert type(a) is type(b)
        for name in a.__dataclass_fields__:
            if name != "details":  # diagnostics of a source are not saved
                same(getattr(a, name), getattr(b, name))
    else:
        assert a == b
        assert type(a) is type(b)


@pytest.mark.parametrize(("imu", "camera"), [(True, True), (False, False)], ids=["with IMU and camera", "without"])
def test_a_saved_record_loads_unchanged(rng: np.random.Generator, tmp_path: Path, imu: bool, camera: bool):
    record = example(rng, imu, camera)
    record.save(tmp_path / "odometry.npz")
    loaded = Record.load(tmp_path / "odometry.npz")
    # loading orthonormalises poses, which changes the last digits
    np.testing.assert_allclose(loaded.online.poses, record.online.poses, atol=1e-14)
    again = tmp_path / "again.npz"
    loaded.save(again)
    same(loaded.imu, record.imu)
    same(loaded.gps, record.gps)
    same(loaded.start, record.start)
    same(loaded.imu_noise, record.imu_noise)
    for step, found in zip(record.initial + record.relative, loaded.initial + loaded.relative, strict=True):
        np.testing.assert_allclose(found.pose, step.pose, atol=1e-14)
        for name in ("covariance", "source", "degenerate", "ok", "from_imu", "drift"):
            same(getattr(found, name), getattr(step, name))
        for near, read in zip(step.earlier_scans, found.earlier_scans, strict=True):
            assert read.stamp_ns == near.stamp_ns
            np.testing.assert_allclose(read.pose, near.pose, atol=1e-14)
            same(read.covariance, near.covariance)
    assert (loaded.calibration.T_camera_lidar is None) == (not camera)


def test_saving_leaves_no_temporary_file(rng: np.random.Generator, tmp_path: Path):
    example(rng).save(tmp_path / "odometry.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["odometry.npz"]


def rewritten(path: Path, **changes: object) -> None:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    for name, value in changes.items():
        if value is None:
            del arrays[name]
        else:
            arrays[name] = np.asarray(value)
    np.savez(path, **arrays)


@pytest.fixture
def saved(rng: np.random.Generator, tmp_path: Path) -> Path:
    example(rng).save(tmp_path / "odometry.npz")
    return tmp_path / "odometry.npz"


def test_a_file_of_an_unknown_version_is_rejected(saved: Path):
    rewritten(saved, version=99)
    with pytest.raises(DataError, match=r"odometry\.npz: .*version 99"):
        Record.load(saved)


def test_a_file_of_version_1_loads_without_poses_relative_to_earlier_scans(saved: Path):
    rewritten(saved, version=1, **{f"keyframe_{n}": None for n in ("step", "stamps_ns", "poses", "covariances")})
    old = Record.load(saved)
    assert [step.earlier_scans for step in old.relative] == [()] * 5


def test_edges_hold_every_relative_pose_with_its_full_covariance(rng: np.random.Generator):
    record = example(rng)
    assert [(i, j) for i, j, _ in record.edges] == [(0, 1), (1, 2), (2, 3), (0, 3), (3, 4), (4, 5), (3, 5), (1, 5)]
    for i, j, edge in record.edges:
        step = record.relative[j - 1]
        if j == i + 1:
            assert edge is step
            continue
        (near,) = (k for k in step.earlier_scans if k.stamp_ns == record.online.stamps_ns[i])
        np.testing.assert_allclose(edge.pose, near.pose, atol=1e-14)
        shared = step.covariance - step.drift if step.drift is not None and step.ok else np.zeros((6, 6))
        np.testing.assert_allclose(edge.covariance, near.covariance + shared)


@pytest.mark.parametrize("missing", ["version", "relative_poses", "start_velocity_m_s", "imu_noise", "keyframe_poses"])
def test_a_file_that_lacks_an_array_is_rejected(saved: Path, missing: str):
    rewritten(saved, **{missing: None})
    with pytest.raises(DataError, match=rf"odometry\.npz: not the record of a run.*{missing}"):
        Record.load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"online_poses": np.zeros((3, 4, 4))},
        {"relative_ok": np.array([True])},
        {"imu_stamps_ns": np.arange(3)},
        {"imu_noise": np.ones(9)},
        {"imu_noise": np.array(["a", "b"])},
        {"start_stamp_ns": np.arange(3)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_file_with_inconsistent_arrays_is_rejected(saved: Path, changes: dict):
    rewritten(saved, **changes)
    with pytest.raises(DataError):
        Record.load(saved)


def test_a_pickled_array_is_never_unpickled(saved: Path, tmp_path: Path):
    class Trap:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "sprung",))

    rewritten(saved, relative_sources=np.array([Trap()], dtype=object))
    with pytest.raises(DataError, match=r"odometry\.npz"):
        Record.load(saved)
    assert not (tmp_path / "sprung").exists()


def test_a_pickle_file_is_never_unpickled(tmp_path: Path):
    import pickle

    (tmp_path / "odometry.npz").write_bytes(pickle.dumps({"version": 1}))
    with pytest.raises(DataError, match=r"odometry\.npz"):
        Record.load(tmp_path / "odometry.npz")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.99])
def test_a_truncated_file_is_rejected(saved: Path, share: float):
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(DataError, match=r"odometry\.npz"):
        Record.load(saved)


def test_a_damaged_file_is_rejected(saved: Path):
    with zipfile.ZipFile(saved) as archive:
        info = archive.getinfo("imu_noise.npy")
    damaged = bytearray(saved.read_bytes())
    start = info.header_offset + 30 + len(info.filename) + 20
    damaged[start : start + 40] = bytes(40)
    saved.write_bytes(bytes(damaged))
    with pytest.raises(DataError, match=r"odometry\.npz"):
        Record.load(saved)


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(DataError, match=r"nowhere\.npz"):
        Record.load(tmp_path / "nowhere.npz")


def test_other_numpy_files_are_rejected(tmp_path: Path):
    np.savez(tmp_path / "other.npz", x=np.arange(3))
    with pytest.raises(DataError, match=r"other\.npz: not the record of a run"):
        Record.load(tmp_path / "other.npz")
    np.save(tmp_path / "array.npy", np.arange(3))
    with pytest.raises(DataError, match=r"array\.npy"):
        Record.load(tmp_path / "array.npy")
