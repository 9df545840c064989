"""How well each kind of factor of a run fits the solution, for the verdict on a smoothing."""

from __future__ import annotations

import gtsam

from hybridlio.graph.run.robust import AddedGroups
from hybridlio.smoothing.verdict import IMU, ODOMETRY, KindFit

_RELATIVE, _INERTIAL = {"x", "m", "c"}, {"x", "v", "b"}  # letters of the keys that factors of each kind connect


def kind_fits(graph: gtsam.NonlinearFactorGraph, own: int, values: gtsam.Values, added: AddedGroups) -> list[KindFit]:
    """Return the fit of odometry, IMU and each group.

    Args:
        graph: of the run, the factors of its own steps first.
        own: their number.
        values: the solution.
        added: the groups.
    """
    fits: dict[str, list[tuple[str, float, int]]] = {ODOMETRY: [], IMU: []}
    for row in range(own):
        factor = graph.at(row)
        kind = _kind(factor)
        if kind is not None:
            scan = max(gtsam.Symbol(key).index() for key in factor.keys())  # noqa: SIM118  (GTSAM's, no mapping)
            fits[kind].append((f"scan {scan}", 2 * factor.error(values), factor.dim()))
    return [*(KindFit.of(kind, found) for kind, found in fits.items()), *added.fits(values)]


def _kind(factor: gtsam.NonlinearFactor) -> str | None:
    """Return the kind of a factor by the letters of its keys; None for priors and links of one vector."""
    keys = list(factor.keys())
    letters = {chr(gtsam.Symbol(key).chr()) for key in keys}
    if len(keys) > 1 and letters <= _RELATIVE:
        return ODOMETRY
    return IMU if letters >= _INERTIAL else None
