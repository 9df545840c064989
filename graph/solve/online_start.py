"""Where an online solver lets new poses, velocities and biases start, and whether its news determine them."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.core.errors import GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import named
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.solve.build import Builder
from hybridlio.graph.solve.changes import News


def is_reached(data: GraphData, news: News, moving: set[int]) -> bool:
    """Whether steps from poses that are known, or priors, lead to every new pose, and velocities come along.

    Told from the news alone. False where it cannot be told so quickly.
    """
    places, new = data.places, news.poses
    known = {places[f.keys[0]] for f in news.others.values() if f.kind == "prior"} | {places[k] for k in news.fixed}
    speeds = {places[f.keys[0]] for f in news.others.values() if f.kind == "velocity"} | moving
    steps = [(i, j, False) for i, j in data.edges.ends[news.rows].tolist()]
    inertial = [factor for factor in news.others.values() if factor.kind == "imu"]
    steps += [(places[i], places[j], True) for i, j in (factor.keys for factor in inertial)]
    changed = True
    while changed:
        changed = False
        for i, j, moves in steps:
            for a, b in ((i, j), (j, i)):
                here = a < new.start or a in known
                if here and not (b < new.start or b in known) and (not moves or a in speeds):
                    known.add(b)
                    changed = True
            if moves and (i in speeds) != (j in speeds):
                speeds |= {i, j}
                changed = True
    told = all(places[key] in speeds for factor in inertial for key in factor.keys)
    return told and all(place in known for place in new)


class Guess:
    """Values of what is new: along the new factors from what is known, or as given."""

    def __init__(self, data: GraphData, news: News, solver: Any, moving: set[int], biased: set[int]) -> None:
        self._data, self._news, self._solver = data, news, solver
        self._moving, self._biased = moving, biased
        self._poses: dict[int, Any] = {}
        self._velocities: dict[int, Any] = {}
        self._biases = {data.places[f.keys[0]]: f.measured for f in news.others.values() if f.kind == "bias"}
        self.builder = Builder(data, self.bias)

    def bias(self, place: int) -> gtsam.imuBias.ConstantBias:
        """Of a pose, around which samples are summed up: as estimated, or as measured, or none."""
        if place in self._biased:
            estimated: gtsam.imuBias.ConstantBias = self._solver.calculateEstimateConstantBias(B(place))
            return estimated
        given = self._biases.get(place, np.zeros(6))
        return gtsam.imuBias.ConstantBias(given[:3], given[3:])

    def values(self) -> gtsam.Values:
        """Of all variables that are new.

        Raises:
            GraphError: nothing says where a pose may lie; names it.
        """
        inertial = [factor for factor in self._news.others.values() if factor.kind == "imu"]
        self._carry_biases(inertial)
        self._follow_edges()
        for factor in inertial:
            self._predict(factor)
        self._follow_edges()
        self._take_given()
        values = gtsam.Values()
        for place, pose in sorted(self._poses.items()):
            values.insert(X(place), pose)
        self._insert_motion(values, inertial)
        return values

    def _carry_biases(self, inertial: list[Factor]) -> None:
        for factor in inertial:
            i, j = (self._data.places[key] for key in factor.keys)
            if j not in self._biases and j not in self._biased:
                self._biases[j] = self.bias(i).vector()

    def _known(self, place: int) -> Any:
        """A pose as GTSAM has it, or None."""
        if place < self._news.poses.start:
            kind = "Pose3" if self._data.dimension == 3 else "Pose2"
            return getattr(self._solver, f"calculateEstimate{kind}")(X(place))
        return self._poses.get(place)

    def _follow_edges(self) -> None:
        table, rows = self._data.edges, self._news.rows
        steps = list(zip(table.ends[rows].tolist(), co.gtsam_poses(table.measured[rows]), strict=True))
        while steps:
            rest = []
            for (i, j), T in steps:
                here, there = self._known(i), self._known(j)
                if there is None and here is not None:
                    self._poses[j] = here.compose(T)
                elif here is None and there is not None:
                    self._poses[i] = there.compose(T.inverse())
                elif here is None:
                    rest.append(((i, j), T))
            if len(rest) == len(steps):
                return
            steps = rest

    def _predict(self, factor: Factor) -> None:
        """Where the samples lead from the pose and velocity before them."""
        i, j = (self._data.places[key] for key in factor.keys)
        pose, velocity = self._known(i), self._velocity(i)
        if pose is None or velocity is None:
            return
        samples = self.builder.other(factor).preintegratedMeasurements()
        then = samples.predict(gtsam.NavState(pose, velocity), self.bias(i))
        if self._known(j) is None:
            self._poses[j] = then.pose()
        if j not in self._moving:
            self._velocities[j] = then.velocity()

    def _velocity(self, place: int) -> Any:
        if place in self._moving:
            return self._solver.calculateEstimateVector(V(place))
        if place not in self._velocities:
            for factor in self._news.others.values():
                if factor.kind == "velocity" and self._data.places[factor.keys[0]] == place:
                    self._velocities[place] = factor.measured
        return self._velocities.get(place)

    def _take_given(self) -> None:
        missing = [place for place in self._news.poses if place not in self._poses]
        priors = {self._data.places[f.keys[0]]: f.measured for f in self._news.others.values() if f.kind == "prior"}
        for place in missing:
            (key,) = self._data.keys_at([place])
            at = priors.get(place, self._data.coordinates(key))
            if at is None:
                raise GraphError(f"nothing says where pose {named([key])} may lie; give an initial value")
            self._poses[place] = co.gtsam_poses(at[None])[0]
            self._follow_edges()

    def _insert_motion(self, values: gtsam.Values, inertial: list[Factor]) -> None:
        """Velocities and biases that come with inertial and velocity factors."""
        places = self._data.places
        biased = {places[k] for f in self._news.others.values() if f.kind in ("imu", "bias") for k in f.keys}
        moving = {places[k] for f in self._news.others.values() if f.kind in ("imu", "velocity") for k in f.keys}
        for factor in inertial:
            i, j = (places[key] for key in factor.keys)
            samples = self.builder.other(factor).preintegratedMeasurements()
            mean = (self._known(j).translation() - self._known(i).translation()) / samples.deltaTij()
            for place in (i, j):
                if self._velocity(place) is None:
                    self._velocities[place] = mean
        for place in sorted(moving - self._moving):
            values.insert(V(place), self._velocity(place))
        for place in sorted(biased - self._biased):
            values.insert(B(place), self.bias(place))
