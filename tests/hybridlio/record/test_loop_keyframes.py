"""Loop keyframes: which scans are kept, how they are thinned, and their file."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import Scan
from hybridlio.record.loop_keyframes import (
    RESOLUTION_M,
    LoopKeyframes,
    LoopKeyframeSelector,
    LoopKeyframeSettings,
    compress,
)


def scan(rng: np.random.Generator, stamp_ns: int = 10**18, points: int = 40_000, reach_m: float = 100.0) -> Scan:
    return Scan(stamp_ns, rng.uniform(-reach_m, reach_m, (points, 3)).astype(np.float32))


def driven(rng: np.random.Generator, steps: int, step_m: float, settings: LoopKeyframeSettings) -> LoopKeyframes:
    selector = LoopKeyframeSelector(settings)
    for k in range(steps):
        pose = se3.make(np.eye(3), (k * step_m, 0.0, 0.0))
        selector.offer(k, scan(rng, 10**18 + k * 10**8, points=500, reach_m=40.0), pose)
    return selector.keyframes()


def test_a_scan_is_kept_once_the_distance_from_the_last_keyframe_reaches_the_spacing(rng: np.random.Generator):
    keyframes = driven(rng, 30, 0.9, LoopKeyframeSettings(spacing_m=2.5))
    assert keyframes.rows.tolist() == list(range(0, 30, 3))
    assert keyframes.stamps_ns.tolist() == [10**18 + k * 10**8 for k in range(0, 30, 3)]


def test_a_standing_vehicle_keeps_one_keyframe(rng: np.random.Generator):
    assert len(driven(rng, 30, 0.0, LoopKeyframeSettings())) == 1


def test_a_scan_with_few_points_is_skipped(rng: np.random.Generator):
    selector = LoopKeyframeSelector(LoopKeyframeSettings())
    assert not selector.offer(0, Scan(1, np.empty((0, 3), np.float32)), np.eye(4))
    assert not selector.offer(1, scan(rng, 2, points=100), np.eye(4))
    assert selector.offer(2, scan(rng, 3), np.eye(4))
    assert selector.keyframes().rows.tolist() == [2]


def test_a_kilometre_takes_at_most_7_5_megabytes(rng: np.random.Generator):
    settings = LoopKeyframeSettings()
    clouds = [compress(scan(rng, reach_m=60.0).points, settings) for _ in range(3)]
    assert {len(cloud) for cloud in clouds} == {settings.max_points}
    bytes_a_km = 1000 / settings.spacing_m * max(cloud.nbytes for cloud in clouds)
    assert bytes_a_km <= 7.5e6


def test_points_are_rounded_to_the_resolution(rng: np.random.Generator):
    points = rng.uniform(-40, 40, (300, 3)).astype(np.float32)
    cloud = compress(points, LoopKeyframeSettings(voxel_m=0.01))
    selector = LoopKeyframeSelector(LoopKeyframeSettings(voxel_m=0.01))
    selector.offer(0, Scan(1, points), np.eye(4))
    back = selector.keyframes().points(0)
    np.testing.assert_array_equal(back, cloud * RESOLUTION_M)
    nearest = np.linalg.norm(points[:, None] - back[None], axis=-1).min(axis=1)
    assert nearest.max() <= np.sqrt(3) * RESOLUTION_M / 2 + 1e-5


def test_points_beyond_the_maximum_range_are_left_out(rng: np.random.Generator):
    cloud = compress(scan(rng).points, LoopKeyframeSettings(max_range_m=30.0))
    assert np.linalg.norm(cloud * RESOLUTION_M, axis=1).max() < 30.1


def test_saved_keyframes_load_unchanged(rng: np.random.Generator, tmp_path: Path):
    keyframes = driven(rng, 20, 1.0, LoopKeyframeSettings(spacing_m=3.0))
    keyframes.save(tmp_path / "keyframes.npz")
    loaded = LoopKeyframes.load(tmp_path / "keyframes.npz")
    np.testing.assert_array_equal(loaded.rows, keyframes.rows)
    np.testing.assert_array_equal(loaded.stamps_ns, keyframes.stamps_ns)
    assert len(loaded.clouds) == len(keyframes.clouds)
    for saved, read in zip(keyframes.clouds, loaded.clouds, strict=True):
        np.testing.assert_array_equal(read, saved, strict=True)


def test_a_run_without_keyframes_writes_a_file_of_none(tmp_path: Path):
    LoopKeyframeSelector(LoopKeyframeSettings()).keyframes().save(tmp_path / "keyframes.npz")
    assert len(LoopKeyframes.load(tmp_path / "keyframes.npz")) == 0


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _text(path: Path) -> None:
    path.write_text("not an archive")


def _other_version(path: Path) -> None:
    _rewrite(path, version=np.int64(99))


def _lost_points(path: Path) -> None:
    with np.load(path) as file:
        _rewrite(path, points=file["points"][:-7])


def _unordered(path: Path) -> None:
    with np.load(path) as file:
        _rewrite(path, rows=file["rows"][::-1])


def _lost_array(path: Path) -> None:
    with np.load(path) as file:
        np.savez_compressed(path, **{name: file[name] for name in file.files if name != "stamps_ns"})


def _pickled(path: Path) -> None:
    _rewrite(path, rows=np.array([print], dtype=object))


def _rewrite(path: Path, **changed: np.ndarray) -> None:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez_compressed(path, **(arrays | changed))


@pytest.mark.parametrize("damage", [_cut, _text, _other_version, _lost_points, _unordered, _lost_array, _pickled])
def test_a_damaged_file_raises_an_error_that_names_the_command_to_run(
    rng: np.random.Generator, tmp_path: Path, damage: Callable[[Path], None]
):
    path = tmp_path / "keyframes.npz"
    driven(rng, 20, 1.0, LoopKeyframeSettings()).save(path)
    damage(path)
    with pytest.raises(DataError, match=r"keyframes.npz: .*hybridlio odometry"):
        LoopKeyframes.load(path)


def test_a_missing_file_raises_an_error_that_names_the_command_to_run(tmp_path: Path):
    with pytest.raises(DataError, match=r"no keyframes.*run `hybridlio odometry` again"):
        LoopKeyframes.load(tmp_path / "keyframes.npz")


def test_the_file_holds_only_plain_arrays(rng: np.random.Generator, tmp_path: Path):
    driven(rng, 20, 1.0, LoopKeyframeSettings()).save(tmp_path / "keyframes.npz")
    with zipfile.ZipFile(tmp_path / "keyframes.npz") as file:
        assert all(name.endswith(".npy") for name in file.namelist())
    assert [path.name for path in tmp_path.iterdir()] == ["keyframes.npz"]


@pytest.mark.parametrize("wrong", [{"spacing_m": 0.0}, {"voxel_m": -1.0}, {"max_range_m": 200.0}, {"max_points": 0}])
def test_settings_out_of_range_are_rejected(wrong: dict[str, float]):
    with pytest.raises(ConfigError, match="LoopKeyframeSettings"):
        LoopKeyframeSettings(**wrong)  # type: ignore[arg-type]


def test_packing_during_a_run_changes_no_cloud(rng: np.random.Generator):
    selector, settings = LoopKeyframeSelector(LoopKeyframeSettings()), LoopKeyframeSettings()
    scans = [Scan(k, rng.uniform(-79, 79, (4000, 3)).astype(np.float32)) for k in range(3)]
    for k, scan in enumerate(scans):
        assert selector.offer(k, scan, se3.make(np.eye(3), [10.0 * k, 0, 0]))
    for scan, cloud in zip(scans, selector.keyframes().clouds, strict=True):
        np.testing.assert_array_equal(cloud, compress(scan.points, settings))
