"""In which order to eliminate a run's variables."""

from __future__ import annotations

import gtsam

_SCANS = "xvbgm"  # kinds of variables that each scan has one of
_POINTS = "awp"  # of a GPS fix


def chain_order(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Ordering | None:
    """Each fix's points first, then scan after scan, and what all share last; None where factors close loops.

    A variable in hundreds of factors along the way, such as the frame of GPS fixes, misleads the search for a good
    order (COLAMD, METIS): it then costs ten times what the same graph costs without it, and twice in this order.
    Where nothing is shared, or where loops close, the search does well.
    """
    keys = [(gtsam.Symbol(key).index(), chr(gtsam.Symbol(key).chr()), key) for key in list(values.keys())]
    shared = [key for _, kind, key in keys if kind not in _SCANS + _POINTS]
    apart = {key for _, kind, key in keys if kind not in _SCANS}
    if not shared or not _is_chain(graph, apart):
        return None
    order = gtsam.Ordering()
    for kinds in (_POINTS, _SCANS):
        for _, _, key in sorted(entry for entry in keys if entry[1] in kinds):
            order.push_back(key)
    for key in shared:
        order.push_back(key)
    return order


def _is_chain(graph: gtsam.NonlinearFactorGraph, apart: set[int]) -> bool:
    for k in range(graph.size()):
        places = [gtsam.Symbol(key).index() for key in list(graph.at(k).keys()) if key not in apart]
        if places and max(places) - min(places) > 1:
            return False
    return True
