"""What crosses between the parts: relative poses with covariances, the state, and the three seams' protocols.

An initial-pose source and a residual source each answer with a :class:`RelativePose`; the backend takes it and answers
with a :class:`State`. Nothing else crosses, so any implementation of a seam goes with any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.covariance import check_covariance
from hybridlio.core.sensors import Frame


@dataclass(frozen=True, eq=False)
class EarlierScanPose:
    """Where a scan is relative to an earlier scan than the last one.

    Attributes:
        stamp_ns: the earlier scan's.
        pose: ``T_j_k`` ``(4, 4)``, lidar frames.
        covariance: ``(6, 6)``, rad² and m², rotation first, of a right perturbation. Beside a step with ``drift`` it is
            of the pair's own error: the scans' scatter, which all their relative poses share, comes from their steps.
    """

    stamp_ns: int
    pose: Array
    covariance: Array

    def __post_init__(self) -> None:
        name = f"pose relative to the scan at {self.stamp_ns} ns"
        object.__setattr__(self, "pose", se3.check_pose(self.pose, name))
        object.__setattr__(self, "covariance", check_covariance(self.covariance, name))


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Where scan k+1 is relative to scan k, and how sure that is.

    Attributes:
        pose: ``T_k_k1`` ``(4, 4)``, lidar frames.
        covariance: ``(6, 6)``, rad² and m², rotation first, of a right perturbation ``T·Exp(ξ)``.
        source: who says so, such as ``preintegration`` or ``scan-matching``.
        degenerate: ``(D, 6)`` unit tangent directions that the measurement does not constrain; often empty.
        ok: False where the source failed and only bridges (the covariance is then wide).
        drift: ``(6, 6)``, what of the covariance adds up over consecutive steps; the rest is scatter about a map that
            the next step takes back. None where the steps' errors are independent, so that all of it adds up.
        from_imu: whether the pose is the inertial data's; a graph that has the IMU itself must not count it twice.
        proposed: ``(4, 4)``, of an initial pose: where else a residual source may start, if it finds that to be better.
        earlier_scans: the same scan k+1 relative to earlier scans than k, from a source that looks at several.
        details: the source's own diagnostics by name (inliers, iterations, error …).
    """

    pose: Array
    covariance: Array
    source: str
    degenerate: Array = field(default_factory=lambda: np.empty((0, 6)))
    ok: bool = True
    from_imu: bool = False
    drift: Array | None = None
    proposed: Array | None = None
    earlier_scans: tuple[EarlierScanPose, ...] = ()
    details: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", se3.check_pose(self.pose, f"{self.source}: relative pose"))
        object.__setattr__(self, "covariance", check_covariance(self.covariance, f"{self.source}: relative pose"))
        if self.proposed is not None:
            object.__setattr__(self, "proposed", se3.check_pose(self.proposed, f"{self.source}: proposed pose"))
        if self.drift is not None:
            object.__setattr__(self, "drift", check_covariance(self.drift, f"{self.source}: drift"))
            if self.ok:  # else the pose bridges, and its covariance is no part of the path's
                check_covariance(self.covariance - self.drift, f"{self.source}: covariance less drift")

    @property
    def translation_sigma_m(self) -> float:
        """How unsure the translation is, along all axes together."""
        return float(np.sqrt(self.covariance[3:, 3:].trace()))

    def wider(self, times: float = 1.0, added: Array | None = None) -> RelativePose:
        """The same poses, less sure.

        Args:
            times: by which every covariance grows.
            added: ``(6, 6)`` to add to the step's covariance; it does not add up over steps. Added to
                ``earlier_scans`` as well where they do not share the scatter of the step.
        """
        extra: Array = np.zeros((6, 6)) if added is None else added
        shared = self.drift is not None
        return replace(
            self,
            covariance=times * self.covariance + extra,
            drift=None if self.drift is None else times * self.drift,
            earlier_scans=tuple(
                replace(k, covariance=times * k.covariance + (0 if shared else extra)) for k in self.earlier_scans
            ),
        )


@dataclass(frozen=True, eq=False)
class State:
    """The backend's estimate at one scan. World is the IMU's pose at the first scan.

    Attributes:
        stamp_ns: the scan's stamp.
        T_world_imu: ``(4, 4)``.
        velocity_m_s: ``(3,)`` of the IMU, in world.
        accel_bias_m_s2, gyro_bias_rad_s: ``(3,)`` each.
        gravity_m_s2: ``(3,)`` in world; near (0, 0, -9.81) where the IMU started level.
        covariance: ``(15, 15)`` of rotation, position (right perturbation of ``T_world_imu``), velocity, accelerometer
            bias, gyroscope bias.
        gravity_covariance: ``(3, 3)``, (m/s²)².
        has_imu: False where no inertial data informs the state; all but the pose is then meaningless.
    """

    stamp_ns: int
    T_world_imu: Array
    velocity_m_s: Array
    accel_bias_m_s2: Array
    gyro_bias_rad_s: Array
    gravity_m_s2: Array
    covariance: Array
    gravity_covariance: Array
    has_imu: bool = True


class InitialPoseSource(Protocol):
    """Where is this scan relative to the last, before looking at the scans?"""

    name: str

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Predict ``T_k_k1``, from the scan that ``state`` is at to ``frame``."""
        ...

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Learn what the step to ``frame`` turned out to be."""
        ...


class ResidualSource(Protocol):
    """How far off was the initial pose, looking at both scans?"""

    name: str

    def start(self, frame: Frame) -> None:
        """Take the first scan."""
        ...

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """The refined ``T = δT·T̂`` with its covariance; ``δT`` is ``T @ inverse(T̂)``."""
        ...


@runtime_checkable
class TakesBack(Protocol):
    """A residual source that can be told that its last answer was not believed; to be so is each source's choice."""

    def take_back(self, initial: RelativePose) -> None:
        """Go on as if the last scan had failed and ``initial`` bridged it."""
        ...


class Backend(Protocol):
    """What does everything together say?"""

    name: str

    def start(self, state: State) -> None:
        """Take the first scan's state as prior, with its covariance."""
        ...

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Add the step to ``frame`` and return the state there."""
        ...

    def last_step(self) -> RelativePose:
        """The step to the current scan as the backend now sees it, lidar frames."""
        ...
