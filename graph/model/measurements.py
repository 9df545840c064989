"""Factors as plain values, before any solver sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from hybridlio.core.arrays import Array
from hybridlio.core.errors import shown
from hybridlio.core.sensors import ImuSamples
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.noise import Noise, Robust

Kind: TypeAlias = Literal[
    "between", "prior", "gps", "attitude", "velocity", "bias", "imu", "point", "bearing-range", "range", "bearing",
    "altitude", "heading",
    "body-velocity", "sensor-step", "marginal", "custom", "gtsam",
]  # fmt: skip
CODE = ("custom", "gtsam")  # of users, which no file holds
OBSERVATIONS = ("point", "bearing-range")  # of landmarks, which they place
PARTIAL_OBSERVATIONS = ("range", "bearing")  # several of which place a landmark
OF_LANDMARKS = (*OBSERVATIONS, *PARTIAL_OBSERVATIONS)
# a direction has two degrees of freedom
VECTOR_NOISE_SIZE = {
    "gps": 3, "attitude": 2, "velocity": 3, "bias": 6, "altitude": 1, "heading": 1, "body-velocity": 3,
}  # fmt: skip
VELOCITIES = ("velocity", "body-velocity")
STEPS = ("between", "sensor-step")  # a pose in the frame of another
JOINING = (*STEPS, "imu", "marginal", *CODE)  # concern several poses
IN_OWN_ORDER = ("custom", "heading", "gps")  # residuals that are no tangent vectors, which GTSAM orders in its own way
SCALARS = ("altitude", "heading")


@dataclass(frozen=True, eq=False)
class Factor:
    """One measurement.

    Attributes:
        kind: what is measured.
        keys: of the poses that it concerns.
        measured: ``between``, ``sensor-step`` and ``prior``: coordinates of a pose
            (:mod:`hybridlio.graph.model.coordinates`); ``gps``: position, lever arm (6; in the plane z is 0);
            ``attitude``: direction in world, in body (6); ``velocity``: m/s (3); ``bias``: accelerometer, gyroscope
            (6); ``imu``: the fields of :class:`hybridlio.core.sensors.ImuNoise` in their order (7); ``point``: a
            landmark in the frame of the pose (d); ``bearing-range``: angle or unit direction, and range (2, in space
            4); ``range`` (1) and ``bearing`` (1, in space 3) as there; ``altitude``: m (1); ``heading``: rad (1);
            ``body-velocity``: m/s (3); ``marginal``: see
            :class:`hybridlio.graph.model.marginals.Marginal`; empty for ``custom`` and ``gtsam``.
        noise: of the measurement; None for ``imu``, whose noise follows from the samples, and for ``marginal``.
        robust: kernel, or None.
        samples: of an ``imu`` factor.
        landmark: key of the observed landmark, of ``point`` and ``bearing-range``.
        calibration: names of the calibration variables that the measurement depends on.
        code: of ``custom`` a :class:`hybridlio.graph.model.user_residual.UserResidual`, of ``gtsam`` GTSAM's factor.
    """

    kind: Kind
    keys: tuple[Key, ...]
    measured: Array
    noise: Noise | None = None
    robust: Robust | None = None
    samples: ImuSamples | None = None
    landmark: Key | None = None
    code: Any = None
    calibration: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Kind and keys for messages, such as ``between 3-4``."""
        return factor_label(self.kind, self.keys if self.landmark is None else (*self.keys, self.landmark))


def factor_label(kind: str, keys: Sequence[object]) -> str:
    """Return a factor's kind and keys for messages, such as ``between 3-4``."""
    return f"{kind} {'-'.join(str(key) if isinstance(key, int | tuple) else shown(key) for key in keys)}"
