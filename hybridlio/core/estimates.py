"""What passes between the parts of odometry: relative poses, the state, and the protocols of the three seams.

One step goes through three seams, each of which answers one question:

* :class:`InitialPoseSource`: where is this scan relative to the last one, before the scans are compared?
* :class:`ResidualSource`: how far off was that, by the two scans?
* :class:`Backend`: what is the state, given all measurements so far?

The two sources answer with a :class:`RelativePose`; the backend takes it and answers with a :class:`State`. Nothing
else passes between them, so every implementation of one seam works with every implementation of the others. To use an
implementation of your own, pass an object with the methods of the protocol to :class:`hybridlio.Odometry`; it needs no
base class.

Frames: ``T_a_b`` maps points of frame b into frame a. Tangent vectors and covariances have rotation first, and belong
to right perturbations ``T·Exp(ξ)``, as in GTSAM.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.covariance import check_covariance
from hybridlio.core.sensors import Calibration, Frame


@dataclass(frozen=True, eq=False)
class EarlierScanPose:
    """Pose of a scan relative to an earlier scan than the last one.

    Attributes:
        stamp_ns: stamp of the earlier scan j.
        pose: ``T_j_k`` ``(4, 4)``, lidar frames.
        covariance: ``(6, 6)``, rad² and m². If the step that it belongs to has ``drift``, this is the error of the pair
            alone: the scatter of both scans, which all their relative poses share, comes from the steps to them.

    Raises:
        DataError: the pose is not rigid, or the covariance not positive definite.
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
    """Pose of scan k+1 relative to scan k, with its uncertainty: the step between two scans.

    ``RelativePose(pose, covariance, "my-source")`` is all that a source has to return. The other attributes tell the
    graph how errors of different steps depend on each other.

    Attributes:
        pose: ``T_k_k1`` ``(4, 4)``, lidar frames.
        covariance: ``(6, 6)``, rad² and m², rotation first, of a right perturbation.
        source: name of the source, such as ``preintegration`` or ``scan-matching``.
        degenerate: ``(D, 6)`` unit tangent vectors that the measurement does not constrain; usually none.
        ok: False if the source failed and the pose only bridges the step; the covariance is then large.
        drift: ``(6, 6)`` part of the covariance that adds up over consecutive steps. The rest is scatter about a map,
            which the next step takes back. None if steps have independent errors, so that all of it adds up.
        from_imu: whether the pose comes from inertial data. A graph that uses the IMU itself must not count it twice.
        proposed: ``(4, 4)`` in an initial pose, another pose to start at, which a source may use if it fits better.
        earlier_scans: poses of scan k+1 relative to scans before k, from a source that compares several.
        details: diagnostics of the source by name, such as inliers and iterations. Records do not keep them.

    Raises:
        DataError: a pose is not rigid, a covariance is not positive definite, or ``drift`` exceeds ``covariance``.
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
            if self.ok:  # the covariance of a bridge is not the path's, so its drift may exceed it
                check_covariance(self.covariance - self.drift, f"{self.source}: covariance less drift")

    @property
    def translation_sigma_m(self) -> float:
        """Standard deviation of the translation, all axes together."""
        return float(np.sqrt(self.covariance[3:, 3:].trace()))

    def wider(self, times: float = 1.0, added: Array | None = None) -> RelativePose:
        """Return the same poses with larger covariances.

        Args:
            times: factor on every covariance.
            added: ``(6, 6)`` to add to the step's covariance afterwards, but not to its drift. It is added to
                ``earlier_scans`` too, unless their covariances exclude the scatter of the step.
        """
        extra: Array = np.zeros((6, 6)) if added is None else added
        has_own_scatter = self.drift is None
        return replace(
            self,
            covariance=times * self.covariance + extra,
            drift=None if self.drift is None else times * self.drift,
            earlier_scans=tuple(
                replace(earlier, covariance=times * earlier.covariance + (extra if has_own_scatter else 0))
                for earlier in self.earlier_scans
            ),
        )


@dataclass(frozen=True, eq=False)
class State:
    """The backend's estimate at one scan. World is the IMU's pose at the first scan.

    Attributes:
        stamp_ns: stamp of the scan.
        T_world_imu: ``(4, 4)`` pose of the IMU.
        velocity_m_s: ``(3,)`` velocity of the IMU, in world.
        accel_bias_m_s2, gyro_bias_rad_s: ``(3,)`` each, in the IMU frame.
        gravity_m_s2: ``(3,)`` in world; near (0, 0, -9.81) if the IMU was level at the start.
        covariance: ``(15, 15)`` of rotation, position (right perturbation of ``T_world_imu``), velocity, accelerometer
            bias and gyroscope bias, in this order.
        gravity_covariance: ``(3, 3)``, (m/s²)².
        has_imu: False if no inertial data has entered the state; only the pose is then meaningful.
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

    def up_in_lidar(self, calibration: Calibration) -> Array:
        """Return the direction ``(3,)`` of up in the frame of the lidar at the state's stamp, of length 1."""
        R_world_lidar = self.T_world_imu[:3, :3] @ calibration.T_imu_lidar[:3, :3]
        return np.asarray(R_world_lidar.T @ -self.gravity_m_s2 / np.linalg.norm(self.gravity_m_s2))


