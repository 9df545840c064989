"""The online factor graph in constant memory: scans older than a lag are marginalised."""

from __future__ import annotations

import gtsam

from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Frame
from hybridlio.graph.run import factors
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import WARM_UP_STEPS, IncrementalBackend

# Scans that are marginalised together: each time, all remaining variables are reordered, so rarely is cheaper; the
# graph holds at most this many scans more than the lag.
_BATCH_SCANS = 40


class FixedLagBackend(IncrementalBackend):
    """As :class:`IncrementalBackend`, in constant time and memory however long the run.

    Marginalised scans are not relinearised. Without loop closures that hardly matters: the newest state differs by less
    than a fiftieth of its standard deviation (tests/graph/run/test_fixed_lag_backend.py).

    GTSAM's ``IncrementalFixedLagSmoother`` marginalises at every scan, and reorders all variables each time: 13.7 ms an
    update, where this takes 2.6 ms, at most 0.010 standard deviations from the incremental backend, where this is 0.007
    (``python benchmarks/fixed_lag.py --steps 300 --seeds 1``). So this marginalises by itself, some scans at a time.

    Args:
        steps: preintegrates the samples between scans.
        lag_scans: the least number of scans that stay in the graph.

    Raises:
        ConfigError: the lag is shorter than the warm-up.
    """

    name = "fixed-lag"
    _removes_factors = True  # 2 % of an update; otherwise empty slots take 0.2 to 0.4 kB a scan

    def __init__(self, steps: InertialSteps, lag_scans: int = 100) -> None:
        super().__init__(steps)
        if lag_scans < WARM_UP_STEPS:
            raise ConfigError(f"fixed-lag: a lag of {lag_scans} scans is too short, take {WARM_UP_STEPS} or more")
        self._lag = lag_scans
        self._oldest = 0

    def start(self, state: State) -> None:
        """As :meth:`IncrementalBackend.start`."""
        super().start(state)
        self._oldest = 0

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Add the step to ``frame``, from time to time marginalising scans beyond the lag; return the state there.

        Raises:
            GraphError: the graph cannot be solved; the message names the variable.
            DataError: as :meth:`IncrementalBackend.update`.
        """
        state = super().update(frame, relative)
        if self._k - self._lag >= self._oldest + _BATCH_SCANS:
            self._marginalise(range(self._oldest, self._k - self._lag))
            self._oldest = self._k - self._lag
        return state

    def _marginalise(self, scans: range) -> None:
        """Eliminate the scans' variables before all others, then marginalise them.

        iSAM2 crashes if it marginalises variables that are not leaves of its Bayes tree, that is, not eliminated first.
        A chain of scans mostly is in that order, but not where old variables were relinearised, or where relative poses
        join old scans to new ones.
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
        self._scans.remove(scans)

    def _keys(self, scans: range) -> list[int]:
        keys = (variable(k) for k in scans for variable in factors.VARIABLES)
        return [key for key in keys if self._isam.valueExists(key)]
