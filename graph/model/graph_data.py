"""What a pose graph holds: poses by key with their initial values, and factors by id."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError, shown
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CalibrationVariable
from hybridlio.graph.model.edge_table import FORMS, EdgeTable
from hybridlio.graph.model.growing_array import GrowingArray
from hybridlio.graph.model.keys import Key, check_key, list_keys
from hybridlio.graph.model.landmarks import Landmarks
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.noise import Robust


class PosesByKey(Protocol):
    """Poses that a graph can start from: a solution, or anything else with keys and coordinates."""

    @property
    def keys(self) -> list[Key]:
        """Keys of the poses."""
        ...

    @property
    def coordinates(self) -> Array:
        """One row per key: ``(N, 7)`` x y z qx qy qz qw, or ``(N, 3)`` x y θ in the plane."""
        ...


class FactorView(Mapping[int, Factor]):
    """A graph's factors by id, in the order they were added; an edge becomes an object when it is first read."""

    def __init__(self, data: GraphData) -> None:
        self._data = data

    def __getitem__(self, factor_id: int) -> Factor:
        other = self._data.other_factors.get(factor_id)
        return self._data.edge_factor(factor_id) if other is None else other

    def __contains__(self, factor_id: object) -> bool:
        return factor_id in self._data.other_factors or factor_id in self._data.edges

    def __iter__(self) -> Iterator[int]:
        return iter(sorted([*self._data.edges.ids.tolist(), *self._data.other_factors]))

    def __len__(self) -> int:
        return len(self._data.edges) + len(self._data.other_factors)


