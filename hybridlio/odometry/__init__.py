"""One odometry step: configuration, registry of implementations, start-up, motion compensation."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlio.odometry.odometry import Estimate as Estimate
    from hybridlio.odometry.odometry import Odometry as Odometry

__all__ = ["Estimate", "Odometry"]


def __getattr__(name: str) -> object:
    """Load ``Odometry`` and ``Estimate`` when first used (PEP 562); the configuration is then quick to import."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from hybridlio.odometry import odometry

    return getattr(odometry, name)
