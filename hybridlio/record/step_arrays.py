"""Relative poses of many steps as plain arrays, for files and for memory.

As objects they take five times the memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hybridlio.core.estimates import EarlierScanPose, RelativePose


def relative_arrays(prefix: str, steps: tuple[RelativePose, ...]) -> dict[str, Any]:
    """Convert steps to plain arrays; names start with ``prefix``.

    Leaves out ``details`` and ``proposed``, which smoothing does not use, and ``earlier_scans``, which
    :func:`earlier_scan_arrays` converts. A step without drift has NaN as its drift.
    """
    return {
        f"{prefix}_poses": np.array([s.pose for s in steps]).reshape(-1, 4, 4),
        f"{prefix}_covariances": np.array([s.covariance for s in steps]).reshape(-1, 6, 6),
        f"{prefix}_sources": np.array([s.source for s in steps], dtype=np.str_),
        f"{prefix}_ok": np.array([s.ok for s in steps], dtype=bool),
        f"{prefix}_from_imu": np.array([s.from_imu for s in steps], dtype=bool),
        f"{prefix}_drifts": np.array([np.full((6, 6), np.nan) if s.drift is None else s.drift for s in steps]).reshape(
            -1, 6, 6
        ),
        f"{prefix}_degenerate_step": np.array(
            [k for k, s in enumerate(steps) for _ in range(len(s.degenerate))], dtype=np.int64
        ),
        f"{prefix}_degenerate": np.concatenate([s.degenerate for s in steps] + [np.empty((0, 6))]),
    }


def earlier_scan_arrays(steps: tuple[RelativePose, ...]) -> dict[str, Any]:
    """Convert the steps' poses relative to earlier scans to plain arrays, one row per pose."""
    found = [(row, earlier) for row, step in enumerate(steps) for earlier in step.earlier_scans]
    return {
        "keyframe_step": np.array([row for row, _ in found], dtype=np.int64),
        "keyframe_stamps_ns": np.array([earlier.stamp_ns for _, earlier in found], dtype=np.int64),
        "keyframe_poses": np.array([earlier.pose for _, earlier in found]).reshape(-1, 4, 4),
        "keyframe_covariances": np.array([earlier.covariance for _, earlier in found]).reshape(-1, 6, 6),
    }


def with_earlier_scans(steps: tuple[RelativePose, ...], arrays: Mapping[str, Any]) -> tuple[RelativePose, ...]:
    """Return the steps with their poses relative to earlier scans: the inverse of :func:`earlier_scan_arrays`."""
    if "keyframe_step" not in arrays:  # version 1 of the format
        return steps
    columns = (arrays[f"keyframe_{name}"] for name in ("step", "stamps_ns", "poses", "covariances"))
    found: dict[int, list[EarlierScanPose]] = {}
    for row, stamp, pose, covariance in zip(*columns, strict=True):
        found.setdefault(int(row), []).append(EarlierScanPose(int(stamp), pose, covariance))
    return tuple(replace(step, earlier_scans=tuple(found.get(row, ()))) for row, step in enumerate(steps))


def relative_poses(prefix: str, arrays: Mapping[str, Any]) -> tuple[RelativePose, ...]:
    """Return the steps in arrays whose names start with ``prefix``: the inverse of :func:`relative_arrays`."""
    at, directions = arrays[f"{prefix}_degenerate_step"], arrays[f"{prefix}_degenerate"]
    columns = (arrays[f"{prefix}_{name}"] for name in ("poses", "covariances", "sources", "ok", "from_imu", "drifts"))
    return tuple(
        RelativePose(
            pose,
            covariance,
            str(source),
            directions[at == k],
            bool(ok),
            bool(from_imu),
            None if np.isnan(drift).any() else drift,
        )
        for k, (pose, covariance, source, ok, from_imu, drift) in enumerate(zip(*columns, strict=True))
    )
