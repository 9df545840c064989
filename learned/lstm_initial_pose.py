"""The LSTMs at run time: a source of initial poses."""

from __future__ import annotations

import os

import numpy as np
import torch
from numpy.typing import NDArray

from hybridlio import se3
from hybridlio.errors import ConfigError
from hybridlio.estimates import RelativePose, State
from hybridlio.initial_pose import unknown_motion_covariance
from hybridlio.learned.imu_rows import imu_rows
from hybridlio.learned.settings import NetworkSettings
from hybridlio.learned.weights import load_weights
from hybridlio.sensors import NS_PER_S, Frame

Array = NDArray[np.float64]

_FORGETTING = 0.05  # share of the newest step in what is known of the LSTMs' errors
_FIRST_SIGMAS = np.r_[np.full(3, 0.01), np.full(3, 0.3)]
_FLOOR_SIGMAS = np.r_[np.full(3, 1e-4), np.full(3, 1e-3)]


class LstmInitialPose:
    """Initial poses by the LSTMs of a trained network.

    The covariance is what the steps so far have shown: it starts wide (0.6°, 0.3 m) and follows the differences between
    prediction and outcome, the newest counting most.

    Args:
        weights: path of a weights file of a network with ``imu="initial-pose"``.
        device: where it computes.

    Raises:
        DataError: the weights cannot be read.
        ConfigError: they are of a network that takes no initial pose from the IMU.
    """

    name = "lstm"

    def __init__(self, weights: str | os.PathLike[str], device: str = "cpu") -> None:
        network = load_weights(weights).network(device)
        if network.imu_network is None or network.settings.imu != "initial-pose":
            raise ConfigError(
                f"{weights}: of a network with imu={network.settings.imu!r}, which predicts no initial pose"
            )
        self._network, self._settings, self._device = network.imu_network, network.settings, device
        self._variances = _FIRST_SIGMAS**2
        self._step: tuple[Array, float] | None = None
        self._predicted: tuple[Array, float] | None = None

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """``T_k_k1`` from the samples since the last scan; without any, no motion, marked as not ok."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        if not len(frame.imu):
            self._predicted = None
            return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), source=self.name, ok=False)
        rows, velocity = inertial(frame, self._settings, self._step)
        with torch.no_grad():
            imu, v = (torch.from_numpy(x)[None].to(self._device) for x in (rows, velocity))
            pose = self._network(imu, v, torch.tensor([dt_s], device=self._device))[0].double().cpu().numpy()
        pose = se3.orthonormalise(pose)
        self._predicted = (pose, dt_s)
        return RelativePose(pose, np.diag(self._variances), source=self.name, from_imu=True)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:  # noqa: ARG002
        """Learn how far off the prediction was, and the velocity for the next one."""
        if self._predicted is None:
            self._step = None
            return
        pose, dt_s = self._predicted
        error = se3.log(se3.between(pose, estimate.pose))
        self._variances = (1 - _FORGETTING) * self._variances + _FORGETTING * (error**2 + _FLOOR_SIGMAS**2)
        self._step = (estimate.pose, dt_s)


def inertial(
    frame: Frame, settings: NetworkSettings, step: tuple[Array, float] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inertial rows ``(S, 6)``, zeros where there are none, and the velocity ``(3,)`` at the last scan, as in shards.

    Args:
        frame: the current scan's.
        settings: of the network.
        step: the last relative pose and its duration in seconds, where there was any.
    """
    T_imu_lidar = None if frame.calibration is None else frame.calibration.T_imu_lidar
    rows = np.zeros((settings.imu_samples, 6), np.float32)
    if len(frame.imu):
        rows = imu_rows(frame.imu, settings.imu_samples, T_imu_lidar)
    if step is None:
        return rows, np.zeros(3, np.float32)
    pose, dt_s = step
    return rows, (pose[:3, :3].T @ pose[:3, 3] / dt_s).astype(np.float32)
