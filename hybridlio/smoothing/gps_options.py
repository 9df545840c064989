"""GPS in smoothing: how fixes are used, and the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.setting_checks import check_not_negative, check_setting
from hybridlio.smoothing.gps_alignment import MAX_SHIFT_S

_REJECTED_WEIGHT = 0.1  # a fix of lower weight is listed as rejected; Cauchy gives it at 8.4 standard deviations


@dataclass(frozen=True, eq=False)
class GpsOptions:
    """How fixes are used.

    Attributes:
        antenna_m: ``(3,)`` the antenna in the IMU's frame; None takes the calibration's, or else the IMU's origin.
        max_shift_s: largest difference of the clocks, also the standard deviation of the shift's prior; 0 takes the
            stamps as they are.
        outages: pairs ``(start_ns, end_ns)``; fixes stamped within are left out.
        robust: method against wrong fixes: a kernel's name, ``gnc``, or None for no method.

    Raises:
        SettingError: an antenna of not three finite numbers, a negative shift, or an outage that ends before it starts.
    """

    antenna_m: Array | None = None
    max_shift_s: float = MAX_SHIFT_S
    outages: Sequence[tuple[int, int]] = ()
    robust: str | None = "cauchy"

    def __post_init__(self) -> None:
        where = np.zeros(3) if self.antenna_m is None else np.asarray(self.antenna_m)
        check_setting(self, "antenna_m", where.shape == (3,) and bool(np.isfinite(where).all()), "three finite numbers")
        check_not_negative(self, "max_shift_s")
        check_setting(self, "outages", all(a <= b for a, b in self.outages), "pairs of start and end, in this order")


@dataclass(frozen=True, eq=False)
class GpsFit:
    """The result of using fixes in smoothing.

    Attributes:
        T_enu_world: ``(4, 4)``; maps points of the first scan's lidar frame into the frame of the fixes.
        T_enu_world_covariance: ``(6, 6)`` of a right perturbation.
        shift_s, shift_sigma_s: a fix stamped ``t`` is of the antenna at ``t + shift_s``; standard deviation of that.
        residuals_m: ``(M, 3)`` smoothed antenna minus fix; NaN for fixes that are not used.
        used: ``(M,)`` whether the fix lies in the run's time and in no outage.
        weights: ``(M,)`` weight of each fix, 0 to 1; 0 for fixes that are not used.
        noise_scale: factor on the claimed standard deviations of the fixes, from their scatter; at least 1.
        antenna_m: ``(3,)`` the antenna in the IMU's frame, as stated or calibrated.
    """

    T_enu_world: Array
    T_enu_world_covariance: Array
    shift_s: float
    shift_sigma_s: float
    residuals_m: Array
    used: Mask
    weights: Array
    noise_scale: float
    antenna_m: Array

    @property
    def rejected(self) -> Mask:
        """``(M,)`` used fixes whose weight is below a tenth."""
        return self.used & (self.weights < _REJECTED_WEIGHT)

    @property
    def rmse_m(self) -> float:
        """Root mean square distance to the used fixes that are not rejected; NaN if there are none."""
        kept = self.residuals_m[self.used & ~self.rejected]
        return float(np.sqrt((kept**2).sum(axis=1).mean())) if len(kept) else float("nan")

    @property
    def is_doubtful(self) -> bool:
        """Whether most used fixes are rejected; then the others may be wrong as well."""
        return bool(2 * self.rejected.sum() > self.used.sum())

    def to_json_dict(self) -> dict[str, Any]:
        """Return the figures as plain values; the RMSE of no fix is None."""
        return {
            "fixes": len(self.used),
            "used": int(self.used.sum()),
            "rejected": np.flatnonzero(self.rejected).tolist(),
            "rmse_m": None if np.isnan(self.rmse_m) else self.rmse_m,
            "shift_s": self.shift_s,
            "shift_sigma_s": self.shift_sigma_s,
            "noise_scale": self.noise_scale,
            "antenna_m": self.antenna_m.tolist(),
            "T_enu_world": self.T_enu_world.tolist(),
        }

    def summary(self) -> str:
        """Return the figures on one line."""
        shift = f"clock shift {1e3 * self.shift_s:.0f} ± {1e3 * self.shift_sigma_s:.0f} ms"
        scale = f", claimed standard deviations scaled by {self.noise_scale:.1f}" if self.noise_scale > 1 else ""
        count = int((self.used & ~self.rejected).sum())
        return (
            f"{count} of {len(self.used)} fixes used, {int(self.rejected.sum())} rejected, "
            f"{self.rmse_m:.2f} m RMSE, {shift}{scale}"
        )
