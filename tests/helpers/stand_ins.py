"""Frames with placeholder scans for tests that look prepared scans up by stamp, and a step between them."""

import numpy as np

from hybridlio.core import se3
from hybridlio.core.sensors import Frame, ImuSamples, Scan
from hybridlio.learned.source_settings import NetworkResidualSettings

STEP = se3.exp([0.0, 0.0, 0.03, 0.3, 0.05, 0.0])
WIDE = np.diag(np.r_[np.full(3, 1e-4), np.full(3, 1e-2)])
FEW = NetworkResidualSettings(min_cells=200)


def frame(k: int, imu: bool = True) -> Frame:
    """Return frame ``k`` at 10 Hz with a placeholder scan."""
    stamps = np.arange(11) * 10**7 + (k - 1) * 10**8
    rows = np.full((11, 3), 0.1)
    samples = ImuSamples(stamps, rows, rows + np.array([0, 0, 9.8])) if imu else ImuSamples.empty()
    return Frame(k, Scan(k * 10**8, np.ones((1, 3), np.float32)), imu=samples)
