"""The factors that an online solver has given to GTSAM: their slots, and the weights of robust ones."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, KeysView, Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from hybridlio.core.errors import GraphError
from hybridlio.graph.solve.custom_factors import with_model
from hybridlio.graph.solve.engines import Engine
from hybridlio.graph.solve.online_factors import NewFactors

# Of a robust factor's pull, its weight times its residual, in standard deviations; of its weight where the residual is
# below one. Estimates then lie within a hundredth of their standard deviation.
_SETTLED = 0.01
# Of a weight: where a robust factor alone holds a part, a trace of it keeps the system solvable.
_SMALLEST_WEIGHT = 1e-9
_ROUNDS = 5  # of weights and estimates in one update; more where users update again
_PERIOD = 10  # updates between two looks at all weights, as iSAM2's between two looks at all linearisation points


@dataclass(frozen=True, eq=False)
class _Weighted:
    """A robust factor, and the weight with which GTSAM holds it."""

    factor: Any
    weight: float

    def at(self, values: gtsam.Values) -> tuple[float, float]:
        """Return the norm of the whitened residual, and the kernel's weight there."""
        model = self.factor.noiseModel()
        norm = float(np.linalg.norm(model.noise().whiten(self.factor.unwhitenedError(values))))
        return norm, max(float(model.robust().weight(norm)), _SMALLEST_WEIGHT)

    def gaussian(self, weight: float) -> Any:
        """Return the factor without its kernel, its information scaled by a weight."""
        root = np.sqrt(weight) * self.factor.noiseModel().noise().R()
        return with_model(self.factor, gtsam.noiseModel.Gaussian.SqrtInformation(root))


class HeldFactors:
    """Gives factors to an engine, and keeps their slots by name.

    iSAM2 keeps a robust kernel's weight from the last linearisation, which the estimate may leave by centimetres before
    it linearises anew. Here GTSAM gets each robust factor as a Gaussian one with the kernel's weight at the estimate
    (iteratively reweighted least squares), and a new one when the weight has changed.
    """

    def __init__(self, engine: Engine, dimension: int) -> None:
        self._engine, self._dimension = engine, dimension
        self._slots: dict[Hashable, int] = {}
        self._robust: dict[Hashable, _Weighted] = {}
        self._recent: set[Hashable] = set()  # robust ones since the last look at all
        self._age = 0  # updates since then

    @property
    def names(self) -> KeysView[Hashable]:
        """Names of all factors, as in :class:`NewFactors`."""
        return self._slots.keys()

    def update(
        self, factors: NewFactors, values: gtsam.Values, removed: Iterable[Hashable], latest: Mapping[int, int]
    ) -> None:
        """Give new factors to GTSAM and remove others; restore it where it fails.

        Args:
            factors: the new ones, and those that they replace.
            values: initial values of new variables.
            removed: names.
            latest: as in :meth:`Engine.update`.

        Raises:
            GraphError: the graph cannot be solved.
        """
        graph, robust = gtsam.NonlinearFactorGraph(), {}
        for name, factor in zip(factors.names, factors.factors, strict=True):
            weighted = self._weighted(factor, values) if _is_robust(factor) else None
            if weighted is not None:
                robust[name] = weighted
            graph.add(factor if weighted is None else weighted.gaussian(weighted.weight))
        outdated = [*removed, *factors.replaced]
        self._exchange(outdated, factors.names, graph, values, latest)
        self.forget(set(outdated) - set(factors.names))
        self._robust |= robust
        self._recent |= robust.keys()

    def settle(self, far: bool) -> None:
        """Iterate weights and estimates until neither changes, or for a few rounds.

        Looks at the robust factors of the last updates, and at all after a change that may move far poses.

        Args:
            far: whether this update may move poses other than the last ones.
        """
        self._age += 1
        if not self._robust:
            return
        everything = far or self._age >= _PERIOD
        for _ in range(_ROUNDS):
            if not self._reweigh(self._robust.keys() if everything else self._recent):
                break
            self._engine.iterate()
        if everything:
            self._age = 0
            self._recent.clear()

    def iterate(self) -> None:
        """Linearise anew what has moved, and weigh every robust factor anew."""
        self._engine.iterate()
        self.settle(far=True)

    def forget(self, names: Collection[Hashable]) -> None:
        """Forget factors that left the engine."""
        for name in names:
            self._slots.pop(name, None)
            self._robust.pop(name, None)
        self._recent.difference_update(names)

    def _reweigh(self, names: Collection[Hashable]) -> bool:
        """Give GTSAM the robust factors anew whose weights have changed; return whether any had."""
        solver = self._engine.solver
        estimate = solver.calculateEstimate() if len(names) > _PERIOD else None
        graph, changed = gtsam.NonlinearFactorGraph(), {}
        for name in names:
            held = self._robust[name]
            at = estimate or _estimates(solver, gtsam.Values(), held.factor.keys(), self._dimension)
            norm, weight = held.at(at)
            if abs(weight - held.weight) * max(norm, 1.0) > _SETTLED:
                changed[name] = _Weighted(held.factor, weight)
                graph.add(held.gaussian(weight))
        if changed:
            self._exchange(changed, changed, graph, gtsam.Values(), {})
            self._robust |= changed
        return bool(changed)

    def _weighted(self, factor: Any, new: gtsam.Values) -> _Weighted | None:
        """Return a robust factor with its first weight; None where GTSAM cannot copy it, a user's own factor."""
        values = _estimates(self._engine.solver, new, factor.keys(), self._dimension)
        weighted = _Weighted(factor, _Weighted(factor, 1.0).at(values)[1])
        try:
            weighted.gaussian(1.0)
        except RuntimeError:
            return None
        return weighted

    def _exchange(
        self, outdated: Collection[Hashable], names: Collection[Hashable], graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values, latest: Mapping[int, int],
    ) -> None:  # fmt: skip
        try:
            slots = self._engine.update(graph, values, [self._slots[name] for name in outdated], latest)
        except GraphError:
            new_slots = self._engine.restore(self._slots.values())
            self._slots = {name: new_slots[slot] for name, slot in self._slots.items()}
            raise
        for name in outdated:
            del self._slots[name]
        self._slots.update(zip(names, slots, strict=True))


def _is_robust(factor: Any) -> bool:
    return isinstance(factor, gtsam.NoiseModelFactor) and isinstance(factor.noiseModel(), gtsam.noiseModel.Robust)


def _estimates(solver: Any, new: gtsam.Values, variables: Iterable[int], dimension: int) -> gtsam.Values:
    """Return the values of some variables: new ones as given, the others as estimated."""
    kinds = {"x": f"Pose{dimension}", "b": "ConstantBias", "v": "Vector", "l": f"Point{dimension}"}
    found = gtsam.Values()
    for variable in variables:
        kind = kinds[chr(gtsam.Symbol(variable).chr())]
        is_new = new.exists(variable)
        read = getattr(new if is_new else solver, f"{'at' if is_new else 'calculateEstimate'}{kind}")
        found.insert(variable, read(variable))
    return found
