"""iSAM2 for a pose graph that grows: over all poses, or over a lag of poses with the older ones marginalised.

An update that cannot be solved leaves GTSAM's solver in an invalid state; both engines then rebuild it from the factors
that it held.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message, make_isam_params

# Changes beyond which a variable is linearised anew, checked at every tenth update: rad, m, m/s, and m/s² and rad/s of
# the biases. Smaller than those of an odometry run (hybridlio.graph.base.isam): a pose graph may span a few metres and
# have loops that are precise to centimetres.
TURN_RAD, SHIFT_M, _SPEED_M_S, _BIASES = 0.01, 0.1, 0.1, (0.05, 0.005)
_WILDFIRE_THRESHOLD = 1e-3  # changes below it (rad, m) stay where they are: a tenth of the turn above


class Engine(Protocol):
    """What an online solver needs from iSAM2.

    Attributes:
        solver: GTSAM's solver.
    """

    solver: Any

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: list[int], latest: Mapping[int, int]
    ) -> list[int]:
        """Add factors and variables, remove factors by slot, and return the slots of the new factors.

        Args:
            graph: the new factors.
            values: initial values of the new variables.
            removed: slots.
            latest: index of the newest pose that observes a landmark, by the index of each landmark in ``graph``.

        Raises:
            GraphError: the graph cannot be solved.
        """
        ...

    def iterate(self) -> bool:
        """Linearise anew what has moved and solve; return whether anything had moved."""
        ...

    def restore(self, kept: Collection[int]) -> dict[int, int]:
        """Rebuild the solver as it was before a failed update.

        Args:
            kept: slots of the factors from before that update.

        Returns:
            The new slot of each.
        """
        ...

    def joint(self, variables: list[int]) -> Any:
        """Return GTSAM's joint marginal covariance of some variables."""
        ...


class Incremental:
    """iSAM2 with QR over all poses (Kaess et al., IJRR 2012)."""

    def __init__(self, dimension: int) -> None:
        self._params, self._newest = _params(dimension, reuse_slots=False), _Newest(dimension)
        self.solver = gtsam.ISAM2(self._params)
        self._removed: dict[int, Any] = {}  # of the last update, by slot
        self._new: Collection[int] = ()  # variables of a failed update

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: list[int], _latest: Mapping[int, int]
    ) -> list[int]:
        """See :class:`Engine`."""
        held = self.solver.getFactorsUnsafe() if removed else gtsam.NonlinearFactorGraph()
        self._removed = {slot: held.at(slot) for slot in removed}
        try:
            slots = list(self.solver.update(graph, values, removed).getNewFactorsIndices())
            self._newest.estimate(self.solver, values)
        except RuntimeError as error:
            self._new = values.keys()
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        return slots

    def iterate(self) -> bool:
        """See :class:`Engine`."""
        again = gtsam.ISAM2UpdateParams()
        again.force_relinearize = True
        try:
            result = self.solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), again)
            self._newest.estimate(self.solver, gtsam.Values())
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        return bool(result.getVariablesRelinearized())

    def restore(self, kept: Collection[int]) -> dict[int, int]:
        """See :class:`Engine`."""
        held, values = self.solver.getFactorsUnsafe(), gtsam.Values(self.solver.getLinearizationPoint())
        for variable in self._new:
            if values.exists(variable):
                values.erase(variable)
        slots = sorted(kept)
        graph, new_slots = _compact({slot: self._removed.get(slot) or held.at(slot) for slot in slots})
        self.solver = gtsam.ISAM2(self._params)
        self.solver.update(graph, values)
        return new_slots

    def joint(self, variables: list[int]) -> Any:
        """See :class:`Engine`."""
        return self.solver.jointMarginalCovariance(variables)


