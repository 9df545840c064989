"""What a viewer shows of a run, whatever program draws it: scans one by one, then fixes, loops and other paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats, Mask, Stamps
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.sensors import Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.odometry.estimate import Estimate, InertialState

SUPPORTED, BRIDGED = "supported", "bridged"
# Shown as one point in n: a scan of 120,000 points at 10 Hz would be 14 MB a second, and looks the same at this size.
SHOWN_POINTS = 5000
MAP_EVERY_M = 4.0  # between the scans that make the map, as between loop keyframes
_PASSED = ("untested", "accepted")  # verdicts of the innovation gate after which the scan counts fully


@dataclass(frozen=True, eq=False)
class ViewedScan:
    """What is shown of one scan.

    Attributes:
        index, stamp_ns: the frame's.
        pose: ``(4, 4)`` lidar pose ``T_world_lidar``.
        covariance: ``(6, 6)`` of a right perturbation, rad² and m², rotation first.
        initial: ``(4, 4)`` the pose before the scans were compared, ``T_world_lidar``; None at the first scan.
        residual: ``(6,)`` ``Log δT``, by which comparing the scans moved it; rad, m.
        degenerate: ``(D, 6)`` directions that the scan leaves free, in the lidar frame.
        support: :data:`SUPPORTED`; :data:`BRIDGED` by the initial pose; or the innovation gate's other verdicts.
        nis: normalised innovation squared; NaN where untested.
        inertial: velocity and biases, or None.
    """

    index: int
    stamp_ns: int
    pose: Array
    covariance: Array
    initial: Array | None = None
    residual: Array = field(default_factory=lambda: np.zeros(6))
    degenerate: Array = field(default_factory=lambda: np.empty((0, 6)))
    support: str = SUPPORTED
    nis: float = float("nan")
    inertial: InertialState | None = None

    @classmethod
    def of_estimate(cls, estimate: Estimate, before: Array | None) -> ViewedScan:
        """Return what is shown of an estimate; ``before`` ``(4, 4)`` is the pose of the scan before."""
        initial, relative, gate = estimate.initial, estimate.relative, estimate.gate
        is_first = initial is None or relative is None or before is None
        return cls(
            estimate.index,
            estimate.stamp_ns,
            estimate.pose,
            estimate.covariance,
            None if is_first else before @ initial.pose,  # type: ignore[union-attr, operator]
            se3.log(estimate.residual),
            np.empty((0, 6)) if relative is None else relative.degenerate,
            support_of(gate.verdict, relative is None or relative.ok),
            float("nan") if gate.nis is None else gate.nis,
            estimate.inertial,
        )

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position, all axes together."""
        return float(np.sqrt(self.covariance[3:, 3:].trace()))

    @property
    def rotation_sigma_deg(self) -> float:
        """Standard deviation of the rotation, all axes together."""
        return float(np.rad2deg(np.sqrt(self.covariance[:3, :3].trace())))


def support_of(verdict: str, is_ok: bool) -> str:
    """Return the support of a scan by the innovation gate's verdict and by whether its pose was measured."""
    if verdict not in _PASSED:
        return verdict
    return SUPPORTED if is_ok else BRIDGED


@dataclass(frozen=True, eq=False)
class PlacedFixes:
    """GPS fixes in the trajectory's frame.

    Attributes:
        stamps_ns: ``(M,)`` on the trajectory's clock.
        positions_m: ``(M, 3)``.
        antennas_m: ``(M, 3)`` where the trajectory has the antenna then.
        residuals_m: ``(M, 3)`` antenna minus fix, east-north-up.
        sigmas_m: ``(M,)`` standard deviations of the fixes, all axes together.
        rejected: ``(M,)`` whether a fix is taken for wrong.
        T_enu_world: ``(4, 4)``.
        origin: of the fixes' frame on Earth, or None.
    """

    stamps_ns: Stamps
    positions_m: Array
    antennas_m: Array
    residuals_m: Array
    sigmas_m: Array
    rejected: Mask
    T_enu_world: Array
    origin: GeodeticPoint | None = None


class Scans(Protocol):
    """Where the points of scans come from."""

    def points(self, index: int) -> Floats | None:
        """Return points ``(N, 3)`` of a frame, lidar frame, motion compensated and thinned; None if unreadable."""
        ...


@dataclass(frozen=True, eq=False)
class Scene:
    """A finished run, to be shown.

    Attributes:
        name: the recording's.
        scans: one for each estimate, in order.
        clouds: points of the map by the row of their scan, lidar frame, in order.
        live: the points of every scan; None if they are left out.
        fixes: the GPS fixes, or None.
        loops: pairs of rows of scans that close a loop.
        paths: other trajectories by name, such as the reference, in the same frame.
        notes: what a viewer should know first, such as what was found in the data.
        left_out: what cannot be shown, and why.
    """

    name: str
    scans: tuple[ViewedScan, ...]
    clouds: tuple[tuple[int, Floats], ...] = ()
    live: Scans | None = None
    fixes: PlacedFixes | None = None
    loops: tuple[tuple[int, int], ...] = ()
    paths: dict[str, Trajectory] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def with_clouds(self) -> Iterator[tuple[ViewedScan, Floats | None, Floats | None]]:
        """Yield each scan with its points, and with the points that it adds to the map; None where it has none."""
        clouds = dict(self.clouds)
        for row, scan in enumerate(self.scans):
            yield scan, None if self.live is None else self.live.points(scan.index), clouds.get(row)


def thinned(scan: Scan, count: int = SHOWN_POINTS) -> Scan:
    """Return a scan with ``count`` points at most, spread evenly over its points."""
    if len(scan) <= count:
        return scan
    rows = np.linspace(0, len(scan) - 1, count).astype(np.intp)  # a whole number as step could pick one beam of many
    return replace(scan, intensity=None).part(rows)
