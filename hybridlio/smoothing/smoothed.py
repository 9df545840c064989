"""The result of smoothing a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import Trajectory
from hybridlio.smoothing.verdict import Verdict


@dataclass(frozen=True, eq=False, repr=False)
class Smoothed:
    """A smoothed run.

    Attributes:
        trajectory: ``N`` lidar poses in the first scan's frame, with covariances ``(N, 6, 6)``.
        step_covariances: ``(N-1, 6, 6)`` of the relative poses between consecutive scans.
        velocities_m_s: ``(N, 3)`` of the IMU, in the frame of its first pose; meaningless without IMU.
        accel_biases_m_s2, gyro_biases_rad_s: ``(N, 3)`` each; meaningless without IMU.
        gravity_m_s2: ``(3,)`` in the frame of the IMU's first pose.
        error_before, error_after: half the sum of squared, whitened residuals at the online estimate and at the
            solution.
        iterations: Levenberg-Marquardt iterations of the last round.
        converged: whether the error stopped falling within the allowed iterations.
        found: results of the further measurements, by the name of their group: ``loops``
            (:class:`hybridlio.smoothing.loops.ClosedLoops`), ``gps``
            (:class:`hybridlio.smoothing.gps_options.GpsFit`).
        verdict: how well each kind of measurement fits. If it is refused, trajectory and step covariances are those of
            the odometry.
        imu_time_offset_s: seconds that were added to the IMU's stamps before, to bring them to the poses' clock.
        notes: what was corrected in the data, such as a clock, and what is doubtful there.
    """

    trajectory: Trajectory
    step_covariances: Array
    velocities_m_s: Array
    accel_biases_m_s2: Array
    gyro_biases_rad_s: Array
    gravity_m_s2: Array
    error_before: float
    error_after: float
    iterations: int
    converged: bool
    found: dict[str, Any] = field(default_factory=dict)
    verdict: Verdict = field(default_factory=lambda: Verdict(()))
    imu_time_offset_s: float = 0.0
    notes: tuple[str, ...] = ()

    def summary(self) -> str:
        """Return some lines: what was corrected, how each kind of measurement fits, and what is doubtful."""
        found = [f"{name}: {result.summary()}" for name, result in self.found.items() if _has_summary(result)]
        doubts = [f"doubtful: {doubt}" for doubt in self.verdict.doubts]
        calibrated = self.found.get("calibration")
        doubts += [] if calibrated is None else list(calibrated.doubts)
        doubts += [] if self.converged else ["stopped at the limit of iterations, before it converged"]
        return "\n".join([*self.notes, *found, self.verdict.summary(), *doubts])

    def __repr__(self) -> str:
        end = "converged" if self.converged else "not converged"
        found = "".join(f", {name}: {result.summary()}" for name, result in self.found.items() if _has_summary(result))
        return (
            f"Smoothed({len(self.trajectory)} poses, {self.trajectory.length_m:.1f} m, error "
            f"{self.error_before:.4g} -> {self.error_after:.4g}, {end} after {self.iterations} iterations{found})"
        )


def _has_summary(result: object) -> bool:
    """Whether a group's result can describe itself; a user's own group may return anything."""
    return callable(getattr(result, "summary", None))
