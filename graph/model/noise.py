"""Noise of a measurement: a Gaussian in the form it was given, and a robust kernel; checked where they enter."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.covariance import check_covariance
from hybridlio.core.errors import ConfigError, DataError, GraphError, shown
from hybridlio.core.se3 import as_floats
from hybridlio.graph.base.kernels import KERNELS, estimator

Form: TypeAlias = Literal["covariance", "information", "sigmas"]

_LARGEST = sys.float_info.max  # a larger integer is no float
_INLIER_SHARE = 0.95  # of good measurements that stay within a kernel's width; the usual 5 % significance level


@dataclass(frozen=True, eq=False)
class Noise:
    """Gaussian noise of a measurement in the form it was given, so that a file holds exactly what the user gave.

    Attributes:
        form: ``covariance``, ``information`` (its inverse) or ``sigmas`` (standard deviations).
        values: ``(d, d)``, or ``(d,)`` for sigmas; rotation first.
    """

    form: Form
    values: Array

    @cached_property
    def information(self) -> Array:
        """Information matrix ``(d, d)``."""
        if self.form == "sigmas":
            return np.diag(self.values**-2.0)
        return self.values if self.form == "information" else _inverse(self.values)

    @cached_property
    def covariance(self) -> Array:
        """Covariance matrix ``(d, d)``."""
        if self.form == "sigmas":
            return np.diag(self.values**2)
        return self.values if self.form == "covariance" else _inverse(self.values)


def _inverse(matrix: Array) -> Array:
    inverse = np.linalg.inv(matrix)
    return np.asarray((inverse + inverse.T) / 2, dtype=np.float64)


class NoiseInput(NamedTuple):
    """Noise as a user gives it: exactly one of the three must be given."""

    covariance: ArrayLike | None = None
    information: ArrayLike | None = None
    sigmas: ArrayLike | None = None


def make_noise(name: str, size: int, given: NoiseInput) -> Noise:
    """Return the noise in the one form that is given.

    Raises:
        GraphError: none or several of covariance, information and sigmas.
        DataError: wrong shape, not finite, not symmetric positive definite; the message starts with ``name``.
    """
    forms: tuple[Form, ...] = ("covariance", "information", "sigmas")
    present = [(form, values) for form, values in zip(forms, given, strict=True) if values is not None]
    if len(present) != 1:
        raise GraphError(f"{name}: give exactly one of covariance, information and sigmas; got {len(present)} of them")
    form, values = present[0]
    array = as_floats(values, name)
    if form == "sigmas":
        return Noise(form, check_sigmas(array, size, name))
    return Noise(form, check_covariance(array, name if form == "covariance" else f"{name}: information", size))


def check_sigmas(values: Array, size: int, name: str) -> Array:
    """Return standard deviations ``(size,)``; a single number applies to all components.

    Raises:
        DataError: wrong shape, not finite or not positive.
    """
    values = np.full(size, values) if values.ndim == 0 else values
    if values.shape != (size,) or not size or not (np.isfinite(values) & (values > 0)).all():
        raise DataError(f"{name}: sigmas must be {size} finite, positive standard deviations, got {values.tolist()}")
    return values.copy()


@dataclass(frozen=True)
class Robust:
    """A robust kernel (M-estimator).

    Attributes:
        kernel: one of :data:`KERNELS`.
        width: norm of the whitened residual, in standard deviations, above which the kernel lowers the weight
            noticeably (Huber, DCS: at all). Dynamic covariance scaling uses its square.
    """

    kernel: str
    width: float

    def loss(self, squared: float) -> float:
        """Return the kernel's replacement for χ², that is twice its share of the error, at a squared residual norm."""
        return 2 * float(estimator(self.kernel, self.width).loss(np.sqrt(squared)))

    def weight(self, norm: float) -> float:
        """Return the factor, 0 to 1, by which the kernel scales the information at a whitened residual norm."""
        return float(estimator(self.kernel, self.width).weight(norm))


def is_positive(value: object) -> bool:
    """Return whether a value is a finite real number above zero."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return is_number and bool(0 < value <= _LARGEST)  # type: ignore[operator]


RobustLike: TypeAlias = "str | tuple[str, float] | Robust | None"


def make_robust(robust: RobustLike, size: int, name: str) -> Robust | None:
    """Return a kernel from its name, or from name and width.

    Args:
        robust: name, ``(name, width)``, a kernel or None.
        size: dimension of the residual, for the default width (:func:`default_width`).
        name: start of the error message.

    Raises:
        ConfigError: unknown kernel, or a width that is not positive.
    """
    if robust is None or isinstance(robust, Robust):
        return robust
    pair = (robust, default_width(size)) if isinstance(robust, str) else robust
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ConfigError(f"{name}: a robust kernel is a name, or a name and a width, got {shown(robust)}")
    kernel, width = pair
    if not isinstance(kernel, str) or kernel not in KERNELS:
        raise ConfigError(f"{name}: unknown robust kernel {shown(kernel)}; choose one of {', '.join(KERNELS)}")
    if not is_positive(width):
        raise ConfigError(f"{name}: the width of a robust kernel must be positive, got {shown(width)}")
    return Robust(kernel, float(width))


def default_width(size: int) -> float:
    """Return the norm that a standard normal vector of ``size`` components stays below with 95 % probability."""
    return float(np.sqrt(chi_square_quantile(_INLIER_SHARE, size)))
