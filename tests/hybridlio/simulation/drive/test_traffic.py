"""Moving cars keep clear of the ego car."""

import numpy as np
from scipy.spatial import cKDTree

from hybridlio.simulation.drive.traffic import EgoDrive, traffic
from hybridlio.simulation.world.ground import Ground
from hybridlio.simulation.world.roads import LANE_OFFSET_M, Road


def level(xy: np.ndarray) -> np.ndarray:
    return np.zeros(len(xy))


def test_no_moving_car_overlaps_a_slow_ego_car():
    x = np.arange(0.0, 400.0, 0.5)
    centreline = Road.through(np.column_stack([x, 0 * x]))
    lane = Road.through(np.column_stack([x, 0 * x - LANE_OFFSET_M]))
    ground = Ground(level, level, level, cKDTree(centreline.at(x)))
    times = np.arange(0.0, 40.0, 0.1)
    ego_s = 60.0 + np.interp(times, [0, 10, 25, 40], [0.0, 80.0, 88.0, 200.0])  # half a metre a second for a while
    ego_xy, followers = lane.at(ego_s), 0
    for seed in range(40):
        for car in traffic(centreline, EgoDrive(lane, times, ego_s, ego_xy), ground, 40.0, seed):
            there = np.array([car.present(t) for t in times])
            poses = car.poses(times[there])
            seen = np.einsum("nji,nj->ni", poses[:, :2, :2], ego_xy[there] - poses[:, :2, 3])
            low, high = car.mesh.vertices[:, :2].min(axis=0), car.mesh.vertices[:, :2].max(axis=0)
            assert not ((seen > low) & (seen < high)).all(axis=1).any()
            followers += int(np.abs(seen[:, 1]).max() < 1.0)
    assert followers > 20