class FixedLag:
    """iSAM2 with QR over the newest poses; GTSAM's smoother marginalises a pose when ``lag`` newer ones exist."""

    def __init__(self, dimension: int, lag: int) -> None:
        self._params, self._lag = _params(dimension, reuse_slots=True), float(lag)
        self._newest = _Newest(dimension)
        self.solver = gtsam.IncrementalFixedLagSmoother(self._lag, self._params)
        self._before = gtsam.NonlinearFactorGraph(), gtsam.Values()  # a failed update
        self._landmark_stamps: dict[Any, float] = {}  # of landmarks, by variable

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: list[int], latest: Mapping[int, int]
    ) -> list[int]:
        """See :class:`Engine`."""
        stamps: dict[Any, float] = {L(landmark): float(pose) for landmark, pose in latest.items()}
        before = gtsam.NonlinearFactorGraph(self.solver.getFactors())
        values_before = gtsam.Values(self.solver.getLinearizationPoint())
        try:
            self.solver.update(graph, values, _stamps(values) | stamps, removed)
            self._newest.estimate(self.solver, values)
        except RuntimeError as error:
            self._before = before, values_before
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        self._landmark_stamps |= stamps
        return list(self.solver.getISAM2Result().getNewFactorsIndices())

    def iterate(self) -> bool:
        """See :class:`Engine`."""
        try:
            self.solver.update()
            self._newest.estimate(self.solver, gtsam.Values())
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        return bool(self.solver.getISAM2Result().getVariablesRelinearized())

    def restore(self, kept: Collection[int]) -> dict[int, int]:
        """See :class:`Engine`."""
        held, values = self._before
        # all slots, not only the kept ones: some hold marginals of poses that have left the lag
        graph, new_slots = _compact({slot: held.at(slot) for slot in range(held.size()) if held.exists(slot)})
        self.solver = gtsam.IncrementalFixedLagSmoother(self._lag, self._params)
        stamps = _stamps(values)
        self.solver.update(graph, values, stamps | {v: self._landmark_stamps[v] for v in stamps if _is_landmark(v)}, [])
        return {slot: new_slots[slot] for slot in kept}

    def joint(self, variables: list[int]) -> Any:
        """See :class:`Engine`."""
        return self.solver.getISAM2().jointMarginalCovariance(variables)


class _Newest:
    """The newest pose of a solver.

    iSAM2 solves for the estimates when the first one is read. A system that is nearly indeterminate fails only there,
    so that one is read in each update, which fails as a whole then.
    """

    def __init__(self, dimension: int) -> None:
        self._read = f"calculateEstimatePose{dimension}"
        self._pose: int | None = None

    def estimate(self, solver: Any, new: gtsam.Values) -> None:
        """Solve for the estimates; raise GTSAM's RuntimeError where that fails.

        Args:
            solver: after an update.
            new: its new variables.
        """
        variables = new.keys()
        poses = [variable for variable in variables if gtsam.Symbol(variable).chr() == ord("x")]
        pose = max([*poses, self._pose] if self._pose else poses, default=None)
        if pose is not None:
            getattr(solver, self._read)(pose)
        self._pose = pose


def _params(dimension: int, reuse_slots: bool) -> gtsam.ISAM2Params:
    turn_3, shift_3 = np.full(3, TURN_RAD), np.full(3, SHIFT_M)
    pose = np.r_[turn_3, shift_3] if dimension == 3 else np.array([SHIFT_M, SHIFT_M, TURN_RAD])
    thresholds = {"x": pose, "v": np.full(3, _SPEED_M_S), "b": np.repeat(_BIASES, 3), "l": np.full(dimension, SHIFT_M)}
    params = make_isam_params(thresholds, _WILDFIRE_THRESHOLD)
    if reuse_slots:
        # few variables are in a lag: checking all at each update is cheap
        params.findUnusedFactorSlots, params.relinearizeSkip = True, 1
    return params


def _is_landmark(variable: int) -> bool:
    return bool(gtsam.Symbol(variable).chr() == ord("l"))


def _stamps(values: gtsam.Values) -> dict[Any, float]:
    """Return the time of each variable but landmarks for GTSAM's smoother: the index of its pose."""
    variables = values.keys()
    return {variable: float(gtsam.Symbol(variable).index()) for variable in variables}


def _compact(held: dict[int, Any]) -> tuple[gtsam.NonlinearFactorGraph, dict[int, int]]:
    """Return a graph of the factors without gaps, and the new slot of each old one."""
    graph, new_slots = gtsam.NonlinearFactorGraph(), {}
    for slot, factor in held.items():
        new_slots[slot] = graph.size()
        graph.add(factor)
    return graph, new_slots
