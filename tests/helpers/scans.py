"""Frames with other scans than they had."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core.sensors import Frame, Scan


def blind(frame: Frame) -> Frame:
    """The frame with a scan of no points."""
    return replace(frame, scan=Scan(frame.scan.stamp_ns, np.empty((0, 3), np.float32)))
