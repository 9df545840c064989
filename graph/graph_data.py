"""The book that a pose graph keeps: poses by key with their initial values, and factors by id."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.errors import GraphError
from hybridlio.estimates import Array
from hybridlio.graph import coordinates as co
from hybridlio.graph.keys import Key, check_key, named
from hybridlio.graph.measurements import Factor, Kind, RobustLike, check_vector, label, make_noise, make_robust

if TYPE_CHECKING:
    from hybridlio.graph.solution import Solution


class GraphData:
    """Poses and factors without the ways to add and to solve them; a call that raises changes nothing."""

    def __init__(self, dimension: co.Dimension = 3) -> None:
        if dimension not in (2, 3):
            raise GraphError(f"a pose graph has dimension 2 or 3, not {dimension!r}")
        self.dimension: co.Dimension = dimension
        self._initial: dict[Key, Array | None] = {}
        self._fixed: set[Key] = set()
        self._factors: dict[int, Factor] = {}
        self.next_id = 0

    # poses

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses, in the order they were added."""
        return list(self._initial)

    @property
    def factors(self) -> Mapping[int, Factor]:
        """Factors by id, in the order they were added; read only."""
        return MappingProxyType(self._factors)

    @property
    def fixed(self) -> frozenset[Key]:
        """Keys of poses that are held where they start."""
        return frozenset(self._fixed)

    def __len__(self) -> int:
        return len(self._initial)

    def __contains__(self, key: object) -> bool:
        return key in self._initial

    def add_pose(self, key: Key, initial: ArrayLike | None = None) -> None:
        """Add a pose, with its initial value if it is known.

        Raises:
            GraphError: the key is in use.
            DataError: the initial value is not a pose.
        """
        key = check_key(key)
        if key in self._initial:
            raise GraphError(f"pose {key} is there already; set_initial gives it another initial value")
        self._initial[key] = None if initial is None else self._coordinates(initial, f"pose {key}")

    def set_initial(self, key: Key, pose: ArrayLike | None) -> None:
        """Give a pose another initial value, or take it away (None)."""
        (key,) = self._known(key, what="initial value")
        self._initial[key] = None if pose is None else self._coordinates(pose, f"pose {key}")

    def initial(self, key: Key) -> Array | None:
        """The initial value ``(4, 4)`` of a pose, or None."""
        (key,) = self._known(key, what="initial value")
        found = self._initial[key]
        return None if found is None else np.asarray(co.to_matrices(found[None])[0])

    def fix(self, key: Key) -> None:
        """Hold a pose at its initial value: the usual way to say where a graph without prior lies."""
        (key,) = self._known(key, what="fix")
        self._fixed.add(key)

    def unfix(self, key: Key) -> None:
        """Let a pose go again."""
        (key,) = self._known(key, what="unfix")
        self._fixed.discard(key)

    def start_from(self, solution: Solution) -> None:
        """Take a solution's poses as initial values."""
        for key in self._initial:
            if key in solution:
                self.set_initial(key, solution.pose(key))

    def remove(self, factor_id: int) -> None:
        """Take a factor out; its poses stay.

        Raises:
            GraphError: there is no such factor.
        """
        if factor_id not in self._factors:
            raise GraphError(f"there is no factor {factor_id}")
        del self._factors[factor_id]

    # inside

    @property
    def _size(self) -> int:
        return co.TANGENT_SIZE[self.dimension]

    def _coordinates(self, pose: ArrayLike, name: str) -> Array:
        return co.from_matrix(pose, self.dimension, name)

    def _in_space(self, name: str) -> None:
        if self.dimension != 3:
            raise GraphError(f"{name}: needs a graph in space, PoseGraph(dimension=3); this one is planar")

    def _known(self, *keys: Key, what: str) -> list[Key]:
        checked = [check_key(key) for key in keys]
        unknown = [key for key in checked if key not in self._initial]
        if unknown:
            raise GraphError(f"{what}: no pose has key {named(unknown)}; add_pose, add_prior or add_between adds one")
        return checked

    def _add_vectors(
        self, kind: Kind, key: Key, vectors: tuple[ArrayLike, ...], size: int, covariance: ArrayLike | None,
        sigmas: ArrayLike | None, robust: RobustLike,
    ) -> int:  # fmt: skip
        name = label(kind, (key,))
        (key,) = self._known(key, what=name)
        self._in_space(name)
        measured = np.concatenate([check_vector(vector, 3, name) for vector in vectors])
        noise = make_noise(name, size, covariance, None, sigmas)
        return self._add(Factor(kind, (key,), measured, noise, make_robust(robust, size, name)))

    def _add(self, factor: Factor) -> int:
        factor_id = self.next_id
        self._factors[factor_id] = factor
        self.next_id += 1
        return factor_id

    def without(self, removed: Collection[int] = ()) -> GraphData:
        """A copy that later changes do not touch, without some factors."""
        copy = GraphData(self.dimension)
        copy._initial, copy._fixed, copy.next_id = dict(self._initial), set(self._fixed), self.next_id
        copy._factors = {number: factor for number, factor in self._factors.items() if number not in removed}
        return copy

    def of_kinds(self, *kinds: Kind) -> GraphData:
        """A copy with factors of these kinds only."""
        return self.without([number for number, factor in self._factors.items() if factor.kind not in kinds])

    def initial_coordinates(self) -> Array | None:
        """Initial values of all poses, ``(N, 7)`` or ``(N, 3)``; None where some are missing."""
        found = [pose for pose in self._initial.values() if pose is not None]
        return np.array(found) if len(found) == len(self._initial) else None

    # for readers, which have checked what they bring

    def put_pose(self, key: Key, coordinates: Array | None) -> None:
        """Add a pose by its coordinates, unchecked."""
        self._initial[key] = coordinates

    def put_factor(self, factor: Factor, factor_id: int | None = None) -> None:
        """Add a factor, unchecked, by an id of its own if it had one."""
        number = self.next_id if factor_id is None else factor_id
        self._factors[number] = factor
        self.next_id = max(self.next_id, number + 1)

    def coordinates(self, key: Key) -> Array | None:
        """Initial value of a pose as it is kept."""
        return self._initial[key]
