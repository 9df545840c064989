"""How errors of poses relative to the local map grow while it is young, and which part of them adds up over steps."""

from __future__ import annotations

# The local map is least reliable while it is young: one keyframe has ground along its own rings only, and normals
# between them are guesses. Its covariance is inflated by 1 + 5/keyframes, and at least half of it, divided by
# the number of keyframes, is drift, because the map is as wrong as the few scans that it consists of.
_YOUNG_MAP_INFLATION, _YOUNG_MAP_DRIFT_SHARE = 5.0, 0.5
# Steps along an unchanged map do not drift against it; a share above 0 keeps the covariance definite. But a map of few
# scans has planes between their rings that lean, and poses against it err more and more as the rings move on: a tenth
# for one keyframe, less with their cube. Over 40 first seconds with 16 beams (rooms, roads, woods) the mean squared
# normalised errors of positions and rotations are 1.7 and 2.3 without that, and 1.2 and 1.6 with it.
_UNCHANGED_MAP_DRIFT_SHARE = 1e-3
_UNCHANGED_YOUNG_MAP_DRIFT_SHARE = 0.1
# Of the covariance relative to a map where a lidar that repeats its pattern measures many points a scan: several beams
# see each surface. Planes fitted between the rings of few beams lean, so that their points share more of an error.
# On 16 simulated drives with 64 beams half the covariance makes the drift 0.88 times as large, as the IMU's noise
# disturbs it less, and the mean squared normalised errors 0.4 in place of 0.3. In 33 recordings of other scenes with 64
# beams the error is 0.95 times as large, and 18 claims of positions are within 0.3 and 2 in place of 14. With 16 beams
# an error in a room is seven times as large. See "Claims of many beams" in docs/results.md.
_DENSE_SHARE = 0.5
# Points of such a scan, relative to `least_measured`, 20,000: 16 beams measure 29,000 or fewer, 64 beams over a whole
# turn 47,000 to 130,000.
_DENSE = 2.0


def is_dense(measured: int, least_measured: int, repeats: bool) -> bool:
    """Return whether scans of this number of measured points show each surface with several beams.

    Args:
        measured: points of a scan.
        least_measured: see :class:`hybridlio.sources.settings.ScanMatchingSettings`.
        repeats: whether the lidar repeats its pattern.
    """
    return repeats and measured >= _DENSE * least_measured


def inflation(keyframes: int, is_dense: bool) -> float:
    """Return the factor on the covariance of a pose relative to a map.

    Args:
        keyframes: number of keyframes in the map.
        is_dense: see :func:`is_dense`.
    """
    return (1 + _YOUNG_MAP_INFLATION / keyframes) * (_DENSE_SHARE if is_dense else 1.0)


def drift_share(map_changed: bool, keyframes: int, least: float, has_rings: bool = True) -> float:
    """Return the share of a step's covariance that adds up over steps.

    Errors against one map of many scans cancel from step to step. What adds up is the error of each keyframe that joins
    it, and errors against a map of few scans.

    Args:
        map_changed: whether the map has got a keyframe since the last step.
        keyframes: number of keyframes in the map.
        least: share at a keyframe that joins an old map.
        has_rings: whether a keyframe is one scan of a lidar that repeats its pattern, with gaps between its rings.
    """
    if map_changed:
        return max(least, _YOUNG_MAP_DRIFT_SHARE / keyframes)
    return max(_UNCHANGED_MAP_DRIFT_SHARE, has_rings * _UNCHANGED_YOUNG_MAP_DRIFT_SHARE / keyframes**3)
