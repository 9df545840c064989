"""People who walk around a sensor."""

import numpy as np
import pytest

from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.people import person
from hybridlio.simulation.platforms.recording import PlatformRecording, plan


def recording(people: int, lidar: str = "os0") -> PlatformRecording:
    return plan(PlatformConfig(scene="office", lidar=lidar, seconds=6.0, seed=5, people=people))


def test_people_stand_on_the_floor_and_keep_out_of_the_sensor():
    walk = recording(12)
    assert len(walk.people) == 12
    times = np.arange(0.0, 6.0, 0.1)
    sensor = walk.lidar_poses(times)[:, :3, 3]
    for walker in walk.people:
        there = np.array([walker.present(t) for t in times])
        apart = walker.poses(times)[:, :3, 3] - sensor
        assert np.linalg.norm(apart[there, :2], axis=1).min(initial=np.inf) > 0.45
        assert np.abs(apart[there, 2] + 1.35).max(initial=0.0) < 0.15  # the lidar is carried 1.35 m above the floor


def test_people_walk_at_the_pace_of_people():
    times = np.arange(1.0, 5.0, 0.1)
    for walker in recording(12).people:
        there = times[[walker.present(t) for t in times]]
        speed = np.linalg.norm(np.diff(walker.poses(there)[:, :2, 3], axis=0), axis=1) / 0.1
        assert speed.max(initial=0.0) < 2.5


@pytest.mark.parametrize("lidar", ["os0", "mid360"])
def test_the_lidar_sees_them(lidar: str):
    alone, among = recording(0, lidar), recording(8, lidar)
    fewer = 0
    for k in (0, 20, 40):
        mine, theirs = (np.linalg.norm(r.scan(k).points, axis=1) for r in (alone, among))
        fewer += float(theirs.mean()) < float(mine.mean()) - 0.01  # people hide what is behind them
    assert fewer >= 1


def test_people_have_the_size_of_people():
    for seed in range(5):
        size = np.ptp(person(np.random.default_rng(seed)).vertices, axis=0)
        assert (size > [0.2, 0.5, 1.49]).all()
        assert (size < [0.6, 0.8, 1.96]).all()
