"""GTSAM's robust kernels by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam

_KERNELS: dict[str, Callable[[float], gtsam.noiseModel.mEstimator.Base]] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
    "fair": gtsam.noiseModel.mEstimator.Fair,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
    "welsch": gtsam.noiseModel.mEstimator.Welsch,
    "truncated-least-squares": gtsam.noiseModel.mEstimator.TruncatedLeastSquares,
    "dead-zone": gtsam.noiseModel.mEstimator.L2WithDeadZone,
}
# all of GTSAM's; its asymmetric ones equal Cauchy and Tukey at norms, which are never negative
KERNELS = tuple(_KERNELS)


def estimator(kernel: str, width: float) -> Any:
    """Return GTSAM's M-estimator of a kernel's name."""
    # GTSAM compares DCS's parameter with the squared norm, the other kernels' with the norm
    return _KERNELS[kernel](width**2 if kernel == "dcs" else width)
