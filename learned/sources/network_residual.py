"""The residual network at run time: a source of residuals, judged by the loss that trained it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio.cloud.projection import MapGeometry
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.learned.data.preparing import Mapped
from hybridlio.learned.losses.loss_judge import CHI2_99, Judged, JudgedScan, LossJudge
from hybridlio.learned.networks.devices import at_run_time, on_device, pick_device
from hybridlio.learned.networks.maps import valid_cells
from hybridlio.learned.networks.odometry_network import SeenScan
from hybridlio.learned.networks.weights import load_weights, weights_path
from hybridlio.learned.settings import Recipe
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.learned.sources.lstm_initial_pose import inertial

_log = logging.getLogger(__name__)

Rows = NDArray[np.float32] | NDArray[np.float64]
Prepare = Callable[[Scan], Mapped]

_LONG_WAY_M = 0.15  # longer than what the network was trained to go
_RISE = 1.02  # the loss has changed by less when only which points match has


@dataclass(frozen=True, eq=False)
class _Seen:
    """A scan as the network takes it, and, once asked for, as the loss does."""

    stamp_ns: int
    maps: SeenScan
    cells: int
    enough: bool
    threads: int

    @cached_property
    def judged(self) -> JudgedScan:
        vertices, normals = (part[0].cpu().numpy() for part in (self.maps.vertices, self.maps.normals))
        return JudgedScan.of_maps(vertices, normals, self.threads)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two scans to be compared, ``dt_s`` apart, and what the network is told of the IMU between them."""

    last: _Seen
    current: _Seen
    dt_s: float
    features: tuple[Tensor, Tensor] | None

    @property
    def enough(self) -> bool:
        return self.last.enough and self.current.enough


