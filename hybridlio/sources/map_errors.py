"""How errors of poses relative to the local map grow while it is young, and which part of them adds up over steps."""

from __future__ import annotations

# The local map is least reliable while it is young: one keyframe has ground along its own rings only, and normals
# between them are guesses. Its covariance is inflated by 1 + 5/keyframes, and at least half of it, divided by
# the number of keyframes, is drift, because the map is as wrong as the few scans that it consists of.
_YOUNG_MAP_INFLATION, _YOUNG_MAP_DRIFT_SHARE = 5.0, 0.5
# Steps along an unchanged map do not drift against it. The share is above 0 because a covariance has to be definite.
_UNCHANGED_MAP_DRIFT_SHARE = 1e-3


def inflation(keyframes: int) -> float:
    """Return the factor on the covariance of a pose relative to a map of this number of keyframes."""
    return 1 + _YOUNG_MAP_INFLATION / keyframes


def drift_share(map_changed: bool, keyframes: int, least: float) -> float:
    """Return the share of a step's covariance that adds up over steps.

    Errors against one map cancel from step to step. What adds up is the error of each keyframe that joins it.

    Args:
        map_changed: whether the map has got a keyframe since the last step.
        keyframes: number of keyframes in the map.
        least: share at a keyframe that joins an old map.
    """
    return max(least, _YOUNG_MAP_DRIFT_SHARE / keyframes) if map_changed else _UNCHANGED_MAP_DRIFT_SHARE
