"""How a vehicle moves between measurements: accelerations, rates and speeds that all rooms assume.

These numbers describe a road vehicle; another kind of vehicle changes this one file. Each is one standard deviation
unless its name says ``LARGEST``. Where they come from: full braking on a dry road reaches 7 to 9 m/s²; braking and
cornering in ordinary traffic stay below 3 m/s² nine times in ten; a yaw rate of 0.6 rad/s is a right-angle bend in
three seconds.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array

GRAVITY_M_S2 = 9.81
GRAVITY_MAGNITUDE_SIGMA_M_S2 = 0.03  # 9.78 at the equator, 9.83 at the poles

ACCELERATION_SIGMA_M_S2 = 2.0  # change of the velocity between two scans
ANGULAR_ACCELERATION_SIGMA_RAD_S2 = 0.5  # change of the rate between two scans
JERK_SIGMA_M_S3 = 5.0  # change of the acceleration between two samples
MEAN_ACCELERATION_SIGMA_M_S2 = 1.5  # acceleration averaged over the first samples, which tilts the measured vertical
BRIDGED_ACCELERATION_SIGMA_M_S2 = 3.0  # difference of the speed at a step's end from its mean speed, without an IMU
LARGEST_ACCELERATION_M_S2 = 4.0
LARGEST_RATE_RAD_S = 0.6

UNKNOWN_SPEED_SIGMA_M_S = 20.0  # before anything is measured: 72 km/h
UNKNOWN_RATE_SIGMA_RAD_S = 0.3
SWEEP_RATE_SIGMA_RAD_S = 0.02  # a car on its springs, about its mean rate over a step

# Floors of a predicted step's standard deviations (rad, m): no prediction is better, and GTSAM needs them positive.
PREDICTION_FLOOR_SIGMAS = np.r_[np.full(3, 1e-4), np.full(3, 1e-3)]
# Floors of a measured step's: no registration of two scans is better.
MEASUREMENT_FLOOR_SIGMAS = np.r_[np.full(3, 5e-5), np.full(3, 1e-3)]

# An initial pose whose translation is less sure than this (all axes together) is treated as unknown.
UNKNOWN_TRANSLATION_SIGMA_M = 0.5
# One that is less sure than this would place a scan in the map twice.
VAGUE_TRANSLATION_SIGMA_M = 0.1


def unknown_motion_covariance(dt_s: float) -> Array:
    """Covariance ``(6, 6)`` of a step of ``dt_s`` seconds about which only the kind of vehicle is known."""
    sigmas = np.r_[np.full(3, UNKNOWN_RATE_SIGMA_RAD_S), np.full(3, UNKNOWN_SPEED_SIGMA_M_S)] * dt_s
    return np.diag(sigmas**2 + PREDICTION_FLOOR_SIGMAS**2)


def changed_motion_covariance(dt_s: float) -> Array:
    """Covariance ``(6, 6)`` of a step of ``dt_s`` seconds that is predicted from the step before."""
    rates = np.r_[np.full(3, ANGULAR_ACCELERATION_SIGMA_RAD_S2), np.full(3, ACCELERATION_SIGMA_M_S2)]
    sigmas = rates * dt_s**2
    return np.diag(sigmas**2 + PREDICTION_FLOOR_SIGMAS**2)