class GraphData:
    """Poses and factors, stored without checks: what comes in was checked by the door or by a reader.

    A pose's index is its position in the order in which poses were added.

    Attributes:
        dimension: 2 or 3.
        landmarks: points that poses observe.
        calibrations: calibration variables by name.
        edges: the between-factors.
        other_factors: all other factors by id, in the order they were added.
        next_id: id of the next factor.
        origin: place on Earth of world's origin, whose axes then are east, north and up; None until it is set.
        is_replaced: whether its graph holds other data now, after the removal of a pose; an online solver may hold it.
    """

    def __init__(self, dimension: co.Dimension = 3) -> None:
        if not isinstance(dimension, int) or dimension not in (2, 3):
            raise GraphError(f"the dimension of a pose graph must be 2 or 3, got {shown(dimension)}")
        self.dimension: co.Dimension = dimension
        self._keys: list[Key] = []
        self._index: dict[Key, int] = {}
        self._initial = GrowingArray(co.IDENTITY[dimension].shape)  # NaN where there is no initial value
        self._fixed: set[Key] = set()
        self.landmarks = Landmarks(dimension)
        self.calibrations: dict[str, CalibrationVariable] = {}
        self.edges = EdgeTable(dimension)
        self._edge_factors: dict[int, Factor] = {}
        self.other_factors: dict[int, Factor] = {}
        self.next_id = 0
        self.origin: GeodeticPoint | None = None
        self.is_replaced = False

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: object) -> bool:
        return key in self._index

    # reading

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses, in the order they were added."""
        return self._keys.copy()

    @property
    def index(self) -> Mapping[Key, int]:
        """Index of each pose by key."""
        return self._index

    @property
    def factors(self) -> Mapping[int, Factor]:
        """Factors by id, in the order they were added; read only."""
        return FactorView(self)

    @property
    def fixed(self) -> frozenset[Key]:
        """Keys of the poses that are held at their initial values."""
        return frozenset(self._fixed)

    @property
    def tangent_size(self) -> int:
        """Degrees of freedom of a pose: 6, or 3 in the plane."""
        return co.TANGENT_SIZE[self.dimension]

    @property
    def initial_values(self) -> Array:
        """Initial values ``(N, 7)`` or ``(N, 3)`` of all poses, NaN where there is none; a copy."""
        return self._initial.array.copy()

    def initial_value(self, key: Key) -> Array | None:
        """Return the initial value of a pose as coordinates, or None."""
        coordinates = self._initial.array[self._index[key]]
        return None if np.isnan(coordinates[0]) else coordinates.copy()

    def keys_at(self, indices: Iterable[int]) -> list[Key]:
        """Return the keys of the poses at some indices."""
        return [self._keys[index] for index in indices]

    def known_keys(self, *keys: Key, what: str) -> list[Key]:
        """Return the keys as plain integers.

        Raises:
            GraphError: malformed, or the graph has no such pose; the message starts with ``what``.
        """
        checked = [check_key(key) for key in keys]
        unknown = [key for key in checked if key not in self._index]
        if unknown:
            is_landmark = unknown[0] in self.landmarks
            hint = "it is a landmark" if is_landmark else "add it by add_pose, add_prior or add_between"
            raise GraphError(f"{what}: no pose has key {list_keys(unknown)}; {hint}")
        return checked

    def known_factor(self, factor_id: int) -> int:
        """Return the id of a factor; raise GraphError where no factor has it."""
        if not isinstance(factor_id, int | np.integer) or factor_id not in self.factors:
            raise GraphError(f"no factor has id {shown(factor_id)}")
        return int(factor_id)

    def require_space(self, what: str) -> None:
        """Raise GraphError where the graph is planar."""
        if self.dimension != 3:
            raise GraphError(f"{what}: needs a graph in space, PoseGraph(dimension=3); this one is planar")

    def edge_factor(self, factor_id: int) -> Factor:
        """Return an edge as an object.

        Raises:
            KeyError: no edge has this id.
        """
        row = self.edges.row(factor_id)
        if row is None:
            raise KeyError(factor_id)
        if factor_id not in self._edge_factors:
            i, j = self.edges.ends[row].tolist()
            measured, robust = self.edges.measured[row].copy(), self.edges.robust.get(factor_id)
            keys = (self._keys[i], self._keys[j])
            self._edge_factors[factor_id] = Factor("between", keys, measured, self.edges.noise(row), robust)
        return self._edge_factors[factor_id]

    def factor_ids_of(self, poses: range) -> set[int]:
        """Return the ids of the factors that concern any of the poses at some indices."""
        ends = self.edges.ends
        near = ((ends >= poses.start) & (ends < poses.stop)).any(axis=1)
        others = (n for n, f in self.other_factors.items() if any(self._index[key] in poses for key in f.keys))
        return {*self.edges.ids[near].tolist(), *others}

    def copy(self, without: Collection[int] = ()) -> GraphData:
        """Return an independent copy, without some factors."""
        copy = GraphData(self.dimension)
        copy._keys, copy._index, copy._fixed = self._keys.copy(), self._index.copy(), self._fixed.copy()
        copy._initial, copy.next_id = self._initial.where(slice(None)), self.next_id
        copy.origin, copy.landmarks = self.origin, self.landmarks.copy()
        copy.calibrations = self.calibrations.copy()
        keep = ~np.isin(self.edges.ids, list(without)) if without else slice(None)
        copy.edges = self.edges.where(keep)
        copy.other_factors = {n: factor for n, factor in self.other_factors.items() if n not in without}
        return copy

    # changing

    def add_pose(self, key: Key, coordinates: Array | None = None) -> None:
        """Add a new pose."""
        row = np.full((1, *co.IDENTITY[self.dimension].shape), np.nan if coordinates is None else coordinates)
        self.add_poses([key], row)

    def add_poses(self, keys: Sequence[Key], coordinates: Array) -> None:
        """Add new poses with initial values ``(M, 7)`` or ``(M, 3)``, NaN where there is none."""
        self._index.update(zip(keys, range(len(self._keys), len(self._keys) + len(keys)), strict=True))
        self._keys.extend(keys)
        self._initial.extend(coordinates)

    def set_initial(self, key: Key, coordinates: Array | None) -> None:
        """Replace the initial value of a pose, or remove it (None)."""
        self._initial.array[self._index[key]] = np.nan if coordinates is None else coordinates

    def set_all_initial(self, coordinates: Array) -> None:
        """Replace the initial values of all poses."""
        self._initial.array[:] = coordinates

    def start_from(self, poses: PosesByKey) -> None:
        """Take initial values from ``poses`` for the keys that both have; landmarks too, where it has ``points``."""
        for key, coordinates in zip(poses.keys, poses.coordinates, strict=True):
            if key in self._index:
                self._initial.array[self._index[key]] = coordinates
        for key, point in getattr(poses, "points", {}).items():
            if key in self.landmarks:
                self.landmarks.set_initial(key, point)

    def fix(self, key: Key) -> None:
        """Hold a pose at its initial value."""
        self._fixed.add(key)

    def unfix(self, key: Key) -> None:
        """Release a fixed pose."""
        self._fixed.discard(key)

    def set_origin(self, origin: GeodeticPoint) -> None:
        """Set world's origin on Earth, once.

        Raises:
            GraphError: a planar graph, or another origin is set: fixes may have been converted with it.
        """
        self.require_space("origin")
        if self.origin not in (None, origin):
            raise GraphError(
                f"the graph has its origin at {tuple(self.origin or ())}; it cannot move to {tuple(origin)}"
            )
        self.origin = origin

    def add_factor(self, factor: Factor, factor_id: int | None = None) -> int:
        """Add a factor and return its id.

        Args:
            factor: of poses that the graph has.
            factor_id: its id, higher than all in the graph; by default the next one.
        """
        number = self.next_id if factor_id is None else factor_id
        if factor.kind == "between":
            assert factor.noise is not None
            i, j = factor.keys
            ends = (self._index[i], self._index[j])
            self.edges.append(number, ends, factor.measured, factor.noise, factor.robust)
        else:
            self.other_factors[number] = factor
        self.next_id = max(self.next_id, number + 1)
        return number

    def add_edges(
        self, ids: ArrayLike, ends: ArrayLike, measured: Array, information: Array, robust: Mapping[int, Robust]
    ) -> None:
        """Add between-factors with given ids, ascending and higher than all in the graph.

        Args:
            ids: ``(M,)``.
            ends: ``(M, 2)`` indices of poses.
            measured: ``(M, 7)`` or ``(M, 3)`` coordinates.
            information: ``(M, d, d)``.
            robust: kernels by id.
        """
        ids = np.asarray(ids, dtype=np.int64)
        self.edges.extend(ids, ends, measured, information, np.full(len(ids), FORMS.index("information")))
        self.edges.robust.update(robust)
        self.next_id = max(self.next_id, int(ids[-1]) + 1)

    def remove(self, factor_id: int) -> None:
        """Remove a factor; its poses stay. Raise GraphError where no factor has this id."""
        if self.known_factor(factor_id) in self.other_factors:
            del self.other_factors[factor_id]
        else:
            self.edges.remove(factor_id)
            self._edge_factors.pop(factor_id, None)

    def forget(self, ids: set[int], poses: range, coordinates: Array) -> None:
        """Remove factors that a solver has marginalised; their poses keep ``coordinates`` as initial values."""
        self.edges = self.edges.where(~np.isin(self.edges.ids, list(ids)))
        for number in ids:
            self.other_factors.pop(number, None)
            self._edge_factors.pop(number, None)
        self._initial.array[poses.start : poses.stop] = coordinates
        self._fixed.difference_update(self.keys_at(poses))
