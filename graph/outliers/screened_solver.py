"""An online solver that decides which measurements to believe: by χ² tests, or by searches for wrong loops."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.errors import ConfigError, GraphError
from hybridlio.graph.base.deep_stack import on_deep_stack
from hybridlio.graph.model.edge_arrays import consecutive
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.outliers.rejection import reject_outliers
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.changes import Changes, ChangeTracker
from hybridlio.graph.solve.online_solver import OnlineSolver
from hybridlio.graph.solve.settings import OUTLIER_TESTS, check_choice, silent

# That tests reject even one of all correct measurements. Wrong loops are mostly off by tens of standard deviations; a
# correct one that is lost early lets the map drift on, so that later ones may be lost with it.
_CHANCE_OF_A_LOSS = 0.01
# A search costs what all loops so far cost. It is repeated when their number has grown by a quarter, so that all
# searches together cost about five times the last one, and earlier where tests reject more than wrong loops explain:
# then the wrong ones may be in the map.
_GROWTH, _LEAST_NEW = 0.25, 5
_REJECTED_SHARE, _LEAST_REJECTED = 0.05, 2


class ScreenedSolver(OnlineSolver):
    """Follows a graph as :class:`OnlineSolver` does, through a copy that has the believed factors alone.

    ``chi2`` tests each loop and GPS fix once: its difference from the estimate against the covariances of both. Of the
    chance that any correct one is lost, the k-th test has a share of 1 / k(k + 1), as their number is not known before.
    A test trusts the map so far, so that a wrong loop which comes before any other is believed.

    ``gnc`` tests loops in the same way, and decides on all of them anew by the search of ``optimize("gnc")`` where
    tests have rejected any: whenever the number of loops has grown by a quarter, when tests begin to reject more than
    a twentieth, and in an update without changes. Where the search finds another set of loops, the solver starts again
    from its solution.

    Args:
        data: the graph.
        backend, lag, forget: as in :class:`OnlineSolver`.
        outliers: ``chi2`` or ``gnc``.

    Raises:
        ConfigError: an unknown name, or ``gnc`` with a lag, whose poses that left cannot be decided on again.
    """

    def __init__(self, data: GraphData, backend: str, lag: int, forget: bool, outliers: str) -> None:
        check_choice("test of outliers", outliers, OUTLIER_TESTS)
        if outliers == "gnc" and backend != "incremental":
            raise ConfigError('outliers="gnc" needs the incremental backend: poses that left a lag cannot move again')
        self._source, self._source_tracker = data, ChangeTracker(data)
        self._settings, self._searches = (backend, lag, forget), outliers == "gnc"
        believed = GraphData(data.dimension)
        believed.landmarks = data.landmarks
        super().__init__(believed, *self._settings)
        self._ids: dict[int, int] = {}  # of believed factors: in the copy, by theirs in the graph
        self._waiting: list[int] = []  # factors to be tested
        self._rejected: set[int] = set()
        self._doubts: tuple[str, ...] = ()
        self._tested = self._tested_then = 0  # now, and at the last search
        self._rejected_since = 0  # by tests since the last search

    @property
    def rejected(self) -> frozenset[int]:
        """See :class:`OnlineSolver`."""
        return frozenset(self._rejected)

    @property
    def doubtful(self) -> tuple[str, ...]:
        """See :class:`OnlineSolver`."""
        return self._doubts

    def update(self) -> None:
        """See :class:`OnlineSolver`."""
        self._check_not_replaced(self._source)
        changes = self._source_tracker.read()
        if changes:
            self._waiting += self._take(changes)
        if changes or not self._is_undecided:
            self._update_believed()
        while self._waiting:
            self._test(self._waiting.pop(0))
        if self._is_search_due or (not changes and self._is_undecided):
            self._search()

    # the copy

    def _take(self, changes: Changes) -> list[int]:
        """Put changes into the copy, and return the ids of the factors to be tested first."""
        source, believed = self._source, self._data
        believed.origin = source.origin
        for key in source.keys_at(changes.poses):
            believed.add_pose(key, source.initial_value(key))
        new = sorted([*source.edges.ids[changes.edge_rows].tolist(), *changes.other_factors])
        factors = {number: source.factors[number] for number in new}
        suspects = [number for number, factor in factors.items() if self._is_suspect(factor)]
        for number in [n for n in new if n not in set(suspects)]:
            self._believe(number)
        for number in changes.removed:
            self._drop(number)
        for key in changes.fixed:
            believed.set_initial(key, source.initial_value(key))
            believed.fix(key)
        for key in changes.unfixed:
            believed.unfix(key)
        self._source_tracker.accept(changes)
        return suspects

    def _is_suspect(self, factor: Factor) -> bool:
        if factor.kind == "between":
            return not consecutive(*factor.keys)
        return factor.kind == "gps" and not self._searches

    def _believe(self, number: int) -> None:
        self._ids[number] = self._data.add_factor(self._source.factors[number])

    def _drop(self, number: int) -> None:
        """Take over the removal of a factor."""
        if number in self._ids:
            self._data.remove(self._ids.pop(number))
        self._rejected.discard(number)
        self._waiting = [waiting for waiting in self._waiting if waiting != number]

    def _update_believed(self) -> None:
        """Update without the factors to be tested; where that does not determine every pose, with those of new ones."""
        try:
            super().update()
        except GraphError:
            if self._searches and self._waiting and not len(self):
                self._search()
                return
            trusted = [number for number in self._waiting if self._concerns_new_pose(self._source.factors[number])]
            if not trusted:
                raise
            self._update_trusting(trusted)

    def _concerns_new_pose(self, factor: Factor) -> bool:
        return any(self._source.index[key] >= len(self) for key in factor.keys)

    def _update_trusting(self, trusted: list[int]) -> None:
        for number in trusted:
            self._believe(number)
        try:
            super().update()
        except GraphError:
            for number in trusted:
                self._data.remove(self._ids.pop(number))
            raise
        self._waiting = [number for number in self._waiting if number not in trusted]

    def _forget_factors(self, ids: set[int], poses: range, leaving: Array) -> None:
        super()._forget_factors(ids, poses, leaving)
        gone = {number for number, own in self._ids.items() if own in ids}
        gone |= {n for n in self._rejected if any(self._source.index[k] in poses for k in self._source.factors[n].keys)}
        self._source.forget(gone, poses, leaving)
        self._source_tracker.forget(gone)
        self._rejected -= gone
        for number in gone & self._ids.keys():
            del self._ids[number]

    # tests

    def _test(self, number: int) -> None:
        """Believe a factor whose χ² is within the bound of correct ones."""
        self._tested += 1
        factor = self._source.factors[number]
        in_lag = all(self._source.index[key] >= self._oldest for key in factor.keys)
        if in_lag:  # else the update says that a pose has left the lag
            chi2, size = self._innovation(number, factor)
            if not chi2 <= chi_square_quantile(1 - _CHANCE_OF_A_LOSS / (self._tested * (self._tested + 1)), size):
                self._rejected.add(number)
                self._rejected_since += 1
                return
        self._believe(number)
        super().update()

    def _innovation(self, number: int, factor: Factor) -> tuple[float, int]:
        """Return χ² of a factor's residual by its own covariance and the estimates', and its degrees of freedom."""
        builder, row = Builder(self._source), self._source.edges.row(number)
        built: Any
        if row is None:
            built = builder.factor(factor, robust=False)
        else:
            (built,) = builder.edges(slice(row, row + 1), robust=False)
        at = gtsam.Values()
        for key in factor.keys:
            index = self._source.index[key]
            at.insert(X(index), self._gtsam_pose(self._engine.solver, index, estimated=True))
        linear = built.linearize(at)
        A, b = linear.jacobian()  # whitened
        spread = np.eye(len(b)) + A @ self._joint_covariance(list(linear.keys())) @ A.T
        return float(b @ np.linalg.solve(spread, b)), len(b)

    def _joint_covariance(self, variables: list[int]) -> Array:
        """Return the joint covariance of pose variables, in GTSAM's order."""
        if len(variables) == 1:
            return self._marginal(variables[0])
        joint: Any = on_deep_stack(len(self), lambda: self._engine.joint(variables))
        return np.block([[joint.at(a, b) for b in variables] for a in variables])

    # searches

    @property
    def _is_undecided(self) -> bool:
        """Whether loops came since the last search, of which tests reject some."""
        return self._searches and bool(self._rejected) and self._tested > self._tested_then

    @property
    def _is_search_due(self) -> bool:
        if not self._is_undecided:
            return False
        new, then = self._tested - self._tested_then, self._tested_then
        contradicted = self._rejected_since >= max(_LEAST_REJECTED, _REJECTED_SHARE * then)
        return contradicted or new >= max(_LEAST_NEW, _GROWTH * then)

    def _search(self) -> None:
        """Decide on all loops anew; where that changes any, start again from what the search found."""
        source = self._source
        found = on_deep_stack(len(source), lambda: reject_outliers(source.copy(), None, silent))
        self._tested += len(self._waiting)
        self._waiting.clear()
        self._tested_then, self._rejected_since, self._doubts = self._tested, 0, found.doubts
        if found.wrong == self._rejected and len(self):
            return
        self._rejected = set(found.wrong)
        believed = source.copy(without=found.wrong)
        believed.landmarks = source.landmarks
        believed.set_all_initial(found.start)
        self._ids = {number: number for number in believed.factors}
        super().__init__(believed, *self._settings)
        super().update()


def online_solver(data: GraphData, backend: str, lag: int, forget: bool, outliers: str | None) -> OnlineSolver:
    """Return a solver that follows a graph, with tests of outliers where they are asked for."""
    if outliers is None:
        return OnlineSolver(data, backend, lag, forget)
    return ScreenedSolver(data, backend, lag, forget, outliers)
