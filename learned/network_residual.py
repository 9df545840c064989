"""The residual network at run time: a source of residuals, judged by the loss that trained it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio import se3
from hybridlio.errors import ConfigError, DataError
from hybridlio.estimates import RelativePose
from hybridlio.information import covariance_of, degenerate_directions, newton_step
from hybridlio.learned.correspondences import Clouds, match
from hybridlio.learned.losses import GaussNewton, gauss_newton, loss
from hybridlio.learned.lstm_initial_pose import inertial
from hybridlio.learned.odometry_network import NetworkInput
from hybridlio.learned.pairs import padded
from hybridlio.learned.preparing import Prepared
from hybridlio.learned.settings import LossSettings
from hybridlio.learned.weights import load_weights
from hybridlio.projection import MapGeometry
from hybridlio.sensors import NS_PER_S, Frame, Scan

Array = NDArray[np.float64]
Prepare = Callable[[Scan], Prepared]

_UNSURE_TRANSLATION_M = 0.5


@dataclass(frozen=True)
class NetworkResidualSettings:
    """How the residual network's answer is weighed.

    Attributes:
        device: where it computes.
        min_cells: with fewer filled cells in either map a scan is bridged by the initial pose.
        min_matched: with a smaller share of points matched, too.
        covariance_scale: how much larger the covariance is than independent residuals would make it.
        refine_steps: Gauss-Newton steps down the loss after the network; 0 leaves its answer.
        kernel_m, max_distance_m: of the robust loss that weighs the answer.
        start_speeds_m_s: forward speeds tried, by the loss, where the initial pose is unsure of the translation.
    """

    device: str = "cpu"
    min_cells: int = 500
    min_matched: float = 0.3
    covariance_scale: float = 6.0
    refine_steps: int = 0
    kernel_m: float = 0.1
    max_distance_m: float = 1.0
    start_speeds_m_s: tuple[float, ...] = (0.0, -5.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)

    def __post_init__(self) -> None:
        if self.min_cells < 1 or not 0 <= self.min_matched <= 1 or self.refine_steps < 0:
            raise ConfigError(
                "network residual: need min_cells >= 1, min_matched within 0 and 1, refine_steps >= 0, got "
                f"{self.min_cells}, {self.min_matched}, {self.refine_steps}"
            )
        if not self.covariance_scale > 0:
            raise ConfigError(f"network residual: covariance_scale must be positive, got {self.covariance_scale}")


@dataclass(frozen=True, eq=False)
class _Seen:
    """A scan as the network and the loss take it."""

    stamp_ns: int
    vertices: Tensor
    cells: int
    cloud: Clouds


@dataclass(frozen=True, eq=False)
class _Judged:
    """A pose and what the loss says of it."""

    pose: Tensor
    cost: float
    matched: float
    near: GaussNewton


class NetworkResidual:
    """Refines each initial pose by the network, looking at the last scan and the current one.

    The loss that trained the network judges its answer, in a robust form: its Hessian gives the covariance, and an
    answer that it finds worse than the initial pose is not taken. Then, or with too little to see, the initial pose
    itself comes back, marked as not ok.

    Args:
        weights: path of a weights file.
        prepare: makes a scan ready with the network's cells (``geometry``), such as
            :func:`hybridlio.preparation.prepare` with its options.
        settings: how the answer is weighed.

    Raises:
        DataError: the weights cannot be read.
    """

    name = "network"

    def __init__(
        self,
        weights: str | os.PathLike[str],
        prepare: Prepare,
        settings: NetworkResidualSettings | None = None,
    ) -> None:
        self._settings = settings or NetworkResidualSettings()
        self._network = load_weights(weights).network(self._settings.device)
        self._prepare = prepare
        self._loss = LossSettings(
            kernel="geman-mcclure",
            kernel_m=self._settings.kernel_m,
            max_distance_m=self._settings.max_distance_m,
            reduction="mean",
        )
        self._last: _Seen | None = None
        self._step: tuple[Array, float] | None = None

    @property
    def geometry(self) -> MapGeometry:
        """The cells that the network takes."""
        return self._network.settings.geometry

    def start(self, frame: Frame) -> None:
        """Take the first scan.

        Raises:
            DataError: too few of its cells are filled.
        """
        self._step = None
        self._last = self._look(frame.scan)
        if self._last.cells < self._settings.min_cells:
            raise DataError(
                f"frame {frame.index}: only {self._last.cells} filled cells; start at a scan with at least "
                f"{self._settings.min_cells}"
            )

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """The network's ``T = δT·T̂``; the initial pose, marked as not ok, where that fails."""
        last, current = self._last, self._look(frame.scan)
        if last is None:
            raise DataError(f"frame {frame.index}: no scan before it; call start with the first frame")
        self._last = current
        dt_s = (current.stamp_ns - last.stamp_ns) / NS_PER_S
        cells = {"cells": float(current.cells), "last_cells": float(last.cells)}
        if min(last.cells, current.cells) < self._settings.min_cells or not len(current.cloud.points[0]):
            return self._keep(_bridge(initial, cells), dt_s)
        with torch.no_grad():
            given = self._given(last, current, frame, dt_s)
            features = self._network.imu_features(given)
            before = min((self._judge(T, last, current) for T in self._starts(initial, dt_s)), key=lambda j: j.cost)
            after = self._judge(self._network.refine(given, before.pose, features).pose, last, current)
            after = self._descend(after, last, current)
        details = {**cells, "cost": after.cost, "initial_cost": before.cost, "matched": after.matched}
        if after.matched < self._settings.min_matched or not after.cost < before.cost:
            return self._keep(_bridge(initial, details), dt_s)
        return self._keep(self._answer(after, initial, features is not None, details), dt_s)

    def _look(self, scan: Scan) -> _Seen:
        prepared = self._prepare(scan)
        vertices, cloud = prepared.vertex_map, prepared.loss_cloud
        cells = (self.geometry.rows, self.geometry.columns)
        if vertices.shape[1:] != cells:
            raise ConfigError(f"the network takes maps of {cells} cells, scans are prepared with {vertices.shape[1:]}")
        normals = cloud.normals if cloud.normals is not None else np.zeros_like(cloud.points)
        on_device = padded([(cloud.points, normals)])
        device = self._settings.device
        on_device = Clouds(on_device.points.to(device), on_device.normals.to(device), on_device.there.to(device))
        filled = int((vertices != 0).any(axis=0).sum()) if prepared.usable else 0
        return _Seen(scan.stamp_ns, self._tensor(vertices), filled, on_device)

    def _tensor(self, values: NDArray[np.float32] | Array) -> Tensor:
        return torch.from_numpy(np.asarray(values, np.float32))[None].to(self._settings.device)

    def _given(self, last: _Seen, current: _Seen, frame: Frame, dt_s: float) -> NetworkInput:
        imu, velocity = inertial(frame, self._network.settings, self._step)
        dt = torch.tensor([dt_s], device=self._settings.device)
        return NetworkInput(last.vertices, current.vertices, self._tensor(imu), dt, self._tensor(velocity))

    def _judge(self, pose: Tensor, last: _Seen, current: _Seen) -> _Judged:
        matches = match(pose, last.cloud, current.cloud, self._loss, self.geometry)
        value, share = loss(matches, pose, self._loss), float(matches.share)
        # a point without a match costs as much as one infinitely far away
        cost = share * float(value.total) + (1 - share) * self._settings.kernel_m
        return _Judged(pose, cost, share, gauss_newton(matches, pose, self._loss))

    def _starts(self, initial: RelativePose, dt_s: float) -> list[Tensor]:
        """The initial pose, or that and others ahead of it where it is unsure of the translation."""
        sure = np.sqrt(initial.covariance[3:, 3:].trace()) <= _UNSURE_TRANSLATION_M
        shifts = [0.0] if sure else [speed * dt_s for speed in self._settings.start_speeds_m_s]
        return [self._tensor(initial.pose @ se3.exp(np.array([0, 0, 0, shift, 0, 0]))) for shift in shifts]

    def _descend(self, judged: _Judged, last: _Seen, current: _Seen) -> _Judged:
        """Go down the loss from the network's answer, as long as it falls."""
        for _ in range(self._settings.refine_steps):
            information, gradient = _numpy(judged.near.information)[0], _numpy(judged.near.gradient)[0]
            # the information is the Hessian times k/2, the Geman-McClure kernel's scale
            step = newton_step(information, gradient * self._settings.kernel_m / 2, limit_m=0.5)
            moved = _numpy(judged.pose)[0] @ se3.exp(step)
            tried = self._judge(self._tensor(se3.orthonormalise(moved)), last, current)
            if not tried.cost < judged.cost:
                break
            judged = tried
        return judged

    def _answer(
        self, judged: _Judged, initial: RelativePose, uses_imu: bool, details: dict[str, float]
    ) -> RelativePose:
        information = _numpy(judged.near.information)[0]
        sigma_m = float(judged.near.sigma_m)
        return RelativePose(
            se3.orthonormalise(_numpy(judged.pose)[0]),
            covariance_of(information, sigma_m, self._settings.covariance_scale),
            source=self.name,
            degenerate=degenerate_directions(information),
            from_imu=uses_imu and initial.from_imu,
            details={**details, "sigma_m": sigma_m},
        )

    def _keep(self, answer: RelativePose, dt_s: float) -> RelativePose:
        self._step = (answer.pose, dt_s)
        return answer


def _bridge(initial: RelativePose, details: dict[str, float]) -> RelativePose:
    return replace(initial, ok=False, degenerate=np.empty((0, 6)), details=details)


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().double().cpu().numpy()
