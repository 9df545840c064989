"""Two residual sources one after the other: the second starts where the first has got to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.estimates import Array, RelativePose, ResidualSource, TakesBack
from hybridlio.sensors import Frame


class ResidualChain:
    """Refines by one source, then by another, such as a network's step before the registration to a local map.

    The second source's initial pose is the first one's answer; where the first fails, the initial pose itself. The
    answer is the second's, with its covariance; where that fails, the first's. Only if both do, the initial pose
    bridges.

    Args:
        first: coarse and forgiving, such as the network.
        second: fine, such as scan matching.
    """

    def __init__(self, first: ResidualSource, second: ResidualSource) -> None:
        self.name = f"{first.name}+{second.name}"
        self._first, self._second = first, second

    def start(self, frame: Frame) -> None:
        """Give both the first scan.

        Raises:
            DataError: one of them cannot start at it.
        """
        self._first.start(frame)
        self._second.start(frame)

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Both sources' answer, whose details are those of both, each with its source's name in front."""
        coarse = self._first.refine(frame, initial)
        # where the first leaves a direction loose, the initial pose still knows something of it
        start = replace(coarse, covariance=_both(coarse.covariance, initial.covariance)) if coarse.ok else initial
        fine = self._second.refine(frame, start)
        details = {
            f"{source.name} {key}": value
            for source, answer in ((self._first, coarse), (self._second, fine))
            for key, value in {"ok": float(answer.ok), **answer.details}.items()
        }
        if fine.ok:
            return replace(fine, source=self.name, details=details)
        if coarse.ok:  # the second kept its place by the first's step, which is as good as a step of its own
            return replace(coarse, source=self.name, drift=fine.drift, details=details)
        return replace(fine, details=details)

    def take_back(self, initial: RelativePose) -> None:
        """Tell those of the two that want to know that their answer was not believed."""
        for source in (self._first, self._second):
            if isinstance(source, TakesBack):
                source.take_back(initial)


def _both(a: Array, b: Array) -> Array:
    """The covariance of what two independent estimates know together."""
    joint = np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b))
    return np.asarray((joint + joint.T) / 2)
