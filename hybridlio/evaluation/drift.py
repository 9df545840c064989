"""KITTI's odometry drift: the error at the end of segments of fixed length, relative to their length.

Definition: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?" (CVPR 2012), §3.2, and the evaluation program
of the odometry benchmark.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)  # of segments, as in KITTI's program
KITTI_STEP = 10  # frames between the starts of segments, as in KITTI's program
_SPEED_BIN_M_S = 2.0  # as in KITTI's program


@dataclass(frozen=True)
class DriftAverage:
    """The average drift of the segments of one length, or around one speed.

    Attributes:
        at: the length in metres, or the speed in metres per second.
        count: number of segments.
        t_rel_percent, r_rel_deg_per_100m: translational and rotational drift.
    """

    at: float
    count: int
    t_rel_percent: float
    r_rel_deg_per_100m: float


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift of every segment, one row each, ordered as KITTI's program does: by first frame, then by length.

    Attributes:
        lengths_m: the requested lengths.
        first_frame, last_frame: ``(S,)``; a segment ends at the first frame more than its length away along the path.
        r_err_rad_per_m, t_err: ``(S,)`` rotational and translational error at the end, divided by the length.
        length_m, speed_m_s: ``(S,)`` the segment's length and mean speed.
    """

    lengths_m: tuple[float, ...]
    first_frame: NDArray[np.int64]
    last_frame: NDArray[np.int64]
    r_err_rad_per_m: Array
    t_err: Array
    length_m: Array
    speed_m_s: Array

    def __len__(self) -> int:
        return len(self.t_err)

    @property
    def t_rel_percent(self) -> float | None:
        """Translational drift averaged over all segments in percent; None if no segment fits the path."""
        return float(self.t_err.mean() * 100) if len(self) else None

    @property
    def r_rel_deg_per_100m(self) -> float | None:
        """Rotational drift averaged over all segments in degrees per 100 m; None if no segment fits the path."""
        return float(np.degrees(self.r_err_rad_per_m.mean()) * 100) if len(self) else None

    def by_length(self) -> list[DriftAverage]:
        """Return the averages over the segments of each length that has any."""
        return self._averages((length, self.length_m == length) for length in self.lengths_m)

    def by_speed(self) -> list[DriftAverage]:
        """Return the averages over segments within 2 m/s of 2, 4, 6 … m/s; as in KITTI's program, the bins overlap."""
        fastest = float(self.speed_m_s.max(initial=0.0))
        speeds = np.arange(_SPEED_BIN_M_S, fastest + _SPEED_BIN_M_S, _SPEED_BIN_M_S)
        return self._averages((float(s), np.abs(self.speed_m_s - s) < _SPEED_BIN_M_S) for s in speeds)

    def rows(self) -> Array:
        """Return ``(S, 5)`` rows as in KITTI's error files: first frame, rad/m, translational error, length, speed."""
        return np.column_stack([self.first_frame, self.r_err_rad_per_m, self.t_err, self.length_m, self.speed_m_s])

    def _averages(self, groups: Iterable[tuple[float, NDArray[np.bool_]]]) -> list[DriftAverage]:
        return [
            DriftAverage(
                at,
                int(mask.sum()),
                float(self.t_err[mask].mean() * 100),
                float(np.degrees(self.r_err_rad_per_m[mask].mean()) * 100),
            )
            for at, mask in groups
            if mask.any()
        ]


def kitti_drift(
    estimate: Trajectory,
    reference: Trajectory,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    step: int = KITTI_STEP,
) -> Drift:
    """Return the drift of an estimate over segments that start at every ``step``-th pose.

    Args:
        estimate, reference: ``N`` poses each, at the same times (see :func:`hybridlio.evaluation.ate_rpe.associate`).
        lengths_m: the segments' lengths along the reference.
        step: number of poses from the start of one segment to that of the next.

    Raises:
        DataError: the trajectories have different numbers of poses, or a length is not positive.
    """
    if len(reference) != len(estimate):
        raise DataError(
            f"drift: {len(reference)} reference poses but {len(estimate)} estimated ones; associate them by time first"
        )
    if not all(math.isfinite(length) and length > 0 for length in lengths_m):
        raise DataError(f"drift: segment lengths must be positive, got {list(lengths_m)} m")
    first, last, length = _segments(reference, lengths_m, step)
    true, estimated = (se3.between(t.poses[first], t.poses[last]) for t in (reference, estimate))
    error = se3.between(estimated, true)
    # KITTI's program divides by 0.1 s per frame of the segment, counting both ends; here a frame takes the mean period
    seconds = (reference.stamps_ns[last] - reference.stamps_ns[first]) / NS_PER_S
    frames = last - first + 1
    return Drift(
        lengths_m=tuple(float(length) for length in lengths_m),
        first_frame=first,
        last_frame=last,
        r_err_rad_per_m=np.linalg.norm(se3.so3_log(error[:, :3, :3]), axis=1) / length,
        t_err=np.linalg.norm(error[:, :3, 3], axis=1) / length,
        length_m=length,
        speed_m_s=length / (seconds / (frames - 1) * frames),
    )


def lengths_for(path_length_m: float) -> tuple[float, ...]:
    """Return eight segment lengths for a path: KITTI's from 100 m on, else multiples of 0.1, 0.2, 0.5, 1 … 10 m.

    A path under 0.8 m, such as that of a vehicle at rest, has none.
    """
    if path_length_m > KITTI_LENGTHS_M[0]:
        return KITTI_LENGTHS_M
    steps = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
    fitting = [s for s in steps if s * 8 < path_length_m]
    return tuple(round(k * fitting[-1], 1) for k in range(1, 9)) if fitting else ()


def _segments(
    reference: Trajectory, lengths_m: Sequence[float], step: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return first frames, last frames and lengths of the segments that fit the path."""
    travelled = _travelled_m(reference)
    first = np.repeat(np.arange(0, len(reference), step), len(lengths_m))
    length = np.tile(np.asarray(lengths_m, np.float32), len(first) // max(len(lengths_m), 1))
    last = np.searchsorted(travelled, travelled[first] + length, side="right")
    fits = last < len(reference)
    return first[fits], last[fits], length[fits].astype(np.float64).round(6)


def _travelled_m(reference: Trajectory) -> NDArray[np.float32]:
    # summed in single precision, like KITTI's program: in double, one segment in a thousand ends at another frame
    steps = np.diff(reference.poses[:, :3, 3], axis=0).astype(np.float32)
    metres = np.linalg.norm(steps.astype(np.float64), axis=1)
    return np.array(
        list(itertools.accumulate(metres, lambda a, b: np.float32(a + b), initial=np.float32(0))), np.float32
    )
