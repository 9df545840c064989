"""What optimising a pose graph gives."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message, incremental_solver
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.solve.build import Builder
from hybridlio.graph.solve.levenberg import Solved


class Solution:
    """Poses, velocities and biases of a solved graph, and how well they fit. Later changes to the graph leave it alone.

    Attributes:
        error_before: half the sum of squared, whitened residuals at the start (robust ones by their kernel).
        error: the same at the answer; rejected factors do not count.
        iterations: Gauss-Newton and Levenberg-Marquardt steps.
        converged: whether the error had stopped falling.
        rejected: ids of the factors that ``gnc`` found to be wrong; empty for other solvers.
    """

    def __init__(self, data: GraphData, solved: Solved, rejected: frozenset[int] = frozenset()) -> None:
        self.error_before = solved.error_before
        self.error = solved.error
        self.iterations = solved.iterations
        self.converged = solved.converged
        self.rejected = rejected
        self._data = data
        self._solved = solved
        self._index = data.places

    def __contains__(self, key: object) -> bool:
        return key in self._index

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses, in the graph's order."""
        return list(self._index)

    @cached_property
    def poses(self) -> Array:
        """All poses ``(N, 4, 4)``, in the order of :attr:`keys`."""
        return co.to_matrices(self._solved.poses)

    @property
    def coordinates(self) -> Array:
        """All poses as text formats have them: ``(N, 7)`` x y z qx qy qz qw, in the plane ``(N, 3)`` x y θ."""
        return self._solved.poses.copy()

    def pose(self, key: Key) -> Array:
        """A pose ``(4, 4)`` in world."""
        return np.array(self.poses[self._at(key)])

    def velocity(self, key: Key) -> Array:
        """The body's velocity ``(3,)`` in world, m/s.

        Raises:
            GraphError: no factor gives this pose a velocity.
        """
        variable = self._variable(V(self._at(key)), key, "velocity")
        return np.array(self._solved.values.atVector(variable))

    def bias(self, key: Key) -> tuple[Array, Array]:
        """Biases of accelerometer (m/s²) and gyroscope (rad/s), ``(3,)`` each.

        Raises:
            GraphError: no factor gives this pose biases.
        """
        variable = self._variable(B(self._at(key)), key, "biases")
        bias = self._solved.values.atConstantBias(variable)
        return np.array(bias.accelerometer()), np.array(bias.gyroscope())

    def covariance(self, key: Key) -> Array:
        """Covariance ``(6, 6)`` of a pose in world, rotation first, right perturbation; in the plane ``(3, 3)``.

        Marginal over everything else; a fixed pose's is that of holding it, 1e-6 rad and m.
        """
        covariance = np.asarray(self._marginals.marginalCovariance(X(self._at(key))))
        return co.our_order((covariance + covariance.T) / 2, self._data.dimension)

    def relative_covariance(self, i: Key, j: Key) -> Array:
        """Covariance ``(6, 6)`` of the pose of j in the frame of i, ``T_i_j = T_i⁻¹ T_j``; in the plane ``(3, 3)``.

        Takes into account how the two depend on each other: neighbours far from the start know each other well.
        """
        a, b = self._at(i), self._at(j)
        size = co.TANGENT_SIZE[self._data.dimension]
        if a == b:
            return np.zeros((size, size))
        joint = self._marginals.jointMarginalCovariance([X(a), X(b)])
        T_j_i = se3.between(self.poses[b], self.poses[a])
        return co.relative_covariance(joint, X(a), X(b), T_j_i, self._data.dimension)

    def residual(self, factor_id: int) -> Array:
        """What a factor's measurement and the answer differ by, not divided by its deviations; rejected ones too.

        For poses a tangent vector, rotation first (rad, m); for inertial factors rotation, position, velocity, biases.
        """
        return self._residuals[self._factor(factor_id)][0]

    def chi2(self, factor_id: int) -> float:
        """χ² of a factor: its residual in units of its covariance, squared, without the robust kernel."""
        return self._residuals[self._factor(factor_id)][1]

    def all_chi2(self) -> dict[int, float]:
        """χ² of every factor, by id."""
        return {factor_id: chi2 for factor_id, (_, chi2) in self._residuals.items()}

    def weight(self, factor_id: int) -> float:
        """What the factor's robust kernel leaves of its weight, 0 to 1; 0 for a rejected one."""
        factor = self._data.factors[self._factor(factor_id)]
        if factor_id in self.rejected:
            return 0.0
        return 1.0 if factor.robust is None else factor.robust.weight(np.sqrt(self.chi2(factor_id)))

    @cached_property
    def _residuals(self) -> dict[int, tuple[Array, float]]:
        builder = Builder(self._data)
        graph = builder.graph(robust=False)
        order = np.argsort(co.GTSAM_ORDER[2]) if self._data.dimension == 2 else slice(None)
        found = {}
        for slot, factor_id in enumerate(builder.slots()):
            factor: Any = graph.at(slot)
            residual = np.asarray(factor.unwhitenedError(self._solved.values))[order]
            found[factor_id] = residual, 2 * float(factor.error(self._solved.values))
        return found

    @cached_property
    def _marginals(self) -> gtsam.Marginals | gtsam.ISAM2:
        try:
            if not self._solved.orthogonal:
                return gtsam.Marginals(self._solved.graph, self._solved.values)
        except RuntimeError:  # Cholesky finds it indeterminate: QR may not
            return self._by_qr()
        return self._by_qr()

    def _by_qr(self) -> gtsam.ISAM2:
        isam = incremental_solver()
        try:
            isam.update(self._solved.graph, self._solved.values)
        except RuntimeError as error:
            raise GraphError(f"covariances: {gtsam_message(error)}") from error
        return isam

    def _at(self, key: Key) -> int:
        if key not in self._index:
            raise GraphError(f"no pose has key {key}")
        return self._index[key]

    def _variable(self, variable: int, key: Key, what: str) -> int:
        if not self._solved.values.exists(variable):
            raise GraphError(f"pose {key} has no {what}; inertial and velocity factors give them")
        return variable

    def _factor(self, factor_id: int) -> int:
        if factor_id not in self._data.factors:
            raise GraphError(f"there was no factor {factor_id}")
        return factor_id
