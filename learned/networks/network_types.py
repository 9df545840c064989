"""Inputs and outputs of the networks, and what is computed once per scan."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hybridlio.learned.networks import torch_se3 as se3


@dataclass(frozen=True, eq=False)
class NetworkInput:
    """What the network sees of a batch of pairs.

    Attributes:
        last, current: vertex maps ``(B, 3, H, W)`` of scan k and k+1, each in its own frame.
        imu: ``(B, S, 6)`` rows of :func:`hybridlio.learned.data.imu_rows.imu_rows`; zeros where there are none.
        dt_s: ``(B,)`` time between the scans.
        velocity_m_s: ``(B, 3)`` at scan k, in its axes; zeros where not known.
        initial: ``(B, 4, 4)`` initial poses from elsewhere, for ``imu="given"``; else None or not looked at.
        shake: ``(B, 4, 4)`` by which initial poses are perturbed on the right before they are refined, or None.
    """

    last: Tensor
    current: Tensor
    imu: Tensor
    dt_s: Tensor
    velocity_m_s: Tensor
    initial: Tensor | None = None
    shake: Tensor | None = None


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """What the network says.

    Attributes:
        initial: ``T̂`` ``(B, 4, 4)``.
        poses: ``T = δT·T̂`` ``(B, 4, 4)`` after each step; the paper's network has one.
    """

    initial: Tensor
    poses: tuple[Tensor, ...]

    @property
    def pose(self) -> Tensor:
        """``T_k_k1`` ``(B, 4, 4)``, the last step's."""
        return self.poses[-1]

    @property
    def residual(self) -> Tensor:
        """``δT`` ``(B, 4, 4)``, of all steps together."""
        return self.pose @ se3.inverse(self.initial)


@dataclass(frozen=True, eq=False)
class ProjectiveScan:
    """A scan as the steps see it, whether it is the last one or the current one; computed once a scan.

    Attributes:
        points: ``(B, 3, N)`` the cells of its vertex map, row by row.
        seen: ``(B, 1, N)`` which cells hold a point.
        planes: ``(B, 4, N)`` the normal n of each cell and n·v, which is infinite where there is no normal.
        rough: ``(B, 1, N)`` of :func:`_roughness`; None without weights to be told of it.
        as_last, as_current: ``(B, n, C)`` what the n coarse cells contribute to the weights of points that fall into
            them, and of their own points; None without weights. Of a scan that is thinned ``as_current`` is each
            point's, ``(B, N, C)``.
        coarse: ``(N,)`` which coarse cell each point's own cell is a part of.
    """

    points: Tensor
    seen: Tensor
    planes: Tensor
    rough: Tensor | None = None
    as_last: Tensor | None = None
    as_current: Tensor | None = None
    coarse: Tensor | None = None


@dataclass(frozen=True, eq=False)
class ScanMaps:
    """What is computed of a scan alone.

    Attributes:
        vertices, normals: maps ``(B, 3, H, W)`` in its own frame.
        points: as the projective steps see it; None in a network without.
    """

    vertices: Tensor
    normals: Tensor
    points: ProjectiveScan | None
