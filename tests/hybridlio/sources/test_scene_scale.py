"""The scale of the scene: what follows from how far scans see, and that rooms and doors work by the defaults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_rooms import box_ranges, directions

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Frame, Scan
from hybridlio.sources.scan_matching import ScanMatching
from hybridlio.sources.scene_scale import SceneScale, scaled
from hybridlio.sources.settings import ScanMatchingSettings

DEFAULTS = ScanMatchingSettings()
UNSURE = np.diag(np.r_[np.full(3, 0.01), np.full(3, 0.05)] ** 2)


AMPLE = (6000, 100_000)  # points after averaging over voxels, and measured ones, of a 64-beam scan of a road


def settings_after(*views_m: float, given: ScanMatchingSettings = DEFAULTS) -> ScanMatchingSettings:
    scale = SceneScale(given)
    for view_m in views_m:
        scale.observe(view_m, *AMPLE)
    return scale.settings


def street_seen_by(points_at_default: int, measured: int, scans: int = 20) -> tuple[SceneScale, list[bool]]:
    """A street of which finer voxels leave more points, in proportion to the inverse of their side's power 1.5."""
    scale = SceneScale(DEFAULTS)
    changes = [observe_street(scale, points_at_default, measured) for _ in range(scans)]
    return scale, changes


def observe_street(scale: SceneScale, points_at_default: int, measured: int) -> bool:
    factor = scale.settings.map_voxel_m / DEFAULTS.map_voxel_m
    return scale.observe(20.0, min(int(points_at_default * factor**-1.5), measured), measured)


# ------------------------------------------------------------------------------------------------- what follows


@pytest.mark.parametrize("view_m", [18.0, 30.0, 200.0])
def test_roads_keep_the_defaults(view_m: float):
    """The shortest view of six simulated road drives is 18 m."""
    assert settings_after(view_m) == DEFAULTS


@pytest.mark.parametrize(("view_m", "least_m", "most_m"), [(2.3, 0.08, 0.18), (6.0, 0.2, 0.45), (0.3, 0.06, 0.1)])
def test_voxels_shrink_with_the_view(view_m: float, least_m: float, most_m: float):
    """In a room of 5 × 4 m to a decimetre, in a hall half-way; nowhere below several times the noise of a range."""
    assert least_m < settings_after(view_m).map_voxel_m < most_m


def test_lengths_that_bridge_noise_shrink_less():
    room = settings_after(2.3)
    assert 0.03 < room.registration.kernel_m < 0.08
    assert 0.03 < room.local_map.spacing_m < 0.08


def test_lengths_that_are_given_stay():
    given = replace(DEFAULTS, min_range_m=1.0, local_map=replace(DEFAULTS.local_map, keyframe_m=1.5))
    room = settings_after(2.3, given=given)
    assert (room.min_range_m, room.local_map.keyframe_m) == (1.0, 1.5)
    assert room.map_voxel_m < DEFAULTS.map_voxel_m


def test_a_scale_that_is_given_stays():
    given = replace(DEFAULTS, scene_scale=0.5)
    assert settings_after(2.3, 100.0, given=given) == scaled(given, 0.5)
    assert settings_after(2.3, given=replace(DEFAULTS, scene_scale=1.0)).map_voxel_m == DEFAULTS.map_voxel_m


# ------------------------------------------------------------------------------------------------- density


@pytest.mark.parametrize("points", [3400, 12_000], ids=["16 beams", "64 beams"])
def test_scans_of_roads_keep_their_voxels(points: int):
    assert street_seen_by(points, 25_000)[0].settings == DEFAULTS


def test_a_narrow_lidar_gets_voxels_that_leave_enough_points():
    """Of 17,000 points that a field of view of 70° has in a street, 1,500 are left by the voxels for 360°."""
    settings = street_seen_by(1500, 17_000)[0].settings
    assert 1500 * (DEFAULTS.map_voxel_m / settings.map_voxel_m) ** 1.5 > 4000
    assert settings.map_voxel_m >= 0.14
    assert settings.source_voxel_m / settings.map_voxel_m == pytest.approx(1.0 / 0.6)
    assert settings.registration == DEFAULTS.registration


