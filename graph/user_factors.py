"""Factors that users write themselves, as Python functions or as GTSAM's factors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.se3 import as_floats
from hybridlio.graph.landmark_measurements import LandmarkMeasurements
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor, factor_label
from hybridlio.graph.model.noise import NoiseInput, RobustLike, make_noise, make_robust
from hybridlio.graph.model.user_residual import Jacobian, Residual, UserResidual, sample_poses


class UserFactors(LandmarkMeasurements):
    """The part of a pose graph that takes factors of any form; each call returns the factor's id.

    Such factors cannot be saved: a file holds no code.
    """

    def add_factor(
        self, keys: Key | Sequence[Key], residual: Residual, sigmas: ArrayLike | None = None,
        jacobian: Jacobian | None = None, *, covariance: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add a residual of some poses, which is zero in the mean.

        A call costs about 40 µs on top of the function's own time; without a Jacobian each linearisation calls the
        function 12 times for each pose (6 in the plane).

        Args:
            keys: one key, or a list of them; the graph must have the poses.
            residual: called with poses ``(4, 4)``, one argument a key; returns ``(m,)``.
            sigmas, covariance: exactly one of them; of the residual: ``(m,)`` or ``(m, m)``.
            jacobian: called like ``residual``; returns a list of one matrix ``(m, d)`` for each key, the derivative by
                a right perturbation ``T·Exp(ξ)``, rotation first; d is 6, or 3 in the plane (heading, x, y). It is
                compared with numeric derivatives when the factor is added.
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.

        Raises:
            DataError: the residual or the Jacobian has another size, or the Jacobian differs from numeric derivatives.
            GraphError: unknown key, no key, or none or both of sigmas and covariance.
        """
        given = _listed(keys)
        name = factor_label("custom", given)
        known = self._known(given, name)
        if not callable(residual) or not (jacobian is None or callable(jacobian)):
            raise DataError(f"{name}: residual and jacobian must be functions")
        given_noise = covariance if sigmas is None else sigmas
        size = 1 if given_noise is None else len(np.atleast_1d(as_floats(given_noise, name)))
        noise = make_noise(name, size, NoiseInput(covariance, sigmas=sigmas))
        function = UserResidual(name, size, self._data.dimension, residual, jacobian)
        function.check(self._sample_poses(known))
        kernel = make_robust(robust, size, name)
        return self._data.add_factor(Factor("custom", known, np.zeros(0), noise, kernel, code=function))

    def add_gtsam_factor(self, keys: Key | Sequence[Key], factor: Any) -> int:
        """Add a factor of GTSAM's over poses (``Pose3``, or ``Pose2`` in the plane), with its own noise model.

        Args:
            keys: of the poses, in the order of the factor's own keys, which they replace.
            factor: a ``gtsam.NonlinearFactor``.

        Raises:
            DataError: not a factor of GTSAM's, or of another number of keys.
            GraphError: unknown key.
        """
        given = _listed(keys)
        name = factor_label("gtsam", given)
        known = self._known(given, name)
        if not hasattr(factor, "rekey"):
            raise DataError(f"{name}: expected a factor of GTSAM's, got {type(factor).__name__}")
        if len(factor.keys()) != len(known):
            raise DataError(f"{name}: the factor has {len(factor.keys())} keys, but {len(known)} poses are given")
        return self._data.add_factor(Factor("gtsam", known, np.zeros(0), code=factor))

    def add_altitude(self, key: Key, altitude_m: float, sigma_m: float, robust: RobustLike = None) -> int:
        """Add the body's height above world's origin, such as a barometer's."""
        return self._add_vectors("altitude", key, ([altitude_m],), NoiseInput(sigmas=sigma_m), robust)

    def add_heading(self, key: Key, heading_rad: float, sigma_rad: float, robust: RobustLike = None) -> int:
        """Add the angle from world's x axis to the body's, seen from above; with world east, north, up: from east."""
        return self._add_vectors("heading", key, ([heading_rad],), NoiseInput(sigmas=sigma_rad), robust)

    def add_body_velocity(
        self, key: Key, velocity_m_s: ArrayLike, sigmas: ArrayLike, robust: RobustLike = None
    ) -> int:  # fmt: skip
        """Add the body's velocity ``(3,)`` in its own frame, such as a Doppler sensor's."""
        return self._add_vectors("body-velocity", key, (velocity_m_s,), NoiseInput(sigmas=sigmas), robust)

    def add_wheel_speed(
        self, key: Key, forward_m_s: float, sigma_m_s: float, sideways_sigma_m_s: float, robust: RobustLike = None
    ) -> int:  # fmt: skip
        """Add the speed along the body's x axis of a vehicle whose wheels hardly slip: it moves forward alone.

        Args:
            key: of a pose.
            forward_m_s, sigma_m_s: the speed and its standard deviation.
            sideways_sigma_m_s: of the speeds to the side and up, which are taken as zero (non-holonomic constraint).
            robust: as in :meth:`~hybridlio.graph.PoseGraph.add_between`.
        """
        sigmas = sigma_m_s, sideways_sigma_m_s, sideways_sigma_m_s
        return self.add_body_velocity(key, [forward_m_s, 0, 0], sigmas, robust)

    def _known(self, keys: list[Key], name: str) -> tuple[Key, ...]:
        if not keys:
            raise GraphError(f"{name}: give at least one key")
        return tuple(self._data.known_keys(*keys, what=name))

    def _sample_poses(self, keys: Sequence[Key]) -> list[Array]:
        return sample_poses([self._data.initial_value(key) for key in keys], self._data.dimension)


def _listed(keys: Key | Sequence[Key]) -> list[Key]:
    return list(keys) if isinstance(keys, list | range) else [keys]  # type: ignore[list-item]  # one key
