"""Which poses of a graph are joined by which factors."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hybridlio.core.sensors import ImuNoise
from hybridlio.graph.model.calibrations import of_kind
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import JOINING, OBSERVATIONS, Factor


def group_labels(data: GraphData, kinds: Iterable[str]) -> tuple[int, NDArray[np.int32]]:
    """Return the number of groups of poses that factors of these kinds join, and each pose's group ``(N,)``."""
    index = data.index
    joining = (f for f in data.other_factors.values() if f.kind in kinds)
    pairs = [(index[i], index[j]) for f in joining for i, j in pairwise(f.keys)]
    ends = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    if "between" in kinds:
        ends = np.vstack([data.edges.ends, ends])
    adjacency = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(data), len(data)))
    count, labels = connected_components(adjacency, directed=False)
    return int(count), labels


def groups(data: GraphData, kinds: Iterable[str]) -> list[list[Key]]:
    """Return the groups of poses that factors of these kinds join, largest first, each in the graph's order."""
    count, labels = group_labels(data, kinds)
    if count == 1:
        return [data.keys]
    found: list[list[Key]] = [[] for _ in range(count)]
    for key, label in zip(data.keys, labels.tolist(), strict=True):
        found[label].append(key)
    return sorted(found, key=len, reverse=True)


def components(data: GraphData) -> list[list[Key]]:
    """Return the connected components over factors of several poses, and over shared landmarks, largest first.

    Two parts are joined where they share as many landmarks as determine a rigid transform: two, or three in space.
    """
    parts = groups(data, JOINING)
    observations = [f for f in data.other_factors.values() if f.kind in OBSERVATIONS]
    if len(parts) == 1 or not observations:
        return parts
    part_of = {key: k for k, part in enumerate(parts) for key in part}
    seen: list[set[Key]] = [set() for _ in parts]
    for factor in observations:
        assert factor.landmark is not None
        seen[part_of[factor.keys[0]]].add(factor.landmark)
    order = data.index
    joined = _join_by_landmarks(list(zip(parts, seen, strict=True)), data.dimension)
    return sorted((sorted(part, key=order.__getitem__) for part in joined), key=len, reverse=True)


def _join_by_landmarks(parts: list[tuple[list[Key], set[Key]]], needed: int) -> list[list[Key]]:
    """Join parts, of poses and the landmarks they see, that share enough landmarks, until no two do."""
    while True:
        pairs = ((a, b) for b in range(len(parts)) for a in range(b))
        pair = next(((a, b) for a, b in pairs if len(parts[a][1] & parts[b][1]) >= needed), None)
        if pair is None:
            return [keys for keys, _ in parts]
        keys, landmarks = parts.pop(pair[1])
        parts[pair[0]] = parts[pair[0]][0] + keys, parts[pair[0]][1] | landmarks


class InertialChain(NamedTuple):
    """Poses that IMU factors join.

    Attributes:
        keys: of the poses.
        start: the first pose from which samples lead on.
        noise: of those samples.
    """

    keys: list[Key]
    start: Key
    noise: ImuNoise


def chains_without_bias(data: GraphData) -> list[InertialChain]:
    """Return the chains of IMU factors without a bias factor; their biases need a prior at the start."""
    measured = {factor.keys[0] for factor in data.other_factors.values() if factor.kind == "bias"}
    first: dict[Key, ImuNoise] = {}
    for factor in data.other_factors.values():
        if walks(data, factor):
            first.setdefault(factor.keys[0], ImuNoise(*factor.measured))
    found = []
    for chain in groups(data, ("imu",)) if first else []:
        starts = [key for key in chain if key in first]
        if starts and not measured & set(chain):
            found.append(InertialChain(chain, starts[0], first[starts[0]]))
    return found


def walks(data: GraphData, factor: Factor) -> bool:
    """Return whether a factor is inertial, with biases that each pose has of its own."""
    return factor.kind == "imu" and of_kind(data.calibrations, factor.calibration, "bias") is None
