"""A trained network with the preparation of scans for the cells of its maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.sensors import Scan
from hybridlio.learned.data.preparing import Mapped
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import Weights
from hybridlio.learned.settings import Recipe

Prepare = Callable[[Scan], Mapped]
"""Prepares a scan for a network."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """The network and the preparation of scans for the same cells."""

    network: OdometryNetwork
    prepare: Prepare


class FittedNetwork:
    """Weights on the cells of any lidar; the last ones asked for are kept.

    Args:
        weights: of the network.
        prepare_for: returns the preparation of scans for a recipe.
        device: of the network.
    """

    def __init__(self, weights: Weights, prepare_for: Callable[[Recipe], Prepare], device: torch.device) -> None:
        self.trained = weights.recipe.network
        self._weights, self._prepare_for, self._device = weights, prepare_for, device
        self._last = self._make(self.trained.geometry)

    def on(self, cells: MapGeometry) -> Fitted:
        """Return the network and the preparation for these cells."""
        if self._last.network.settings.geometry != cells:
            self._last = self._make(cells)
        return self._last

    def _make(self, cells: MapGeometry) -> Fitted:
        weights = self._weights.on_cells(cells)
        return Fitted(weights.network(self._device), self._prepare_for(weights.recipe))
