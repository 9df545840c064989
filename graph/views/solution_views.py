"""What a solution offers to other programs and to the eye."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.trajectory import Trajectory, write_tum
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, to_integer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hybridlio.graph.solve.nonlinear import SolverResult

_NS_PER_S = 1_000_000_000


class SolutionViews:
    """The part of a solution that converts it; the subclass has poses, χ² and the solver's result."""

    _data: GraphData
    _result: SolverResult
    rejected: frozenset[int]

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses."""
        raise NotImplementedError

    @property
    def poses(self) -> Array:
        """All poses ``(N, 4, 4)``."""
        raise NotImplementedError

    def covariance(self, key: Key) -> Array:
        """Return the covariance of a pose."""
        raise NotImplementedError

    def all_chi2(self) -> dict[int, float]:
        """Return χ² of every factor, by id."""
        raise NotImplementedError

    @property
    def degrees_of_freedom(self) -> int:
        """Numbers that the factors measure, without rejected ones, less those that were found."""
        graph = self._result.graph
        return int(sum(graph.at(k).dim() for k in range(graph.size())) - self._result.values.dim())

    def covariances(self) -> Array:
        """Return the covariances of all poses ``(N, d, d)``, in the order of :attr:`keys`, as :meth:`covariance`."""
        return np.array([self.covariance(key) for key in self.keys])

    def trajectory(self, stamps_ns: ArrayLike | None = None, covariances: bool = False) -> Trajectory:
        """Return the poses as a trajectory.

        Args:
            stamps_ns: ``(N,)`` int64 in the order of :attr:`keys`; by default a second a pose.
            covariances: whether to compute those of all poses; a planar graph has none in space.

        Raises:
            DataError: times do not increase, or covariances of a planar graph are asked for.
        """
        if covariances and self._data.dimension == 2:
            raise DataError("trajectory: a planar graph has no covariances in space; leave them out")
        stamps = np.arange(len(self.keys)) * _NS_PER_S if stamps_ns is None else np.asarray(stamps_ns)
        return Trajectory(stamps.astype(np.int64), self.poses, self.covariances() if covariances else None)

    def to_tum(self, path: str | os.PathLike[str], stamps_ns: ArrayLike | None = None) -> None:
        """Write the poses in TUM's format, as :meth:`trajectory`."""
        write_tum(path, self.trajectory(stamps_ns))

    def to_dot(self) -> str:
        """Return the graph in Graphviz's language, with poses as nodes and factors of two poses as edges."""
        poses = [f'  {to_integer(key)} [label="{key}"];' for key in self.keys]
        edges = [
            f'  {to_integer(i)} -- {to_integer(j)} [label="{chi2:.2g}"{", style=dashed" if rejected else ""}];'
            for i, j, chi2, rejected in self._joints()
        ]
        return "\n".join(["graph {", *poses, *edges, "}"])

    def to_networkx(self) -> Any:
        """Return a ``networkx.MultiGraph``: nodes with ``pose``, edges by id with ``kind``, ``chi2``, ``rejected``.

        Raises:
            ConfigError: networkx is not installed.
        """
        try:
            import networkx
        except ImportError as error:
            raise ConfigError("to_networkx needs networkx; install it by pip install networkx") from error
        graph, chi2 = networkx.MultiGraph(), self.all_chi2()
        for key, pose in zip(self.keys, self.poses, strict=True):
            graph.add_node(key, pose=pose)
        for factor_id, factor in self._data.factors.items():
            for i, j in zip(factor.keys[:-1], factor.keys[1:], strict=True):
                rejected = factor_id in self.rejected
                graph.add_edge(i, j, factor_id, kind=factor.kind, chi2=chi2[factor_id], rejected=rejected)
        return graph

    def plot(self) -> Figure:
        """Return a picture from above, with factors of two poses coloured by χ² and rejected ones dashed."""
        from hybridlio.graph.views.picture import picture

        return picture(self.poses, self.keys, self._joints())

    def _joints(self) -> Sequence[tuple[Key, Key, float, bool]]:
        """Return both poses, χ² and whether it is rejected of each pair that a factor joins."""
        chi2 = self.all_chi2()
        return [
            (i, j, chi2[n], n in self.rejected)
            for n, factor in self._data.factors.items()
            for i, j in zip(factor.keys[:-1], factor.keys[1:], strict=True)
        ]
