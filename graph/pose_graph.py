"""The pose graph: poses by key, measurements between and of them, and one call that solves it."""

from __future__ import annotations

import os
from dataclasses import astuple
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.geodesy import check_geodetic, enu_from_geodetic
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.graph.model.measurements import Factor, RobustLike, label, make_noise, make_robust

if TYPE_CHECKING:
    from hybridlio.graph.solve.levenberg import Progress
    from hybridlio.graph.solve.online_solver import OnlineSolver
    from hybridlio.graph.solve.optimise import Backend, Initial
    from hybridlio.graph.solve.solution import Solution
    from hybridlio.graph.solve.starts import Method

_UP = np.array([0.0, 0.0, 1.0])
_STANDS_STILL_M_S = 0.01


class PoseGraph(GraphData):
    """Poses and measurements; :meth:`optimize` finds the poses that fit them best.

    Keys are integers or ``(robot, index)``. Poses are ``(4, 4)``; covariances are ``(6, 6)``, rotation first, of a
    right perturbation. A planar graph (``dimension=2``) has poses ``(4, 4)`` in the plane z = 0, also taken as
    ``(3, 3)``, and covariances ``(3, 3)`` of heading, x, y. Inertial data, GPS and attitude need a graph in space; its
    world then has gravity along −z, and its poses are those of the IMU.

    A call that raises leaves the graph as it was.
    """

    # factors: each call returns the factor's id

    def add_prior(
        self, key: Key, pose: ArrayLike, covariance: ArrayLike | None = None, *, information: ArrayLike | None = None,
        sigmas: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """A pose measured in world; adds the pose where it is new, with this as its initial value.

        Raises:
            DataError: not a pose, or the covariance is not symmetric positive definite.
            GraphError: none or several of covariance, information, sigmas.
        """
        key = check_key(key)
        name = label("prior", (key,))
        measured = self._coordinates(pose, name)
        noise = make_noise(name, self._size, covariance, information, sigmas)
        factor = Factor("prior", (key,), measured, noise, make_robust(robust, self._size, name))
        if key not in self:
            self.put_pose(key, measured)
        return self._add(factor)

    def add_between(
        self, i: Key, j: Key, T_i_j: ArrayLike, covariance: ArrayLike | None = None, *,
        information: ArrayLike | None = None, sigmas: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """Pose j measured in the frame of pose i; adds pose j where it is new.

        Args:
            i, j: keys; ``i`` must be known.
            T_i_j: ``(4, 4)``.
            covariance, information, sigmas: one of them, of a right perturbation of ``T_i_j``, rotation first.
            robust: ``huber``, ``cauchy``, ``geman-mcclure`` or ``dcs``, alone or with a width.

        Raises:
            DataError: not a pose, or the covariance is not symmetric positive definite.
            GraphError: unknown key, a pose joined to itself, none or several of covariance, information, sigmas.
        """
        name = label("between", (i, j))
        (i,) = self._known(i, what=name)
        j = check_key(j)
        if i == j:
            raise GraphError(f"{name}: joins a pose to itself")
        measured = self._coordinates(T_i_j, name)
        noise = make_noise(name, self._size, covariance, information, sigmas)
        factor = Factor("between", (i, j), measured, noise, make_robust(robust, self._size, name))
        if j not in self:
            self.put_pose(j, None)
        return self._add(factor)

    def add_gps(
        self, key: Key, position_m: ArrayLike, sigmas: ArrayLike | None = None, lever_arm_m: ArrayLike = (0, 0, 0), *,
        covariance: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """The antenna's position ``(3,)`` in world; ``lever_arm_m`` is the antenna in the body's frame."""
        vectors = (position_m, lever_arm_m)
        return self._add_vectors("gps", key, vectors, 3, covariance, sigmas, robust)

    def add_gps_geodetic(
        self, key: Key, latitude_deg: float, longitude_deg: float, altitude_m: float, sigmas: ArrayLike | None = None,
        lever_arm_m: ArrayLike = (0, 0, 0), *, covariance: ArrayLike | None = None, robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """The antenna's place on Earth; world is east, north, up at ``origin``, which the first fix sets if need be.

        Args:
            key: a pose that is known.
            latitude_deg, longitude_deg, altitude_m: on WGS 84, metres above the ellipsoid (not above sea level).
            sigmas, covariance: one of them, of east, north, up in metres.
            lever_arm_m: ``(3,)`` the antenna in the body's frame.
            robust: as for other factors.

        Raises:
            DataError: not finite, no such latitude or longitude, or as for other factors.
            GraphError: unknown key, a planar graph, none or both of covariance and sigmas.
        """
        point = check_geodetic(latitude_deg, longitude_deg, altitude_m, label("gps", (key,)))
        origin = self.origin or point
        position = enu_from_geodetic([point], origin)[0]
        number = self.add_gps(key, position, sigmas, lever_arm_m, covariance=covariance, robust=robust)
        self.origin = origin
        return number

    def add_attitude(
        self, key: Key, direction_world: ArrayLike, direction_body: ArrayLike, sigma_rad: float,
        robust: RobustLike = None,
    ) -> int:  # fmt: skip
        """A direction known in world and seen in the body's frame, each ``(3,)``; lengths do not matter.

        Raises:
            DataError: a direction of no length, or as for other factors.
        """
        for direction in (direction_world, direction_body):
            if not np.any(np.asarray(direction)):
                raise DataError(f"{label('attitude', (key,))}: a direction has no length")
        vectors = (direction_world, direction_body)
        return self._add_vectors("attitude", key, vectors, 2, None, sigma_rad, robust)

    def add_gravity(self, key: Key, accel_m_s2: ArrayLike, sigma_rad: float, robust: RobustLike = None) -> int:
        """Roll and pitch from an accelerometer at rest or in steady motion, which shows what is up."""
        return self.add_attitude(key, _UP, accel_m_s2, sigma_rad, robust)

    def add_velocity(self, key: Key, velocity_m_s: ArrayLike, sigmas: ArrayLike, robust: RobustLike = None) -> int:
        """The body's velocity in world ``(3,)``."""
        return self._add_vectors("velocity", key, (velocity_m_s,), 3, None, sigmas, robust)

    def add_zero_velocity(self, key: Key, sigma_m_s: float = _STANDS_STILL_M_S) -> int:
        """The body stands still."""
        return self.add_velocity(key, np.zeros(3), sigma_m_s)

    def add_bias(self, key: Key, accel_m_s2: ArrayLike, gyro_rad_s: ArrayLike, sigmas: ArrayLike) -> int:
        """The IMU's biases; ``sigmas`` are six, accelerometer first.

        A chain of inertial factors without one has biases of zero at its start, as sure as its :class:`ImuNoise` says.
        """
        accel, gyro = np.asarray(accel_m_s2, dtype=np.float64), np.asarray(gyro_rad_s, dtype=np.float64)
        return self._add_vectors("bias", key, (accel, gyro), 6, None, sigmas, None)

    def add_imu(self, i: Key, j: Key, samples: ImuSamples, noise: ImuNoise | None = None) -> int:
        """Raw samples from the time of pose i (the first) to that of pose j (the last); both poses must be known.

        Velocities and biases of both come with it.

        Raises:
            DataError: fewer than two samples.
            GraphError: unknown key, a planar graph.
        """
        name = label("imu", (i, j))
        i, j = self._known(i, j, what=name)
        self._in_space(name)
        if i == j:
            raise GraphError(f"{name}: joins a pose to itself")
        if len(samples) < 2:
            raise DataError(f"{name}: {len(samples)} IMU samples; at least 2 are needed")
        densities = np.array(astuple(noise or ImuNoise()))
        if not (np.isfinite(densities).all() and densities.min() > 0):
            raise DataError(f"{name}: noise densities must be finite and positive, got {densities.tolist()}")
        return self._add(Factor("imu", (i, j), densities, samples=samples))

    # solving

    def components(self) -> list[list[Key]]:
        """The parts that no between- or IMU factor joins, largest first."""
        from hybridlio.graph.model.checks import components

        return components(self)

    def initialise(self, method: Method = "chordal") -> None:
        """Find initial values from the between-factors: ``odometry``, ``spanning-tree`` or ``chordal``.

        ``odometry`` follows the chain of consecutive keys; ``spanning-tree`` goes breadth first from the fixed or
        measured poses; ``chordal`` solves for all rotations at once, relaxed to linear least squares, then for all
        positions (Carlone et al., "Initialization techniques for 3D SLAM", ICRA 2015).

        Raises:
            GraphError: some poses cannot be reached; names them.
        """
        from hybridlio.graph.solve.starts import find

        self._initial.array[:] = find(self, method)

    def optimize(
        self, backend: Backend = "auto", *, initial: Initial = "auto", max_iterations: int = 100,
        tolerance: float = 1e-6, lag: int = 200, progress: Progress | None = None,
    ) -> Solution:  # fmt: skip
        """Find the poses, velocities and biases that fit all factors best.

        Args:
            backend: ``batch`` is Gauss-Newton, damped where the error would rise; ``gnc`` finds and rejects wrong loop
                closures (graduated non-convexity, Yang et al., RA-L 2020) and takes factors between consecutive keys
                for right; ``incremental`` and ``fixed-lag`` give the graph pose by pose, in its order, to what
                :meth:`online` makes; ``auto`` is ``batch``.
            initial: ``auto`` starts from the given initial values or from chordal ones, whichever fit better; from
                ``given`` ones, or those that a method of :meth:`initialise` finds, where it says so. Online backends
                start each pose from its neighbours.
            max_iterations: of Gauss-Newton and Levenberg-Marquardt together.
            tolerance: share of the error that further iterations may still gain.
            lag: poses that ``fixed-lag`` keeps.
            progress: called with the stage, the iteration and the error there.

        Raises:
            GraphError: the factors do not determine every pose; names the keys.
        """
        from hybridlio.graph.solve.optimise import Settings, optimise

        return optimise(self, Settings(backend, initial, max_iterations, tolerance, lag), progress)

    def online(
        self, backend: Literal["incremental", "fixed-lag"] = "incremental", *, lag: int = 200, forget: bool = False
    ) -> OnlineSolver:
        """A solver that follows this graph while it grows; its ``update()`` takes in what has changed.

        Args:
            backend: ``incremental`` keeps everything (iSAM2); ``fixed-lag`` the newest poses, in constant time.
            lag: poses that ``fixed-lag`` keeps.
            forget: whether ``fixed-lag`` takes the factors of poses that leave the lag out of the graph, and leaves
                their last estimates as initial values, so that the graph stays small too.

        Raises:
            ConfigError: no such backend, or a lag that is not positive.
        """
        from hybridlio.graph.solve.online_solver import OnlineSolver

        return OnlineSolver(self, backend, lag, forget)

    # files

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> PoseGraph:
        """Read ``.npz``, ``.g2o`` or TORO's ``.graph``; text is told by its tags, in the plane or in space.

        A text file that holds neither FIX nor prior has its pose of lowest number fixed, as is usual.

        Raises:
            DataError: the file is missing, truncated or garbled; names the row.
        """
        from hybridlio.graph.formats.files import load

        data = load(path)
        graph = cls(data.dimension)
        vars(graph).update(vars(data))
        return graph

    def save(self, path: str | os.PathLike[str], solution: Solution | None = None) -> None:
        """Write ``.npz`` (everything), ``.g2o`` or TORO's ``.graph``, by the name's ending.

        Args:
            path: the file.
            solution: whose poses to write; by default the initial values.

        Raises:
            GraphError: the format cannot hold what is in the graph.
            DataError: unknown ending, or the place cannot be written to.
        """
        from hybridlio.graph.formats.files import save

        save(self, path, solution)
