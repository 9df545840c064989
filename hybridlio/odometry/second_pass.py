"""A second registration of a scan whose sweep is compensated otherwise by its own motion than by the predicted one.

A sweep that is compensated with a speed that is wrong by ``δ`` displaces the points on average by ``δ·τ``, where ``τ``
is their mean time after the scan's stamp, and registration moves the scan by as much the other way. While the run
knows its speed by few steps alone, this error of a step goes into the next speed with the opposite sign: positions
swing by centimetres around the path from scan to scan.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import NS_PER_S, Frame

_LEVER_M = 10.0  # half of a scan's points are nearer; turns a rotation into a displacement
# Displacement of the sweep's last points, over the spread of the residuals, from which a scan is registered again. The
# mean displacement, which moves the scan, is half of it.
_LEAST_RATIO = 1.0


def motion_for_second_pass(
    frame: Frame, initial: RelativePose, found: RelativePose, before_ns: int
) -> RelativePose | None:
    """Return the step by which to compensate a scan once more; None if its points would move by less than their noise.

    Registration found the step ``f`` with points compensated for the step ``p``. The error of ``p`` is ``(p − f)·T /
    (T + τ)`` with the step's duration ``T``, since ``f`` errs by ``−τ/T`` of it.

    Args:
        frame: as recorded.
        initial: initial relative pose of the step, by which the scan was compensated.
        found: the step of the first pass, with the spread of its residuals in ``details``.
        before_ns: stamp of the scan before.
    """
    offsets_ns, noise_m = frame.scan.time_offsets_ns, found.details.get("sigma_m", np.inf)
    if not found.ok or offsets_ns is None or not len(offsets_ns):
        return None
    step_s = (frame.scan.stamp_ns - before_ns) / NS_PER_S
    mean_s, sweep_s = offsets_ns.mean() / NS_PER_S, np.abs(offsets_ns).max() / NS_PER_S
    error = se3.log(se3.between(initial.pose, found.pose)) * step_s / (step_s + mean_s)
    turned_m = 0.0 if len(frame.imu) else _LEVER_M * float(np.linalg.norm(error[:3]))  # else by the gyroscope
    moved_m = (float(np.linalg.norm(error[3:])) + turned_m) * sweep_s / step_s
    return replace(initial, pose=initial.pose @ se3.exp(error)) if moved_m > _LEAST_RATIO * noise_m else None
