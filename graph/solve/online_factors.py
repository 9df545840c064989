"""GTSAM's factors of one update of an online solver, under names by which they can be removed later."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from typing import Any, NamedTuple

from hybridlio.graph.model.connectivity import InertialChain, chains_without_bias
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.changes import Changes


class NewFactors(NamedTuple):
    """Factors of an update.

    A factor's name is its id; the prior of a fixed pose is ``("fixed", key)``, that of a chain's first biases
    ``("bias", key)``.

    Attributes:
        factors: the new ones, GTSAM's.
        names: theirs, in the same order.
        replaced: names of factors that no longer hold.
    """

    factors: list[Any]
    names: list[Hashable]
    replaced: list[Hashable]


def new_factors(
    builder: Builder, changes: Changes, present: Collection[Hashable], bias_marginalised: set[int]
) -> NewFactors:
    """Return the factors of some changes.

    Args:
        builder: of the changed graph.
        changes: since the last update.
        present: names of the factors that the solver has.
        bias_marginalised: indices of the poses whose biases a marginal constrains, so that they need no prior.

    Raises:
        GraphError: a fixed pose has no initial value.
    """
    found: list[tuple[Hashable, Any]] = []
    ids = builder.data.edges.ids[changes.edge_rows].tolist()
    found += zip(ids, builder.edges(changes.edge_rows), strict=True)
    found += [(factor_id, builder.factor(factor)) for factor_id, factor in changes.other_factors.items()]
    found += [(("fixed", key), builder.fixed_pose_prior(key)) for key in changes.fixed]
    replaced: list[Hashable] = [("fixed", key) for key in changes.unfixed if ("fixed", key) in present]
    if changes.of_kind("imu", "bias"):
        started, ended = _initial_biases(builder, present, bias_marginalised)
        found += [(("bias", chain.start), builder.initial_bias_prior(chain)) for chain in started]
        replaced += ended
    return NewFactors([factor for _, factor in found], [name for name, _ in found], replaced)


def _initial_biases(
    builder: Builder, present: Collection[Hashable], bias_marginalised: set[int]
) -> tuple[list[InertialChain], list[Hashable]]:
    """Return the chains that need a prior of their first biases, and the names of such priors no longer needed."""
    chains, index = chains_without_bias(builder.data), builder.data.index
    wanted = {("bias", chain.start) for chain in chains}
    old = {name for name in present if isinstance(name, tuple) and name[0] == "bias"}
    free = [chain for chain in chains if not any(index[key] in bias_marginalised for key in chain.keys)]
    return [chain for chain in free if ("bias", chain.start) not in old], list(old - wanted)
