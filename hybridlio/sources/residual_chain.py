"""Two residual sources one after the other: the second starts where the first has got to."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, ResidualSource, TakesBack
from hybridlio.core.motion_limits import VAGUE_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import Frame


class Proposer(ResidualSource, Protocol):
    """A residual source that finds a pose quickly and, where it is asked to, says how good it is."""

    def propose(self, frame: Frame, initial: RelativePose) -> Array | None:
        """A pose ``T_k_k1`` ``(4, 4)`` that nothing has judged yet; None where it finds none."""
        ...

    def judge(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """What ``refine`` says of the frame for which a pose was proposed last."""
        ...


class ResidualChain:
    """Refines by one source, then by another, such as a network's step before the registration to a local map.

    Where the initial pose is sure to a decimetre, the first source only proposes where to start. The second looks
    whether that is better, and answers as it would without: a wrong proposal does no harm, and none has to be judged.
    Where it is not, the first one's judged answer is the second's initial pose; where the first fails or leaves a
    direction open, of which the second may see more, the initial pose itself.

    The answer is the second's, with its covariance; where that fails, the first's. Only if both do, the initial pose
    bridges.

    Args:
        first: coarse and forgiving, such as the network.
        second: fine, such as scan matching, and such that it looks at what is ``proposed``.
    """

    def __init__(self, first: Proposer, second: ResidualSource) -> None:
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
        coarse, fine = self._judged(frame, initial) if _is_unsure(initial) else self._proposed(frame, initial)
        answers = ((self._first, coarse), (self._second, fine))
        details = {
            f"{source.name} {key}": value
            for source, answer in answers
            if answer is not None
            for key, value in {"ok": float(answer.ok), **answer.details}.items()
        }
        if fine.ok:
            return replace(fine, source=self.name, details=details)
        if coarse is not None and coarse.ok:
            if isinstance(self._second, TakesBack):  # to keep its place by it, which is as good as a step of its own
                self._second.take_back(coarse)
            return replace(coarse, source=self.name, drift=fine.drift, details=details)
        return replace(fine, details=details)

    def _judged(self, frame: Frame, initial: RelativePose) -> tuple[RelativePose, RelativePose]:
        """Both answers, the second's from the first's."""
        coarse = self._first.refine(frame, initial)
        return coarse, self._second.refine(frame, coarse if coarse.ok and not len(coarse.degenerate) else initial)

    def _proposed(self, frame: Frame, initial: RelativePose) -> tuple[RelativePose | None, RelativePose]:
        """The second's answer, from where the first proposes or not; the first's where it is needed."""
        fine = self._second.refine(frame, replace(initial, proposed=self._first.propose(frame, initial)))
        return None if fine.ok else self._first.judge(frame, initial), fine

    def take_back(self, initial: RelativePose) -> None:
        """Tell those of the two that want to know that their answer was not believed."""
        for source in (self._first, self._second):
            if isinstance(source, TakesBack):
                source.take_back(initial)


def _is_unsure(pose: RelativePose) -> bool:
    return pose.translation_sigma_m > VAGUE_TRANSLATION_SIGMA_M


class NoResidual:
    """Leaves the initial pose as it is: a run on the initial poses alone, to compare with."""

    name = "none"

    def start(self, frame: Frame) -> None:
        """Nothing to keep."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        """The initial pose itself."""
        return initial
