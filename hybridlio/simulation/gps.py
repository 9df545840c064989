"""GPS fixes of the path."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.sensors import NS_PER_S, GpsFix
from hybridlio.simulation.path import SmoothPath


def gps_fixes(
    path: SmoothPath, times_s: ArrayLike, start_ns: int, sigma_m: float, rng: np.random.Generator
) -> tuple[GpsFix, ...]:
    """Fixes of the IMU's position (east, north, up) with independent Gaussian noise of ``sigma_m`` on each axis.

    ``start_ns`` is the stamp of the path's time zero. The antenna is taken to sit at the IMU.
    """
    times = np.asarray(times_s, dtype=np.float64)
    positions = path.poses(times)[:, :3, 3]
    positions = positions + sigma_m * rng.standard_normal(positions.shape)
    stamps = start_ns + np.round(times * NS_PER_S).astype(np.int64)
    return tuple(GpsFix(int(t), p, np.eye(3) * sigma_m**2) for t, p in zip(stamps, positions, strict=True))


def gps_csv(fixes: tuple[GpsFix, ...]) -> str:
    """The fixes as CSV: ``stamp_ns,east,north,up,sigma``, metres."""
    rows = ["stamp_ns,east,north,up,sigma"]
    rows += [
        f"{f.stamp_ns},{','.join(f'{v:.6f}' for v in f.position_m)},{np.sqrt(f.covariance_m2[0, 0]):.6f}" for f in fixes
    ]
    return "\n".join(rows) + "\n"
