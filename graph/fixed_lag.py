"""The online graph with a memory of constant length: scans older than the lag are marginalised."""

from __future__ import annotations

import gtsam
from gtsam.symbol_shorthand import B, G, M, V, X

from hybridlio.errors import ConfigError
from hybridlio.estimates import RelativePose, State
from hybridlio.graph.online import WARM_UP_STEPS, IncrementalBackend
from hybridlio.sensors import Calibration, Frame, ImuNoise


class FixedLagBackend(IncrementalBackend):
    """As :class:`IncrementalBackend`, in constant time and memory, however long the run.

    What is marginalised is not linearised anew; without loop closures nothing would change it, so the newest state is
    the same.

    Args:
        calibration, imu_noise: as there.
        lag_scans: how many scans stay in the graph.

    Raises:
        ConfigError: the lag is shorter than the warm-up.
    """

    name = "fixed-lag"

    def __init__(self, calibration: Calibration, imu_noise: ImuNoise, lag_scans: int = 100) -> None:
        super().__init__(calibration, imu_noise)
        if lag_scans < WARM_UP_STEPS:
            raise ConfigError(f"fixed-lag: a lag of {lag_scans} scans is too short, take {WARM_UP_STEPS} or more")
        self._lag = lag_scans

    def start(self, state: State) -> None:
        """As :meth:`IncrementalBackend.start`."""
        super().start(state)
        self._oldest = 0

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Add the step to ``frame`` and forget the scan that falls out of the lag; returns the state there.

        Raises:
            GraphError: the graph cannot be solved; names the variable.
        """
        state = super().update(frame, relative)
        oldest = self._k - self._lag
        if oldest > WARM_UP_STEPS:  # the scans solved at once at the start hang together: they go at once too
            self._forget(range(self._oldest, oldest))
            self._oldest = oldest
        return state

    def _forget(self, scans: range) -> None:
        keys = gtsam.KeyList()
        for key in (variable(k) for k in scans for variable in (X, V, B, G, M)):
            if self._isam.valueExists(key):
                keys.push_back(key)
        self._isam.marginalizeLeaves(keys)
