"""Calibration of sensors as variables of a pose graph, and measurements that depend on it."""

from __future__ import annotations

from collections.abc import Mapping

from numpy.typing import ArrayLike

from hybridlio.core.errors import GraphError, shown
from hybridlio.graph.landmark_measurements import check_free
from hybridlio.graph.model.calibrations import CalibrationKind, CalibrationNames, calibration_variable, chosen
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor, factor_label
from hybridlio.graph.model.new_factors import between_factor
from hybridlio.graph.model.noise import NoiseInput, RobustLike
from hybridlio.graph.user_factors import UserFactors

_OF_STEPS = ("extrinsics", "time_offset", "scale")


class CalibratedMeasurements(UserFactors):
    """The part of a pose graph that estimates how sensors are mounted, how their clocks differ, and their biases."""

    @property
    def calibrations(self) -> Mapping[str, CalibrationKind]:
        """Kind of each calibration variable by name, in the order they were added."""
        return {name: variable.kind for name, variable in self._data.calibrations.items()}

    def add_calibration(
        self, name: str, kind: CalibrationKind, stated: ArrayLike | None = None, sigmas: ArrayLike | None = None, *,
        covariance: ArrayLike | None = None,
    ) -> None:  # fmt: skip
        """Add a calibration variable, with what is known of it before as its prior; factors take it by its name.

        =============== ======================================= =============== ====================================
        kind            value                                   default         factors that take it
        =============== ======================================= =============== ====================================
        ``lever_arm``   antenna in the body frame ``(3,)``, m   zero            ``add_gps``
        ``time_offset`` s, added to a sensor's stamps           0               ``add_gps``, ``add_sensor_step``
        ``extrinsics``  ``T_body_sensor`` ``(4, 4)``            the identity    ``add_sensor_step``
        ``scale``       measured length over true length        1               ``add_sensor_step``
        ``bias``        accelerometer, gyroscope ``(6,)``       zero            ``add_imu``: constant biases
        ``gravity``     its direction in world ``(3,)``         −z              ``add_imu``
        =============== ======================================= =============== ====================================

        Only ``lever_arm`` ``(2,)``, ``extrinsics`` and ``scale`` may be in a planar graph.

        Args:
            name: of the variable.
            kind: one of the above.
            stated: its stated value.
            sigmas, covariance: exactly one of them, of the stated value; one number applies to all components.
                Extrinsics: of a right perturbation, rotation first, rad and m. ``gravity``: tilt in rad. Where the
                measurements do not determine a variable, this is what is known of it.

        Raises:
            GraphError: the name is in use, an unknown kind, or none or both of sigmas and covariance.
            DataError: a value of another shape, or noise that is not positive definite.
        """
        variable = calibration_variable(name, kind, stated, NoiseInput(covariance, sigmas=sigmas), self._data.dimension)
        if name in self._data.calibrations:
            raise GraphError(f"calibration variable {shown(name)} exists already")
        self._data.calibrations[name] = variable

    def add_sensor_step(
        self, i: Key, j: Key, T_i_j: ArrayLike, calibration: CalibrationNames, covariance: ArrayLike | None = None, *,
        sigmas: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add the motion of a sensor whose mounting, clock or scale is a variable; a new pose j is added.

        With extrinsics ``K``, body poses ``X``, clock offset ``δ`` and scale ``s`` the sensor's poses are
        ``S = X(t + δ)·K``, and ``T_i_j`` measures ``S_i⁻¹·S_j`` with its translation times ``s``. Over ``δ`` the body
        moves by its velocity, and turns as its inertial samples say; so a clock needs ``add_imu`` or velocities of both
        poses. An acceleration ``a`` leaves an error of ``a·δ²/2``: 2 mm for 20 ms at 10 m/s². A factor in Python: 50 to
        130 µs to linearise.

        Args:
            i, j: keys; the graph must have ``i``.
            T_i_j: ``(4, 4)``, the sensor's pose at ``j`` in its frame at ``i``.
            calibration: names of variables ``extrinsics``, ``time_offset``, ``scale``; one of each at most.
            covariance, sigmas, robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.

        Raises:
            DataError: as :meth:`~hybridlio.graph.PoseGraph.add_between`.
            GraphError: as there; no variable, an unknown one, or one of another kind.
        """
        plain = between_factor(self._data, (i, j), T_i_j, NoiseInput(covariance, sigmas=sigmas), robust)
        name = factor_label("sensor-step", plain.keys)
        names = chosen(self._data.calibrations, calibration, _OF_STEPS, name)
        if not names:
            raise GraphError(f"{name}: no calibration variable is given; without one use add_between")
        factor = Factor("sensor-step", plain.keys, plain.measured, plain.noise, plain.robust, calibration=names)
        if factor.keys[1] not in self._data:
            check_free(self._data, factor.keys[1], "pose")
            self._data.add_pose(factor.keys[1])
        return self._data.add_factor(factor)
