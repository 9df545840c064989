"""GPS fixes along the path."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.geodesy import GeodeticPoint, geodetic_from_enu
from hybridlio.core.sensors import NS_PER_S, GpsFix
from hybridlio.simulation.drive.path import SmoothPath


def gps_fixes(
    path: SmoothPath,
    times_s: ArrayLike,
    start_ns: int,
    sigma_m: float,
    rng: np.random.Generator,
    origin: GeodeticPoint | None = None,
) -> tuple[GpsFix, ...]:
    """Return fixes of the IMU's position (east, north, up) with white noise. The antenna is at the IMU.

    Args:
        path: of the IMU.
        times_s: ``(N,)`` times of the fixes.
        start_ns: stamp of time zero.
        sigma_m: standard deviation on each axis.
        rng: of the noise.
        origin: geodetic position of the path's origin, or None.
    """
    times = np.asarray(times_s, dtype=np.float64)
    positions = path.poses(times)[:, :3, 3]
    positions = positions + sigma_m * rng.standard_normal(positions.shape)
    stamps = start_ns + np.round(times * NS_PER_S).astype(np.int64)
    return tuple(GpsFix(int(t), p, np.eye(3) * sigma_m**2, origin) for t, p in zip(stamps, positions, strict=True))


def gps_csv(fixes: tuple[GpsFix, ...]) -> str:
    """Format fixes as CSV: ``stamp_ns,east,north,up,sigma``; with an origin also ``latitude,longitude,height``."""
    known = bool(fixes) and fixes[0].origin is not None
    rows = ["stamp_ns,east,north,up,sigma" + (",latitude,longitude,height" if known else "")]
    for fix in fixes:
        values = [f"{fix.stamp_ns}", *(f"{v:.6f}" for v in fix.position_m), f"{np.sqrt(fix.covariance_m2[0, 0]):.6f}"]
        if fix.origin is not None:
            latitude, longitude, height = geodetic_from_enu([fix.position_m], fix.origin)[0]
            values += [f"{latitude:.11f}", f"{longitude:.11f}", f"{height:.6f}"]
        rows.append(",".join(values))
    return "\n".join(rows) + "\n"
