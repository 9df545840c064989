"""Settings of iSAM2 (Kaess et al., "iSAM2: Incremental Smoothing and Mapping Using the Bayes Tree", IJRR 2012)."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from hybridlio.core.arrays import Array

# Changes below this (rad, m, m/s) are not propagated from the newest variables to older ones (the paper's wildfire
# threshold). Propagating all of them would make each update as expensive as the run is long. The variables that an
# update eliminates, the newest ones, are always solved in full, so online estimates do not depend on the value.
_WILDFIRE_THRESHOLD = 1.0
# Threshold of the solver that relinearises everything: GTSAM's default wildfire threshold, far below sensor noise.
_EXACT_THRESHOLD = 1e-3
# Changes above which a variable is relinearised, by the letter of its key. Position thresholds are wide because a small
# rotation of the whole path moves its far end by metres without changing any relative pose; factors become nonlinear
# by rotations only. A rotation error of 0.02 rad costs 0.02²/2 = 2e-4 of a step's length.
_RELINEARISATION_THRESHOLDS = {
    "x": np.r_[np.full(3, 0.02), np.full(3, 5.0)],  # pose: rad, m
    "m": np.r_[np.full(3, 0.02), np.full(3, 5.0)],  # pose on scan matching's own path: rad, m
    "v": np.full(3, 1.0),  # velocity, m/s: enters linearly
    "b": np.r_[np.full(3, 0.1), np.full(3, 0.01)],  # biases, m/s² and rad/s: preintegration is corrected to first order
    "g": np.full(3, 0.1),  # gravity, m/s²: 0.01 rad of tilt
    "e": np.r_[np.full(3, 0.02), np.full(3, 1.0)],  # world in the frame of GPS fixes: rad, m
    **{kind: np.full(3, 1.0) for kind in "awp"},  # antenna at a GPS fix, m: enters linearly
    "t": np.full(1, 0.1),  # clock shift of the fixes, s: 1 cm at an acceleration of 2 m/s²
}


def incremental_solver(removes_factors: bool = False) -> gtsam.ISAM2:
    """Return an empty iSAM2 for the variables of a run (keys as in :mod:`hybridlio.graph.run.factors`).

    Args:
        removes_factors: reuse the slots of removed factors. The search for a free slot visits every slot, so this only
            pays where factors are removed.
    """
    params = make_isam_params(_RELINEARISATION_THRESHOLDS, _WILDFIRE_THRESHOLD)
    params.findUnusedFactorSlots = removes_factors
    return gtsam.ISAM2(params)


def relinearising_solver() -> gtsam.ISAM2:
    """Return an empty iSAM2 that relinearises every changed variable at every update; for graphs of few scans."""
    thresholds = {kind: np.full_like(change, _EXACT_THRESHOLD) for kind, change in _RELINEARISATION_THRESHOLDS.items()}
    params = make_isam_params(thresholds, _EXACT_THRESHOLD)
    params.relinearizeSkip = 1
    return gtsam.ISAM2(params)


def make_isam_params(relinearise: Mapping[str, Array], wildfire_threshold: float) -> gtsam.ISAM2Params:
    """Return the parameters that every iSAM2 of this package shares.

    Args:
        relinearise: changes above which a variable is relinearised, by the letter of its key.
        wildfire_threshold: changes below it are not propagated to older variables.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")  # Cholesky, the default, finds long straight chains indeterminate
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(wildfire_threshold))
    params.relinearizeSkip = 10  # GTSAM's default: check for relinearisation at every tenth update
    thresholds = gtsam.ISAM2ThresholdMap()
    for kind, change in relinearise.items():
        thresholds.insert((kind, change))
    params.setRelinearizeThreshold(thresholds)
    return params


def gtsam_message(error: RuntimeError) -> str:
    """Return the first paragraph of GTSAM's message on one line: what failed, and at which variable."""
    return " ".join(str(error).strip().split("\n\n")[0].split())
