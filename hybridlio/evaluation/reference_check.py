"""Whether a reference can be believed: against the vehicle's own forward speed, and against what any vehicle can do."""

from __future__ import annotations

import numpy as np

from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory

# Lengths of one path by positions and by forward speed agree within 0.1 % where both are good (simulated drives; KITTI
# 0048: 0.3 %). KITTI 0005, whose GPS is poor, differs by 2.7 %.
MAX_LENGTH_DIFFERENCE = 0.01
_MIN_LENGTH_M = 10.0  # a shorter path is as long as the noise of its positions
# m/s²; ten times gravity is beyond any vehicle or person, so a second difference of positions above it is a jump
_MAX_ACCELERATION_M_S2 = 100.0


def reference_doubts(
    reference: Trajectory, length_m: float | None = None, forward_speed_length_m: float | None = None
) -> list[str]:
    """Return reasons not to believe a reference, as sentences; empty if none is found.

    Args:
        reference: the ground truth.
        length_m: path length of its vehicle (of the IMU, which the forward speed is of).
        forward_speed_length_m: the same by integrated forward speed.
    """
    out = []
    if length_m is not None and forward_speed_length_m is not None and forward_speed_length_m >= _MIN_LENGTH_M:
        difference = length_m / forward_speed_length_m - 1
        if abs(difference) > MAX_LENGTH_DIFFERENCE:
            out.append(
                f"The reference contradicts the vehicle's own forward speed: {length_m:.1f} m against "
                f"{forward_speed_length_m:.1f} m, {100 * difference:+.1f} %. Figures that compare with it are in doubt."
            )
    jumps = _jumps(reference)
    if jumps:
        more = f" and {len(jumps) - 1} times more" if jumps[1:] else ""
        out.append(f"The reference jumps at {jumps[0]:.1f} s{more}: positions change faster than anything accelerates.")
    return out


def _jumps(reference: Trajectory) -> list[float]:
    """Return the times at which positions change faster than anything can accelerate."""
    if len(reference) < 3:
        return []
    steps_s = np.diff(reference.stamps_ns) / NS_PER_S
    velocities = np.diff(reference.poses[:, :3, 3], axis=0) / steps_s[:, None]
    between_s = (steps_s[1:] + steps_s[:-1]) / 2
    accelerations = np.linalg.norm(np.diff(velocities, axis=0), axis=1) / between_s
    return [float(t) for t in reference.times_s[1:-1][accelerations > _MAX_ACCELERATION_M_S2]]
