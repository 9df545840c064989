"""iSAM2 as hybridlio uses it (Kaess et al., "iSAM2: Incremental Smoothing and Mapping", IJRR 2012)."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from hybridlio.core.arrays import Array

# A change of the newest pose hardly moves the oldest: below this change (rad, m, m/s) it is not carried on to older
# variables, which would make each update cost as much as the run is long. The newest are always solved in full.
_WILDFIRE_THRESHOLD = 1.0
_EAGER = 1e-3
# Far from the origin a little turn of the whole path moves its newest part by metres, all alike, which makes no other
# factors: only turns do, and moves against each other.
_RELINEARISE = {
    "x": np.r_[np.full(3, 0.02), np.full(3, 5.0)],  # pose: rad, m
    "m": np.r_[np.full(3, 0.02), np.full(3, 5.0)],  # pose on scan matching's own path
    "v": np.full(3, 1.0),  # velocity, m/s
    "b": np.r_[np.full(3, 0.1), np.full(3, 0.01)],  # biases: m/s², rad/s
    "g": np.full(3, 0.1),  # gravity, m/s²
    "e": np.r_[np.full(3, 0.02), np.full(3, 1.0)],  # world in the frame of GPS fixes: rad, m
    **{kind: np.full(3, 1.0) for kind in "awp"},  # antenna at a GPS fix, m
    "t": np.full(1, 0.1),  # time between the clocks of fixes and scans, s
}


def incremental_solver(forgets: bool = False) -> gtsam.ISAM2:
    """An empty iSAM2 for graphs of poses ``x`` and ``m``, velocities ``v``, biases ``b``, gravity ``g`` …

    Args:
        forgets: factors will leave, and new ones take their slots: looking for a free one goes through all slots.
    """
    params = make_isam_params(_RELINEARISE, _WILDFIRE_THRESHOLD)
    params.findUnusedFactorSlots = forgets
    return gtsam.ISAM2(params)


def eager_solver() -> gtsam.ISAM2:
    """As :func:`incremental_solver`, but every update linearises all that moves anew: for a graph of few scans."""
    everything = {kind: np.full_like(change, _EAGER) for kind, change in _RELINEARISE.items()}
    params = make_isam_params(everything, _EAGER)
    params.relinearizeSkip = 1
    return gtsam.ISAM2(params)


def make_isam_params(relinearise: Mapping[str, Array], wildfire_threshold: float) -> gtsam.ISAM2Params:
    """Parameters of iSAM2 as used everywhere here.

    Args:
        relinearise: changes beyond which a variable is linearised anew, by the letter of its name.
        wildfire_threshold: changes below it are not carried on to older variables.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")  # Cholesky finds long straight chains indeterminate
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(wildfire_threshold))
    params.relinearizeSkip = 10
    thresholds = gtsam.ISAM2ThresholdMap()
    for kind, change in relinearise.items():
        thresholds.insert((kind, change))
    params.setRelinearizeThreshold(thresholds)
    return params


def reason(error: RuntimeError) -> str:
    """What GTSAM says went wrong, and at which variable, on one line; the essay that follows it left out."""
    return " ".join(str(error).strip().split("\n\n")[0].split())
