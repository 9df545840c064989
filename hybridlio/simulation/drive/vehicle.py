"""The car on the road: lane keeping, attitude from the ground below the wheels, and the suspension between them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import cont2discrete, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.rig import T_VEHICLE_IMU
from hybridlio.simulation.world.ground import Ground
from hybridlio.simulation.world.roads import LANE_OFFSET_M, STEP_M, Road

KNOT_S = 0.05
FINE_S = 0.01
_WHEELBASE_M, _TRACK_M = 2.7, 1.6
_SUSPENSION_HZ, _DAMPING = 1.3, 0.35
_DIVE_RAD_PER_M_S2, _ROLL_RAD_PER_M_S2 = 0.006, 0.008


def lane_of(centreline: Road, rng: np.random.Generator) -> Road:
    """The right-hand lane of a road, driven with a slow wander of some ten centimetres."""
    s = np.arange(0.0, centreline.length_m, STEP_M)
    wander = 0.15 * np.sin(2 * np.pi * s / rng.uniform(60, 110) + rng.uniform(0, 6))
    wander += 0.08 * np.sin(2 * np.pi * s / rng.uniform(25, 45) + rng.uniform(0, 6))
    return Road.through(centreline.beside(s, wander - LANE_OFFSET_M))


def drive_path(lane: Road, s: Array, times_s: Array, ground: Ground) -> SmoothPath:
    """The IMU's path of a car whose rear axle is at arc length ``s`` ``(N,)`` of the lane at ``times_s``, every 10 ms.

    Heave, pitch and roll follow the ground under the wheels, and the car leans and dives with its acceleration,
    through one spring and damper each.
    """
    xy, heading = lane.at(s), lane.heading(s)
    height, pitch, roll = _ground_attitude(xy, heading, ground)
    speed = np.gradient(s, FINE_S)
    ahead = gaussian_filter1d(np.gradient(speed, FINE_S), 5.0, mode="nearest")
    aside = speed**2 * lane.curvature(s)
    pitch = pitch - _DIVE_RAD_PER_M_S2 * ahead
    roll = roll + _ROLL_RAD_PER_M_S2 * aside
    height, pitch, roll = (_suspension(v) for v in (height, pitch, roll))
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).as_matrix()
    vehicle = se3.make(attitude, np.column_stack([xy, height]))
    every = round(KNOT_S / FINE_S)
    return SmoothPath.through(times_s[::every], (vehicle @ T_VEHICLE_IMU)[::every])


def _ground_attitude(xy: Array, heading: Array, ground: Ground) -> tuple[Array, Array, Array]:
    """Height, pitch and roll of the plane through the ground below the four wheels."""
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    corners = [(x, y) for x in (0.0, _WHEELBASE_M) for y in (-_TRACK_M / 2, _TRACK_M / 2)]
    rear_right, rear_left, front_right, front_left = (ground.height(xy + x * forward + y * left) for x, y in corners)
    rear, front = (rear_right + rear_left) / 2, (front_right + front_left) / 2
    pitch = -np.arctan2(front - rear, _WHEELBASE_M)
    roll = np.arctan2((rear_left + front_left - rear_right - front_right) / 2, _TRACK_M)
    return rear, pitch, roll


def _suspension(signal: Array) -> Array:
    """The signal after a damped spring (natural frequency, damping ratio above), settled at its first value."""
    w = 2 * np.pi * _SUSPENSION_HZ
    numerator, denominator, _ = cont2discrete(
        ([2 * _DAMPING * w, w**2], [1.0, 2 * _DAMPING * w, w**2]), FINE_S, "bilinear"
    )
    b, a = numerator.ravel(), denominator.ravel()
    settled = lfilter_zi(b, a) * signal[0]
    filtered, _ = lfilter(b, a, signal, zi=settled)
    return np.asarray(gaussian_filter1d(filtered, 1.5, mode="nearest"))
