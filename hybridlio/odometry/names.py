"""Names of the implementations of the three seams, which the configuration checks without loading the registry.

:mod:`hybridlio.odometry.registry` says what makes each; a test holds both equal.
"""

from __future__ import annotations

from hybridlio.core.errors import ConfigError

INITIAL_POSES = ("preintegration", "lstm", "kalman", "constant-velocity", "identity")
WITHOUT_IMU = ("constant-velocity", "identity")  # those of them that take no inertial data
RESIDUALS = ("scan-matching", "network", "network+scan-matching", "none")
BACKENDS = ("incremental", "fixed-lag", "none")


def check_name(seam: str, choice: object, known: tuple[str, ...]) -> None:
    """Check an implementation that is given by name; accept one that is given as an object.

    Raises:
        ConfigError: the name is unknown; the message lists the known ones.
    """
    if isinstance(choice, str) and choice not in known:
        raise ConfigError(f"unknown {seam} {choice!r}; choose one of {', '.join(known)}")
