"""A chain of two residual sources, where the second starts from the first one's result; a source that does nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, ResidualSource, TakesBack
from hybridlio.core.motion_limits import VAGUE_TRANSLATION_SIGMA_M
from hybridlio.core.sensors import Frame


class Proposer(ResidualSource, Protocol):
    """A residual source that finds a pose quickly, and computes its quality only on demand."""

    def propose(self, frame: Frame, initial: RelativePose) -> Array | None:
        """Return a pose ``T_k_k1`` ``(4, 4)`` without checking its quality; None where there is none."""
        ...

    def assess(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return what ``refine`` would for the frame of the last :meth:`propose`, with covariance and ``ok``."""
        ...


class ResidualChain:
    """Refines by one source, then by another, such as a network's step before registration to a local map.

    If the initial pose is certain to a decimetre, the first source only proposes a pose. The second starts there if
    its scan fits better, and otherwise answers as if there were no proposal. A wrong proposal does no harm, so the cost
    of assessing it is saved.

    If the initial pose is less certain, the first source's full answer is the second one's initial pose. Where the
    first fails or leaves a direction unconstrained, the second starts from the initial pose itself.

    The result is the second source's. If that fails it is the first one's, and if both fail the initial pose bridges.

    Args:
        first: coarse and robust, such as the network.
        second: precise, and able to use :attr:`RelativePose.proposed`, such as scan matching.
    """

    def __init__(self, first: Proposer, second: ResidualSource) -> None:
        self.name = f"{first.name}+{second.name}"
        self._first, self._second = first, second

    def start(self, frame: Frame) -> None:
        """Give both sources the first scan.

        Raises:
            DataError: one of them cannot start at it.
        """
        self._first.start(frame)
        self._second.start(frame)

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return the answer of both sources. Keys of ``details`` are prefixed by the name of their source."""
        coarse, fine = self._refine_in_turn(frame, initial) if _is_vague(initial) else self._propose(frame, initial)
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
            if isinstance(self._second, TakesBack):  # its path is to continue by the coarse answer, not by `initial`
                self._second.take_back(coarse)
            return replace(coarse, source=self.name, drift=fine.drift, details=details)
        return replace(fine, details=details)

    def take_back(self, initial: RelativePose) -> None:
        """Have each source that can do so take back its last result."""
        for source in (self._first, self._second):
            if isinstance(source, TakesBack):
                source.take_back(initial)

    def _refine_in_turn(self, frame: Frame, initial: RelativePose) -> tuple[RelativePose, RelativePose]:
        """Return the results of both sources; the second starts from the first one's result."""
        coarse = self._first.refine(frame, initial)
        return coarse, self._second.refine(frame, coarse if coarse.ok and not len(coarse.degenerate) else initial)

    def _propose(self, frame: Frame, initial: RelativePose) -> tuple[RelativePose | None, RelativePose]:
        """Return the first source's result where the second fails; and the second's, from the first's proposal."""
        fine = self._second.refine(frame, replace(initial, proposed=self._first.propose(frame, initial)))
        return None if fine.ok else self._first.assess(frame, initial), fine


def _is_vague(pose: RelativePose) -> bool:
    return pose.translation_sigma_m > VAGUE_TRANSLATION_SIGMA_M


class NoResidual:
    """Returns the initial pose unchanged, for runs on initial poses alone."""

    name = "none"

    def start(self, frame: Frame) -> None:
        """Do nothing: no scan is needed."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        """Return the initial pose."""
        return initial
