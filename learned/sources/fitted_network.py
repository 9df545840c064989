"""A trained network with the preparation of scans for the cells of its maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.sensors import Scan
from hybridlio.learned.data.preparing import Mapped
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.settings import NetworkSettings

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
        trained: settings of the network that was trained.
        make: returns the network and the preparation for given cells.
    """

    def __init__(self, trained: NetworkSettings, make: Callable[[MapGeometry], Fitted]) -> None:
        self.trained, self._make = trained, make
        self._last = make(trained.geometry)

    def on(self, cells: MapGeometry) -> Fitted:
        """Return the network and the preparation for these cells."""
        if self._last.network.settings.geometry != cells:
            self._last = self._make(cells)
        return self._last
