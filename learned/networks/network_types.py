"""Inputs and outputs of the networks, and everything that is computed once per scan."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hybridlio.learned.networks import torch_se3 as se3


@dataclass(frozen=True, eq=False)
class NetworkInput:
    """The network's inputs of a batch of pairs.

    Attributes:
        last, current: vertex maps ``(B, 3, H, W)`` of scan k and k+1, each in its own frame.
        imu: ``(B, S, 6)`` rows of :func:`hybridlio.learned.data.imu_rows.imu_rows`; zeros without an IMU.
        dt_s: ``(B,)`` time between the scans.
        velocity_m_s: ``(B, 3)`` at scan k, in its axes; zeros where it is not known.
        initial: ``(B, 4, 4)`` given initial poses, for ``imu="given"``; ignored otherwise.
        perturbation: ``(B, 4, 4)`` right perturbations of the initial poses before they are refined, or None.
    """

    last: Tensor
    current: Tensor
    imu: Tensor
    dt_s: Tensor
    velocity_m_s: Tensor
    initial: Tensor | None = None
    perturbation: Tensor | None = None


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """The network's estimate.

    Attributes:
        initial: ``T̂`` ``(B, 4, 4)``.
        poses: ``T = δT·T̂`` ``(B, 4, 4)`` after each step; the paper's network has one.
    """

    initial: Tensor
    poses: tuple[Tensor, ...]

    @property
    def pose(self) -> Tensor:
        """``T_k_k1`` ``(B, 4, 4)`` after the last step."""
        return self.poses[-1]

    @property
    def residual(self) -> Tensor:
        """``δT`` ``(B, 4, 4)`` of all steps together."""
        return self.pose @ se3.inverse(self.initial)


@dataclass(frozen=True, eq=False)
class ProjectiveScan:
    """Inputs of the projective steps from one scan, for its use as the last scan and as the current one.

    Attributes:
        points: ``(B, 3, N)`` the cells of its vertex map, row by row.
        seen: ``(B, 1, N)`` true where a cell holds a point.
        planes: ``(B, 4, N)`` the normal n of each cell and n·v, which is infinite without a normal.
        rough: ``(B, 1, N)`` of :func:`hybridlio.learned.networks.projective_steps._roughness`; None without weights.
        as_last, as_current: ``(B, n, C)`` contribution of the n coarse cells to the weights of points that fall into
            them, and of their own points; None without weights. In a thinned scan ``as_current`` is that of each point,
            ``(B, N, C)``.
        coarse: ``(N,)`` index of the coarse cell that contains each cell.
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
    """Everything that depends on one scan only, computed once for the two pairs that contain it.

    Attributes:
        vertices, normals: maps ``(B, 3, H, W)`` in its own frame.
        points: inputs of the projective steps; None in a network without them.
    """

    vertices: Tensor
    normals: Tensor
    points: ProjectiveScan | None
