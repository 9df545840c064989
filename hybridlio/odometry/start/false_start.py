"""What tells a false start: a turn that the gyroscope excludes."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.estimates import RelativePose

_EXCLUDED_TURN = chi_square_quantile(0.999, 3)


def turns_elsewhere(initial: RelativePose, found: RelativePose, sigma_rad: float = 0.0) -> bool:
    """Return whether a step, whose own turn is uncertain by ``sigma_rad``, turns by what its initial pose excludes."""
    apart = se3.so3_log(initial.pose[:3, :3].T @ found.pose[:3, :3])
    covariance = initial.covariance[:3, :3] + sigma_rad**2 * np.eye(3)
    return bool(apart @ np.linalg.solve(covariance, apart) > _EXCLUDED_TURN)
