"""Measurements of a pose's position on Earth, direction, velocity and inertial data that users add to a pose graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.geodesy import GeodeticPoint, check_geodetic, enu_from_geodetic
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CalibrationNames
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Kind, factor_label
from hybridlio.graph.model.new_factors import check_direction, gps_factor, imu_factor, vector_factor
from hybridlio.graph.model.noise import NoiseInput, RobustLike

_STANDING_SIGMA_M_S = 0.01  # of a standing vehicle: it sways on its springs by millimetres in a second


class BodyMeasurements:
    """The part of a pose graph in space that measures bodies against the world; each call returns the factor's id."""

    def __init__(self, dimension: co.Dimension) -> None:
        self._data = GraphData(dimension)

    @property
    def origin(self) -> GeodeticPoint | None:
        """Place on Earth of world's origin, whose axes then are east, north and up; None until it is set."""
        return self._data.origin

    def set_origin(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> None:
        """Set world's origin on Earth (WGS 84; metres above the ellipsoid); it cannot change, as fixes depend on it."""
        self._data.set_origin(check_geodetic(latitude_deg, longitude_deg, altitude_m, "origin"))

    def add_gps(
        self, key: Key, position_m: ArrayLike, sigmas: ArrayLike | None = None, lever_arm_m: ArrayLike | None = None, *,
        covariance: ArrayLike | None = None, robust: RobustLike = None, calibration: CalibrationNames = (),
    ) -> int:  # fmt: skip
        """Add the antenna's position in world.

        Args:
            key: of a pose that the graph has.
            position_m: ``(3,)``, in a planar graph ``(2,)``.
            sigmas, covariance: exactly one of them.
            lever_arm_m: the antenna in the body frame, ``(3,)`` or ``(2,)``; zero by default.
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.
            calibration: names of variables ``lever_arm`` and ``time_offset`` (:meth:`add_calibration`), which take the
                place of ``lever_arm_m`` and of equal clocks. The offset moves the antenna by the pose's velocity.
        """
        noise = NoiseInput(covariance, sigmas=sigmas)
        return self._data.add_factor(gps_factor(self._data, key, (position_m, lever_arm_m), noise, robust, calibration))

    def add_gps_geodetic(  # noqa: PLR0913  (the three coordinates of a place, as GPS receivers give them)
        self, key: Key, latitude_deg: float, longitude_deg: float, altitude_m: float, sigmas: ArrayLike | None = None,
        lever_arm_m: ArrayLike | None = None, *, covariance: ArrayLike | None = None, robust: RobustLike = None,
        calibration: CalibrationNames = (),
    ) -> int:  # fmt: skip
        """Add the antenna's place on Earth; world is east, north, up at ``origin``, which is the first fix if not set.

        Args:
            key: of a pose that the graph has.
            latitude_deg, longitude_deg, altitude_m: on WGS 84, metres above the ellipsoid (not above sea level).
            sigmas, covariance: exactly one of them, of east, north, up in metres.
            lever_arm_m, robust, calibration: as in :meth:`add_gps`.
        """
        label = factor_label("gps", (key,))
        self._data.require_space(label)
        point = check_geodetic(latitude_deg, longitude_deg, altitude_m, label)
        origin = self.origin or point
        position = enu_from_geodetic([point], origin)[0]
        number = self.add_gps(
            key, position, sigmas, lever_arm_m, covariance=covariance, robust=robust, calibration=calibration
        )
        self._data.origin = origin
        return number

    def add_attitude(
        self, key: Key, direction_world: ArrayLike, direction_body: ArrayLike, sigma_rad: float,
        robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add a direction known in world and measured in the body frame, ``(3,)`` each, of any length but zero."""
        for direction in (direction_world, direction_body):
            check_direction(direction, factor_label("attitude", (key,)))
        vectors, noise = (direction_world, direction_body), NoiseInput(sigmas=sigma_rad)
        return self._add_vectors("attitude", key, vectors, noise, robust)

    def add_gravity(self, key: Key, accel_m_s2: ArrayLike, sigma_rad: float, robust: RobustLike = None) -> int:
        """Add roll and pitch from an accelerometer at rest or in steady motion, whose specific force points up."""
        return self.add_attitude(key, co.UP, accel_m_s2, sigma_rad, robust)

    def add_velocity(self, key: Key, velocity_m_s: ArrayLike, sigmas: ArrayLike, robust: RobustLike = None) -> int:
        """Add the body's velocity ``(3,)`` in world."""
        return self._add_vectors("velocity", key, (velocity_m_s,), NoiseInput(sigmas=sigmas), robust)

    def add_zero_velocity(self, key: Key, sigma_m_s: float = _STANDING_SIGMA_M_S) -> int:
        """Add that the body stands still."""
        return self.add_velocity(key, np.zeros(3), sigma_m_s)

    def add_bias(self, key: Key, accel_m_s2: ArrayLike, gyro_rad_s: ArrayLike, sigmas: ArrayLike) -> int:
        """Add the IMU's biases, ``(3,)`` each; ``sigmas`` are six, accelerometer first.

        A chain of inertial factors without one starts from biases of zero, with the sigmas of its :class:`ImuNoise`.
        """
        return self._add_vectors("bias", key, (accel_m_s2, gyro_rad_s), NoiseInput(sigmas=sigmas))

    def add_imu(
        self, i: Key, j: Key, samples: ImuSamples, noise: ImuNoise | None = None, *, calibration: CalibrationNames = ()
    ) -> int:  # fmt: skip
        """Add two or more raw samples, the first at pose i, the last at pose j; brings both velocities and biases.

        ``calibration`` names variables ``bias``, which takes the place of walking biases, and ``gravity``, which takes
        that of −z (:meth:`add_calibration`).
        """
        noise = ImuNoise() if noise is None else noise
        return self._data.add_factor(imu_factor(self._data, (i, j), samples, noise, calibration))

    def _add_vectors(
        self, kind: Kind, key: Key, vectors: tuple[ArrayLike, ...], noise: NoiseInput, robust: RobustLike = None
    ) -> int:
        return self._data.add_factor(vector_factor(self._data, kind, key, vectors, noise, robust))
