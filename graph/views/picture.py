"""The picture of a solved graph, by matplotlib, without changing global state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from hybridlio.core.arrays import Array
from hybridlio.graph.model.keys import Key

_SMALLEST_CHI2 = 1e-2  # χ² below it all look alike: a tenth of a standard deviation


def picture(poses: Array, keys: Sequence[Key], joints: Sequence[tuple[Key, Key, float, bool]]) -> Figure:
    """Return a picture of poses ``(N, 4, 4)`` from above.

    Args:
        poses: in the order of ``keys``.
        keys: of the poses.
        joints: both poses, χ² and whether it is rejected, of each factor of two poses.
    """
    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot()
    place = dict(zip(keys, poses[:, :2, 3], strict=True))
    kept = [joint for joint in joints if not joint[3]]
    chi2 = np.maximum([joint[2] for joint in kept], _SMALLEST_CHI2)
    largest = max(float(chi2.max(initial=0)), 10 * _SMALLEST_CHI2)
    lines = LineCollection([(place[i], place[j]) for i, j, _, _ in kept], norm=LogNorm(_SMALLEST_CHI2, largest))
    lines.set_array(chi2)
    axes.add_collection(lines)
    wrong = [(place[i], place[j]) for i, j, _, rejected in joints if rejected]
    axes.add_collection(LineCollection(wrong, colors="#D55E00", linestyles="dashed", linewidths=0.5, label="rejected"))
    axes.plot(*poses[:, :2, 3].T, ".", color="black", markersize=1, label="poses")
    figure.colorbar(lines, label="χ² of factors", shrink=0.7)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.legend(loc="upper right")
    return figure
