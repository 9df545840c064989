"""The car on the road: its lane, its attitude from the ground below the wheels, and its suspension."""

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

KNOT_S = 0.05  # of the path's spline: a fifteenth of the suspension's period
FINE_S = 0.01  # step of the vehicle's dynamics
# Textbook values of a passenger car: its body on the springs has 1 to 1.5 Hz with a damping ratio of 0.2 to 0.4, and
# it rolls and dives by 3 to 5° per g.
_WHEELBASE_M, _TRACK_M = 2.7, 1.6
_SUSPENSION_HZ, _DAMPING = 1.3, 0.35
_DIVE_RAD_PER_M_S2, _ROLL_RAD_PER_M_S2 = 0.006, 0.008
_PEDAL_STEPS, _TYRE_STEPS = 5.0, 1.5  # of FINE_S: smoothing of the acceleration, and of what passes the suspension


def lane_of(centreline: Road, rng: np.random.Generator) -> Road:
    """Return the line driven in the right-hand lane, which wanders slowly by one or two decimetres."""
    s = np.arange(0.0, centreline.length_m, STEP_M)
    wander = 0.15 * np.sin(2 * np.pi * s / rng.uniform(60, 110) + rng.uniform(0, 6))
    wander += 0.08 * np.sin(2 * np.pi * s / rng.uniform(25, 45) + rng.uniform(0, 6))
    return Road.through(centreline.beside(s, wander - LANE_OFFSET_M))


def drive_path(lane: Road, s: Array, times_s: Array, ground: Ground) -> SmoothPath:
    """Return the path of the IMU of a car that drives along a lane.

    Heave, pitch and roll follow the ground below the wheels and the car's acceleration, each through a spring with a
    damper.

    Args:
        lane: the line that the middle of the rear axle follows.
        s: ``(N,)`` arc length of the rear axle.
        times_s: ``(N,)``, every ``FINE_S``.
        ground: the ground.
    """
    xy, heading = lane.at(s), lane.heading(s)
    height, pitch, roll = _ground_attitude(xy, heading, ground)
    speed = np.gradient(s, FINE_S)
    ahead = gaussian_filter1d(np.gradient(speed, FINE_S), _PEDAL_STEPS, mode="nearest")
    aside = speed**2 * lane.curvature(s)
    pitch = pitch - _DIVE_RAD_PER_M_S2 * ahead
    roll = roll + _ROLL_RAD_PER_M_S2 * aside
    height, pitch, roll = (_suspension(v) for v in (height, pitch, roll))
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).as_matrix()
    vehicle = se3.make(attitude, np.column_stack([xy, height]))
    every = round(KNOT_S / FINE_S)
    return SmoothPath.through(times_s[::every], (vehicle @ T_VEHICLE_IMU)[::every])


def _ground_attitude(xy: Array, heading: Array, ground: Ground) -> tuple[Array, Array, Array]:
    """Return height of the rear axle, pitch and roll on the ground below the four wheels, each ``(N,)``."""
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    corners = [(x, y) for x in (0.0, _WHEELBASE_M) for y in (-_TRACK_M / 2, _TRACK_M / 2)]
    rear_right, rear_left, front_right, front_left = (ground.height(xy + x * forward + y * left) for x, y in corners)
    rear, front = (rear_right + rear_left) / 2, (front_right + front_left) / 2
    pitch = -np.arctan2(front - rear, _WHEELBASE_M)
    roll = np.arctan2((rear_left + front_left - rear_right - front_right) / 2, _TRACK_M)
    return rear, pitch, roll


def _suspension(signal: Array) -> Array:
    """Filter a signal by a damped spring, which starts settled at the first value."""
    w = 2 * np.pi * _SUSPENSION_HZ
    numerator, denominator, _ = cont2discrete(
        ([2 * _DAMPING * w, w**2], [1.0, 2 * _DAMPING * w, w**2]), FINE_S, "bilinear"
    )
    b, a = numerator.ravel(), denominator.ravel()
    settled = lfilter_zi(b, a) * signal[0]
    filtered, _ = lfilter(b, a, signal, zi=settled)
    return np.asarray(gaussian_filter1d(filtered, _TYRE_STEPS, mode="nearest"))
