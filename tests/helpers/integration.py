"""Integration of inertial samples, independent of the library's own."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from hybridlio.simulation.rig import GRAVITY_WORLD_M_S2


def integrate(times: np.ndarray, gyro: np.ndarray, accel: np.ndarray, R0: Rotation, p0: np.ndarray, v0: np.ndarray):
    """Integrate samples: attitude by fourth-order Magnus steps, velocity and position by quadrature.

    Between the samples, rate and acceleration are taken as the cubic splines through them.
    """
    step = np.diff(times)[:, None]
    rate = CubicSpline(times, gyro)
    w1, w2 = (rate(times[:-1] + (0.5 + side * np.sqrt(3) / 6) * step[:, 0]) for side in (-1, 1))
    turns = (w1 + w2) * step / 2 + np.sqrt(3) / 12 * step**2 * np.cross(w1, w2)
    attitude = [R0]
    for turn in turns:
        attitude.append(attitude[-1] * Rotation.from_rotvec(turn))
    rotations = Rotation.concatenate(attitude)
    velocity = CubicSpline(times, rotations.apply(accel) + GRAVITY_WORLD_M_S2).antiderivative()
    position = p0 + v0 * (times - times[0])[:, None] + velocity.antiderivative()(times)
    return rotations, position
