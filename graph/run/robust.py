"""Adding groups of factors to a run's graph, with their possible outliers made robust.

Either by a robust kernel, or by graduated non-convexity (GNC, :mod:`hybridlio.graph.base.truncated_squares`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import State
from hybridlio.graph.base import noise
from hybridlio.graph.base.marginals import Covariance
from hybridlio.graph.base.truncated_squares import chi2_bound, graduate
from hybridlio.graph.model.noise import Robust, default_width
from hybridlio.graph.run.factor_groups import (
    FactorGroup,
    GroupFactors,
    GroupSolution,
    PossibleOutlier,
    squared_residuals,
)
from hybridlio.smoothing.verdict import KindFit

# Kernels that tolerate outliers from the poses of the odometry on. Those that lose all weight (Tukey, truncated least
# squares) drop correct loops there, and a dead zone keeps wrong ones (tests/graph/run/test_factor_groups.py).
ROBUST_METHODS = ("huber", "cauchy", "geman-mcclure", "dcs", "gnc")
_MAX_STEPS = 100  # a bound on a loop that ends by itself
_LEAST_WEIGHT = 0.5  # of a measurement that counts as accepted: one at the kernel's width keeps a quarter to a half
_CONVERGED_RATIO = 0.99  # of the error to the previous one: weights do not depend on the last percent

Solve = Callable[[gtsam.NonlinearFactorGraph, gtsam.Values], gtsam.Values]


def check_robust_method(robust: str | None) -> str | None:
    """Return the name of a robust method, or None.

    Raises:
        ConfigError: no method has this name.
    """
    if robust is not None and robust not in ROBUST_METHODS:
        raise ConfigError(f"robust: there is no {robust!r}; choose one of {', '.join(ROBUST_METHODS)}")
    return robust


class AddedGroups:
    """Groups of factors that are added to a run's graph, round by round.

    Args:
        groups: in this order.
        robust: one method for all, instead of each group's default.
    """

    def __init__(self, groups: Sequence[FactorGroup], robust: str | None) -> None:
        self._groups = groups
        self._methods = [robust or check_robust_method(group.robust) for group in groups]
        self._weights: list[Array] = []
        self._parts: list[GroupFactors] = []
        self._previous: gtsam.Values | None = None

    def add_to(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, states: list[State], solve: Solve
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the run's graph and values with those of the groups; the first call decides on outliers.

        Args:
            graph, values: of the run's own steps.
            states: of its scans.
            solve: optimises a graph from values; a few iterations are enough.
        """
        if not self._groups:
            return graph, values
        self._parts = [group.build(states, self._previous) for group in self._groups]
        for part in self._parts:
            for factor in part.trusted:
                graph.add(factor)
            values.insert(part.values)
        if not self._weights:
            values = self._weigh(graph, values, solve)
        for part, method, weights in zip(self._parts, self._methods, self._weights, strict=True):
            for factor in robust_factors(part.possible_outliers, method, weights):
                graph.add(factor)
        return graph, values

    def _weigh(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, solve: Solve) -> gtsam.Values:
        """Set the weights of all groups, those of GNC together, and return values that fit them."""
        self._weights = [np.ones(len(part.possible_outliers)) for part in self._parts]
        by_gnc = [k for k, method in enumerate(self._methods) if method == "gnc"]
        pooled = [measurement for k in by_gnc for measurement in self._parts[k].possible_outliers]
        if not pooled:
            return values
        trusted = gtsam.NonlinearFactorGraph(graph)
        for part, method in zip(self._parts, self._methods, strict=True):
            for factor in [] if method == "gnc" else robust_factors(part.possible_outliers, method, np.ones(0)):
                trusted.add(factor)
        values, weights = reject_outliers(trusted, pooled, values, solve)
        ends = np.cumsum([len(self._parts[k].possible_outliers) for k in by_gnc])[:-1]
        for k, own in zip(by_gnc, np.split(weights, ends), strict=True):
            self._weights[k] = np.asarray(own)
        return values

    def start_next_from(self, values: gtsam.Values) -> None:
        """Take the solution of this round as the start of the next."""
        self._previous = values

    def fits(self, values: gtsam.Values) -> list[KindFit]:
        """Return how the measurements of each group fit a solution, without those that are rejected."""
        out = []
        for group, part, method, weights in zip(self._groups, self._parts, self._methods, self._weights, strict=True):
            chi2 = squared_residuals(part.possible_outliers, values)
            if method is not None and method != "gnc":
                weights = kernel_weights(part.possible_outliers, method, chi2)
            rows = zip(part.possible_outliers, chi2, weights, strict=True)
            fits = [(m.name, float(x), len(m.covariance)) for m, x, weight in rows if weight > _LEAST_WEIGHT]
            out.append(KindFit.of(group.name, fits))
        return out

    def results(self, values: gtsam.Values, states: list[State], covariance: Covariance) -> dict[str, Any]:
        """Return each group's result in the solved graph, by the group's name."""
        out: dict[str, Any] = {}
        for group, part, method, weights in zip(self._groups, self._parts, self._methods, self._weights, strict=True):
            chi2 = squared_residuals(part.possible_outliers, values)
            if method is not None and method != "gnc":
                weights = kernel_weights(part.possible_outliers, method, chi2)
            out[group.name] = group.read(GroupSolution(values, states, weights, chi2, covariance))
        return out


