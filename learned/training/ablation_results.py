"""Results of the rows of a comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

Drift = tuple[float, float]


@dataclass(frozen=True)
class RowResult:
    """Results of a trained row.

    Attributes:
        name: name of its recipe.
        steps, pairs: training steps, and pairs in them.
        seconds: duration of the training.
        train, test: t_rel (percent) and r_rel (degrees per 100 m) by recording; None for a recording that is too short.
    """

    name: str
    steps: int
    pairs: int
    seconds: float
    train: Mapping[str, Drift | None]
    test: Mapping[str, Drift | None]

    @property
    def train_average(self) -> Drift | None:
        """Mean over the training recordings; None if all are too short."""
        return _average(self.train)

    @property
    def test_average(self) -> Drift | None:
        """Mean over the test recordings; None if all are too short."""
        return _average(self.test)


def _average(drifts: Mapping[str, Drift | None]) -> Drift | None:
    known = [drift for drift in drifts.values() if drift is not None]
    if not known:
        return None
    return sum(t for t, _ in known) / len(known), sum(r for _, r in known) / len(known)
