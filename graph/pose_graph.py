"""The pose graph that users build: poses by key, measurements of and between them, and one call that solves it."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.graph.base.deep_stack import on_deep_stack
from hybridlio.graph.formats.files import read_graph, write_graph
from hybridlio.graph.formats.load_report import LoadOptions, LoadReport
from hybridlio.graph.landmark_measurements import check_free
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.graph_data import PosesByKey
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.new_factors import between_factor, check_start, check_vector, prior_factor
from hybridlio.graph.model.noise import NoiseInput, RobustLike
from hybridlio.graph.outliers.screened_solver import online_solver
from hybridlio.graph.solve.batch import solve_batch
from hybridlio.graph.solve.initial_values import find_initial_values
from hybridlio.graph.solve.online_solver import OnlineSolver
from hybridlio.graph.solve.replay import solve_online
from hybridlio.graph.solve.settings import (
    ONLINE_SOLVERS,
    InitialMethod,
    InitialName,
    IterationProgress,
    OnlineName,
    OutlierTest,
    Settings,
    SolverName,
    silent,
)
from hybridlio.graph.solve.solution import Solution
from hybridlio.graph.whole_graphs import WholeGraph


class PoseGraph(WholeGraph):
    """Poses and measurements; :meth:`optimize` finds the poses that fit the measurements best.

    Keys are integers or ``(robot, index)``. Poses are ``(4, 4)``; covariances are ``(6, 6)`` in rad² and m², rotation
    first, of a right perturbation. A planar graph (``dimension=2``) has poses ``(4, 4)`` in the plane z = 0, also taken
    as ``(3, 3)``, and covariances ``(3, 3)`` of heading, x, y. Inertial data, GPS and attitude need a graph in space;
    world then has gravity along −z, and poses are those of the IMU.

    A call that raises leaves the graph unchanged. Unknown or malformed keys raise ``GraphError``, malformed values
    ``DataError``.
    """

    def __init__(self, dimension: co.Dimension = 3) -> None:
        super().__init__(dimension)
        self._load_report = LoadReport()

    def __repr__(self) -> str:
        edges, others = len(self._data.edges), len(self._data.other_factors)
        landmarks = f"{len(self.landmarks)} landmarks, " if self.landmarks else ""
        return (
            f"<PoseGraph {self.dimension}D: {len(self)} poses, {landmarks}{len(self.fixed)} fixed, "
            f"{edges} between-factors, {others} other factors>"
        )

    def __len__(self) -> int:
        return len(self._data)

    def __contains__(self, key: object) -> bool:
        return key in self._data

    # poses

    @property
    def dimension(self) -> co.Dimension:
        """2 for a planar graph, 3 for one in space."""
        return self._data.dimension

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses, in the order they were added."""
        return self._data.keys

    def add_pose(self, key: Key, initial: ArrayLike | None = None) -> None:
        """Add a pose, with its initial value if it is known; raise GraphError where the key is in use."""
        key = check_key(key)
        check_free(self._data, key, "pose")
        self._data.add_pose(key, None if initial is None else co.from_matrix(initial, self.dimension, f"pose {key}"))

    def set_initial(self, key: Key, value: ArrayLike | None) -> None:
        """Replace the initial value of a pose or of a landmark, or remove it (None)."""
        if (key := check_key(key)) in self._data.landmarks:
            point = None if value is None else check_vector(value, self.dimension, f"landmark {key}")
            self._data.landmarks.set_initial(key, point)
            return
        self._data.known_keys(key, what="initial value")
        self._data.set_initial(key, None if value is None else co.from_matrix(value, self.dimension, f"pose {key}"))

    def initial(self, key: Key) -> Array | None:
        """Return the initial value of a pose ``(4, 4)`` or of a landmark ``(3,)`` or ``(2,)``, or None."""
        if (key := check_key(key)) in self._data.landmarks:
            return self._data.landmarks.initial_value(key)
        self._data.known_keys(key, what="initial value")
        found = self._data.initial_value(key)
        return None if found is None else np.asarray(co.to_matrices(found[None])[0])

    def start_from(self, solution: PosesByKey) -> None:
        """Take a solution's poses and landmarks as initial values, for the keys that both have."""
        self._data.start_from(check_start(self._data, solution))

    @property
    def fixed(self) -> frozenset[Key]:
        """Keys of the poses that are held at their initial values."""
        return self._data.fixed

    def fix(self, key: Key) -> None:
        """Hold a pose at its initial value: the usual way to anchor a graph without priors."""
        self._data.fix(*self._data.known_keys(key, what="fix"))

    def unfix(self, key: Key) -> None:
        """Release a fixed pose."""
        self._data.unfix(*self._data.known_keys(key, what="unfix"))

    # factors: each call returns the factor's id

    @property
    def factors(self) -> Mapping[int, Factor]:
        """Factors by id, in the order they were added; read only."""
        return self._data.factors

    def remove(self, factor_id: int) -> None:
        """Remove a factor; its poses stay. Raise GraphError where no factor has this id."""
        self._data.remove(factor_id)

    def add_prior(
        self, key: Key, pose: ArrayLike, covariance: ArrayLike | None = None, *, information: ArrayLike | None = None,
        sigmas: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add a measured pose in world; a new pose starts from it. Noise and kernel as in :meth:`add_between`."""
        factor = prior_factor(self._data, key, pose, NoiseInput(covariance, information, sigmas), robust)
        if factor.keys[0] not in self._data:
            check_free(self._data, factor.keys[0], "pose")
            self._data.add_pose(factor.keys[0], factor.measured)
        return self._data.add_factor(factor)

    def add_between(
        self, i: Key, j: Key, T_i_j: ArrayLike, covariance: ArrayLike | None = None, *,
        information: ArrayLike | None = None, sigmas: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Add a measurement of pose j in the frame of pose i; a new pose j is added.

        Args:
            i, j: keys; the graph must have ``i``.
            T_i_j: ``(4, 4)``.
            covariance, information, sigmas: exactly one of them, of a right perturbation of ``T_i_j``, rotation first.
            robust: a kernel's name (``hybridlio.graph.KERNELS``), alone or with a width in standard deviations.

        Raises:
            DataError: not a pose, or the covariance is not symmetric positive definite.
            GraphError: unknown key, a pose joined to itself, none or several of covariance, information, sigmas.
        """
        factor = between_factor(self._data, (i, j), T_i_j, NoiseInput(covariance, information, sigmas), robust)
        if factor.keys[1] not in self._data:
            check_free(self._data, factor.keys[1], "pose")
            self._data.add_pose(factor.keys[1])
        return self._data.add_factor(factor)

    # solving

    def components(self) -> list[list[Key]]:
        """Return the connected components over between- and IMU factors, largest first."""
        return components(self._data)

    def initialise(self, method: InitialMethod = "chordal") -> None:
        """Replace the initial values by ones found from the between-factors.

        ``odometry`` follows the chain of consecutive keys; ``spanning-tree`` goes breadth first from the fixed or
        measured poses; ``chordal`` solves for all rotations, relaxed to linear least squares, then for all positions
        (Carlone et al., "Initialization techniques for 3D SLAM", ICRA 2015). GraphError names poses out of reach.
        """
        self._data.set_all_initial(find_initial_values(self._data, method))

    def optimize(
        self, backend: SolverName = "auto", *, initial: InitialName = "auto", max_iterations: int = 100,
        tolerance: float = 1e-6, lag: int = 200, progress: IterationProgress | None = None,
    ) -> Solution:  # fmt: skip
        """Find the poses, velocities and biases that fit all factors best.

        Args:
            backend: ``batch`` (or ``auto``) is Gauss-Newton, damped where the error would rise; ``gnc`` rejects wrong
                loop closures by graduated non-convexity (Yang et al., RA-L 2020) and trusts factors between consecutive
                keys; ``incremental`` and ``fixed-lag`` give the graph pose by pose to the solvers of :meth:`online`.
            initial: ``auto`` starts from the given initial values or from chordal ones, whichever fit better;
                ``given`` from the given ones; a method of :meth:`initialise` from what it finds.
                Online backends start each pose from its neighbours.
            max_iterations: of Gauss-Newton and Levenberg-Marquardt together.
            tolerance: share of the error that further iterations may still gain.
            lag: number of poses that ``fixed-lag`` keeps.
            progress: called with the stage, the iteration and the error there.

        Raises:
            ConfigError: an unknown name, or a number that is not positive.
            GraphError: the factors do not determine every pose; names the keys.
        """
        settings = Settings(backend, initial, max_iterations, tolerance, lag)
        if progress is not None and not callable(progress):
            raise ConfigError("progress must be a function of stage, iteration and error")
        solve = solve_online if backend in ONLINE_SOLVERS else solve_batch
        return on_deep_stack(len(self), lambda: solve(self._data, settings, progress or silent))

    def online(
        self, backend: OnlineName = "incremental", *, lag: int = 200, forget: bool = False,
        outliers: OutlierTest | None = None,
    ) -> OnlineSolver:  # fmt: skip
        """Return a solver that follows this graph while it grows: its ``update()`` takes over what has changed.

        Args:
            backend: ``incremental`` keeps everything (iSAM2); ``fixed-lag`` the newest poses, in constant time.
            lag: number of poses that ``fixed-lag`` keeps.
            forget: whether ``fixed-lag`` removes the factors of poses that leave the lag from the graph, and keeps
                their last estimates as initial values, so that the graph stays small too.
            outliers: ``chi2`` tests each new loop and GPS fix against the estimate and both covariances; ``gnc`` also
                decides on all loops anew as they become more (``incremental`` only). ``solver.rejected`` has the ids
                of the factors that are left out.

        Raises:
            ConfigError: an unknown name, a lag that is not positive, or ``gnc`` with ``fixed-lag``.
        """
        return online_solver(self._data, backend, lag, forget, outliers)

    # files

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, repair: bool = False, strict: bool = False, drop: Collection[str] = ()
    ) -> PoseGraph:
        """Read ``.npz``, ``.g2o`` or TORO's ``.graph``; in text that places no pose, the one of lowest id is fixed.

        :attr:`load_report` and a warning tell what was left out, repaired or completed.

        Args:
            path: the file.
            repair: whether to replace each information matrix that is not positive definite by the nearest one that
                is, instead of refusing the file.
            strict: whether to refuse rows that are left out by default (planes and directions, as hdl_graph_slam
                writes them) and TORO's edges without information, which are given the identity by default.
            drop: tags of rows to leave out, where a file has rows that cannot be read.

        Raises:
            DataError: the file is missing, truncated or malformed, or has rows that cannot be read; names the row.
        """
        graph = cls()
        graph._data, graph._load_report = read_graph(path, LoadOptions(repair, strict, drop))
        return graph

    @property
    def load_report(self) -> LoadReport:
        """Counts of what :meth:`load` left out or changed; false where it read everything as it is."""
        return self._load_report

    def save(self, path: str | os.PathLike[str], solution: Solution | None = None) -> None:
        """Write ``.npz`` (everything), ``.g2o`` or TORO's ``.graph``, with the initial values or a solution's poses.

        Raises:
            GraphError: the format cannot hold what is in the graph.
            DataError: unknown ending, or the file cannot be written.
        """
        write_graph(self._data, path, solution)
