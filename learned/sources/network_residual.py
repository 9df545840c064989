"""The residual network at run time: a source of residuals whose answers the training loss evaluates."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio.cloud.fitting_geometry import fitting_geometry
from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.motion_limits import UNKNOWN_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.learned.losses.loss_evaluator import CHI2_99, EvaluatedPose, LossEvaluator, LossScan
from hybridlio.learned.networks.devices import at_run_time, on_device, pick_device
from hybridlio.learned.networks.maps import valid_cells
from hybridlio.learned.networks.network_types import ScanMaps
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import Weights, load_weights, weights_path
from hybridlio.learned.settings import Recipe
from hybridlio.learned.source_settings import NetworkResidualSettings
from hybridlio.learned.sources.fitted_network import Fitted, FittedNetwork, Prepare
from hybridlio.learned.sources.inertial_inputs import inertial
from hybridlio.record import plain_values

_log = logging.getLogger(__name__)
plain_values.register(  # so that the state of a run can be stored
    "torch.Tensor",
    Tensor,
    lambda tensor: (str(tensor.device), tensor.detach().cpu().numpy()),
    lambda stored: torch.from_numpy(stored[1]).to(stored[0]),
)

Rows = NDArray[np.float32] | NDArray[np.float64]
_LONG_CORRECTION_M = 0.15  # the network is trained on initial poses 0.14 m off; longer corrections are less accurate
_RISE = 1.02  # a smaller change of the loss may come from other points matching alone


@dataclass(frozen=True, eq=False)
class _Seen:
    """A scan in the form that the network takes, and on demand in the form that the loss takes."""

    stamp_ns: int
    maps: ScanMaps
    cells: int
    enough: bool
    threads: int

    @cached_property
    def for_loss(self) -> LossScan:
        vertices, normals = (part[0].cpu().numpy() for part in (self.maps.vertices, self.maps.normals))
        return LossScan.of_maps(vertices, normals, self.threads)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two scans ``dt_s`` apart, and the IMU features between them where the network uses them."""

    last: _Seen
    current: _Seen
    dt_s: float
    features: tuple[Tensor, Tensor] | None

    @property
    def enough(self) -> bool:
        return self.last.enough and self.current.enough


def _fitted(weights: Weights, prepare_for: Callable[[Recipe], Prepare], device: torch.device) -> Fitted:
    return Fitted(weights.network(device), prepare_for(weights.recipe))