def test_voxels_of_a_room_are_not_made_finer():
    """They are as small already; below a decimetre voxels average away too little noise."""
    room, few = SceneScale(DEFAULTS), SceneScale(DEFAULTS)
    for _ in range(20):
        room.observe(2.3, *AMPLE)
        few.observe(2.3, 1500, 14_400)
    assert few.settings.map_voxel_m == room.settings.map_voxel_m


def test_voxels_are_no_finer_than_the_measured_points():
    """A scan of 1,000 points has no more, however fine the voxels."""
    assert street_seen_by(900, 1000)[0].settings == DEFAULTS


def test_voxels_become_coarser_again_where_points_are_many():
    scale, changes = street_seen_by(1500, 17_000)
    assert changes[10:] == [False] * 10
    for _ in range(20):
        observe_street(scale, 10_000, 100_000)
    assert scale.settings == DEFAULTS


# ------------------------------------------------------------------------------------------------- over time


def test_the_scale_follows_within_a_second():
    """Ten scans after a door, the scale is about that of a run that started there."""
    assert settings_after(2.3, *[30.0] * 10) == DEFAULTS
    ratio = settings_after(30.0, *[2.3] * 10).map_voxel_m / settings_after(2.3).map_voxel_m
    assert 0.7 < ratio < 1.5  # one step of the scale at most


def test_a_single_scan_changes_nothing():
    """A truck that passes, or a door that is passed."""
    assert settings_after(18.0, 5.0) == DEFAULTS


def test_the_scale_does_not_flicker_at_a_boundary(rng: np.random.Generator):
    """Views that differ by ±10 % about any view change the scale once at most."""
    for view_m in np.geomspace(1.5, 12.0, 20):
        scale = SceneScale(DEFAULTS)
        scale.observe(float(view_m), *AMPLE)
        changes = sum(scale.observe(float(v), *AMPLE) for v in view_m * np.exp(0.1 * rng.standard_normal(200)))
        assert changes <= 1


def test_a_scan_without_points_changes_nothing():
    assert settings_after(2.3, *[float("nan")] * 50) == settings_after(2.3)


# ------------------------------------------------------------------------------------------------- in a room


def seen(position: np.ndarray, yaw: float, size: tuple[float, float, float], rng: np.random.Generator) -> Frame:
    """A scan of 16 × 600 points in an empty box, corner at the origin."""
    T = se3.exp(np.array([0, 0, yaw, 0, 0, 0]))
    rays = directions(beams=16, columns=600, half_fov_deg=45.0)
    ranges = box_ranges(position, rays @ T[:3, :3].T, size)
    return Frame(0, Scan(0, (rays * (ranges + 0.01 * rng.standard_normal(len(rays)))[:, None]).astype(np.float32)))


@pytest.mark.parametrize("size", [(5.0, 4.0, 2.6), (2.6, 5.0, 3.0), (12.0, 9.0, 4.0)], ids=["room", "stairs", "hall"])
def test_motion_in_a_room_is_found_to_millimetres(size: tuple[float, float, float], rng: np.random.Generator):
    matching, middle = ScanMatching(), np.array(size) / 2
    steps = [(middle + np.array([0.02 * k, 0.01 * k, 0.0]), 0.02 * k) for k in range(8)]
    path = [se3.make(se3.exp(np.array([0, 0, yaw, 0, 0, 0]))[:3, :3], p) for p, yaw in steps]
    pose = np.eye(4)
    for k, (position, yaw) in enumerate(steps):
        frame = replace(seen(position, yaw, size, rng), index=k)
        frame = replace(frame, scan=replace(frame.scan, stamp_ns=k * 100_000_000))
        if not k:
            matching.start(frame)
            continue
        found = matching.refine(frame, RelativePose(np.eye(4), UNSURE, "guess"))
        assert found.ok
        pose = pose @ found.pose
    assert np.linalg.norm(se3.between(pose, se3.between(path[0], path[-1]))[:3, 3]) < 0.01


def test_a_first_scan_with_too_few_points_is_refused(rng: np.random.Generator):
    frame = Frame(3, Scan(0, rng.uniform(2, 5, (30, 3)).astype(np.float32)))
    with pytest.raises(DataError, match=r"frame 3: only \d+ points .* start at a scan with at least 50"):
        ScanMatching().start(frame)
