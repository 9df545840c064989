"""The book that a pose graph keeps: poses by key with their initial values, and factors by id."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.geodesy import GeodeticPoint, check_geodetic
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_table import FORMS, EdgeTable, Rows
from hybridlio.graph.model.keys import Key, check_key, named
from hybridlio.graph.model.measurements import (
    Factor,
    Kind,
    Robust,
    RobustLike,
    check_vector,
    label,
    make_noise,
    make_robust,
)


class PosesByKey(Protocol):
    """Poses that a graph can start from: a solution, or anything else with keys and coordinates."""

    @property
    def keys(self) -> list[Key]:
        """Keys of the poses."""
        ...

    @property
    def coordinates(self) -> Array:
        """One row per key: ``(N, 7)`` x y z qx qy qz qw, in the plane ``(N, 3)`` x y θ."""
        ...


class FactorView(Mapping[int, Factor]):
    """A graph's factors by id, in the order they were added; those of the table become objects when asked for."""

    def __init__(self, keys: list[Key], edges: EdgeTable, others: dict[int, Factor]) -> None:
        self._keys, self._edges, self._others = keys, edges, others

    def __getitem__(self, number: int) -> Factor:
        other = self._others.get(number)
        return self._edges.factor(number, self._keys) if other is None else other

    def __contains__(self, number: object) -> bool:
        return number in self._others or number in self._edges

    def __iter__(self) -> Iterator[int]:
        return iter(sorted([*self._edges.ids.tolist(), *self._others]))

    def __len__(self) -> int:
        return len(self._edges) + len(self._others)


