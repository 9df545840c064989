"""Source of initial poses that runs the trained LSTMs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import PREDICTION_FLOOR_SIGMAS, unknown_motion_covariance
from hybridlio.core.sensors import NS_PER_S, Frame, ImuSamples
from hybridlio.learned.networks.devices import at_run_time, pick_device
from hybridlio.learned.networks.weights import load_weights, weights_path
from hybridlio.learned.source_settings import LstmSettings
from hybridlio.learned.sources.inertial_inputs import inertial

_STEP_S = 0.1  # scan period of the training data (10 Hz); the LSTMs do not take the duration as input
_FORGETTING = 0.05  # weight of the newest step in the variances: averages over about 20 steps (2 s); a choice
_FIRST_SIGMAS = np.r_[np.full(3, 0.01), np.full(3, 0.3)]  # rad, m a step: several times the training errors


class LstmInitialPose:
    """Predict initial poses by the LSTMs of a trained network.

    The covariance starts at 0.6° and 0.3 m and follows the errors of the predictions so far, with exponential
    forgetting. While the last velocity is an input but unknown, as at the start, the covariance of the translation is
    that of an unknown motion. Steps longer than 0.1 s, over missing scans, are split into parts of about 0.1 s.

    Args:
        settings: weights and device.

    Raises:
        DataError: the weights cannot be read.
        ConfigError: their network predicts no initial pose from the IMU, the device does not exist, or no weights of
            that name are shipped.
    """

    name = "lstm"

    def __init__(self, settings: LstmSettings | None = None) -> None:
        settings = settings or LstmSettings()
        path, self._device = weights_path(settings.weights), pick_device(settings.device)
        network = load_weights(path).network(self._device)
        if network.imu_network is None or network.settings.imu != "initial-pose":
            raise ConfigError(
                f"{path}: weights of a network with imu={network.settings.imu!r}, which predicts no initial pose; "
                "choose other weights (lstm.weights) or another initial pose"
            )
        self._network, self._settings = network.imu_network, network.settings
        self._variances = _FIRST_SIGMAS**2  # of a step of _STEP_S
        self._step: tuple[Array, float] | None = None
        self._predicted: tuple[Array, float, bool] | None = None

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Return ``T_k_k1`` from the samples since the last scan; without samples the identity, marked as not ok."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        informed = self._step is not None or not self._settings.velocity
        if not len(frame.imu):
            self._predicted = None
            return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), source=self.name, ok=False)
        pose = self._chained(frame, dt_s)
        self._predicted = (pose, dt_s, informed)
        covariance = np.diag(self._variances) * (dt_s / _STEP_S) ** 2
        if not informed:
            covariance = covariance + unknown_motion_covariance(dt_s)
        return RelativePose(pose, covariance, source=self.name, from_imu=True)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:  # noqa: ARG002
        """Update the variances by the error of the prediction, and the velocity for the next one."""
        if self._predicted is None:
            self._step = None
            return
        pose, dt_s, informed = self._predicted
        if informed:
            error = se3.log(se3.between(pose, estimate.pose)) * _STEP_S / dt_s
            self._variances = (1 - _FORGETTING) * self._variances + _FORGETTING * (
                error**2 + PREDICTION_FLOOR_SIGMAS**2
            )
        self._step = (estimate.pose, dt_s)

    def _chained(self, frame: Frame, dt_s: float) -> Array:
        """Return the motion in ``dt_s``, predicted in equal parts of about a tenth of a second."""
        parts, pose, step = max(round(dt_s / _STEP_S), 1), np.eye(4), self._step
        first_ns = frame.scan.stamp_ns - round(dt_s * NS_PER_S)
        ends_ns = [first_ns + round(part * dt_s * NS_PER_S / parts) for part in range(parts + 1)]
        for start_ns, end_ns in pairwise(ends_ns):
            samples = frame.imu if parts == 1 else frame.imu.between(start_ns, end_ns)
            moved = self._part(samples if len(samples) else frame.imu, frame, step, dt_s / parts)
            pose, step = se3.orthonormalise(pose @ moved), (moved, dt_s / parts)
        return pose

    def _part(self, samples: ImuSamples, frame: Frame, step: tuple[Array, float] | None, dt_s: float) -> Array:
        rows, velocity = inertial(samples, frame, self._settings, step)
        with at_run_time():
            imu, v = (torch.from_numpy(x)[None].to(self._device) for x in (rows, velocity))
            pose = self._network(imu, v, torch.tensor([_STEP_S], device=self._device))[0].double().cpu().numpy()
        # the network predicts the motion of _STEP_S: scale it to the duration of the part
        return se3.exp(se3.log(se3.orthonormalise(pose)) * dt_s / _STEP_S)
