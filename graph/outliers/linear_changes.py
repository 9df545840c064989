"""By how much the total χ² of a solved graph changes where loops are left out or taken in, to first order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from hybridlio.core.arrays import Array, Index, Mask

# Entries of the factorisation that all solutions may pass over: a few seconds. In the largest graphs the loops whose
# residuals are nearest to the bound are tested alone.
_WORK = 5_000_000_000
_WORK_FOR_CHOSEN = 20 * _WORK  # where they decide alone on a result whose alternatives take ten times as long
_COLUMNS = 240  # of one solution: 30 MB for 15,000 unknowns
_LEAST = 1e-12  # χ², whose logarithm is finite
_REGULAR = 1e-9  # of the unit matrix: loops that alone determine a pose leave it undetermined


class Linear(NamedTuple):
    """All factors at a state, linear in small changes of its variables.

    Attributes:
        jacobian: ``(R, D)`` of whitened residuals, those of the ``M`` loops last, in their order.
        residual: ``(R,)``.
        trusted: number of rows before those of the loops.
    """

    jacobian: csr_matrix
    residual: Array
    trusted: int


class LinearChanges:
    """What exchanges of loops change at a result.

    Args:
        linear: all factors around the result.
        correct: ``(M,)`` the accepted loops.
        price: cost of rejecting a loop.
        chosen: ``(M,)`` loops for which changes are found, or None: all.

    Attributes:
        single: ``(M,)`` by how much χ² falls without an accepted loop, or rises with a rejected one; NaN where the
            work does not suffice.

    Raises:
        RuntimeError: the accepted loops and the trusted factors do not determine every variable.
    """

    def __init__(self, linear: Linear, correct: Mask, price: float, chosen: Mask | None = None) -> None:
        count, total = len(correct), linear.jacobian.shape[0]
        self._size = (total - linear.trusted) // count
        used = np.concatenate([np.ones(linear.trusted, dtype=bool), np.repeat(correct, self._size)])
        kept = linear.jacobian[used]
        self._jacobian = linear.jacobian[linear.trusted :]
        self._residuals = linear.residual[linear.trusted :].reshape(count, self._size)
        self._price = price
        self._sign = np.where(correct, -1.0, 1.0)  # of an information matrix that an exchange adds
        self._solver = splu(
            (kept.T @ kept).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        work = _WORK if chosen is None else _WORK_FOR_CHOSEN
        self._left = work // (self._solver.nnz * self._size)  # loops that can still be solved for
        self._spreads = np.full((count, self._size, self._size), np.nan)
        self._find_spreads(np.ones(count, dtype=bool) if chosen is None else chosen)
        self.single = self._chi2(self._residuals, self._spreads)

    def exchange(self, some: Mask) -> tuple[float, Array]:
        """Return the change of χ² where some loops change sides, and :attr:`single` of the others after that.

        The change is infinite where the work does not suffice, and nothing is known after it.
        """
        rows = np.flatnonzero(some)
        if len(rows) > self._left or not np.isfinite(self._spreads[rows]).all():
            return np.inf, np.full(len(some), np.nan)
        self._left -= len(rows)
        r = self._residuals[rows].ravel()
        cross = self._predicted(rows)  # of all loops
        joint = cross.reshape(len(some), self._size, -1)[rows].reshape(len(r), len(r))
        signs = np.repeat(self._sign[rows], self._size)
        pulled = np.linalg.solve(np.diag(signs) + joint, np.column_stack([r, cross.T]))
        change = float(r @ pulled[:, 0])
        residuals = self._residuals - (cross @ pulled[:, 0]).reshape(self._residuals.shape)
        blocks = cross.reshape(len(some), self._size, -1), pulled[:, 1:].reshape(len(r), len(some), self._size)
        spreads = self._spreads - np.einsum("mik,kmj->mij", *blocks)
        return change, np.where(some, np.nan, self._chi2(residuals, spreads))

    def _chi2(self, residuals: Array, spreads: Array) -> Array:
        """Return the change of χ² for each loop, with its residual and the covariance of its prediction."""
        innovations = np.eye(self._size) + self._sign[:, None, None] * spreads + _REGULAR * np.eye(self._size)
        known = np.isfinite(spreads).all(axis=(1, 2))
        innovations[~known] = np.eye(self._size)
        chi2 = (residuals * np.linalg.solve(innovations, residuals[..., None])[..., 0]).sum(axis=1)
        return np.where(known, chi2, np.nan)

    def _find_spreads(self, chosen: Mask) -> None:
        chi2 = (self._residuals**2).sum(axis=1)
        from_price = np.abs(np.log(np.maximum(chi2, _LEAST)) - np.log(max(self._price, _LEAST)))
        first = np.argsort(np.where(chosen, from_price, np.inf), kind="stable")
        first = first[: min(np.count_nonzero(chosen), self._left)]
        self._left -= len(first)
        at_once = _COLUMNS // self._size
        for begin in range(0, len(first), at_once):
            some = first[begin : begin + at_once]
            cross = self._predicted(some).reshape(-1, self._size, len(some), self._size)
            self._spreads[some] = cross[some, :, np.arange(len(some))]

    def _predicted(self, some: Index) -> Array:
        """Return the covariances ``J P Jᵀ`` of the predictions of all loops with those of some."""
        rows = (self._size * some[:, None] + np.arange(self._size)).ravel()
        return np.asarray(self._jacobian @ self._solver.solve(self._jacobian[rows].T.toarray()))
