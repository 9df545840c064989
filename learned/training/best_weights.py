"""The weights of a run with the best validation score, stored beside the latest ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import load_weights, save_weights
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training.validation_result import Validation


@dataclass(frozen=True)
class BestWeights:
    """A file of weights that is replaced only by better ones.

    Attributes:
        path: path of the file; its metadata holds score and step.
    """

    path: Path

    def offer(
        self, found: Validation, step: int, network: OdometryNetwork, recipe: Recipe, about: Mapping[str, str]
    ) -> bool:
        """Keep a network's weights if they score lower than those kept; return whether they do."""
        kept = self._kept("score")
        if kept is not None and kept <= found.score:
            return False
        save_weights(self.path, network, recipe, {**about, "steps": str(step), "score": repr(found.score)})
        return True

    def forget_after(self, step: int) -> None:
        """Delete weights of a later step, which an interrupted run left behind its last checkpoint."""
        kept = self._kept("steps")
        if kept is not None and kept > step:
            self.path.unlink()

    def _kept(self, key: str) -> float | None:
        if not self.path.is_file():
            return None
        text = load_weights(self.path).about.get(key)
        return None if text is None else float(text)
