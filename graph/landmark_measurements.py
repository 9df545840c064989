"""Landmarks, and their measurements from poses, that users add to a pose graph."""

from __future__ import annotations

from numpy.typing import ArrayLike

from hybridlio.core.errors import GraphError
from hybridlio.graph.body_measurements import BodyMeasurements
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.new_factors import check_vector, observation_factor
from hybridlio.graph.model.noise import NoiseInput, RobustLike


class LandmarkMeasurements(BodyMeasurements):
    """The part of a pose graph that holds landmarks; poses and landmarks share one set of keys."""

    @property
    def landmarks(self) -> list[Key]:
        """Keys of all landmarks, in the order they were added."""
        return self._data.landmarks.keys

    def add_landmark(self, key: Key, initial: ArrayLike | None = None) -> None:
        """Add a landmark, a point ``(3,)`` in world, ``(2,)`` in the plane, with its initial value if it is known.

        Without one it starts where its observations place it.

        Raises:
            GraphError: a pose or a landmark has this key.
        """
        key = check_key(key)
        check_free(self._data, key, "landmark")
        point = None if initial is None else check_vector(initial, self._data.dimension, f"landmark {key}")
        self._data.landmarks.add(key, point)

    def add_point_observation(
        self, pose: Key, landmark: Key, point_m: ArrayLike, covariance: ArrayLike | None = None, *,
        information: ArrayLike | None = None, sigmas: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add a landmark's position in the frame of a pose and return the factor's id; a new landmark is added.

        It is solved as bearing and range, with the covariance propagated to first order, as GTSAM reads text files:
        the same as long as the noise is small against the range. Residuals are bearing (rad) and range (m).

        Args:
            pose: key of a pose that the graph has.
            landmark: key of the landmark.
            point_m: ``(3,)``, or ``(2,)`` in the plane; not zero.
            covariance, information, sigmas: exactly one of them, of the position, in the frame of the pose.
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.
        """
        noise = NoiseInput(covariance, information, sigmas)
        return self._observe(observation_factor(self._data, "point", (pose, landmark), (point_m,), noise, robust))

    def add_bearing_range(
        self, pose: Key, landmark: Key, bearing: ArrayLike, range_m: float, sigmas: ArrayLike,
        robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add a landmark's direction and distance from a pose and return the factor's id; a new landmark is added.

        Args:
            pose: key of a pose that the graph has.
            landmark: key of the landmark.
            bearing: in the frame of the pose: the angle from x to y in rad in the plane; in space a direction
                ``(3,)`` of any length but zero.
            range_m: the distance, positive.
            sigmas: standard deviations of the bearing (rad) and of the range (m); in space the first is that of both
                components of the direction, and three numbers give each its own, in GTSAM's basis of the direction.
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.
        """
        noise = NoiseInput(sigmas=sigmas)
        measured = (bearing, range_m)
        return self._observe(observation_factor(self._data, "bearing-range", (pose, landmark), measured, noise, robust))

    def add_range(self, pose: Key, landmark: Key, range_m: float, sigma_m: float, robust: RobustLike = None) -> int:
        """Add a landmark's distance from a pose alone, as a radio beacon gives it, and return the factor's id.

        A new landmark is added. It is placed by its other observations; where ranges alone allow several places, give
        one near it to :meth:`add_landmark`. An online solver needs another observation that places it first.

        Args:
            pose: key of a pose that the graph has.
            landmark: key of the landmark.
            range_m: the distance, positive.
            sigma_m: standard deviation.
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.
        """
        noise = NoiseInput(sigmas=sigma_m)
        return self._observe(observation_factor(self._data, "range", (pose, landmark), (range_m,), noise, robust))

    def add_bearing(
        self, pose: Key, landmark: Key, bearing: ArrayLike, sigma_rad: float, robust: RobustLike = None
    ) -> int:
        """Add a landmark's direction from a pose alone, as a camera gives it, and return the factor's id.

        A new landmark is added, and placed by its observations from other poses, as for :meth:`add_range`.

        Args:
            pose: key of a pose that the graph has.
            landmark: key of the landmark.
            bearing: as in :meth:`add_bearing_range`.
            sigma_rad: standard deviation; in space of both components of the direction.
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.
        """
        noise = NoiseInput(sigmas=sigma_rad)
        return self._observe(observation_factor(self._data, "bearing", (pose, landmark), (bearing,), noise, robust))

    def _observe(self, factor: Factor) -> int:
        assert factor.landmark is not None
        if factor.landmark not in self._data.landmarks:
            self._data.landmarks.add(factor.landmark)
        return self._data.add_factor(factor)


def check_free(data: GraphData, key: Key, what: str) -> None:
    """Raise GraphError where a pose or a landmark has a key that ``what`` is to get."""
    if key in data:
        hint = "; use set_initial to change its initial value" if what == "pose" else ""
        raise GraphError(f"pose {key} exists already{hint}")
    if key in data.landmarks:
        raise GraphError(f"landmark {key} exists already")
