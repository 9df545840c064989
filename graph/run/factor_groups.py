"""Groups of factors that smoothing adds to a run's own steps, such as GPS fixes or loop closures.

A group adds factors on the scans' variables (keys as in :mod:`hybridlio.graph.run.factors`) and variables of its own.
It returns measurements that may be outliers as :class:`PossibleOutlier`, so that one module makes all of them robust.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.graph.base import noise
from hybridlio.graph.base.marginals import Covariance


@dataclass(frozen=True, eq=False)
class PossibleOutlier:
    """A measurement that may be an outlier.

    Attributes:
        make: makes the factor from its noise model.
        covariance: ``(d, d)`` of the measurement if it is correct.
        name: for messages, such as ``loop 12-480``.
    """

    make: Callable[[gtsam.noiseModel.Base], gtsam.NonlinearFactor]
    covariance: Array
    name: str

    def factor(self, weight: float = 1.0) -> gtsam.NonlinearFactor:
        """Return the factor at a weight in (0, 1]."""
        return self.make(noise.gaussian(self.covariance / weight, self.name))


@dataclass(frozen=True, eq=False)
class GroupFactors:
    """What a group adds to the graph.

    Attributes:
        trusted: factors that are taken as they are.
        possible_outliers: measurements that the robust method decides on.
        values: initial values of the group's own variables, under keys that no other group uses.
    """

    trusted: list[gtsam.NonlinearFactor] = field(default_factory=list)
    possible_outliers: list[PossibleOutlier] = field(default_factory=list)
    values: gtsam.Values = field(default_factory=gtsam.Values)


@dataclass(frozen=True, eq=False)
class GroupSolution:
    """The solved graph as a group sees it.

    Attributes:
        values: of all variables.
        states: of all scans.
        weights: ``(M,)`` weight of each possible outlier: 1 in full, 0 rejected.
        chi2: ``(M,)`` their squared whitened residuals.
        covariance: returns the joint marginal covariance of variables, in the order of the given keys.
    """

    values: gtsam.Values
    states: list[State]
    weights: Array
    chi2: Array
    covariance: Covariance


class FactorGroup(Protocol):
    """Further measurements of a run's poses."""

    name: str
    robust: str | None  # default robust method: a kernel's name or ``gnc``; None takes all measurements for correct

    def build(self, states: Sequence[State], previous: gtsam.Values | None) -> GroupFactors:
        """Return factors and variables.

        Args:
            states: of all scans: the online estimate, or the previous round's solution.
            previous: all variables as the previous round solved them; None in the first round.
        """
        ...

    def read(self, solution: GroupSolution) -> Any:
        """Return the group's result for the user; it becomes an entry of ``Smoothed.found``."""
        ...


def squared_residuals(measurements: Sequence[PossibleOutlier], values: gtsam.Values) -> Array:
    """Return the squared whitened residuals ``(M,)``; χ² distributed for correct measurements."""
    return np.array([2 * measurement.factor().error(values) for measurement in measurements])
