"""Relative poses of a planar graph as arrays: residuals and Jacobians of all at once.

Arrays have the number of edges last, so that each operation passes over contiguous memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from hybridlio.core.arrays import Array, Index, Mask

_SMALL_ANGLE_RAD = 1e-4  # below it the next term of the series, θ³/360, is below double precision


class PlanarEdges(NamedTuple):
    """Relative poses in the plane.

    Attributes:
        i, j: indices ``(M,)`` of the poses.
        measured: ``(3, M)`` x y θ of pose j in the frame of pose i.
        information: ``(3, 3, M)`` in the order x y θ.
    """

    i: Index
    j: Index
    measured: Array
    information: Array

    def error(self, poses: Array) -> float:
        """Return half the sum of χ² at poses ``(3, N)``, as GTSAM does."""
        return float(self.chi2(poses).sum() / 2)

    def chi2(self, poses: Array) -> Array:
        """Return χ² ``(M,)`` at poses ``(3, N)``."""
        residual = self.residuals(poses)
        return np.asarray((residual * times(self.information, residual[:, None])[:, 0]).sum(axis=0))

    def residuals(self, poses: Array) -> Array:
        """Return the tangent vectors ``(3, M)`` of ``measured⁻¹ · T_i⁻¹ · T_j`` at poses ``(3, N)``."""
        error, angle = self._errors(poses)
        return np.concatenate([times(_inverse_left_jacobian(angle), error[:, None])[:, 0], angle[None]])

    def jacobians(self, poses: Array) -> tuple[Array, Array]:
        """Return the derivatives ``(3, 3, M)`` of the residuals by x y θ of both poses."""
        error, angle = self._errors(poses)
        a, b = poses[:, self.i], poses[:, self.j]
        inverse = _inverse_left_jacobian(angle)
        turned = a[2] + self.measured[2]
        c, s, (dx, dy) = np.cos(turned), np.sin(turned), b[:2] - a[:2]
        by_j, by_i = np.zeros((2, 3, 3, len(angle)))
        by_j[:2, :2] = times(inverse, np.array([[c, s], [-s, c]]))
        by_j[:2, 2] = times(_inverse_left_jacobian_slope(angle), error[:, None])[:, 0]
        by_j[2, 2] = 1.0
        by_i[:] = -by_j
        by_i[:2, 2] += times(inverse, np.array([[c * dy - s * dx], [-c * dx - s * dy]]))[:, 0]
        return by_i, by_j

    def whitened(self, poses: Array, held: Mask) -> tuple[csr_matrix, Array]:
        """Return the Jacobian ``(3 M, 3 K)`` of whitened residuals by the ``K`` poses that are not held, and these.

        Args:
            poses: ``(3, N)``.
            held: ``(N,)`` which poses do not move.
        """
        lower = np.linalg.cholesky(np.moveaxis(self.information, 2, 0))
        root = np.asarray(np.transpose(lower, (2, 1, 0)), dtype=np.float64)
        residual = times(root, self.residuals(poses)[:, None])[:, 0]
        blocks = np.concatenate([times(root, J) for J in self.jacobians(poses)], axis=2)
        edge, pose = np.tile(np.arange(len(self.i)), 2), np.concatenate([self.i, self.j])
        place = np.cumsum(~held) - 1
        free = ~held[pose]
        p, q = np.arange(3)[:, None, None], np.arange(3)[None, :, None]
        at = np.broadcast_arrays(3 * edge[free] + p, 3 * place[pose[free]] + q)
        shape = 3 * len(self.i), 3 * int(np.count_nonzero(~held))
        return csr_matrix((blocks[..., free].ravel(), (at[0].ravel(), at[1].ravel())), shape), residual.T.ravel()

    def _errors(self, poses: Array) -> tuple[Array, Array]:
        """Return the translation ``(2, M)`` and the angle ``(M,)`` of ``measured⁻¹ · T_i⁻¹ · T_j``."""
        a, b, z = poses[:, self.i], poses[:, self.j], self.measured
        angle = b[2] - a[2] - z[2]
        return _turned_back(_turned_back(b[:2] - a[:2], a[2]) - z[:2], z[2]), wrapped(angle)


def wrapped(angle: Array) -> Array:
    """Return angles within ±π."""
    return np.asarray(angle - 2 * np.pi * np.round(angle / (2 * np.pi)))


def times(A: Array, B: Array) -> Array:
    """Return the products ``(p, q, M)`` of matrices ``(p, k, M)`` and ``(k, q, M)``."""
    return np.asarray(sum(A[:, k, None] * B[None, k] for k in range(A.shape[1])))


def _turned_back(vectors: Array, angle: Array) -> Array:
    """Return vectors ``(2, M)`` in frames turned by angles ``(M,)``."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vectors[0] + s * vectors[1], c * vectors[1] - s * vectors[0]])


def _inverse_left_jacobian(angle: Array) -> Array:
    """Return the matrices ``(2, 2, M)`` that turn translations into those of tangent vectors (Solà et al., eq. 159)."""
    half = angle / 2
    small = np.abs(half) < _SMALL_ANGLE_RAD
    c = np.where(small, 1 - half**2 / 3, half / np.tan(np.where(small, 1.0, half)))
    return np.array([[c, half], [-half, c]])


def _inverse_left_jacobian_slope(angle: Array) -> Array:
    """Return the derivatives ``(2, 2, M)`` of :func:`_inverse_left_jacobian` by the angle."""
    half = angle / 2
    small = np.abs(half) < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, half)
    slope = np.where(small, -half / 3, 0.5 / np.tan(safe) - 0.5 * safe / np.sin(safe) ** 2)
    halves = np.full_like(angle, 0.5)
    return np.array([[slope, halves], [-halves, slope]])
