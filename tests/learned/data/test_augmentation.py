from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridlio.cloud.projection import vertex_map
from hybridlio.core import se3
from hybridlio.learned.data.augmentation import mirrored, training_batch, with_points
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.losses.correspondences import match_nearest
from hybridlio.learned.losses.loss import loss
from hybridlio.learned.settings import LossSettings, NetworkSettings, OptimiserSettings

ALL = torch.tensor([True, True])


def pairs_of(shard: Shard, network: NetworkSettings) -> Pairs:
    return Pairs([shard], replace(network, velocity=True))


@pytest.fixture
def pairs(winding: Shard, tiny_recipe) -> Pairs:
    return pairs_of(winding, tiny_recipe.network)


def test_a_mirrored_map_is_the_map_of_the_mirrored_points(pairs):
    batch = pairs.batch([0, 1])
    seen = mirrored(batch, torch.tensor([True, False]))
    cells = batch.network.last[0].flatten(1).T
    points = (cells[cells.any(1)] * torch.tensor([1.0, -1.0, 1.0])).numpy()
    geometry = pairs.shards[0].info.geometry
    same = np.abs(seen.network.last[0].numpy() - vertex_map(points, geometry)).max(axis=0) < 1e-5
    assert same.mean() > 0.98  # a shard's whole steps move some points over a cell's edge
    assert torch.equal(seen.network.last[1], batch.network.last[1])


def test_a_mirrored_pair_fits_its_mirrored_pose_as_well(rooms, tiny_recipe):
    batch = Pairs(rooms[:1], tiny_recipe.network).batch([0, 1])
    both = [batch, mirrored(batch, ALL)]
    costs = [
        loss(match_nearest(b.reference, b.last, b.current), b.reference, LossSettings(reduction="mean")).total
        for b in both
    ]
    assert torch.allclose(*costs, rtol=1e-4)
    turned, back = (se3.log(b.reference.double().numpy()) for b in both)
    assert np.allclose(turned * [-1, 1, -1, 1, -1, 1], back, atol=1e-6)


def test_mirroring_twice_changes_nothing(pairs):
    batch = pairs.batch([0, 1])
    again = mirrored(mirrored(batch, ALL), ALL)
    for name in ("last", "current", "imu", "velocity_m_s", "initial"):
        assert torch.equal(getattr(again.network, name), getattr(batch.network, name))
    assert torch.equal(again.reference, batch.reference)


def test_a_pair_runs_backwards_with_its_scans_pose_and_rates_reversed(pairs):
    index = 3
    assert pairs.swappable(index)
    ahead, back = pairs.batch([index]), pairs.batch([index], [index])
    assert torch.equal(ahead.network.last, back.network.current)
    assert torch.equal(ahead.last.points, back.current.points)
    assert np.allclose(se3.inverse(ahead.reference[0].numpy()), back.reference[0], atol=1e-6)
    assert torch.equal(ahead.network.imu.flip(1) * torch.tensor([-1.0, -1, -1, 1, 1, 1]), back.network.imu)
    assert back.network.velocity_m_s[0, 0] < 0


def test_the_last_pairs_of_a_recording_do_not_run_backwards(pairs):
    assert [pairs.swappable(i) for i in range(len(pairs))][-1] is False


def test_points_of_the_current_cloud_are_drawn_and_others_left_alone(pairs):
    batch = pairs.batch([0, 1])
    drawn = with_points(batch, OptimiserSettings(points=50), seed=1)
    assert drawn.current.points.shape == (2, 50, 3)
    assert drawn.current.there.all()
    assert drawn.last is batch.last
    whole = {tuple(p) for p in batch.current.points[1].tolist()}
    assert {tuple(p) for p in drawn.current.points[1].tolist()} <= whole


def test_points_are_drawn_alike_by_the_axis_of_their_normals(pairs):
    drawn = with_points(pairs.batch([0]), OptimiserSettings(points=90, balanced=1.0), seed=1)
    assert torch.bincount(drawn.current.normals[0].abs().argmax(-1)).tolist() == [30, 30, 30]


def test_how_a_pair_is_varied_depends_on_the_pair_and_the_seed_alone(pairs):
    settings = OptimiserSettings(mirrored=0.5, swapped=0.5, points=40, balanced=0.5, initial_noise_m=0.1)
    whole, part = training_batch(pairs, [0, 1, 2, 3], settings, 7), training_batch(pairs, [2], settings, 7)
    assert torch.equal(whole.network.last[2], part.network.last[0])
    assert torch.equal(whole.current.points[2], part.current.points[0])
    assert torch.equal(whole.network.perturbation[2], part.network.perturbation[0])
    seeds = [training_batch(pairs, [2], settings, seed).network.last for seed in range(8)]
    assert any(not torch.equal(seeds[0], other) for other in seeds)
