"""Whether a pose graph determines its poses, told from its structure before any solver sees it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.sensors import ImuNoise
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, named
from hybridlio.graph.model.measurements import Factor

_MOTIONS = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")
_UP = np.array([0.0, 0.0, 1.0])


def labels(data: GraphData, kinds: Iterable[str]) -> tuple[int, NDArray[np.int32]]:
    """How many groups of poses factors of these kinds make, and each pose's group ``(N,)``."""
    places = data.places
    others = [[places[key] for key in f.keys] for f in data.others.values() if f.kind in kinds and len(f.keys) == 2]
    ends = np.array(others, dtype=np.int64).reshape(-1, 2)
    if "between" in kinds:
        ends = np.vstack([data.edges.ends, ends])
    joined = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(data), len(data)))
    count, found = connected_components(joined, directed=False)
    return int(count), found


def groups(data: GraphData, kinds: Iterable[str]) -> list[list[Key]]:
    """Poses that factors of these kinds join, in the graph's order, largest group first."""
    count, label = labels(data, kinds)
    if count == 1:
        return [data.keys]
    found: list[list[Key]] = [[] for _ in range(count)]
    for key, number in zip(data.keys, label.tolist(), strict=True):
        found[number].append(key)
    return sorted(found, key=len, reverse=True)


def components(data: GraphData) -> list[list[Key]]:
    """The parts of a graph that nothing joins."""
    return groups(data, ("between", "imu"))


class Chain(NamedTuple):
    """Poses that inertial factors join; ``start`` is the first of them that has samples, ``noise`` theirs."""

    keys: list[Key]
    start: Key
    noise: ImuNoise


def chains_without_bias(data: GraphData) -> list[Chain]:
    """Each chain of inertial factors whose biases nothing measures."""
    measured = {factor.keys[0] for factor in data.others.values() if factor.kind == "bias"}
    first: dict[Key, ImuNoise] = {}
    for factor in data.others.values():
        if factor.kind == "imu":
            first.setdefault(factor.keys[0], ImuNoise(*factor.measured))
    found = []
    for chain in groups(data, ("imu",)) if first else []:
        starts = [key for key in chain if key in first]
        if starts and not measured & set(chain):
            found.append(Chain(chain, starts[0], first[starts[0]]))
    return found


def check_determined(data: GraphData) -> None:
    """Raise where some pose or velocity could be anything.

    Raises:
        GraphError: no poses, a pose that no factor concerns, a part of the graph that may move as a whole, or a chain
            of inertial factors whose speed nothing tells; names the keys.
    """
    if not len(data):
        raise GraphError("the graph has no poses")
    concerned = np.zeros(len(data), dtype=bool)
    concerned[data.edges.ends.ravel()] = True
    named_by_others = {key for factor in data.others.values() for key in factor.keys} | data.fixed
    concerned[[data.places[key] for key in named_by_others]] = True
    if not concerned.all():
        alone = [key for key, there in zip(data.keys, concerned, strict=True) if not there]
        raise GraphError(f"no factor concerns pose {named(alone)}; add one, or leave the pose out")
    free = [(part, motions) for part in components(data) if (motions := _free_motions(data, part))]
    if free:
        raise GraphError(_free_message(data, free))
    _check_speeds(data)


def _free_message(data: GraphData, free: list[tuple[list[Key], list[str]]]) -> str:
    parts = "; ".join(f"poses {named(part)} may still move: {', '.join(motions)}" for part, motions in free)
    count = len(components(data))
    apart = f"the graph has {count} parts that nothing joins; " if count > 1 else ""
    return f"{apart}{parts}. Add a prior, fix a pose, or give what is missing"


def _free_motions(data: GraphData, part: list[Key]) -> list[str]:
    """Motions of the world that change none of the part's measurements."""
    inside = set(part)
    if inside & data.fixed:
        return []
    names = _MOTIONS if data.dimension == 3 else _MOTIONS[2:5]
    factors = [f for f in data.others.values() if f.keys[0] in inside and f.kind != "bias"]
    if any(factor.kind == "prior" for factor in factors):
        return []
    rows = [_seen(factor) for factor in factors]
    if data.dimension == 2 or not rows:
        return list(names)
    seen = np.vstack(rows)
    positions = np.linalg.norm(seen[:, :3], axis=1).max()
    seen = seen / np.r_[np.full(3, max(float(positions), 1.0)), np.ones(3)]
    _, sizes, directions = np.linalg.svd(seen)
    hidden = directions[int((sizes > 1e-6 * sizes.max()).sum()) :]
    return [name for name, share in zip(names, np.abs(hidden).max(axis=0, initial=0.0), strict=True) if share > 0.1]


def _seen(factor: Factor) -> Array:
    """How the measurement changes when the world turns and shifts by ``(ω, v)``: rows of six."""
    nothing = np.zeros((3, 3))
    z = factor.measured
    if factor.kind == "gps":
        return np.hstack([-se3.hat(z[:3]), np.eye(3)])
    if factor.kind == "attitude":
        return np.hstack([-se3.hat(z[:3] / np.linalg.norm(z[:3])), nothing])
    if factor.kind == "velocity":
        return np.hstack([-se3.hat(z), nothing])
    if factor.kind == "imu":
        return np.hstack([-se3.hat(_UP), nothing])
    return np.eye(6)


def _check_speeds(data: GraphData) -> None:
    """A chain of inertial factors has a free speed unless a velocity or two of its poses are told otherwise."""
    told = {f.keys[0] for f in data.others.values() if f.kind == "velocity"}
    placed = {f.keys[0] for f in data.others.values() if f.kind in ("prior", "gps")} | data.fixed
    if not any(factor.kind == "imu" for factor in data.others.values()):
        return
    place: dict[Key, int] = {}
    for number, group in enumerate(groups(data, ("between",)), 1):
        place |= dict.fromkeys(group, 0 if placed & set(group) else number)
    for chain in groups(data, ("imu",)):
        places = [place[key] for key in chain]
        if len(chain) > 1 and not told & set(chain) and len(set(places)) == len(places):
            raise GraphError(
                f"nothing tells the velocity along the inertial factors of poses {named(chain)}; "
                "add a velocity, or another factor between two of the poses"
            )
