"""Work on whole graphs: copies, parts, joining, changes of what is there, and GTSAM's form."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Self

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.calibrated_measurements import CalibratedMeasurements
from hybridlio.graph.marginal_factors import marginal_factor
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData, PosesByKey
from hybridlio.graph.model.keys import Key, check_key, list_keys
from hybridlio.graph.model.marginals import Marginal
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.new_factors import check_start, new_measurement
from hybridlio.graph.model.noise import NoiseInput, make_noise
from hybridlio.graph.views.gtsam_graph import from_gtsam, to_gtsam


class WholeGraph(CalibratedMeasurements):
    """The part of a pose graph that copies, cuts and joins graphs."""

    def copy(self) -> Self:
        """Return an independent copy; ids of factors stay."""
        return self._of(self._data.copy())

    def subgraph(self, keys: Collection[Key]) -> Self:
        """Return the graph of some poses, and of the factors that concern them alone; ids of factors stay.

        Raises:
            GraphError: unknown key.
        """
        kept = set(self._data.known_keys(*_listed(keys, "subgraph"), what="subgraph"))
        return self._of(_part(self._data, kept))

    def remove_pose(self, key: Key) -> None:
        """Remove a pose and all factors that concern it; online solvers of this graph then refuse to update.

        Raises:
            GraphError: unknown key.
        """
        (known,) = self._data.known_keys(key, what="remove_pose")
        rest = _part(self._data, set(self._data.keys) - {known})
        self._data.is_replaced = True
        self._data = rest

    def marginalise(self, keys: Collection[Key], solution: PosesByKey) -> int | None:
        """Remove poses, and keep what their factors say about the others as one linear factor of GTSAM's.

        It joins all poses that shared a factor with them. Factors are linearised at the solution, from which the other
        poses start afterwards; away from it the marginal is an approximation. It cannot be saved. Online solvers of
        this graph then refuse to update.

        Args:
            keys: of the poses to remove.
            solution: of this graph.

        Returns:
            The id of the new factor; None where no other pose shared a factor with them.

        Raises:
            GraphError: unknown key, a pose that the solution lacks, no pose would stay, or a factor of the poses that
                also concerns velocities, biases, landmarks or calibration variables.
            DataError: not a solution.
        """
        gone = self._data.known_keys(*_listed(keys, "marginalise"), what="marginalise")
        place = {key: k for k, key in enumerate(check_start(self._data, solution).keys)}
        missing = [key for key in self._data.keys if key not in place]
        if missing:
            raise GraphError(f"marginalise: the solution has no pose {list_keys(missing)}")
        if len(set(gone)) == len(self._data):
            raise GraphError("marginalise: no pose would stay")
        coordinates = solution.coordinates[[place[key] for key in self._data.keys]]
        marginal = marginal_factor(self._data, gone, coordinates)
        rest = _part(self._data, set(self._data.keys) - set(gone))
        rest.start_from(solution)
        self._data.is_replaced = True
        self._data = rest
        return None if marginal is None else rest.add_factor(marginal)

    def set_measurement(self, factor_id: int, measured: ArrayLike) -> int:
        """Replace what a factor measures; its noise stays, and the factor gets a new id, which is returned.

        Args:
            factor_id: of a factor.
            measured: in the form in which the factor was added: a pose ``(4, 4)`` of a between-factor, a sensor's step
                or a prior; of GPS the position, whose lever arm stays; of an attitude the direction in the body frame;
                a velocity, a point, biases ``(6,)``; one number of altitude and heading; bearing and range.

        Raises:
            GraphError: unknown id, or a factor of samples, of a user's code or of GTSAM's.
            DataError: as for a new factor.
        """
        factor = self._data.factors[self._data.known_factor(factor_id)]
        changed = replace(factor, measured=new_measurement(factor, measured, self._data.dimension))
        self._data.remove(factor_id)
        return self._data.add_factor(changed)

    def set_noise(
        self, factor_id: int, covariance: ArrayLike | None = None, *, information: ArrayLike | None = None,
        sigmas: ArrayLike | None = None,
    ) -> int:  # fmt: skip
        """Replace a factor's noise; the factor gets a new id, which is returned.

        Raises:
            GraphError: unknown id, or a factor without noise of its own.
            DataError: as for a new factor.
        """
        factor = self._data.factors[self._data.known_factor(factor_id)]
        if factor.noise is None:
            raise GraphError(f"{factor.label}: its noise follows from its samples or is GTSAM's")
        size = len(factor.noise.values)
        changed = replace(factor, noise=make_noise(factor.label, size, NoiseInput(covariance, information, sigmas)))
        self._data.remove(factor_id)
        return self._data.add_factor(changed)

    def merge(
        self, other: WholeGraph, keys: Mapping[Key, Key] | None = None, T_world_other: ArrayLike | None = None
    ) -> dict[int, int]:
        """Add another graph's poses and factors; return the new id of each of its factors.

        Args:
            other: a graph of the same dimension, without landmarks, geodetic origin or fixed poses. Its calibration
                variables keep their names, which this graph must not have.
            keys: new keys of its poses, for those that change, such as ``{k: (1, k) for k in other.keys}``.
            T_world_other: the other graph's world in this one ``(4, 4)``, by which its initial values, priors and
                marginals are moved; without it they are left out, and factors between the graphs place its poses. Its
                other factors in world (GPS, attitude, velocity, altitude, heading) are left out in any case.

        Raises:
            GraphError: a key that is in use, or a graph that cannot be merged.
        """
        keys = {} if keys is None else keys
        if not isinstance(other, WholeGraph) or not isinstance(keys, Mapping):
            raise GraphError("merge: expected another graph, and a mapping of its keys to new ones")
        theirs, changes = other._data, {check_key(k): check_key(v) for k, v in keys.items()}
        theirs.known_keys(*changes, what="merge")
        renamed = {key: changes.get(key, key) for key in theirs.keys}
        _check_mergeable(self._data, theirs, list(renamed.values()))
        T, initial = None, np.full_like(theirs.initial_values, np.nan)
        if T_world_other is not None:
            at = co.from_matrix(T_world_other, self._data.dimension, "T_world_other")
            T, known = co.to_matrices(at[None])[0], ~np.isnan(theirs.initial_values[:, 0])
            initial[known] = _moved(theirs.initial_values[known], T)
        self._data.add_poses(list(renamed.values()), initial)
        self._data.calibrations |= theirs.calibrations
        ids = {}
        for factor_id, factor in theirs.factors.items():
            if factor.kind in ("prior", "marginal") and T is not None:
                factor = replace(factor, measured=_moved_measurement(factor, T, self._data.dimension))
            elif factor.kind in _IN_WORLD:
                continue
            ids[factor_id] = self._data.add_factor(replace(factor, keys=tuple(renamed[key] for key in factor.keys)))
        return ids

    def to_gtsam(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return GTSAM's factors, and the initial values; an integer key stays, ``(robot, index)`` becomes a symbol."""
        return to_gtsam(self._data)

    @classmethod
    def from_gtsam(cls, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Self:
        """Return a pose graph of GTSAM's factors over poses and landmarks, with GTSAM's values as initial values.

        Between-factors, priors, and bearings with ranges, all with Gaussian noise, become this graph's own; other
        factors over poses stay GTSAM's, and cannot be saved. Calibration variables do not come back from
        :meth:`to_gtsam`: GTSAM's have neither kind nor name.

        Raises:
            DataError: values other than poses and points of one dimension, or a factor that cannot be taken.
        """
        data = from_gtsam(graph, values)
        made: Any = cls(data.dimension)
        made._data = data
        return made  # type: ignore[no-any-return]

    def _of(self, data: GraphData) -> Self:
        made = type(self)(data.dimension)
        made._data = data
        return made


_IN_WORLD = (
    "prior",
    "marginal",
    "gps",
    "attitude",
    "velocity",
    "altitude",
    "heading",
)  # they hold in the other graph's world


def _listed(keys: Collection[Key], what: str) -> list[Key]:
    try:
        return list(keys)
    except TypeError:
        raise GraphError(f"{what}: expected keys, got {type(keys).__name__}") from None


def _moved(coordinates: Array, T: Array) -> Array:
    """Return coordinates of poses seen from another world."""
    poses = se3.orthonormalise(T @ co.to_matrices(coordinates))
    return co.from_matrices(poses, 2 if coordinates.shape[1] == 3 else 3)


def _moved_measurement(factor: Factor, T: Array, dimension: co.Dimension) -> Array:
    """Return what a prior or a marginal measures, seen from another world."""
    if factor.kind == "prior":
        return np.asarray(_moved(factor.measured[None], T)[0])
    marginal = Marginal.unpacked(factor.measured, len(factor.keys), dimension, factor.label)
    return marginal.moved(_moved(marginal.coordinates, T)).packed()


def _part(data: GraphData, kept: set[Key]) -> GraphData:
    """Return a graph of some poses, and of the factors that concern them alone."""
    part, old = GraphData(data.dimension), data.index
    order = [key for key in data.keys if key in kept]
    part.add_poses(order, data.initial_values[[old[key] for key in order]])
    for key in data.fixed & kept:
        part.fix(key)
    part.origin, part.calibrations = data.origin, data.calibrations.copy()
    part.other_factors = {n: f for n, f in data.other_factors.items() if kept.issuperset(f.keys)}
    seen = {factor.landmark for factor in part.other_factors.values()}
    for key in data.landmarks.keys:
        if key in seen:
            part.landmarks.add(key, data.landmarks.initial_value(key))
    new = np.full(len(data), -1, dtype=np.int64)
    new[[old[key] for key in order]] = np.arange(len(order))
    part.edges = data.edges.where(np.asarray((new[data.edges.ends] >= 0).all(axis=1)))
    part.edges.ends[:] = new[part.edges.ends]
    part.next_id = data.next_id
    return part


def _check_mergeable(ours: GraphData, theirs: GraphData, keys: list[Key]) -> None:
    if ours.dimension != theirs.dimension:
        raise GraphError(f"merge: one graph is {ours.dimension}D, the other {theirs.dimension}D")
    if len(theirs.landmarks) or theirs.origin is not None or theirs.fixed:
        raise GraphError("merge: a graph with landmarks, a geodetic origin or fixed poses cannot be added to another")
    same = sorted(ours.calibrations.keys() & theirs.calibrations.keys())
    if same:
        raise GraphError(f"merge: both graphs have a calibration variable {same[0]!r}")
    in_use = [key for key in keys if key in ours or key in ours.landmarks]
    if in_use or len(set(keys)) < len(keys):
        raise GraphError(f"merge: keys in use, or given twice: {list_keys(in_use or keys)}; give new ones by keys=")
