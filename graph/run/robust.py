"""Solving with measurements that may be wrong: by a robust kernel, or by graduated non-convexity (as in `gnc`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import State
from hybridlio.graph.base import noise
from hybridlio.graph.base.truncated_squares import GRADUATION, chi2_bound, first_control, truncated_weights
from hybridlio.graph.model.measurements import KERNELS, Robust, default_width
from hybridlio.graph.run.factor_groups import Doubtful, FactorGroup, GroupAnswer, GroupFactors, chi2_of

TREATMENTS = (*KERNELS, "gnc")
_STEPS = 100
_SETTLED = 0.99  # of the error before

Solve = Callable[[gtsam.NonlinearFactorGraph, gtsam.Values], gtsam.Values]


def check_treatment(robust: str | None) -> str | None:
    """The name of a treatment of what may be wrong, or None.

    Raises:
        ConfigError: there is none of this name.
    """
    if robust is not None and robust not in TREATMENTS:
        raise ConfigError(f"robust: there is no {robust!r}; choose one of {', '.join(TREATMENTS)}")
    return robust


class Added:
    """Groups of factors joined to a run's own graph, what is doubtful among them made robust.

    Args:
        groups: in this order.
        robust: one treatment for all, in place of the one each prefers.
    """

    def __init__(self, groups: Sequence[FactorGroup], robust: str | None) -> None:
        self._groups = groups
        self._treatments = [robust or check_treatment(group.robust) for group in groups]
        self._weights: list[Array] = []
        self._parts: list[GroupFactors] = []
        self._before: gtsam.Values | None = None

    def to(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, states: list[State], solve: Solve
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """A run's graph and values with those of the groups; in the first round wrong measurements are looked for.

        Args:
            graph, values: of the run's own steps.
            states: of its scans.
            solve: optimises a graph from values; a few iterations are enough.
        """
        if not self._groups:
            return graph, values
        self._parts = [group.build(states, self._before) for group in self._groups]
        for part in self._parts:
            for factor in part.sure:
                graph.add(factor)
            values.insert(part.values)
        if not self._weights:
            values = self._reject(graph, values, solve)
        for part, treatment, weights in zip(self._parts, self._treatments, self._weights, strict=True):
            for factor in robust_factors(part.doubtful, treatment, weights):
                graph.add(factor)
        return graph, values

    def _reject(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, solve: Solve) -> gtsam.Values:
        self._weights = [np.ones(len(part.doubtful)) for part in self._parts]
        chosen = [k for k, treatment in enumerate(self._treatments) if treatment == "gnc"]
        pooled = [measurement for k in chosen for measurement in self._parts[k].doubtful]
        if not pooled:
            return values
        sure = gtsam.NonlinearFactorGraph(graph)
        for part, treatment in zip(self._parts, self._treatments, strict=True):
            for factor in [] if treatment == "gnc" else robust_factors(part.doubtful, treatment, np.ones(0)):
                sure.add(factor)
        values, weights = reject(sure, pooled, values, solve)
        ends = np.cumsum([len(self._parts[k].doubtful) for k in chosen])[:-1]
        for k, own in zip(chosen, np.split(weights, ends), strict=True):
            self._weights[k] = np.asarray(own)
        return values

    def keep(self, values: gtsam.Values) -> None:
        """Go on from these values in the next round."""
        self._before = values

    def found(self, values: gtsam.Values, states: list[State], isam: gtsam.ISAM2) -> dict[str, Any]:
        """What each group found, by its name, in the solved graph."""

        def covariance(keys: Sequence[int]) -> Array:
            return np.asarray(isam.jointMarginalCovariance(list(keys)).fullMatrix())

        out: dict[str, Any] = {}
        for group, part, treatment, weights in zip(
            self._groups, self._parts, self._treatments, self._weights, strict=True
        ):
            chi2 = chi2_of(part.doubtful, values)
            if treatment is not None and treatment != "gnc":
                weights = kernel_weights(part.doubtful, treatment, chi2)
            out[group.name] = group.read(GroupAnswer(values, states, weights, chi2, covariance))
        return out


def robust_factors(doubtful: Sequence[Doubtful], treatment: str | None, weights: Array) -> list[gtsam.NonlinearFactor]:
    """The measurements as factors: with a kernel or, for ``gnc``, at their ``(M,)`` weights, those of 0 left out."""
    if treatment is None:
        return [measurement.factor() for measurement in doubtful]
    if treatment == "gnc":
        return [measurement.factor(w) for measurement, w in zip(doubtful, weights, strict=True) if w > 0]
    return [_with_kernel(measurement, treatment) for measurement in doubtful]


def kernel_weights(doubtful: Sequence[Doubtful], kernel: str, chi2: Array) -> Array:
    """``(M,)`` what a kernel leaves of each measurement's weight."""
    kernels = [_kernel(measurement, kernel) for measurement in doubtful]
    return np.array([robust.weight(float(np.sqrt(x))) for robust, x in zip(kernels, chi2, strict=True)])


def reject(
    sure: gtsam.NonlinearFactorGraph, doubtful: Sequence[Doubtful], values: gtsam.Values, solve: Solve
) -> tuple[gtsam.Values, Array]:
    """Find the wrong ones of the doubtful measurements by graduated non-convexity with truncated least squares.

    Args:
        sure: the other factors, which determine every variable with any of the doubtful ones left out.
        doubtful: ``M`` measurements.
        values: to start from, best those of the sure factors alone: all the doubtful ones at once may bend what is
            soft to the wrong ones so far that the right ones look wrong.
        solve: optimises a graph from values; a few iterations are enough.

    Returns:
        Values, and weights ``(M,)``: 1 for what is right, 0 for what is wrong.
    """
    bounds = np.array([chi2_bound(len(measurement.covariance)) for measurement in doubtful])
    control = 0.0
    for step in range(_STEPS):
        shares = chi2_of(doubtful, values) / bounds
        control = control * GRADUATION if step else first_control(float(shares.max()), 1.0)
        weights = truncated_weights(shares, 1.0, control)
        graph = gtsam.NonlinearFactorGraph(sure)
        for factor in robust_factors(doubtful, "gnc", weights):
            graph.add(factor)
        values = _settle(graph, values, solve)
        if ((weights == 0) | (weights == 1)).all():
            break
    return values, np.round(weights)


def _settle(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, solve: Solve) -> gtsam.Values:
    """Solve until the error has stopped falling: residuals far from the answer would say nothing of what is wrong."""
    error = float(graph.error(values))
    for _ in range(_STEPS):
        values, before = solve(graph, values), error
        error = float(graph.error(values))
        if error > _SETTLED * before:
            break
    return values


def _kernel(measurement: Doubtful, kernel: str) -> Robust:
    return Robust(kernel, default_width(len(measurement.covariance)))


def _with_kernel(measurement: Doubtful, kernel: str) -> gtsam.NonlinearFactor:
    model = noise.gaussian(measurement.covariance, measurement.name)
    return measurement.make(noise.with_kernel(model, kernel, default_width(len(measurement.covariance))))
