"""Scale and misalignment of an IMU's axes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples

LARGEST_SHARE = 0.2  # by which a matrix may differ from the identity: sensors keep 3 %; more is a unit or another frame

# Standard deviation of what a known scale of a gyroscope leaves: sensitivity changes by 0.03 % per kelvin (BMI088, data
# sheet), and an IMU warms up by 10 K.
KNOWN_SCALE_SIGMA = 3e-3


def _identity() -> Array:
    return np.eye(3)


@dataclass(frozen=True, eq=False)
class ImuScale:
    """The matrices that bring an IMU's measurements to true scale and to orthogonal axes.

    Attributes:
        gyro: ``(3, 3)``, angular velocity in the IMU frame from the gyroscope's.
        accel: ``(3, 3)``, specific force in the IMU frame from the accelerometer's.

    Raises:
        DataError: a matrix is not ``(3, 3)`` and finite, or differs from the identity by more than a fifth.
    """

    gyro: Array = field(default_factory=_identity)
    accel: Array = field(default_factory=_identity)

    def __post_init__(self) -> None:
        for name in ("gyro", "accel"):
            matrix = np.array(getattr(self, name), dtype=np.float64)
            if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
                raise DataError(f"imu_scale: {name} must be a matrix of 3 × 3 finite numbers")
            if np.abs(matrix - np.eye(3)).max() > LARGEST_SHARE:
                raise DataError(
                    f"imu_scale: {name} differs from the identity by more than {LARGEST_SHARE:g}; convert units and "
                    "turn axes before (T_imu_lidar)"
                )
            object.__setattr__(self, name, matrix)

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        return bool((self.gyro == np.eye(3)).all() and (self.accel == np.eye(3)).all())

    def corrected(self, imu: ImuSamples) -> ImuSamples:
        """Return samples of true scale on orthogonal axes."""
        if self.is_identity:
            return imu
        return ImuSamples(imu.stamps_ns, imu.gyro_rad_s @ self.gyro.T, imu.accel_m_s2 @ self.accel.T)

    def after(self, earlier: ImuScale) -> ImuScale:
        """Return the scale that corrects by ``earlier`` and then by this one."""
        return ImuScale(self.gyro @ earlier.gyro, self.accel @ earlier.accel)
