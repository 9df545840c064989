import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import hybridlio as hl
from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.cloud.preparation import PreparationOptions, prepare
from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.learned.data.augmentation import perturbed
from hybridlio.learned.data.pairs import Pairs, padded
from hybridlio.learned.data.preparing import KnownMotion, prepare_shard
from hybridlio.learned.data.shards import ScanRecord, Shard, write_shard
from hybridlio.learned.settings import NetworkSettings, OptimiserSettings

GEOMETRY = MapGeometry(16.0, -16.0, 16, 90)
SETTINGS = NetworkSettings(geometry=GEOMETRY)


def record(seed: int = 0, points: int = 30, **changes: object) -> ScanRecord:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(points, 3)).astype(np.float32)
    whole = ScanRecord(
        vertex_map=rng.uniform(-120, 120, size=(3, 16, 90)).astype(np.float32),
        loss_points=rng.uniform(-120, 120, size=(points, 3)).astype(np.float32),
        loss_normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        imu=rng.normal(size=(15, 6)).astype(np.float32),
        dt_s=0.1,
        velocity_m_s=rng.normal(size=3),
        initial=se3.exp(rng.normal(size=6)),
        reference=se3.exp(rng.normal(size=6)),
    )
    return replace(whole, **changes)


def shard_of(folder, records) -> Shard:
    write_shard(folder / "shard", records, "made up", GEOMETRY, 15)
    return Shard(folder / "shard")


def test_what_goes_in_comes_out_within_the_steps_of_the_format(tmp_path):
    records = [record(k, points=30 + k) for k in range(3)]
    shard = shard_of(tmp_path, records)
    for k, scan in enumerate(records):
        points, normals = shard.loss_cloud(k)
        assert np.abs(shard.vertex_map(k) - scan.vertex_map).max() <= 0.00201
        assert np.abs(points - scan.loss_points).max() <= 0.00201
        assert np.einsum("ij,ij->i", normals, scan.loss_normals).min() > np.cos(np.radians(0.6))
        assert np.array_equal(shard.imu[k], scan.imu)
        assert np.array_equal(shard.reference[k], scan.reference)


def test_batches_join_the_pair_of_each_row(tmp_path):
    records = [record(k, points=30 + k) for k in range(4)]
    batch = Pairs([shard_of(tmp_path, records)], SETTINGS).batch([2, 0])
    assert batch.index.tolist() == [2, 0]
    assert np.allclose(batch.network.last[1].numpy(), records[0].vertex_map, atol=0.003)
    assert np.allclose(batch.network.current[0].numpy(), records[3].vertex_map, atol=0.003)
    assert np.allclose(batch.reference[0].numpy(), records[3].reference, atol=1e-6)
    assert batch.current.there.sum(1).tolist() == [33, 31]
    assert not batch.current.points[1, 31:].any()


@pytest.mark.parametrize(
    ("imu", "left"), [("initial-pose", [1, 5]), ("none", [1, 2, 5]), ("given", [2, 5]), ("feature", [1, 5])]
)
def test_pairs_that_lack_what_the_network_needs_are_left_out(tmp_path, imu, left):
    records = [record(k) for k in range(6)]
    records[1] = replace(records[1], initial=None)
    records[2] = replace(records[2], imu=None)
    records[3] = replace(records[3], usable=False)
    pairs = Pairs([shard_of(tmp_path, records)], replace(SETTINGS, imu=imu))
    assert [pairs.where(i)[1] for i in range(len(pairs))] == left


def test_a_network_that_starts_from_the_velocity_leaves_out_pairs_without_one(tmp_path):
    records = [record(k) for k in range(4)]
    records[2] = replace(records[2], velocity_m_s=None)
    pairs = Pairs([shard_of(tmp_path, records)], replace(SETTINGS, velocity=True, siamese="twins"))
    assert [pairs.where(i)[1] for i in range(len(pairs))] == [1, 3]


def test_without_a_reference_velocities_come_from_the_initial_poses(tiny_drive, tmp_path):
    sequence = replace(hl.open_sequence(tiny_drive).part(0, 4), reference=None)
    options = PreparationOptions(geometry=GEOMETRY, loss_points=1000, threads=1)
    step = se3.exp([0, 0, 0.5, 1.0, 0, 0])
    prepare_shard(sequence, tmp_path / "s", partial(prepare, options=options), SETTINGS, KnownMotion(lambda _: step))
    shard = Shard(tmp_path / "s")
    assert np.isnan(shard.velocity_m_s[1]).all()
    assert np.allclose(shard.velocity_m_s[2:], step[:3, :3].T @ step[:3, 3] / 0.1, rtol=1e-2)
    assert np.isnan(shard.reference).all()


def test_no_pair_at_all_is_an_error_that_names_the_recording(tmp_path):
    shard = shard_of(tmp_path, [record(k, imu=None) for k in range(3)])
    with pytest.raises(DataError, match="made up"):
        Pairs([shard], SETTINGS)