class InitialPoseSource(Protocol):
    """First seam: predicts each step before its scans are compared.

    Implementations: :mod:`hybridlio.sources.constant_velocity`, :mod:`hybridlio.sources.kalman`, and by names of
    :data:`hybridlio.odometry.registry.INITIAL_POSE_SOURCES` preintegration and the LSTM.

    Called once a step: ``predict``, then, if a residual source has measured the step, ``correct``.

    Attributes:
        name: goes into ``RelativePose.source``, tables and files.
    """

    name: str

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Return ``T_k_k1``, the motion from scan k, where ``state`` is, to scan k+1 in ``frame``.

        Its covariance matters: it decides how widely the residual source searches. If it comes from inertial data,
        set ``from_imu``.
        """
        ...

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Learn from the step to ``frame`` as the backend estimates it; do nothing if there is nothing to learn."""
        ...


class ResidualSource(Protocol):
    """Second seam: corrects each initial pose by comparing scans.

    Implementations: :mod:`hybridlio.sources.scan_matching`, :mod:`hybridlio.sources.residual_chain`, and by names of
    :data:`hybridlio.odometry.registry.RESIDUAL_SOURCES` the network.

    Called once for the first scan: ``start`` (at start-up twice or more, the later calls with a scan that is
    compensated better); then once a step: ``refine``. Scans come compensated for motion.

    Attributes:
        name: goes into ``RelativePose.source``, tables and files.
    """

    name: str

    def start(self, frame: Frame) -> None:
        """Take the first scan and forget everything before it.

        Raises:
            DataError: the scan is unusable. The run then tries to start at the next one.
        """
        ...

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return the corrected step ``T = δT·T̂`` with its covariance, where ``T̂`` is the initial pose.

        If the scan cannot be used, return the initial pose with ``ok`` False rather than raise an error.
        """
        ...


@runtime_checkable
class TakesBack(Protocol):
    """A residual source that keeps a map or path and can discard its last answer. Implementing it is optional."""

    def take_back(self, initial: RelativePose) -> None:
        """Continue as if the last scan had failed and ``initial`` had bridged it.

        Called when the innovation gate rejects the answer, so that a wrong scan does not enter the map.
        """
        ...


@runtime_checkable
class RefinesAgain(Protocol):
    """A residual source that can measure its last scan again, compensated otherwise. Implementing it is optional."""

    def refine_again(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return what ``refine`` would return for the frame in place of the last one, which must have been usable."""
        ...


class Backend(Protocol):
    """Third seam: combines all relative poses and inertial data into the state.

    Implementations: :mod:`hybridlio.sources.dead_reckoning`, and by names of
    :data:`hybridlio.odometry.registry.BACKENDS` those with a factor graph.

    Called once: ``start`` (again if an IMU starts late, with all steps after it); then once a step: ``update``, then
    ``last_step``.

    Attributes:
        name: goes into tables and files.
    """

    name: str

    def start(self, state: State) -> None:
        """Take the state at the first scan as prior, with its covariance, and forget everything before it."""
        ...

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Add the step to ``frame``, with the frame's inertial samples, and return the state there.

        If ``relative.ok`` is False and there are samples, these bridge the step.

        Raises:
            GraphError: the estimation failed.
        """
        ...

    def last_step(self) -> RelativePose:
        """Return the step to the current scan as now estimated, lidar frames."""
        ...
