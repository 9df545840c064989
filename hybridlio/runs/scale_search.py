"""The IMU's scale over the rounds of a calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.calibration.imu_scale import FoundScale, find_imu_scale
from hybridlio.core.errors import DataError
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.smoothing.calibration import Calibrated, Parameter, undetermined_elements

SETTLED_SIGMAS = 0.5  # by which a round may still change a component and be the last


class ScaleSearch:
    """The scale found so far; each round adds what its path still shows."""

    def __init__(self) -> None:
        self._scale = ImuScale()
        self._newest: FoundScale | None = None

    @property
    def is_settled(self) -> bool:
        """Whether the last round changed no element by more than half its standard deviation."""
        if self._newest is None:
            return False
        changes = (self._newest.scale.gyro - np.eye(3), self._newest.scale.accel - np.eye(3))
        pairs = zip(changes, self._newest.sigmas, strict=True)
        return all(bool((np.abs(change) <= SETTLED_SIGMAS * sigmas).all()) for change, sigmas in pairs)

    def correct(self, path: Trajectory, sequence: Sequence) -> ImuSamples:
        """Return the samples of a recording, corrected by what a path through it shows.

        Raises:
            DataError: the path is too short.
        """
        self._newest = find_imu_scale(path, sequence.imu, sequence.calibration.T_imu_lidar)
        if self._newest is None:
            raise DataError(f"{sequence.name}: too short to find the IMU's scale; record 30 s or more of motion")
        self._scale = self._newest.scale.after(self._scale)
        return self._newest.scale.corrected(sequence.imu)

    def added_to(self, found: Calibrated, stated: ImuScale) -> Calibrated:
        """Return a calibration with the scale: changes against what was stated, and the matrices of the raw samples."""
        assert self._newest is not None
        columns = (
            ("gyro_scale", self._scale.gyro, self._newest.gyro_covariance, self._newest.gyro_prior_sigmas),
            ("accel_scale", self._scale.accel, self._newest.accel_covariance, self._newest.accel_prior_sigmas),
        )
        parameters = [
            Parameter(
                name, (matrix - np.eye(3)).ravel(), covariance, float(prior.max()),
                undetermined_elements(covariance, prior),
            )
            for name, matrix, covariance, prior in columns
        ]  # fmt: skip
        return replace(found, parameters=(*found.parameters, *parameters), imu_scale=self._scale.after(stated))
