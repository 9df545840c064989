"""The scale of the scene, from how far and how densely the scans see; every length of scan matching follows from it.

A room and a street differ in one thing above all: how far away the surfaces are. Points are as dense at twice the
distance in a scene twice as large, so voxels, cells, distances between keyframes and speeds that suit a street suit a
room when they are multiplied by the ratio of the two. The defaults of
:class:`hybridlio.sources.settings.ScanMatchingSettings` hold for streets, and a street has scale 1.

**Measure.** The *view* of a scan is the median range of its points, averaged over voxels. Raw points are densest on
what is near, such as the ground or the sensor's carrier; one a voxel, they count the area that is seen. In rooms and
stairwells the view is 2 to 3 m, in a hall 5 to 10 m, and on roads 18 m or more.

**Density.** A lidar with a narrow field of view sees a street, too, but little of it: voxels for a street leave too few
points to tell where along the street it is. Where a scan has few points although it has measured many, its voxels are
made finer until it has enough.

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
from hybridlio.sources.settings import STREET_VIEW_M, ScanMatchingSettings

# Smallest scale: a factor of 8, for a view of 1.5 m, that of a narrow stairwell. Voxels of 7.5 cm are still several
# times the noise of a range.
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

# With fewer points than this, voxels are made finer, until there are this number. HDL-64E scans of six simulated road
# drives leave 4,000 to 12,000 and 16-beam scans 3,400 or more; in a street a lidar with a field of view of 70° leaves
# 1,500, by which its start at rest is found at no speed, with 2,900 or 3,800 at some and with 4,900 always.
_FEW_POINTS, _ENOUGH_POINTS = 3000, 4500
# Finer voxels give no more points if this share of the measured points has a voxel of its own.
_MOSTLY_SINGLE = 0.7
# Steps of voxels below a street's at which they are made no finer: 0.15 m. In a room, where they are as small, finer
# ones only add noise and time: with 16 beams in a room of 5 × 4 m, the error tripled.
_FINEST_STEP = 4

_VOXELS = ("map_voxel_m", "source_voxel_m")
_LENGTHS = ("min_range_m", *_VOXELS)
_MAP_LENGTHS = ("keyframe_m", "voxel_m")


class SceneScale:
    """Estimates scale and density from each scan, and scales the settings.

    Args:
        given: the settings at scale 1. A length that differs from its default is used as it is given.
    """

    def __init__(self, given: ScanMatchingSettings) -> None:
        self._given = given
        self._view, self._points = _Smoothed(), _Smoothed()  # both logarithms
        self._step = self._finer = 0
        self.settings = given if given.scene_scale is None else scaled(given, given.scene_scale)

    def observe(self, view_m: float, points: int, measured: int) -> bool:
        """Take a scan as these settings have thinned it, and return whether they have changed.

        Args:
            view_m: the scan's view, metres.
            points: number of its points after averaging over voxels.
            measured: number of measured points.
        """
        if self._given.scene_scale is not None or not view_m > 0:
            return False
        if not (self._move_scale(view_m) or self._refine(points, measured)):
            return False
        self._points = _Smoothed()  # the number of points will be another
        self.settings = finer(self._given, scaled(self._given, _STEP**-self._step), _STEP**-self._finer)
        return True

    @property
    def _most_finer(self) -> int:
        return max(_FINEST_STEP - self._step, 0)

    def _move_scale(self, view_m: float) -> bool:
        is_first = self._view.value is None
        smoothed = min(max(self._view.add(math.log(STREET_VIEW_M / view_m, _STEP)), 0.0), float(_STEPS))
        if abs(smoothed - self._step) < (_ROUNDING if is_first else _HYSTERESIS):
            return False
        self._step = round(smoothed)
        self._finer = min(self._finer, self._most_finer)
        return True

    def _refine(self, points: int, measured: int) -> bool:
        """Make voxels finer where points are few, and coarser again where the coarser ones would leave enough."""
        smoothed = math.exp(self._points.add(math.log(max(points, 1))))
        few = _ENOUGH_POINTS if self._finer else _FEW_POINTS
        if smoothed < few and points < _MOSTLY_SINGLE * measured and self._finer < self._most_finer:
            self._finer += 1
        elif self._finer and smoothed > 2 * _STEP * _ENOUGH_POINTS:  # a step halves them at most
            self._finer -= 1
        else:
            return False
        return True


def scale_of(view_m: float) -> float:
    """Return the scale, at most 1, of the scene of one scan by its view, rounded to a step; 1 without a view."""
    if not view_m > 0:
        return 1.0
    return float(_STEP ** -min(max(round(math.log(STREET_VIEW_M / view_m, _STEP)), 0), _STEPS))


class _Smoothed:
    """A running mean that forgets."""

    def __init__(self) -> None:
        self.value: float | None = None

    def add(self, value: float) -> float:
        """Add a value and return the mean."""
        self.value = value if self.value is None else self.value + _NEW_SHARE * (value - self.value)
        return self.value


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
        local_map=replace(_shrunk(local_map, LocalMapSettings(), noise_scale, "spacing_m"), one_sided=True),
    )


def finer(given: ScanMatchingSettings, settings: ScanMatchingSettings, factor: float) -> ScanMatchingSettings:
    """Return ``settings`` with smaller voxels, where ``given`` leaves them at their defaults."""
    free = (name for name in _VOXELS if getattr(given, name) == getattr(ScanMatchingSettings(), name))
    return replace(settings, **{name: factor * getattr(settings, name) for name in free})


def _shrunk(settings: Settings, defaults: Settings, scale: float, *names: str) -> Settings:
    """Multiply those of the named settings that are at their defaults."""
    at_default = (name for name in names if getattr(settings, name) == getattr(defaults, name))
    return replace(settings, **{name: scale * getattr(settings, name) for name in at_default})
