"""The online graph with a memory of constant length: scans older than the lag are marginalised."""

from __future__ import annotations

import gtsam

from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Frame
from hybridlio.graph.run import factors
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import WARM_UP_STEPS, IncrementalBackend

_AT_ONCE = 40  # so many scans are forgotten together, as it takes sorting all that are left


class FixedLagBackend(IncrementalBackend):
    """As :class:`IncrementalBackend`, in constant time and memory, however long the run.

    What is marginalised is not linearised anew; without loop closures little would change it, so that the newest state
    is the same to a hundredth of its standard deviation.

    Args:
        steps: as there.
        lag_scans: how many scans stay in the graph at least.

    Raises:
        ConfigError: the lag is shorter than the warm-up.
    """

    name = "fixed-lag"
    _forgets = True  # costs 2 % of an update; without, empty slots take 0.2 to 0.4 kB a scan

    def __init__(self, steps: InertialSteps, lag_scans: int = 100) -> None:
        super().__init__(steps)
        if lag_scans < WARM_UP_STEPS:
            raise ConfigError(f"fixed-lag: a lag of {lag_scans} scans is too short, take {WARM_UP_STEPS} or more")
        self._lag = lag_scans

    def start(self, state: State) -> None:
        """As :meth:`IncrementalBackend.start`."""
        super().start(state)
        self._oldest = 0

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Add the step to ``frame``, now and then forgetting scans beyond the lag; returns the state there.

        Raises:
            GraphError: the graph cannot be solved; names the variable.
        """
        state = super().update(frame, relative)
        if self._k - self._lag >= self._oldest + _AT_ONCE:
            self._forget(range(self._oldest, self._k - self._lag))
            self._oldest = self._k - self._lag
        return state

    def _forget(self, scans: range) -> None:
        """Eliminate the scans before all others, then marginalise them.

        iSAM2 crashes at variables that were not eliminated first. As they come in, a chain of scans mostly is in order,
        but not where old variables were linearised anew, or where keyframes join old scans to new ones.
        """
        order, everything, leaving = gtsam.KeyGroupMap(), gtsam.KeyList(), gtsam.KeyList()
        for place, group in enumerate((scans, range(scans.stop, self._k + 1))):
            for key in self._keys(group):
                order.insert2(key, place)
                everything.push_back(key)
        for key in self._keys(scans):
            leaving.push_back(key)
        self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], order, None, everything)
        self._isam.marginalizeLeaves(leaving)
        self._scans.forget(scans)

    def _keys(self, scans: range) -> list[int]:
        keys = (variable(k) for k in scans for variable in factors.VARIABLES)
        return [key for key in keys if self._isam.valueExists(key)]
