"""What a pose graph holds: factors as plain values, checked where they enter, before any solver sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.covariance import check_covariance
from hybridlio.core.errors import ConfigError, DataError, GraphError
from hybridlio.core.sensors import ImuSamples
from hybridlio.graph.model.keys import Key

Kind: TypeAlias = Literal["between", "prior", "gps", "attitude", "velocity", "bias", "imu"]
Form: TypeAlias = Literal["covariance", "information", "sigmas"]

KERNELS = ("huber", "cauchy", "geman-mcclure", "dcs")
_INLIER_SHARE = 0.95


@dataclass(frozen=True, eq=False)
class Noise:
    """Gaussian noise of a measurement in the form it was given, so that nothing is lost on the way to a file.

    Attributes:
        form: ``covariance``, ``information`` (its inverse) or ``sigmas`` (standard deviations).
        values: ``(d, d)``, or ``(d,)`` for sigmas; rotation first.
    """

    form: Form
    values: Array

    @cached_property
    def information(self) -> Array:
        """``(d, d)``."""
        if self.form == "sigmas":
            return np.diag(self.values**-2.0)
        return self.values if self.form == "information" else _inverse(self.values)

    @cached_property
    def covariance(self) -> Array:
        """``(d, d)``."""
        if self.form == "sigmas":
            return np.diag(self.values**2)
        return self.values if self.form == "covariance" else _inverse(self.values)


def _inverse(matrix: Array) -> Array:
    inverse = np.linalg.inv(matrix)
    return np.asarray((inverse + inverse.T) / 2, dtype=np.float64)


def make_noise(
    name: str, size: int, covariance: ArrayLike | None, information: ArrayLike | None, sigmas: ArrayLike | None
) -> Noise:
    """The one of the three that is given.

    Raises:
        GraphError: none or more than one is given.
        DataError: wrong shape, not finite, not symmetric positive definite; the message carries ``name``.
    """
    given: list[tuple[Form, ArrayLike]] = []
    given += [("covariance", covariance)] if covariance is not None else []
    given += [("information", information)] if information is not None else []
    given += [("sigmas", sigmas)] if sigmas is not None else []
    if len(given) != 1:
        raise GraphError(f"{name}: give one of covariance, information and sigmas, not {len(given)}")
    form, values = given[0]
    array = np.asarray(values, dtype=np.float64)
    if form == "sigmas":
        return Noise(form, check_sigmas(array, size, name))
    return Noise(form, check_covariance(array, name if form == "covariance" else f"{name}: information", size))


def check_sigmas(values: Array, size: int, name: str) -> Array:
    """Standard deviations as ``(size,)``; a single number stands for all.

    Raises:
        DataError: wrong shape, not finite or not positive.
    """
    values = np.full(size, values) if values.ndim == 0 else values
    if values.shape != (size,) or not np.isfinite(values).all() or values.min() <= 0:
        raise DataError(f"{name}: expected {size} finite, positive standard deviations, got {values.tolist()}")
    return values.copy()


def check_vector(values: ArrayLike, size: int, name: str) -> Array:
    """The values as float64 ``(size,)``.

    Raises:
        DataError: wrong shape or not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise DataError(f"{name}: expected {size} finite numbers, got {array.tolist()}")
    return array


@dataclass(frozen=True)
class Robust:
    """A robust kernel by name, and the size of residual up to which a measurement counts in full.

    ``width`` is in standard deviations (the whitened residual's norm); dynamic covariance scaling takes its square.
    """

    kernel: str
    width: float

    def loss(self, squared: float) -> float:
        """Twice what a whitened residual of this squared norm adds to the error."""
        c = self.width**2
        if self.kernel == "huber":
            return squared if squared <= c else 2 * self.width * float(np.sqrt(squared)) - c
        if self.kernel == "cauchy":
            return c * float(np.log1p(squared / c))
        if self.kernel == "geman-mcclure":
            return c * squared / (c + squared)
        return squared if squared <= c else 4 * c * squared / (c + squared) - c

    def weight(self, norm: float) -> float:
        """What is left of a measurement's weight when its whitened residual has this norm."""
        share = (norm / self.width) ** 2
        if self.kernel == "huber":
            return min(1.0, self.width / norm) if norm > 0 else 1.0
        if self.kernel == "cauchy":
            return 1 / (1 + share)
        if self.kernel == "geman-mcclure":
            return 1 / (1 + share) ** 2
        return 1.0 if share <= 1 else (2 / (1 + share)) ** 2


RobustLike: TypeAlias = "str | tuple[str, float] | Robust | None"


def make_robust(robust: RobustLike, size: int, name: str) -> Robust | None:
    """A kernel from its name, or from name and width; by default 95 % of good measurements count in full.

    Raises:
        ConfigError: no kernel has this name, or the width is not positive.
    """
    if robust is None or isinstance(robust, Robust):
        return robust
    kernel, width = (robust, default_width(size)) if isinstance(robust, str) else robust
    if kernel not in KERNELS:
        raise ConfigError(f"{name}: no robust kernel is called {kernel!r}; there are {', '.join(KERNELS)}")
    if not (np.isfinite(width) and width > 0):
        raise ConfigError(f"{name}: a robust kernel's width is positive, got {width}")
    return Robust(kernel, float(width))


def default_width(size: int) -> float:
    """The norm that 95 % of ``size`` standard normal numbers stay below."""
    return float(np.sqrt(chi_square_quantile(_INLIER_SHARE, size)))


@dataclass(frozen=True, eq=False)
class Factor:
    """One measurement.

    Attributes:
        kind: what is measured.
        keys: of the poses concerned.
        measured: ``between`` and ``prior``: pose coordinates; ``gps``: position and lever arm (6); ``attitude``:
            direction in world and in body (6); ``velocity``: m/s (3); ``bias``: accelerometer, gyroscope (6);
            ``imu``: the densities of :class:`hybridlio.core.sensors.ImuNoise` in its order (6).
        noise: of the measurement; None for ``imu``, whose noise follows from the samples.
        robust: kernel, or None.
        samples: for ``imu``.
    """

    kind: Kind
    keys: tuple[Key, ...]
    measured: Array
    noise: Noise | None = None
    robust: Robust | None = None
    samples: ImuSamples | None = None

    @property
    def label(self) -> str:
        """For messages, such as ``between 3-4``."""
        return label(self.kind, self.keys)


def label(kind: str, keys: Sequence[object]) -> str:
    """Name of a factor for messages, such as ``between 3-4``."""
    return f"{kind} {'-'.join(str(key) for key in keys)}"
