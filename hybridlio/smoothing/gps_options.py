"""How GPS fixes are used in smoothing, and what comes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.setting_checks import check_not_negative, check_setting
from hybridlio.smoothing.gps_alignment import MAX_SHIFT_S


@dataclass(frozen=True, eq=False)
class GpsOptions:
    """How fixes are used.

    Attributes:
        antenna_m: ``(3,)`` the antenna in the IMU's frame; None takes the calibration's, or the IMU's own place.
        max_shift_s: the clocks are no farther apart (also the shift's prior); 0 takes the stamps as they are.
        outages: times ``(start_ns, end_ns)`` whose fixes are left out.
        robust: how to treat those that may be wrong.

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
    """What smoothing found of the fixes.

    Attributes:
        T_enu_world: ``(4, 4)``; maps the first scan's lidar frame into the fixes'.
        T_enu_world_covariance: ``(6, 6)`` of a right perturbation.
        shift_s, shift_sigma_s: a fix stamped ``t`` shows the antenna at ``t + shift_s``, and how sure that is.
        residuals_m: ``(M, 3)`` the antenna as smoothed less the fix; NaN where the run does not reach.
        used: ``(M,)`` whether the run reaches, and the fix is in no outage.
        weights: ``(M,)`` what counts of each, 0 to 1; 0 of those not used.
        noise_scale: the fixes' standard deviations were taken so many times as large as they claim, as they scatter.
    """

    T_enu_world: Array
    T_enu_world_covariance: Array
    shift_s: float
    shift_sigma_s: float
    residuals_m: Array
    used: NDArray[np.bool_]
    weights: Array
    noise_scale: float

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """``(M,)`` used fixes that count for less than a tenth."""
        return self.used & (self.weights < 0.1)

    @property
    def rmse_m(self) -> float:
        """Root mean square distance from the fixes that are not rejected."""
        kept = self.residuals_m[self.used & ~self.rejected]
        return float(np.sqrt((kept**2).sum(axis=1).mean())) if len(kept) else float("nan")

    @property
    def is_doubtful(self) -> bool:
        """Whether most of the fixes that the run reaches are rejected: then the others may be wrong as well."""
        return bool(2 * self.rejected.sum() > self.used.sum())

    def to_json_dict(self) -> dict[str, Any]:
        """The figures as plain values; None for an RMSE of no fix."""
        return {
            "fixes": len(self.used),
            "used": int(self.used.sum()),
            "rejected": np.flatnonzero(self.rejected).tolist(),
            "rmse_m": None if np.isnan(self.rmse_m) else self.rmse_m,
            "shift_s": self.shift_s,
            "shift_sigma_s": self.shift_sigma_s,
            "noise_scale": self.noise_scale,
            "T_enu_world": self.T_enu_world.tolist(),
        }

    def summary(self) -> str:
        """One line."""
        shift = f"clocks {1e3 * self.shift_s:.0f} ± {1e3 * self.shift_sigma_s:.0f} ms apart"
        scale = f", fixes taken {self.noise_scale:.1f} times less sure than they claim" if self.noise_scale > 1 else ""
        count = int((self.used & ~self.rejected).sum())
        return (
            f"{count} of {len(self.used)} fixes used, {int(self.rejected.sum())} rejected, "
            f"{self.rmse_m:.2f} m RMSE, {shift}{scale}"
        )
