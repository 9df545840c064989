import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.registration.local_map import LocalMap
from hybridlio.registration.ring_planes import RingPlanes
from hybridlio.registration.settings import LocalMapSettings

HEIGHT_M = 1.7
GRADE = np.radians(2.0)  # of the ground, rising ahead


def ring(elevation_deg: float, x_m: float = 0.0, apart_m: float = 0.6, half_deg: float = 40.0) -> np.ndarray:
    """One beam's points on sloping ground ahead of a lidar ``x_m`` up the slope, in the first lidar's frame."""
    angle = np.radians(elevation_deg)
    range_m = HEIGHT_M / (np.tan(GRADE) - np.tan(angle))  # straight ahead, level
    azimuth = np.arange(-np.radians(half_deg), np.radians(half_deg), apart_m / range_m)
    level = HEIGHT_M / (np.tan(GRADE) * np.cos(azimuth) - np.tan(angle))
    points = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), level * np.tan(angle)])
    return points + np.array([x_m, 0.0, x_m * np.tan(GRADE)])


def noisy(points: np.ndarray, seed: int, sigma_m: float = 0.03) -> np.ndarray:
    away = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + sigma_m * np.random.default_rng(seed).standard_normal((len(points), 1)) * away


NORMAL = np.array([-np.sin(GRADE), 0.0, np.cos(GRADE)])


def test_a_single_ring_makes_no_plane():
    index, planes = RingPlanes(side_m=2.0).add_keyframe(noisy(ring(-5.0), 0), 1)
    assert len(index) == len(planes.normals) == len(planes.weights) == 0


def test_rings_of_two_keyframes_make_planes_of_the_ground():
    loose = RingPlanes(side_m=2.0)
    loose.add_keyframe(noisy(ring(-5.0), 0), 1)
    second = noisy(ring(-5.0, 2.0), 1)
    index, planes = loose.add_keyframe(second, 1)
    assert len(index) > 0.8 * len(second)
    off_deg = np.degrees(np.arccos(np.minimum(np.abs(planes.normals @ NORMAL), 1.0)))
    assert np.median(off_deg) < 1.0  # the beam's cone differs from the ground by seven degrees
    assert (planes.weights > 0.9).all()


def test_the_same_ring_from_the_same_place_makes_no_plane():
    loose = RingPlanes(side_m=2.0)
    for seed in range(4):
        index, _ = loose.add_keyframe(noisy(ring(-5.0), seed), 1)
        assert len(index) == 0


def test_rings_too_far_apart_make_no_plane():
    loose = RingPlanes(side_m=2.0)
    loose.add_keyframe(ring(-5.0), 1)
    assert len(loose.add_keyframe(ring(-5.0, 6.0), 1)[0]) == 0


@pytest.mark.parametrize(("between", "planes"), [(3, True), (4, False)])
def test_only_the_last_keyframes_are_used(between: int, planes: bool):
    loose = RingPlanes(side_m=2.0)
    loose.add_keyframe(ring(-5.0), 1)
    for k in range(between):
        loose.add_keyframe(ring(-5.0, 500.0 * (k + 1)), 1)
    assert bool(len(loose.add_keyframe(ring(-5.0, 2.0), 1)[0])) == planes


def test_few_or_no_points_are_not_an_error():
    loose = RingPlanes(side_m=2.0)
    assert len(loose.add_keyframe(np.empty((0, 3)), 1)[0]) == 0
    assert len(loose.add_keyframe(ring(-5.0)[:3], 1)[0]) == 0


def test_the_map_of_a_sparse_sensor_has_ground_beyond_single_rings():
    """Rings at −15° and −13° are 1 m apart and make planes in one scan; those at −5° and −3° are 13 m apart."""
    far, near_normals = [], []
    for keyframes in (1, 3):
        local_map = LocalMap(LocalMapSettings(threads=1))
        for k in range(keyframes):
            pose = se3.make(np.eye(3), [2.0 * k, 0.0, 2.0 * k * np.tan(GRADE)])
            scan = np.concatenate([noisy(ring(e), 10 * k + i) for i, e in enumerate((-15.0, -13.0, -5.0, -3.0))])
            local_map.insert(scan, pose)
        assert local_map.surface is not None
        distant = local_map.surface.points[:, 0] > 12.0
        far.append(int(distant.sum()))
        near_normals.append(np.abs(local_map.surface.normals @ NORMAL))
    assert far[0] == 0
    assert far[1] > 50
    assert np.median(near_normals[1]) > np.cos(np.radians(2.0))


@pytest.mark.parametrize("dense", [True, False])
def test_distant_rings_of_a_dense_sensor_are_left_out(dense: bool):
    """Distant rings are single ones with any sensor; planes across keyframes are for sensors with single near rings."""
    left, ahead = np.meshgrid(np.arange(-21.0, 21.0, 0.6), np.arange(-21.0, 21.0, 0.6))
    floor = np.column_stack([ahead.ravel(), left.ravel(), ahead.ravel() * np.tan(GRADE) - HEIGHT_M])
    near = floor if dense else np.concatenate([ring(-15.0), ring(-13.0), ring(-5.0)])
    local_map = LocalMap(LocalMapSettings(threads=1))
    for k in range(3):
        scan = np.concatenate([near, ring(-1.0)])
        local_map.insert(scan, se3.make(np.eye(3), [2.0 * k, 0.0, 2.0 * k * np.tan(GRADE)]))
    assert local_map.surface is not None
    assert (local_map.surface.points[:, 0] > 30.0).any() != dense  # where only the last ring is