class NetworkResidual:
    """Refines each initial pose by the network, looking at the last scan and the current one.

    The loss that trained the network judges its answer, in a robust form: its Hessian gives the covariance, and an
    answer that it finds worse than the initial pose, by more than the covariance allows, is not taken. Then, or with
    too little to see, the initial pose itself comes back, marked as not ok, and the log says why.

    Args:
        prepare_for: gives, for the recipe that the weights were trained by, what makes a scan ready, such as
            :func:`hybridlio.cloud.preparation.prepare` with the network's cells.
        settings: weights, device, and how the answer is weighed.

    Raises:
        DataError: the weights cannot be read.
        ConfigError: there is no such device.
    """

    name = "network"

    def __init__(
        self, prepare_for: Callable[[Recipe], Prepare], settings: NetworkResidualSettings | None = None
    ) -> None:
        self._settings = settings or NetworkResidualSettings()
        self._device = pick_device(self._settings.device)
        weights = load_weights(weights_path(self._settings.weights))
        self._network = weights.network(self._device)
        self._prepare = prepare_for(weights.recipe)
        self._threads = torch.get_num_threads()
        self._last: _Seen | None = None
        self._pair: _Pair | None = None  # of the last scan and the one before it
        self._step: tuple[Array, float] | None = None

    @property
    def geometry(self) -> MapGeometry:
        """The cells that the network takes."""
        return self._network.settings.geometry

    def start(self, frame: Frame) -> None:
        """Take the first scan.

        Raises:
            DataError: too few of its cells have a normal.
        """
        self._step = self._pair = None
        self._last = self._look(frame.scan)
        if not self._last.enough:
            raise DataError(
                f"frame {frame.index}: only {self._last.cells} cells of the network's maps "
                f"({self.geometry.rows} x {self.geometry.columns}) have a normal, {self._settings.min_cells} are "
                "needed; start at another scan, or take weights that were trained for this lidar"
            )

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """The network's ``T = δT·T̂``; the initial pose, marked as not ok, where that fails."""
        self._take(frame)
        return self.judge(frame, initial)

    def propose(self, frame: Frame, initial: RelativePose) -> Array | None:
        """The network's ``T`` ``(4, 4)``, which nothing has judged yet; None with too little to see."""
        pair = self._take(frame)
        if not pair.enough:
            return None
        pose = self._ask(pair, initial.pose)
        self._step = (pose, pair.dt_s)
        return pose

    def judge(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """What :meth:`refine` says of the frame that was last given to :meth:`propose`."""
        pair = self._pair
        assert pair is not None
        cells, dt_s = (pair.last.cells, pair.current.cells), pair.dt_s
        details = {"cells": float(cells[1]), "last_cells": float(cells[0])}
        if not pair.enough:
            why = f"{min(cells)} cells with a normal, {self._settings.min_cells} are needed"
            return self._bridge(frame, initial, details, dt_s, why)
        before, after = self._estimate(pair, initial)
        details |= {"cost": after.cost, "initial_cost": before.cost, "matched": after.matched}
        if after.matched < self._settings.min_matched:
            return self._bridge(frame, initial, details, dt_s, f"only {after.matched:.0%} of the points have a match")
        if self._is_worse(after, before):
            why = f"the loss finds the answer worse ({after.cost:.4f} m, the initial pose {before.cost:.4f} m)"
            return self._bridge(frame, initial, details, dt_s, why)
        self._step = (after.pose, dt_s)
        return self._answer(after, details)

    @property
    def current_scan(self) -> _Seen | None:
        """The scan last looked at, for :meth:`pair`."""
        return self._last

    def pair(self, earlier: _Seen, current: _Seen, initial: RelativePose) -> RelativePose:
        """A scan relative to any earlier one, ``T_j_k``, by the points alone; ``initial``, not ok, where that fails."""
        if not (earlier.enough and current.enough):
            return replace(initial, ok=False)
        nothing, still = np.zeros((self._network.settings.imu_samples, 6)), np.zeros(3)
        before, after = self._estimate(self._paired(earlier, current, nothing, still), initial)
        if after.matched < self._settings.min_matched or self._is_worse(after, before):
            return replace(initial, ok=False)
        return self._answer(after, {})

    def take_back(self, initial: RelativePose) -> None:
        """Go on at the velocity of the initial pose: the last answer was not believed."""
        if self._step is not None:
            self._step = (initial.pose, self._step[1])

    def _take(self, frame: Frame) -> _Pair:
        """The last scan and the frame's, which is the last one from now on."""
        last, current = self._last, self._look(frame.scan)
        if last is None:
            raise DataError(f"frame {frame.index}: no scan before it; call start with the first frame")
        imu, velocity = inertial(frame.imu, frame, self._network.settings, self._step)
        self._last, self._pair = current, self._paired(last, current, imu, velocity)
        return self._pair

    def _paired(self, last: _Seen, current: _Seen, imu: Rows, velocity: Rows) -> _Pair:
        with at_run_time():
            features = self._network.imu_features(on_device(imu, self._device), on_device(velocity, self._device))
        return _Pair(last, current, (current.stamp_ns - last.stamp_ns) / NS_PER_S, features)

    def _look(self, scan: Scan) -> _Seen:
        prepared = self._prepare(scan)
        vertices, cells = prepared.vertex_map, (self.geometry.rows, self.geometry.columns)
        if vertices.shape[1:] != cells:
            raise ConfigError(f"the network takes maps of {cells} cells, scans are prepared with {vertices.shape[1:]}")
        with at_run_time():
            seen = self._network.look(on_device(vertices, self._device))
            there = int(valid_cells(seen.normals).sum()) if prepared.usable else 0
        return _Seen(scan.stamp_ns, seen, there, there >= self._settings.min_cells, self._threads)

    def _estimate(self, pair: _Pair, initial: RelativePose) -> tuple[Judged, Judged]:
        """The pose that the network starts from and its answer, both judged."""
        judge = LossJudge(pair.last.judged, pair.current.judged, self._settings, self._threads)
        before = min((judge.judge(T) for T in self._starts(initial, pair.dt_s)), key=lambda j: j.cost)
        answer = judge.judge(self._ask(pair, before.pose))
        if len(answer.degenerate):  # where the scans say nothing, the initial pose knows better than the network
            way = answer.constrained(se3.log(se3.between(before.pose, answer.pose)))
            answer = judge.judge(se3.orthonormalise(before.pose @ se3.exp(way)))
        return before, judge.descend(answer)

    def _ask(self, pair: _Pair, start: Array) -> Array:
        """Where the network gets to from a pose ``(4, 4)``, and once more from there after a long way."""
        found = self._once(pair, start)
        way_m = float(np.linalg.norm(se3.between(start, found)[:3, 3]))
        return found if way_m < _LONG_WAY_M else self._once(pair, found)

    def _once(self, pair: _Pair, start: Array) -> Array:
        with at_run_time():
            pose = on_device(start, self._device)
            found = self._network.refine_seen(pair.last.maps, pair.current.maps, pose, pair.features)
            return se3.orthonormalise(found.pose[0].double().cpu().numpy())

    def _starts(self, initial: RelativePose, dt_s: float) -> list[Array]:
        """The initial pose, or that and others ahead of it where it is unsure of the translation."""
        sure = initial.translation_sigma_m <= UNKNOWN_TRANSLATION_SIGMA_M
        shifts = [0.0] if sure else [speed * dt_s for speed in self._settings.start_speeds_m_s]
        return [initial.pose @ se3.exp(np.array([0, 0, 0, shift, 0, 0])) for shift in shifts]

    def _is_worse(self, after: Judged, before: Judged) -> bool:
        """Whether the loss rises on the way from the initial pose, by a way longer than what it cannot tell apart."""
        if after.cost < before.cost * _RISE:
            return False
        way = se3.log(se3.between(before.pose, after.pose))
        return bool(way @ np.linalg.solve(before.spread(self._settings.covariance_scale), way) > CHI2_99)

    def _answer(self, judged: Judged, details: dict[str, float]) -> RelativePose:
        # weighed by the points alone; what a network was told of the IMU, its noise over a step (0.02°, 0.2 mm), is
        # nothing beside the answer's own, so that it may stand beside the samples
        return RelativePose(
            judged.pose,
            judged.covariance(self._settings.covariance_scale),
            source=self.name,
            degenerate=judged.degenerate,
            details={**details, "sigma_m": judged.sigma_m, "refined": float(judged.refined)},
        )

    def _bridge(
        self, frame: Frame, initial: RelativePose, details: dict[str, float], dt_s: float, why: str
    ) -> RelativePose:
        _log.warning("frame %d: bridged by the initial pose: network: %s", frame.index, why)
        self._step = (initial.pose, dt_s)
        return replace(initial, ok=False, degenerate=np.empty((0, 6)), details=details)
