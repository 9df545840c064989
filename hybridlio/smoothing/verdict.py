"""The verdict on a smoothing: how well each kind of measurement fits the result, and what a bad fit usually means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from hybridlio.core.tables import counted

ODOMETRY, IMU = "odometry", "IMU"
# χ² per component that is doubtful: residuals of 1.4 standard deviations. It is below 1 where all covariances are
# right, as the poses are fitted to the residuals.
_DOUBTFUL = 2.0
# χ² per degree of freedom, so residuals of two standard deviations on average: odometry and IMU contradict each other.
# KITTI 00 with KISS-ICP's odometry and its IMU has 0.4 with right clocks, and 8 or more with clocks 521 ms apart.
_CONTRADICTING = 4.0
_WORST = 3  # named of each kind
# 12 components of odometry, to the path and to the scan, and 15 of the IMU, for two poses, a velocity and biases
_REDUNDANCY = 27 - 21
_MEANINGS = {
    ODOMETRY: "the odometry's covariances are too small, or another measurement contradicts it: check the IMU's clock, "
    "units and T_imu_lidar",
    IMU: "the IMU contradicts the odometry: check its clock, units and T_imu_lidar, or raise imu_noise",
    "gps": "the fixes scatter more than they claim, or their antenna or clock is wrong: see --antenna and --max-shift",
    "wheels": "wheels slip, or their radius, their clock or the axes of T_imu_lidar are wrong",
    "loops": "wrong loops, or odometry that drifts more than its covariances: try --robust gnc",
}


@dataclass(frozen=True)
class KindFit:
    """How measurements of one kind fit.

    Attributes:
        kind: ``odometry``, ``IMU``, or the name of a group such as ``gps`` or ``loops``.
        measurements: their number, without rejected ones.
        components: number of components of their residuals.
        chi2: sum of their squared whitened residuals.
        worst: names of the worst measurements, each with its χ² per component.
    """

    kind: str
    measurements: int
    components: int
    chi2: float
    worst: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, kind: str, fits: Sequence[tuple[str, float, int]]) -> KindFit:
        """Return the fit of measurements, each with its name, χ² and number of components."""
        ranked = sorted(((name, chi2 / size) for name, chi2, size in fits), key=lambda one: -one[1])
        sizes, chi2s = [size for _, _, size in fits], [chi2 for _, chi2, _ in fits]
        return cls(kind, len(fits), sum(sizes), float(sum(chi2s)), tuple(ranked[:_WORST]))

    @property
    def ratio(self) -> float:
        """χ² per component; at most 1 where covariances are right."""
        return self.chi2 / max(self.components, 1)

    @property
    def is_doubtful(self) -> bool:
        """Whether the measurements fit worse than their covariances say."""
        return self.ratio > _DOUBTFUL

    def __str__(self) -> str:
        return f"{self.kind} {self.ratio:.2g} ({counted(self.measurements, 'measurement')})"


@dataclass(frozen=True)
class Verdict:
    """The verdict on a smoothing.

    Attributes:
        kinds: the fit of each kind of measurement.
        refused: the solution contradicts the odometry, with nothing but the IMU against it; the smoothed trajectory is
            the odometry's own.
    """

    kinds: tuple[KindFit, ...]
    refused: bool = False

    @classmethod
    def of(cls, kinds: Sequence[KindFit]) -> Verdict:
        """Judge the kinds; further groups, such as GPS, may rightly contradict an odometry."""
        found = cls(tuple(kind for kind in kinds if kind.measurements))
        alone = {kind.kind for kind in found.kinds} == {ODOMETRY, IMU}
        return replace(found, refused=alone and found._contradicts_odometry)

    @property
    def _contradicts_odometry(self) -> bool:
        """Whether odometry and IMU do not fit, and odometry has more than all of the χ² that both may have."""
        (odometry,) = (kind for kind in self.kinds if kind.kind == ODOMETRY)
        share = odometry.chi2 / (odometry.chi2 + sum(kind.chi2 for kind in self.kinds if kind.kind == IMU))
        return self.variance_factor > _CONTRADICTING and share * self.variance_factor > 1.0

    @property
    def doubts(self) -> tuple[str, ...]:
        """What does not fit, the worst measurements, and what that usually means."""
        out = (
            ["refused: the solution contradicts its own odometry; the odometry's poses are kept"]
            if self.refused
            else []
        )
        for kind in self.kinds:
            if kind.is_doubtful:
                named = ", ".join(f"{name} ({ratio:.0f})" for name, ratio in kind.worst)
                meaning = _MEANINGS.get(kind.kind, "its measurements are wrong, or their covariances too small")
                out.append(f"{kind.kind}: χ² per component is {kind.ratio:.1f}; worst: {named}. Usually {meaning}")
        return tuple(out)

    @property
    def variance_factor(self) -> float:
        """χ² of odometry and IMU per degree of freedom: 1 where their covariances are right, less where too large.

        A step with samples has :data:`_REDUNDANCY` components more than variables. 1 without such steps.
        """
        known = {kind.kind: kind for kind in self.kinds}
        if not known.keys() >= {ODOMETRY, IMU}:
            return 1.0
        return (known[ODOMETRY].chi2 + known[IMU].chi2) / (_REDUNDANCY * known[IMU].measurements)

    def summary(self) -> str:
        """Return χ² per component by kind, in one line."""
        return f"χ² per component: {', '.join(map(str, self.kinds))}"

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content for ``metrics.json``."""
        kinds = {
            kind.kind: {
                "measurements": kind.measurements,
                "chi2": kind.chi2,
                "chi2_per_component": kind.ratio,
                "worst": dict(kind.worst),
            }
            for kind in self.kinds
        }
        return {"refused": self.refused, "doubts": list(self.doubts), "kinds": kinds}
