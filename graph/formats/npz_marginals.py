"""Marginals of a pose graph as arrays, for its ``.npz`` file: each has its own number of poses and of rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.marginals import Marginal
from hybridlio.graph.model.measurements import Factor

_PREFIX = "marginal"


def marginal_arrays(data: GraphData) -> dict[str, Any]:
    """Return ids, numbers of poses and of values, and the places of the poses and the values one after the other."""
    by_id = {number: factor for number, factor in data.other_factors.items() if factor.kind == "marginal"}
    if not by_id:
        return {}
    factors = list(by_id.values())
    return {
        f"{_PREFIX}_id": np.array(list(by_id), dtype=np.int64),
        f"{_PREFIX}_poses": np.array([len(factor.keys) for factor in factors], dtype=np.int64),
        f"{_PREFIX}_sizes": np.array([len(factor.measured) for factor in factors], dtype=np.int64),
        f"{_PREFIX}_indices": np.array([data.index[k] for factor in factors for k in factor.keys], dtype=np.int64),
        f"{_PREFIX}_values": np.concatenate([factor.measured for factor in factors]),
    }


def marginals(data: GraphData, arrays: Mapping[str, Any]) -> dict[int, Factor]:
    """Return the marginals of an archive by id; raise DataError where their numbers do not fit.

    Args:
        data: the graph with its poses.
        arrays: of the archive.
    """
    if f"{_PREFIX}_id" not in arrays:
        return {}
    ids, poses, sizes, indices, values = (
        arrays[f"{_PREFIX}_{column}"] for column in ("id", "poses", "sizes", "indices", "values")
    )
    keys = np.split(indices, np.cumsum(poses)[:-1])
    rows = np.split(values.astype(np.float64), np.cumsum(sizes)[:-1])
    return {
        number: _marginal(data, tuple(data.keys_at(at.tolist())), row)
        for number, at, row in zip(ids.tolist(), keys, rows, strict=True)
    }


def _marginal(data: GraphData, keys: tuple[Key, ...], values: Any) -> Factor:
    factor = Factor("marginal", keys, values)
    Marginal.unpacked(values, len(keys), data.dimension, factor.label)
    return factor