def robust_factors(
    measurements: Sequence[PossibleOutlier], method: str | None, weights: Array
) -> list[gtsam.NonlinearFactor]:
    """Return the measurements as factors.

    Args:
        measurements: ``M`` of them.
        method: a kernel's name; ``gnc`` uses the weights and leaves out those of 0; None takes all as correct.
        weights: ``(M,)``; only used with ``gnc``.
    """
    if method is None:
        return [measurement.factor() for measurement in measurements]
    if method == "gnc":
        return [measurement.factor(w) for measurement, w in zip(measurements, weights, strict=True) if w > 0]
    return [_with_kernel(measurement, method) for measurement in measurements]


def kernel_weights(measurements: Sequence[PossibleOutlier], kernel: str, chi2: Array) -> Array:
    """Return the weights ``(M,)`` that a kernel gives measurements of squared whitened residuals ``chi2``."""
    kernels = [Robust(kernel, default_width(len(measurement.covariance))) for measurement in measurements]
    return np.array([robust.weight(float(np.sqrt(x))) for robust, x in zip(kernels, chi2, strict=True)])


def reject_outliers(
    trusted: gtsam.NonlinearFactorGraph,
    measurements: Sequence[PossibleOutlier],
    values: gtsam.Values,
    solve: Solve,
) -> tuple[gtsam.Values, Array]:
    """Find the outliers by graduated non-convexity with truncated least squares (Yang et al., RA-L 2020).

    Unlike the paper, the first residuals are those of ``values``, not of a solution with all measurements at full
    weight: outliers may bend a poorly constrained path so far that the correct measurements look wrong.

    Args:
        trusted: the other factors, which determine every variable without any of the measurements.
        measurements: ``M`` possible outliers.
        values: to start from; best the solution of the trusted factors alone.
        solve: optimises a graph from values; a few iterations are enough.

    Returns:
        Values, and weights ``(M,)``: 1 for inliers, 0 for outliers.
    """
    bounds = np.array([chi2_bound(len(measurement.covariance)) for measurement in measurements])

    def shares(at: gtsam.Values) -> Array:  # of the bounds, so that one control parameter serves all sizes
        return np.asarray(squared_residuals(measurements, at) / bounds)

    def weighted(at: gtsam.Values, weights: Array) -> gtsam.Values:
        graph = gtsam.NonlinearFactorGraph(trusted)
        for factor in robust_factors(measurements, "gnc", weights):
            graph.add(factor)
        return _solve_to_convergence(graph, at, solve)

    values, weights = graduate(values, shares, weighted, 1.0)
    return weighted(values, np.round(weights)), np.round(weights)


def _solve_to_convergence(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, solve: Solve) -> gtsam.Values:
    """Solve until the error stops falling: residuals before that would not tell outliers from inliers."""
    error = float(graph.error(values))
    for _ in range(_MAX_STEPS):
        values, before = solve(graph, values), error
        error = float(graph.error(values))
        if error > _CONVERGED_RATIO * before:
            break
    return values


def _with_kernel(measurement: PossibleOutlier, kernel: str) -> gtsam.NonlinearFactor:
    model = noise.gaussian(measurement.covariance, measurement.name)
    return measurement.make(noise.with_kernel(model, kernel, default_width(len(measurement.covariance))))