def test_shards_of_other_cells_or_rows_are_refused(tmp_path):
    shard = shard_of(tmp_path, [record(k) for k in range(2)])
    with pytest.raises(DataError, match="52"):
        Pairs([shard], NetworkSettings())
    with pytest.raises(DataError, match="15 IMU rows"):
        Pairs([shard], replace(SETTINGS, imu_samples=10))


@pytest.mark.parametrize("file", ["vertex_maps.raw", "loss_points.raw", "imu.npy", "shard.json"])
def test_a_damaged_shard_names_the_file(tmp_path, file):
    shard_of(tmp_path, [record(k) for k in range(2)])
    path = tmp_path / "shard" / file
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match=file):
        Shard(tmp_path / "shard")


def test_shards_of_another_format_and_folders_without_one_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"shard\.json is missing"):
        Shard(tmp_path)
    shard_of(tmp_path, [record(k) for k in range(2)])
    path = tmp_path / "shard" / "shard.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format": 99}))
    with pytest.raises(DataError, match="format 99"):
        Shard(tmp_path / "shard")


def test_a_shard_that_fails_to_be_written_leaves_nothing_behind(tmp_path):
    with pytest.raises(DataError, match="scan 1"):
        shard_of(tmp_path, [record(0), record(1, imu=np.zeros((3, 6), np.float32))])
    assert list(tmp_path.iterdir()) == []


def test_noise_of_initial_pose_and_velocity_depends_on_the_pair_and_the_seed_alone(tmp_path):
    pairs = Pairs([shard_of(tmp_path, [record(k) for k in range(5)])], replace(SETTINGS, imu="given"))
    noise = OptimiserSettings(initial_noise_rad=0.01, initial_noise_m=0.1, velocity_noise_m_s=0.2)
    whole, part = perturbed(pairs.batch([0, 1, 2, 3]), noise, seed=7), perturbed(pairs.batch([2]), noise, seed=7)
    other = perturbed(pairs.batch([2]), noise, seed=8)
    for name in ("perturbation", "velocity_m_s"):
        assert torch.equal(getattr(whole.network, name)[2], getattr(part.network, name)[0])
        assert not torch.allclose(getattr(other.network, name), getattr(part.network, name))
    assert perturbed(pairs.batch([2]), OptimiserSettings(), seed=7).network.perturbation is None


def test_clouds_are_padded_to_the_largest():
    one, two = np.ones((2, 3), np.float32), np.ones((4, 3), np.float32)
    assert padded([(one, one), (two, two)]).there.sum(1).tolist() == [2, 4]


def test_a_recording_becomes_a_shard_with_true_steps_and_resampled_imu(tiny_drive, tmp_path):
    sequence = hl.open_sequence(tiny_drive).part(0, 5)
    options = PreparationOptions(geometry=GEOMETRY, loss_points=1000, threads=1)
    info = prepare_shard(sequence, tmp_path / "s", partial(prepare, options=options), SETTINGS)
    shard = Shard(tmp_path / "s")
    assert (info.scans, info.name) == (5, sequence.name)
    truth = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    assert np.allclose(shard.reference[1:], truth)
    assert np.isnan(shard.reference[0]).all()
    assert shard.imu_there.tolist() == [False, True, True, True, True]
    assert np.allclose(shard.imu[1:, :, 5].mean(), 9.8, atol=1.0)
    assert np.allclose(shard.velocity_m_s[3], truth[1][:3, :3].T @ truth[1][:3, 3] / 0.1, rtol=1e-3)
    assert abs(len(shard.loss_cloud(2)[0]) - 1000) <= 100
    assert np.allclose(shard.vertex_map(2), prepare(sequence[2].scan, options).vertex_map, atol=0.003)


def test_a_scan_that_cannot_be_read_stays_as_one_that_is_not_usable(tiny_drive, tmp_path):
    whole = hl.open_sequence(tiny_drive).part(0, 4)

    def load(k):
        if k == 1:
            raise DataError("scan 1 is truncated")
        return whole.load_scan(k)

    options = PreparationOptions(geometry=GEOMETRY, loss_points=1000, threads=1)
    sequence = replace(whole, load_scan=load)
    prepare_shard(sequence, tmp_path / "s", partial(prepare, options=options), SETTINGS)
    shard = Shard(tmp_path / "s")
    assert shard.usable.tolist() == [True, False, True, True]
    assert len(Pairs([shard], SETTINGS)) == 1


@pytest.mark.parametrize("name", ["reference", "initial", "velocity_m_s", "dt_s", "imu"])
def test_values_that_no_sensor_gives_are_named_before_they_overflow(tmp_path, name: str):
    shard_of(tmp_path, [record(k) for k in range(3)])
    path = tmp_path / "shard" / f"{name}.npy"
    values = np.load(path)
    values.flat[-1] = 1e37
    np.save(path, values)
    with pytest.raises(DataError, match=rf"{name}\.npy: a value over 1e\+06"):
        Shard(tmp_path / "shard")
