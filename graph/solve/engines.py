"""iSAM2 under a pose graph that grows: over everything, or over a lag of poses with the older ones marginalised.

An update that cannot be solved leaves GTSAM's solver in pieces; both engines then make it anew from what it held.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message, make_isam_params

# Linearised anew beyond these changes, rad and m; every tenth update looks.
_TURN, _SHIFT, _SPEED, _BIAS = 0.01, 0.1, 0.1, (0.05, 0.005)
_WILDFIRE_THRESHOLD = 1e-3
_X0 = X(0)


class Engine(Protocol):
    """What an online solver asks of iSAM2."""

    solver: Any

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: list[int]) -> list[int]:
        """Add factors and variables, take factors out by their slots; the new factors' slots.

        Raises:
            GraphError: cannot be solved.
        """
        ...

    def iterate(self) -> bool:
        """Linearise anew what has moved, and solve; whether anything had."""
        ...

    def restore(self, kept: Collection[int]) -> dict[int, int]:
        """As before an update that failed; ``kept`` are the slots from then, which get the numbers of the answer."""
        ...

    def joint(self, variables: list[int]) -> Any:
        """GTSAM's joint marginal covariance."""
        ...


class Incremental:
    """iSAM2 by QR (Kaess et al., IJRR 2012)."""

    def __init__(self, dimension: int) -> None:
        self._params = _params(dimension, reuse_slots=False)
        self.solver = gtsam.ISAM2(self._params)

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: list[int]) -> list[int]:
        """See :class:`Engine`."""
        held = self.solver.getFactorsUnsafe() if removed else gtsam.NonlinearFactorGraph()
        self._removed = {slot: held.at(slot) for slot in removed}
        try:
            return list(self.solver.update(graph, values, removed).getNewFactorsIndices())
        except RuntimeError as error:
            self._new = values.keys()
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error

    def iterate(self) -> bool:
        """See :class:`Engine`."""
        again = gtsam.ISAM2UpdateParams()
        again.force_relinearize = True
        result = self.solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), again)
        return bool(result.getVariablesRelinearized())

    def restore(self, kept: Collection[int]) -> dict[int, int]:
        """See :class:`Engine`."""
        held, values = self.solver.getFactorsUnsafe(), gtsam.Values(self.solver.getLinearizationPoint())
        for variable in self._new:
            if values.exists(variable):
                values.erase(variable)
        slots = sorted(kept)
        graph, numbers = _compacted({slot: self._removed.get(slot) or held.at(slot) for slot in slots})
        self.solver = gtsam.ISAM2(self._params)
        self.solver.update(graph, values)
        return numbers

    def joint(self, variables: list[int]) -> Any:
        """See :class:`Engine`."""
        return self.solver.jointMarginalCovariance(variables)


class FixedLag:
    """The newest poses in iSAM2 by QR; GTSAM's smoother marginalises a pose when ``lag`` newer ones are there."""

    def __init__(self, dimension: int, lag: int) -> None:
        self._params, self._lag = _params(dimension, reuse_slots=True), float(lag)
        self.solver = gtsam.IncrementalFixedLagSmoother(self._lag, self._params)

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: list[int]) -> list[int]:
        """See :class:`Engine`."""
        before = gtsam.NonlinearFactorGraph(self.solver.getFactors())
        values_before = gtsam.Values(self.solver.getLinearizationPoint())
        try:
            self.solver.update(graph, values, _stamps(values), removed)
        except RuntimeError as error:
            self._before = before, values_before
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        return list(self.solver.getISAM2Result().getNewFactorsIndices())

    def iterate(self) -> bool:
        """See :class:`Engine`."""
        self.solver.update()
        return bool(self.solver.getISAM2Result().getVariablesRelinearized())

    def restore(self, kept: Collection[int]) -> dict[int, int]:
        """See :class:`Engine`."""
        held, values = self._before
        # marginals have slots beside the kept ones
        graph, numbers = _compacted({slot: held.at(slot) for slot in range(held.size()) if held.exists(slot)})
        self.solver = gtsam.IncrementalFixedLagSmoother(self._lag, self._params)
        self.solver.update(graph, values, _stamps(values), [])
        return {slot: numbers[slot] for slot in kept}

    def joint(self, variables: list[int]) -> Any:
        """See :class:`Engine`."""
        return self.solver.getISAM2().jointMarginalCovariance(variables)


def _params(dimension: int, reuse_slots: bool) -> gtsam.ISAM2Params:
    pose = np.r_[np.full(3, _TURN), np.full(3, _SHIFT)] if dimension == 3 else np.array([_SHIFT, _SHIFT, _TURN])
    thresholds = {"x": pose, "v": np.full(3, _SPEED), "b": np.repeat(_BIAS, 3)}
    params = make_isam_params(thresholds, _WILDFIRE_THRESHOLD)
    if reuse_slots:
        params.findUnusedFactorSlots, params.relinearizeSkip = True, 1  # looking at a lag costs little
    return params


def _stamps(values: gtsam.Values) -> Any:
    """A variable's age is its pose's place."""
    variables = values.keys()
    return {variable: float(gtsam.Symbol(variable).index()) for variable in variables}


def _compacted(held: dict[int, Any]) -> tuple[gtsam.NonlinearFactorGraph, dict[int, int]]:
    graph, numbers = gtsam.NonlinearFactorGraph(), {}
    for slot, factor in held.items():
        numbers[slot] = graph.size()
        graph.add(factor)
    return graph, numbers
