"""Groups of factors that smoothing adds to a run's own steps, such as GPS fixes or loop closures.

A group adds factors on the scans' variables (keys as in :mod:`hybridlio.graph.run.factors`) and variables of its own.
It returns measurements that may be wrong as :class:`Doubtful`, so that one module makes all of them robust.
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


@dataclass(frozen=True, eq=False)
class Doubtful:
    """A measurement that may be wrong.

    Attributes:
        make: makes the factor, given its noise model.
        covariance: ``(d, d)`` of the measurement if it is right.
        name: for messages, such as ``loop 12-480``.
    """

    make: Callable[[gtsam.noiseModel.Base], gtsam.NonlinearFactor]
    covariance: Array
    name: str

    def factor(self, weight: float = 1.0) -> gtsam.NonlinearFactor:
        """The factor at a weight in (0, 1]."""
        return self.make(noise.gaussian(self.covariance / weight, self.name))


@dataclass(frozen=True, eq=False)
class GroupFactors:
    """What a group adds to the graph.

    Attributes:
        sure: factors that are taken as they are.
        doubtful: measurements that may be wrong.
        values: first values of the group's own variables, under keys that no other group uses.
    """

    sure: list[gtsam.NonlinearFactor] = field(default_factory=list)
    doubtful: list[Doubtful] = field(default_factory=list)
    values: gtsam.Values = field(default_factory=gtsam.Values)


@dataclass(frozen=True, eq=False)
class GroupAnswer:
    """The solved graph as a group sees it.

    Attributes:
        values: of all variables.
        states: of all scans.
        weights: ``(M,)`` what counts of each doubtful measurement: 1 in full, 0 not at all.
        chi2: ``(M,)`` their squared residuals in standard deviations.
        covariance: joint marginal covariance of variables, by keys, in their order.
    """

    values: gtsam.Values
    states: list[State]
    weights: Array
    chi2: Array
    covariance: Callable[[Sequence[int]], Array]


class FactorGroup(Protocol):
    """Measurements of a run's poses from elsewhere."""

    name: str
    robust: str | None  # how to treat what may be wrong, by default: a kernel's name, ``gnc``, or None: as if right

    def build(self, states: Sequence[State], before: gtsam.Values | None) -> GroupFactors:
        """Factors and variables.

        Args:
            states: of all scans, online's or the last round's.
            before: all variables as the last round found them; None in the first round.
        """
        ...

    def read(self, answer: GroupAnswer) -> Any:
        """What the group found, for the user."""
        ...


def chi2_of(doubtful: Sequence[Doubtful], values: gtsam.Values) -> Array:
    """``(M,)`` squared residuals in standard deviations."""
    return np.array([2 * measurement.factor().error(values) for measurement in doubtful])
