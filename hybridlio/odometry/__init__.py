"""Odometry: the estimator, its stages and start-up, the configuration, and the registry of implementations."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlio.odometry.estimate import Estimate as Estimate
    from hybridlio.odometry.odometry import Odometry as Odometry

__all__ = ["Estimate", "Odometry"]


def __getattr__(name: str) -> object:
    """Load ``Odometry`` and ``Estimate`` when first used (PEP 562); the configuration is then quick to import."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from hybridlio.odometry import odometry

    return getattr(odometry, name)
