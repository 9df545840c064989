"""Finding a scan's place again after scans that were bridged over decimetres or more."""

from __future__ import annotations

from itertools import product

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import POINT_LEVER_M, VAGUE_TRANSLATION_SIGMA_M

# An initial rotation less certain than this (all axes together) is searched for as well: 1.1°, which displaces points
# 10 m away by 0.2 m, two of the default kernels.
_UNKNOWN_ROTATION_SIGMA_RAD = 0.02
# Mean cost of the best of many starts, some of which fit by chance. Scans on their path cost 0.3 to 0.47 in simulated
# towns, the best wrong place in 10 m 0.55 and more. To miss a place costs a new map, to believe a wrong one the run.
REFOUND_COST = 0.5

_REACH_SIGMAS = 2.5  # along each axis: 1.2 % of the places lie beyond
_MOST_STARTS = 400  # a fifth of a second for scans of 500 compared points


def starts_within(T_map_lidar: Array, covariance: Array, step_m: float) -> list[Array]:
    """Return poses ``(4, 4)`` all over the region in which a pose lies, if a search of it is feasible.

    Args:
        T_map_lidar: ``(4, 4)`` the most likely pose, the first of those returned.
        covariance: ``(6, 6)`` of a right perturbation of it, rad² and m², rotation first.
        step_m: about the distance between two starts. Where there would be too many, the only start is the most likely.
    """
    units = np.r_[np.full(3, 1 / POINT_LEVER_M), np.ones(3)]  # of a perturbation by which points move one metre
    variances, axes = np.linalg.eigh(covariance / np.outer(units, units))
    reach_m = _REACH_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    counts = np.floor(reach_m / step_m).astype(int)
    if np.prod(2 * counts + 1) > _MOST_STARTS:
        return [T_map_lidar]
    offsets = [step_m * np.arange(-count, count + 1) for count in counts]
    tangents = sorted((axes @ np.array(chosen) for chosen in product(*offsets)), key=np.linalg.norm)
    return [T_map_lidar @ se3.exp(units * tangent) for tangent in tangents]


def has_vague_start(pose: RelativePose) -> bool:
    """Whether a map of scans at such poses would show every object several times."""
    return pose.translation_sigma_m > VAGUE_TRANSLATION_SIGMA_M


def has_unknown_turn(pose: RelativePose) -> bool:
    """Whether a search for a scan's place has to try turns as well."""
    return float(pose.covariance[:3, :3].trace()) > _UNKNOWN_ROTATION_SIGMA_RAD**2
