"""Result of optimising a pose graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import block_diag

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.deep_stack import on_deep_stack
from hybridlio.graph.base.marginals import Marginals
from hybridlio.graph.calibration.estimates import CalibrationEstimate, estimate, reported
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.graph.model.measurements import CODE
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.landmark_factors import landmark_point
from hybridlio.graph.solve.nonlinear import SolverResult
from hybridlio.graph.views.solution_views import SolutionViews


class Solution(SolutionViews):
    """What was found for a solved graph, and how well it fits; independent of later changes to the graph.

    Attributes:
        error_before: half the sum of squared, whitened residuals at the start, under the robust kernels.
        error: the same at the optimum, without rejected factors.
        iterations: Gauss-Newton and Levenberg-Marquardt steps.
        converged: whether the error had stopped falling.
        rejected: ids of the factors that ``gnc`` found to be wrong; empty for other backends.
        doubtful: reasons why the solution may be wrong; empty where nothing speaks against it.
    """

    def __init__(
        self,
        data: GraphData,
        result: SolverResult,
        rejected: frozenset[int] = frozenset(),
        doubts: tuple[str, ...] = (),
    ) -> None:
        self.error_before = result.error_before
        self.error = result.error
        self.iterations = result.iterations
        self.converged = result.converged
        self.rejected = rejected
        self.doubtful = doubts if result.converged else (*doubts, f"not converged after {result.iterations} iterations")
        self._data = data
        self._result = result
        self._index = data.index

    def __repr__(self) -> str:
        state = "converged" if self.converged else "not converged"
        landmarks = f"{len(self.landmarks)} landmarks, " if self.landmarks else ""
        rejected = f", {len(self.rejected)} factors rejected" if self.rejected else ""
        doubts = f", doubtful: {'; '.join(self.doubtful)}" if self.doubtful else ""
        return (
            f"<Solution: {len(self._index)} poses, {landmarks}error {self.error_before:.6g} -> {self.error:.6g} "
            f"in {self.iterations} iterations, {state}{rejected}{doubts}>"
        )

    def __contains__(self, key: object) -> bool:
        return key in self._index

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses, in the graph's order."""
        return list(self._index)

    @property
    def poses(self) -> Array:
        """All poses ``(N, 4, 4)`` in world, in the order of :attr:`keys`."""
        return self._poses

    @cached_property
    def _poses(self) -> Array:
        return co.to_matrices(self._result.poses)

    @property
    def coordinates(self) -> Array:
        """All poses as text formats hold them: ``(N, 7)`` x y z qx qy qz qw, or ``(N, 3)`` x y θ in the plane."""
        return self._result.poses.copy()

    def pose(self, key: Key) -> Array:
        """Return a pose ``(4, 4)`` in world.

        Raises:
            GraphError: no pose has this key.
        """
        return np.array(self.poses[self._known(key)])

    @property
    def landmarks(self) -> list[Key]:
        """Keys of all landmarks, in the graph's order."""
        return self._data.landmarks.keys

    @cached_property
    def points(self) -> Mapping[Key, Array]:
        """All landmarks ``(3,)`` in world, ``(2,)`` in the plane, by key."""
        found = self._data.landmarks.index.items()
        return {key: landmark_point(self._result.values, k, self._data.dimension) for key, k in found}

    def point(self, key: Key) -> Array:
        """Return a landmark ``(3,)`` in world, ``(2,)`` in the plane.

        Raises:
            GraphError: no landmark has this key.
        """
        if (known := check_key(key)) not in self._data.landmarks:
            raise GraphError(f"no landmark has key {known}")
        return self.points[known].copy()

    def velocity(self, key: Key) -> Array:
        """Return the body's velocity ``(3,)`` in world, m/s.

        Raises:
            GraphError: no factor gives this pose a velocity.
        """
        variable = self._variable(V(self._known(key)), key, "velocity")
        return np.array(self._result.values.atVector(variable))

    def bias(self, key: Key) -> tuple[Array, Array]:
        """Return the biases of accelerometer (m/s²) and gyroscope (rad/s), ``(3,)`` each.

        Raises:
            GraphError: no factor gives this pose biases.
        """
        variable = self._variable(B(self._known(key)), key, "biases")
        bias = self._result.values.atConstantBias(variable)
        return np.array(bias.accelerometer()), np.array(bias.gyroscope())

    @property
    def calibrations(self) -> list[str]:
        """Names of all calibration variables, in the order they were added."""
        return list(self._data.calibrations)

    def calibration(self, name: str) -> CalibrationEstimate:
        """Return a calibration variable: value, covariance, and what the measurements do not determine.

        Raises:
            GraphError: no variable has this name.
        """
        variable, _ = reported(self._data, self._result.values, name)
        return estimate(self._data, self._result.values, name, self._marginal(variable))

    def covariance(self, key: Key | str) -> Array:
        """Return the marginal covariance of a pose, a landmark or a calibration variable.

        A pose's, of a right perturbation in world, is ``(6, 6)`` in rad² and m², rotation first; in the plane
        ``(3, 3)`` of heading, x, y. A landmark's is ``(3, 3)`` in m², in the plane ``(2, 2)``. A fixed pose has the
        covariance of the prior that holds it, 1e-6 rad and m. A calibration variable's, by its name, is as
        :class:`~hybridlio.graph.CalibrationEstimate` has it.

        Raises:
            GraphError: no pose, landmark or variable has this key, or the graph is too ill-conditioned for covariances.
        """
        return self.joint_covariance([key])

    def relative_covariance(self, i: Key, j: Key) -> Array:
        """Return the covariance of ``T_i_j = T_i⁻¹ T_j``, the pose of j in the frame of i; shape as :meth:`covariance`.

        The correlation of the two poses counts: far from the start, neighbours are uncertain in world but not to each
        other.

        Raises:
            GraphError: as :meth:`covariance`.
        """
        a, b = self._known(i), self._known(j)
        if a == b:
            return np.zeros((self._data.tangent_size,) * 2)
        joint = self._joint([X(a), X(b)])
        T_j_i = se3.between(self.poses[b], self.poses[a])
        return co.relative_covariance(joint, T_j_i, self._data.dimension)

    def velocity_covariance(self, key: Key) -> Array:
        """Return the covariance ``(3, 3)`` of a velocity in world, m²/s²; raises as :meth:`velocity`."""
        return _symmetric(self._marginal(self._variable(V(self._known(key)), key, "velocity")))

    def bias_covariance(self, key: Key) -> Array:
        """Return the covariance ``(6, 6)`` of the biases, accelerometer first; raises as :meth:`bias`."""
        return _symmetric(self._marginal(self._variable(B(self._known(key)), key, "biases")))

    def joint_covariance(self, keys: Sequence[Key | str]) -> Array:
        """Return the joint covariance of several poses, landmarks and calibration variables, in blocks in their order.

        Each block is as in :meth:`covariance`, which also lists what is raised.
        """
        found = [reported(self._data, self._result.values, key) for key in keys]
        M = block_diag(*(M for _, M in found))
        return _symmetric(M @ self._joint([variable for variable, _ in found]) @ M.T)

    def residual(self, factor_id: int) -> Array:
        """Return the difference of a factor's measurement and the solution, not whitened; of rejected factors too.

        A pose's is a tangent vector, rotation first (rad, m); a landmark's is bearing and range (rad, m); an inertial
        factor's holds rotation, position, velocity and biases.

        Raises:
            GraphError: no factor has this id.
        """
        return self._residuals[self._known_factor(factor_id)][0]

    def chi2(self, factor_id: int) -> float:
        """Return χ² of a factor: its squared residual in units of its covariance, without the robust kernel.

        Raises:
            GraphError: no factor has this id.
        """
        return self._residuals[self._known_factor(factor_id)][1]

    def all_chi2(self) -> dict[int, float]:
        """Return χ² of every factor, by id."""
        return {factor_id: chi2 for factor_id, (_, chi2) in self._residuals.items()}

    def weight(self, factor_id: int) -> float:
        """Return the factor, 0 to 1, by which the robust kernel scales a factor's information; 0 for a rejected one.

        Raises:
            GraphError: no factor has this id.
        """
        factor = self._data.factors[self._known_factor(factor_id)]
        if factor_id in self.rejected:
            return 0.0
        return 1.0 if factor.robust is None else factor.robust.weight(np.sqrt(self.chi2(factor_id)))

    @cached_property
    def _residuals(self) -> dict[int, tuple[Array, float]]:
        builder = Builder(self._data)
        graph = builder.graph(robust=False)
        order = np.argsort(co.GTSAM_ORDER[2]) if self._data.dimension == 2 else slice(None)
        coded = {n for n, f in self._data.other_factors.items() if f.kind in ("marginal", *CODE)}
        found = {}
        for slot, factor_id in enumerate(builder.factor_ids()):
            factor: Any = graph.at(slot)
            has_residual = hasattr(factor, "unwhitenedError")  # some of GTSAM's have none
            residual = np.asarray(factor.unwhitenedError(self._result.values)) if has_residual else np.zeros(0)
            # a planar observation has two components; users' own residuals and marginals have any number
            in_gtsams_order = len(residual) > 2 and factor_id not in coded
            residual = residual[order] if in_gtsams_order else residual
            found[factor_id] = residual, 2 * float(factor.error(self._result.values))
        return found

    def _marginal(self, variable: int) -> Array:
        return self._joint([variable])

    def _joint(self, variables: Sequence[int]) -> Array:
        """Return the joint covariance of GTSAM's variables, in its order of tangent vectors."""
        return on_deep_stack(len(self._index), lambda: self._marginals.covariance(variables))

    @cached_property
    def _marginals(self) -> Marginals:
        graph, values, by_qr = self._result.graph, self._result.values, self._result.uses_qr
        try:
            return Marginals(graph, values, by_qr)
        except GraphError:
            if by_qr:
                raise
            return Marginals(graph, values)  # Cholesky finds the system indeterminate

    def _known(self, key: Key) -> int:
        if (known := check_key(key)) not in self._index:
            raise GraphError(f"no pose has key {known}")
        return self._index[known]

    def _variable(self, variable: int, key: Key, what: str) -> int:
        if not self._result.values.exists(variable):
            raise GraphError(f"pose {key} has no {what}; inertial and velocity factors add them")
        return variable

    def _known_factor(self, factor_id: int) -> int:
        return self._data.known_factor(factor_id)


def _symmetric(covariance: Array) -> Array:
    return np.asarray((covariance + covariance.T) / 2)
