"""IMU samples, and states to integrate them from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core.estimates import State
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples

GRAVITY = np.array([0.0, 0.0, -9.81])
CERTAIN = 1e-18 * np.eye(15)
NOISE = ImuNoise(gyro_scale_sigma=0.0)  # of samples whose only errors are noise and biases


def state_at(T: np.ndarray, velocity: np.ndarray, **changes: object) -> State:
    state = State(0, T, velocity, np.zeros(3), np.zeros(3), GRAVITY, CERTAIN, 1e-18 * np.eye(3))
    return replace(state, **changes)


def samples(times_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> ImuSamples:
    return ImuSamples(np.round(times_s * NS_PER_S).astype(np.int64), gyro, accel)


def at_rest(start_s: float, end_s: float) -> ImuSamples:
    times = np.arange(round(start_s * 100), round(end_s * 100) + 1) / 100
    return samples(times, np.zeros((len(times), 3)), np.tile(-GRAVITY, (len(times), 1)))


def tumbling(turns: float) -> tuple[ImuSamples, Rotation]:
    """Return 4 s of an IMU that turns on the spot, mostly about z, and its orientation at the end."""
    times = np.arange(1601) / 400
    about_z = np.full(len(times), 2 * np.pi * turns / 4)
    rates = np.column_stack([0.3 * np.sin(3 * times), 0.3 * np.cos(2 * times), about_z])
    steps = Rotation.from_rotvec((rates[1:] + rates[:-1]) / 2 / 400)
    orientations = [Rotation.identity()]
    for step in steps:
        orientations.append(orientations[-1] * step)
    R = Rotation.concatenate(orientations)
    return samples(times, rates, R.inv().apply(-GRAVITY)), R[-1]
