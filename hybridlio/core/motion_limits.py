"""What is assumed of motion that no sensor has measured yet: accelerations, rates and speeds, for every platform alike.

Each is one standard deviation. With an IMU they hold until its samples do, and where these have gaps. Without one,
predictions are as uncertain as the last steps have changed (:mod:`hybridlio.sources.gate.motion_change`), and at least
as uncertain as these numbers: those of calm motion, such as a car in traffic, whose braking and cornering stay below
3 m/s² nine times in ten (full braking on a dry road reaches 7 to 9 m/s²).
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array

GRAVITY_M_S2 = 9.81  # standard gravity, 9.80665, rounded; the value of a place varies by the sigma below
GRAVITY_MAGNITUDE_SIGMA_M_S2 = 0.03  # 9.78 at the equator, 9.83 at the poles

ACCELERATION_SIGMA_M_S2 = 2.0  # change of velocity between two scans; covers ordinary traffic
ANGULAR_ACCELERATION_SIGMA_RAD_S2 = 0.5  # change of angular velocity between two scans; 0.05 rad/s in 0.1 s
JERK_SIGMA_M_S3 = 5.0  # change of acceleration between two samples; builds up full braking in 1.6 s
MEAN_ACCELERATION_SIGMA_M_S2 = 1.5  # mean over the first samples; tilts the vertical measured from them by 0.15 rad
BRIDGED_ACCELERATION_SIGMA_M_S2 = 3.0  # acceleration over a step without samples; hard braking reaches twice that
LARGEST_ACCELERATION_M_S2 = 4.0  # of a step or its part without samples, taken as one σ; harder braking is an emergency
LARGEST_RATE_RAD_S = 0.6  # likewise; a right-angle bend in three seconds

UNKNOWN_SPEED_SIGMA_M_S = 20.0  # 72 km/h: one σ covers towns, two a motorway
UNKNOWN_RATE_SIGMA_RAD_S = 0.3  # two σ are a right-angle bend in three seconds; faster ones are searched for
LEVEL_SINE = 0.5  # a direction within 30° of the horizontal counts as level, and one within 30° of the vertical as up
SWEEP_RATE_SIGMA_RAD_S = 0.02  # pitch and roll of a car on its springs about the mean rate over a step

# Floors of a predicted step's standard deviations (rad, m). No prediction is better, and GTSAM needs a positive
# definite covariance even where the time step is tiny.
PREDICTION_FLOOR_SIGMAS = np.r_[np.full(3, 1e-4), np.full(3, 1e-3)]
# Floors of a measured step's standard deviations (rad, m). No registration of two scans is better: 2 cm of range noise
# averaged over hundreds of points is 1 mm.
MEASUREMENT_FLOOR_SIGMAS = np.r_[np.full(3, 5e-5), np.full(3, 1e-3)]

POINT_LEVER_M = 10.0  # half of a scan's points are nearer; turns a rotation, or its uncertainty, into a displacement

# An initial pose whose translation is less certain than this (all axes together) is treated as unknown: it is beyond
# the width of registration's coarse kernel.
UNKNOWN_TRANSLATION_SIGMA_M = 0.5
# Above this uncertainty, an initial pose alone would show objects of the map twice. Registration's
# default kernel is as wide.
VAGUE_TRANSLATION_SIGMA_M = 0.1


def unknown_motion_covariance(dt_s: float) -> Array:
    """Return the covariance ``(6, 6)`` of a step of ``dt_s`` seconds of a motion that nothing is known of."""
    sigmas = np.r_[np.full(3, UNKNOWN_RATE_SIGMA_RAD_S), np.full(3, UNKNOWN_SPEED_SIGMA_M_S)] * dt_s
    return np.diag(sigmas**2 + PREDICTION_FLOOR_SIGMAS**2)


def changed_motion_covariance(dt_s: float) -> Array:
    """Return the covariance ``(6, 6)`` of a step of ``dt_s`` seconds that is predicted from the step before."""
    rates = np.r_[np.full(3, ANGULAR_ACCELERATION_SIGMA_RAD_S2), np.full(3, ACCELERATION_SIGMA_M_S2)]
    sigmas = rates * dt_s**2
    return np.diag(sigmas**2 + PREDICTION_FLOOR_SIGMAS**2)