class NetworkResidual:
    """Refines each initial pose by the network, from the last scan and the current one.

    The training loss, with a robust kernel, evaluates the answer: its Hessian gives the covariance. An answer is
    rejected where the loss rises from the initial pose to it by more than the covariance explains. Then, or with too
    few cells or matches, the source returns the initial pose, marked as not ok, and logs the reason.

    Args:
        prepare_for: returns a function that prepares a scan for the recipe of the weights, such as
            :func:`hybridlio.cloud.preparation.prepare` with the network's map geometry.
        settings: weights, device, and settings of the loss.

    Raises:
        DataError: the weights cannot be read.
        ConfigError: the device does not exist, or no weights of that name are shipped.
    """

    name = "network"
    # the last is of one step only; the network and the preparation follow from the cells
    NOT_STATE = ("_settings", "_device", "_fitting", "_threads", "_pair")

    def __init__(
        self, prepare_for: Callable[[Recipe], Prepare], settings: NetworkResidualSettings | None = None
    ) -> None:
        self._settings = settings or NetworkResidualSettings()
        self._device = pick_device(self._settings.device)
        weights = load_weights(weights_path(self._settings.weights)).asked(self._settings.iterations)
        self._fitting = FittedNetwork(
            weights.recipe.network, lambda cells: _fitted(weights.on_cells(cells), prepare_for, self._device)
        )
        self._cells = self._fitting.trained.geometry
        self._threads = torch.get_num_threads()
        self._last: _Seen | None = None
        self._pair: _Pair | None = None  # of the last scan and the one before it
        self._step: tuple[Array, float] | None = None

    @property
    def geometry(self) -> MapGeometry:
        """Cells of the maps that the network takes."""
        return self._cells

    @property
    def _network(self) -> OdometryNetwork:
        return self._fitting.on(self._cells).network

    def start(self, frame: Frame) -> None:
        """Start at a first scan; where its lidar does not fill the cells of the weights, find cells that fit it.

        Raises:
            DataError: too few cells of its map have a normal.
        """
        self._step = self._pair = None
        self._last = self._look(frame.scan)
        if not self._last.enough and self._fitting.trained.fits_any_cells:
            self._last = self._look_with_fitting_cells(frame)
        if not self._last.enough:
            raise DataError(
                f"frame {frame.index}: only {self._last.cells} cells of the network's maps "
                f"({self.geometry.rows} x {self.geometry.columns}) have a normal, {self._settings.min_cells} are "
                "needed; start at another scan, choose weights trained for this lidar, or residual scan-matching, "
                "which takes any"
            )

    def _look_with_fitting_cells(self, frame: Frame) -> _Seen:
        before, found = self._cells, fitting_geometry(frame.scan.points)
        self._cells = found or before
        seen = self._look(frame.scan)
        if not seen.enough:
            self._cells = before
            return self._look(frame.scan)
        _log.warning(
            "frame %d: this lidar does not fill the cells that the weights were trained on (%d x %d); the maps get "
            "%d x %d from %.1f to %.1f degrees",
            *(frame.index, before.rows, before.columns, self._cells.rows, self._cells.columns),
            *(self._cells.fov_down_deg, self._cells.fov_up_deg),
        )
        return seen

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return the network's ``T = δT·T̂``, or the initial pose marked as not ok on failure."""
        self._take(frame)
        return self.assess(frame, initial)

    def propose(self, frame: Frame, initial: RelativePose) -> Array | None:
        """Return the network's ``T`` ``(4, 4)`` before the loss evaluates it; None with too few cells."""
        pair = self._take(frame)
        if not pair.enough:
            return None
        pose = self._corrected(pair, initial.pose)
        self._step = (pose, pair.dt_s)
        return pose

    def assess(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return the answer of :meth:`refine` for the frame of the last :meth:`propose`."""
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
            return self._bridge(
                frame,
                initial,
                details,
                dt_s,
                f"only {after.matched:.0%} of the points have a match, {self._settings.min_matched:.0%} are needed",
            )
        if self._is_worse(after, before):
            why = f"the loss of the answer is higher ({after.cost:.4f} m, of the initial pose {before.cost:.4f} m)"
            return self._bridge(frame, initial, details, dt_s, why)
        self._step = (after.pose, dt_s)
        return self._answer(after, details)

    @property
    def current_scan(self) -> _Seen | None:
        """The last scan, for use as an argument of :meth:`pair`."""
        return self._last

    def pair(self, earlier: _Seen, current: _Seen, initial: RelativePose) -> RelativePose:
        """Return a scan's pose relative to any earlier one, ``T_j_k``, from the points only.

        Return ``initial``, marked as not ok, on failure.
        """
        if not (earlier.enough and current.enough):
            return replace(initial, ok=False)
        nothing, still = np.zeros((self._network.settings.imu_samples, 6)), np.zeros(3)
        before, after = self._estimate(self._paired(earlier, current, nothing, still), initial)
        if after.matched < self._settings.min_matched or self._is_worse(after, before):
            return replace(initial, ok=False)
        return self._answer(after, {})

    def take_back(self, initial: RelativePose) -> None:
        """Take the velocity from the initial pose, because the last answer was rejected downstream."""
        if self._step is not None:
            self._step = (initial.pose, self._step[1])

    def _take(self, frame: Frame) -> _Pair:
        """Return the pair of the last scan and the frame's, and make the latter the last scan."""
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
        prepared = self._fitting.on(self._cells).prepare(scan)
        vertices, cells = prepared.vertex_map, (self.geometry.rows, self.geometry.columns)
        if vertices.shape[1:] != cells:
            raise ConfigError(f"the network takes maps of {cells} cells, scans are prepared with {vertices.shape[1:]}")
        with at_run_time():
            seen = self._network.encode(on_device(vertices, self._device))
            there = int(valid_cells(seen.normals).sum()) if prepared.usable else 0
        return _Seen(scan.stamp_ns, seen, there, there >= self._settings.min_cells, self._threads)

    def _estimate(self, pair: _Pair, initial: RelativePose) -> tuple[EvaluatedPose, EvaluatedPose]:
        """Return the pose that the network starts from and its answer, both evaluated by the loss."""
        evaluator = LossEvaluator(pair.last.for_loss, pair.current.for_loss, self._settings, self._threads)
        before = min((evaluator.evaluate(T) for T in self._starts(initial, pair.dt_s)), key=lambda found: found.cost)
        answer = evaluator.evaluate(self._corrected(pair, before.pose))
        if len(answer.degenerate):  # along directions that the scans do not constrain, keep the initial pose
            correction = answer.constrained(se3.log(se3.between(before.pose, answer.pose)))
            answer = evaluator.evaluate(se3.orthonormalise(before.pose @ se3.exp(correction)))
        return before, evaluator.refine(answer)

    def _corrected(self, pair: _Pair, start: Array) -> Array:
        """Return the network's pose from a start ``(4, 4)``; after a long correction, run the network again."""
        found = self._run(pair, start)
        correction_m = float(np.linalg.norm(se3.between(start, found)[:3, 3]))
        return found if correction_m < _LONG_CORRECTION_M else self._run(pair, found)

    def _run(self, pair: _Pair, start: Array) -> Array:
        with at_run_time():
            pose = on_device(start, self._device)
            found = self._network.refine_encoded(pair.last.maps, pair.current.maps, pose, pair.features)
            return se3.orthonormalise(found.pose[0].double().cpu().numpy())

    def _starts(self, initial: RelativePose, dt_s: float) -> list[Array]:
        """Return the initial pose, and where its translation is uncertain, also poses behind and ahead of it."""
        sure = initial.translation_sigma_m <= UNKNOWN_TRANSLATION_SIGMA_M
        shifts = [0.0] if sure else [speed * dt_s for speed in self._settings.start_speeds_m_s]
        return [initial.pose @ se3.exp(np.array([0, 0, 0, shift, 0, 0])) for shift in shifts]

    def _is_worse(self, after: EvaluatedPose, before: EvaluatedPose) -> bool:
        """Return whether the loss rises to the answer, and the poses are too far apart (99 %) for that to be noise."""
        if after.cost < before.cost * _RISE:
            return False
        xi = se3.log(se3.between(before.pose, after.pose))
        return bool(xi @ np.linalg.solve(before.spread(self._settings.covariance_scale), xi) > CHI2_99)

    def _answer(self, found: EvaluatedPose, details: dict[str, float]) -> RelativePose:
        # The covariance comes from the points alone. IMU features make the answer depend on the samples too, but their
        # noise over a step (0.02°, 0.2 mm) is far below the answer's own, so the graph may use both as independent.
        return RelativePose(
            found.pose,
            found.covariance(self._settings.covariance_scale),
            source=self.name,
            degenerate=found.degenerate,
            details={**details, "sigma_m": found.sigma_m, "refined": float(found.refined)},
        )

    def _bridge(
        self, frame: Frame, initial: RelativePose, details: dict[str, float], dt_s: float, why: str
    ) -> RelativePose:
        _log.warning("frame %d: bridged by the initial pose: network: %s", frame.index, why)
        self._step = (initial.pose, dt_s)
        return replace(initial, ok=False, degenerate=np.empty((0, 6)), details=details)