class GraphData:
    """Poses and factors without the ways to add and to solve them; a call that raises changes nothing.

    Attributes:
        dimension: 2 or 3.
        edges: the between-factors.
        others: all other factors by id, in the order they were added.
        next_id: of the next factor.
        origin: where on Earth world has its origin, east, north and up its axes; None while nobody has said so.
    """

    def __init__(self, dimension: co.Dimension = 3) -> None:
        if dimension not in (2, 3):
            raise GraphError(f"a pose graph has dimension 2 or 3, not {dimension!r}")
        self.dimension: co.Dimension = dimension
        self._keys: list[Key] = []
        self._places: dict[Key, int] = {}
        self._initial = Rows(co.IDENTITY[dimension].shape)  # NaN where none is known
        self._fixed: set[Key] = set()
        self.edges = EdgeTable(dimension)
        self.others: dict[int, Factor] = {}
        self.next_id = 0
        self.origin: GeodeticPoint | None = None

    # poses

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses, in the order they were added."""
        return self._keys.copy()

    @property
    def places(self) -> Mapping[Key, int]:
        """Each key's place in that order."""
        return self._places

    @property
    def factors(self) -> Mapping[int, Factor]:
        """Factors by id, in the order they were added; read only."""
        return FactorView(self._keys, self.edges, self.others)

    @property
    def fixed(self) -> frozenset[Key]:
        """Keys of poses that are held where they start."""
        return frozenset(self._fixed)

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: object) -> bool:
        return key in self._places

    def add_pose(self, key: Key, initial: ArrayLike | None = None) -> None:
        """Add a pose, with its initial value if it is known.

        Raises:
            GraphError: the key is in use.
            DataError: the initial value is not a pose.
        """
        key = check_key(key)
        if key in self._places:
            raise GraphError(f"pose {key} is there already; set_initial gives it another initial value")
        self.put_pose(key, None if initial is None else self._coordinates(initial, f"pose {key}"))

    def set_initial(self, key: Key, pose: ArrayLike | None) -> None:
        """Give a pose another initial value, or take it away (None)."""
        (key,) = self._known(key, what="initial value")
        coordinates = np.nan if pose is None else self._coordinates(pose, f"pose {key}")
        self._initial.array[self._places[key]] = coordinates

    def initial(self, key: Key) -> Array | None:
        """The initial value ``(4, 4)`` of a pose, or None."""
        (key,) = self._known(key, what="initial value")
        found = self.coordinates(key)
        return None if found is None else np.asarray(co.to_matrices(found[None])[0])

    def fix(self, key: Key) -> None:
        """Hold a pose at its initial value: the usual way to say where a graph without prior lies."""
        (key,) = self._known(key, what="fix")
        self._fixed.add(key)

    def unfix(self, key: Key) -> None:
        """Let a pose go again."""
        (key,) = self._known(key, what="unfix")
        self._fixed.discard(key)

    def set_origin(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> None:
        """Say where on Earth (WGS 84; metres above the ellipsoid) world has its origin, once and for all.

        Raises:
            DataError: not finite, or no such latitude or longitude.
            GraphError: a planar graph, or there is another origin, by which fixes may have been placed.
        """
        self._in_space("origin")
        point = check_geodetic(latitude_deg, longitude_deg, altitude_m, "origin")
        if self.origin not in (None, point):
            raise GraphError(
                f"the graph has its origin at {tuple(self.origin or ())}; it cannot move to {tuple(point)}"
            )
        self.origin = point

    def start_from(self, solution: PosesByKey) -> None:
        """Take a solution's poses as initial values."""
        for key, pose in zip(solution.keys, solution.coordinates, strict=True):
            if key in self._places:
                self._initial.array[self._places[key]] = pose

    def remove(self, factor_id: int) -> None:
        """Take a factor out; its poses stay.

        Raises:
            GraphError: there is no such factor.
        """
        if factor_id in self.others:
            del self.others[factor_id]
        elif factor_id in self.edges:
            self.edges.remove(factor_id)
        else:
            raise GraphError(f"there is no factor {factor_id}")

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
        unknown = [key for key in checked if key not in self._places]
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
        self.put_factor(factor)
        return self.next_id - 1

    def without(self, removed: Collection[int] = ()) -> GraphData:
        """A copy that later changes do not touch, without some factors."""
        copy = GraphData(self.dimension)
        copy._keys, copy._places, copy._fixed = self._keys.copy(), self._places.copy(), self._fixed.copy()
        copy._initial, copy.next_id = self._initial.where(slice(None)), self.next_id
        copy.origin = self.origin
        keep = ~np.isin(self.edges.ids, list(removed)) if removed else slice(None)
        copy.edges = self.edges.where(keep)
        copy.others = {number: factor for number, factor in self.others.items() if number not in removed}
        return copy

    def initial_coordinates(self) -> Array | None:
        """Initial values of all poses, ``(N, 7)`` or ``(N, 3)``; None where some are missing."""
        found = self._initial.array
        return None if np.isnan(found[:, 0]).any() else found.copy()

    @property
    def coordinates_or_nan(self) -> Array:
        """Initial values ``(N, 7)`` or ``(N, 3)``, NaN where there is none."""
        return self._initial.array.copy()

    def coordinates(self, key: Key) -> Array | None:
        """Initial value of a pose as it is kept, or None."""
        found = self._initial.array[self._places[key]]
        return None if np.isnan(found[0]) else found.copy()

    def keys_at(self, places: Iterable[int]) -> list[Key]:
        """Keys of the poses at some places."""
        return [self._keys[place] for place in places]

    def concerning(self, places: range) -> set[int]:
        """Ids of the factors that concern any of the poses at some places."""
        ends = self.edges.ends
        near = ((ends >= places.start) & (ends < places.stop)).any(axis=1)
        others = (n for n, f in self.others.items() if any(self._places[key] in places for key in f.keys))
        return {*self.edges.ids[near].tolist(), *others}

    def drop(self, ids: set[int], places: range, coordinates: Array) -> None:
        """Take out factors whose effect is held elsewhere; their poses keep ``coordinates`` as initial values."""
        self.edges = self.edges.where(~np.isin(self.edges.ids, list(ids)))
        for number in ids & self.others.keys():
            del self.others[number]
        self._initial.array[places.start : places.stop] = coordinates
        self._fixed.difference_update(self.keys_at(places))

    # for readers, which have checked what they bring

    def put_pose(self, key: Key, coordinates: Array | None) -> None:
        """Add a pose by its coordinates, unchecked."""
        self.put_poses(
            [key], np.full((1, *self._initial.array.shape[1:]), np.nan if coordinates is None else coordinates)
        )

    def put_poses(self, keys: Sequence[Key], coordinates: Array) -> None:
        """Add new poses by their coordinates ``(M, 7)`` or ``(M, 3)``, NaN where unknown, unchecked."""
        self._places.update(zip(keys, range(len(self._keys), len(self._keys) + len(keys)), strict=True))
        self._keys.extend(keys)
        self._initial.extend(coordinates)

    def put_edges(
        self, ids: ArrayLike, ends: ArrayLike, measured: Array, information: Array, robust: Mapping[int, Robust]
    ) -> None:
        """Add between-factors by the ids they shall have, which rise and are higher than all before, unchecked.

        Args:
            ids: ``(M,)``.
            ends: ``(M, 2)`` places.
            measured: ``(M, 7)`` or ``(M, 3)`` coordinates.
            information: ``(M, d, d)``.
            robust: kernels by id.
        """
        ids = np.asarray(ids, dtype=np.int64)
        self.edges.extend(ids, ends, measured, information, np.full(len(ids), FORMS.index("information")))
        self.edges.robust.update(robust)
        self.next_id = max(self.next_id, int(ids[-1]) + 1)

    def put_factor(self, factor: Factor, factor_id: int | None = None) -> None:
        """Add a factor, unchecked, by an id of its own if it had one, which is higher than all before."""
        number = self.next_id if factor_id is None else factor_id
        if factor.kind == "between":
            i, j = factor.keys
            self.edges.append(number, (self._places[i], self._places[j]), factor)
        else:
            self.others[number] = factor
        self.next_id = max(self.next_id, number + 1)
