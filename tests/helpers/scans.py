"""Frames with replaced scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core.sensors import Frame, Scan


def blind(frame: Frame) -> Frame:
    """Return the frame with an empty scan."""
    return replace(frame, scan=Scan(frame.scan.stamp_ns, np.empty((0, 3), np.float32)))
