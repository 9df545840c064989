"""The scale of the scene, from how far the scans see; every length of scan matching follows from it.

A room and a street differ in one thing above all: how far away the surfaces are. Points are as dense at twice the
distance in a scene twice as large, so voxels, cells, distances between keyframes and speeds that suit a street suit a
room when they are multiplied by the ratio of the two. The defaults of
:class:`hybridlio.sources.settings.ScanMatchingSettings` hold for streets, and a street has scale 1.

**Measure.** The *view* of a scan is the median range of its points, averaged over voxels. Raw points are densest on
what is near, such as the ground or the sensor's carrier; one a voxel, they count the area that is seen. In rooms and
stairwells the view is 2 to 3 m, in a hall 5 to 10 m, and on roads 18 m or more.

**Running and hysteretic.** The logarithm of the view is smoothed over scans, so that a truck that passes changes
nothing. The scale has steps of a factor √2 and moves when the smoothed view is a whole step away: each change makes
new cells for the map, and at a boundary the scale would otherwise flicker.

A scale related in spirit is Adaptive-LIO's, which sets the resolution of its map by whether the scene is indoors (Zhao
et al., "Adaptive-LIO").
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

from hybridlio.registration.settings import LocalMapSettings, RegistrationSettings
from hybridlio.sources.settings import ScanMatchingSettings

# View of the smallest scene with scale 1: two thirds of the shortest of six simulated road drives, 18 m.
_STREET_VIEW_M = 12.0
# Smallest scale: a view of 1.5 m, that of a narrow stairwell. Voxels of 7.5 cm are then still several times the noise
# of a range.
_STEPS = 6
_STEP = math.sqrt(2)
# Distance of the smoothed view from the scale's own, in steps, at which the scale moves: beyond half a step it would be
# rounded to the next; half a step more keeps it from moving back at once.
_HYSTERESIS = 1.0
_ROUNDING = 0.5  # the same for the first scan, which has no scale to leave
# Share of a new scan in the smoothed logarithm: three scans, a third of a second at 10 Hz. Through a door a person
# walks half a metre in that time.
_NEW_SHARE = 0.3
# Smallest factor for lengths that bridge the noise of ranges and poses, which does not shrink with the scene: kernel
# 5 cm, spacing of map points 5 cm, about three times the noise of a range.
_LEAST_NOISE_SCALE = 0.5

Settings = TypeVar("Settings", ScanMatchingSettings, RegistrationSettings, LocalMapSettings)

_LENGTHS = ("min_range_m", "map_voxel_m", "source_voxel_m")
_MAP_LENGTHS = ("keyframe_m", "voxel_m")


class SceneScale:
    """Estimates the scale from each scan's view, and scales the settings.

    Args:
        given: the settings at scale 1. A length that differs from its default is used as it is given.
    """

    def __init__(self, given: ScanMatchingSettings) -> None:
        self._given = given
        self._log_view: float | None = None
        self._step = 0
        self.settings = given if given.scene_scale is None else scaled(given, given.scene_scale)

    def observe(self, view_m: float) -> bool:
        """Take the view of a scan, metres. Return whether the settings have changed."""
        if self._given.scene_scale is not None or not view_m > 0:
            return False
        here = math.log(_STREET_VIEW_M / view_m, _STEP)  # steps below scale 1
        is_first = self._log_view is None
        self._log_view = here if self._log_view is None else self._log_view + _NEW_SHARE * (here - self._log_view)
        smoothed = min(max(self._log_view, 0.0), float(_STEPS))
        if abs(smoothed - self._step) < (_ROUNDING if is_first else _HYSTERESIS):
            return False
        self._step = round(smoothed)
        self.settings = scaled(self._given, _STEP**-self._step)
        return True


def scaled(given: ScanMatchingSettings, scale: float) -> ScanMatchingSettings:
    """Return settings at a scale of at most 1 from those at scale 1."""
    if scale == 1.0:
        return given
    noise_scale = max(scale, _LEAST_NOISE_SCALE)
    registration = _shrunk(given.registration, RegistrationSettings(), scale, "max_distance_m")
    local_map = _shrunk(given.local_map, LocalMapSettings(), scale, *_MAP_LENGTHS)
    settings = _shrunk(given, ScanMatchingSettings(), scale, *_LENGTHS)
    return replace(
        settings,
        start_speeds_m_s=tuple(scale * speed for speed in given.start_speeds_m_s),
        registration=_shrunk(registration, RegistrationSettings(), noise_scale, "kernel_m"),
        local_map=_shrunk(local_map, LocalMapSettings(), noise_scale, "spacing_m"),
    )


def _shrunk(settings: Settings, defaults: Settings, scale: float, *names: str) -> Settings:
    """Multiply those of the named settings that are at their defaults."""
    at_default = (name for name in names if getattr(settings, name) == getattr(defaults, name))
    return replace(settings, **{name: scale * getattr(settings, name) for name in at_default})
