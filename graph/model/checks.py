"""Checks that the factors of a graph determine its poses and velocities, from its structure, before any solver runs."""

from __future__ import annotations

from collections import Counter

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import of_kind
from hybridlio.graph.model.connectivity import components, groups
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, list_keys
from hybridlio.graph.model.measurements import OF_LANDMARKS, STEPS, VELOCITIES, Factor
from hybridlio.graph.model.user_residual import sample_poses

_MOTIONS = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")
# Numerical rank of the observed motions, relative to the largest singular value: far above double rounding (1e-16),
# far below what two fixes a metre apart give in a map of 100 km.
_RANK_TOLERANCE = 1e-6
# Share of a named motion in an unobserved unit direction from which a message names it: a direction may mix all six,
# none then has less than 1/√6 = 0.4 in its largest, and smaller shares only confuse.
_NAMED_SHARE = 0.1
_ROWS = {
    "heading": [2],
    "altitude": [5],
    "body-velocity": [],
    "sensor-step": [],
}  # motions that these measure by themselves
_REPEATED = ("gps", "velocity")  # measured: a vector in world, then the lever arm if there is one


def check_determined(data: GraphData) -> None:
    """Check that every pose and velocity is determined.

    Raises:
        GraphError: no poses, a pose without factors, a part of the graph that may move as a whole, or a chain of IMU
            factors whose velocity is free; names the keys.
    """
    if not len(data):
        raise GraphError("the graph has no poses")
    _check_concerned(data)
    free = [(part, motions) for part in components(data) if (motions := free_motions(data, part))]
    if free:
        raise GraphError(_free_message(data, free))
    _check_velocities(data)
    _check_clocks(data)


def check_observed(data: GraphData) -> None:
    """Check that every landmark is observed by as many numbers as it has coordinates.

    Raises:
        GraphError: no factor observes a landmark, or only a range or a bearing; names the keys.
    """
    observed: Counter[Key] = Counter()
    for factor in data.other_factors.values():
        if factor.kind in OF_LANDMARKS and factor.landmark is not None and factor.noise is not None:
            observed[factor.landmark] += len(factor.noise.values)
    unseen = [key for key in data.landmarks.keys if not observed[key]]
    if unseen:
        raise GraphError(f"no factor observes landmark {list_keys(unseen)}; add one, or leave the landmark out")
    hardly = [key for key in data.landmarks.keys if observed[key] < data.dimension]
    if hardly:
        raise GraphError(
            f"too few ranges and bearings observe landmark {list_keys(hardly)} to place it; add others from other poses"
        )


def _check_concerned(data: GraphData) -> None:
    concerned = np.zeros(len(data), dtype=bool)
    concerned[data.edges.ends.ravel()] = True
    of_others = {key for factor in data.other_factors.values() for key in factor.keys} | data.fixed
    concerned[[data.index[key] for key in of_others]] = True
    if not concerned.all():
        alone = [key for key, has_factor in zip(data.keys, concerned, strict=True) if not has_factor]
        raise GraphError(f"no factor concerns pose {list_keys(alone)}; add one, or leave the pose out")


def _free_message(data: GraphData, free: list[tuple[list[Key], list[str]]]) -> str:
    parts = "; ".join(f"poses {list_keys(part)} are free in {', '.join(motions)}" for part, motions in free)
    count = len(components(data))
    apart = f"the graph has {count} parts that no factor joins; " if count > 1 else ""
    return f"{apart}{parts}. Add a prior, fix a pose, or measure these directions"


def free_motions(data: GraphData, part: list[Key]) -> list[str]:
    """Return the motions of the part as a whole that change none of its measurements."""
    inside = set(part)
    if inside & data.fixed:
        return []
    names = _MOTIONS if data.dimension == 3 else _MOTIONS[2:5]
    factors = [f for f in data.other_factors.values() if f.keys[0] in inside and f.kind not in ("bias", *OF_LANDMARKS)]
    if any(factor.kind in ("prior", "marginal", "gtsam") for factor in factors):
        return []  # what a marginal or a factor of GTSAM's leaves free, the solver finds
    jacobian = np.vstack([np.zeros((1, 6)), *(_motion_jacobian(data, factor) for factor in _distinct(factors))])
    # rotations move a far position by metres: scaled down, so that both halves compare in the rank below
    reach = float(np.linalg.norm(jacobian[:, :3], axis=1).max())
    jacobian = jacobian / np.r_[np.full(3, max(reach, 1.0)), np.ones(3)]
    jacobian = jacobian if data.dimension == 3 else jacobian[:, 2:5]
    _, sizes, directions = np.linalg.svd(jacobian)
    unobserved = directions[int((sizes > _RANK_TOLERANCE * sizes.max()).sum()) :]
    shares = np.abs(unobserved).max(axis=0, initial=0.0)
    return [name for name, share in zip(names, shares, strict=True) if share > _NAMED_SHARE]


def _distinct(factors: list[Factor]) -> list[Factor]:
    """Return the factors without repetitions at one pose, whose noise would pass for another place or velocity."""
    what = [(f.kind, f.keys[0], tuple(f.measured[3:])) if f.kind in _REPEATED else n for n, f in enumerate(factors)]
    return list(dict(zip(what, factors, strict=True)).values())


def _motion_jacobian(data: GraphData, factor: Factor) -> Array:
    """Return rows of six: derivative of the measurement by a rotation and shift ``(ω, v)`` of the whole graph."""
    if factor.kind == "custom":
        return _residual_motion_jacobian(data, factor)
    no_shift = np.zeros((3, 3))
    z = factor.measured
    if factor.kind == "gps":
        return np.hstack([-se3.hat(z[:3]), np.eye(3)])
    if factor.kind == "attitude":
        return np.hstack([-se3.hat(z[:3] / np.linalg.norm(z[:3])), no_shift])
    if factor.kind == "velocity":
        return np.hstack([-se3.hat(z), no_shift])
    if factor.kind in _ROWS:
        return np.eye(6)[_ROWS[factor.kind]]
    if factor.kind == "imu":  # gravity shows the vertical
        return np.hstack([-se3.hat(co.UP), no_shift])
    return np.eye(6)


def _residual_motion_jacobian(data: GraphData, factor: Factor) -> Array:
    """Return the rows of a user's residual, scaled to size one, as its unit is not known.

    Poses without an initial value are taken at places of no special kind, where the rank is that of almost everywhere.
    """
    poses = sample_poses([data.initial_value(key) for key in factor.keys], data.dimension)
    used = slice(0, 6) if data.dimension == 3 else slice(2, 5)
    rows = [J @ se3.adjoint(se3.inverse(T))[used] for J, T in zip(factor.code.derivatives(poses), poses, strict=True)]
    total = np.sum(rows, axis=0)
    return np.asarray(total / max(float(np.abs(rows).max()), np.finfo(float).tiny))


def _check_velocities(data: GraphData) -> None:
    """Check each chain of IMU factors for its one free velocity.

    It is determined by a velocity factor, or by two poses of the chain whose relative position other factors give.
    """
    others = data.other_factors.values()
    if not any(factor.kind == "imu" for factor in others):
        return
    with_velocity = {f.keys[0] for f in others if f.kind in VELOCITIES}
    placed = {f.keys[0] for f in others if f.kind in ("prior", "gps")} | data.fixed
    # poses of one group have known relative positions; group 0 holds all whose position in world is known
    group_of: dict[Key, int] = {}
    for number, group in enumerate(groups(data, STEPS), 1):
        group_of |= dict.fromkeys(group, 0 if placed & set(group) else number)
    for chain in groups(data, ("imu",)):
        numbers = [group_of[key] for key in chain]
        if len(chain) > 1 and not with_velocity & set(chain) and len(set(numbers)) == len(numbers):
            raise GraphError(
                f"nothing determines the velocity along the inertial factors of poses {list_keys(chain)}; "
                "add a velocity, or another factor between two of the poses"
            )


def _check_clocks(data: GraphData) -> None:
    """Check that the poses of factors on another clock have a velocity, which moves them."""
    others = data.other_factors.values()
    moving = {key for factor in others if factor.kind in ("imu", *VELOCITIES) for key in factor.keys}
    for factor in others:
        if of_kind(data.calibrations, factor.calibration, "time_offset") is None:
            continue
        still = [key for key in factor.keys if key not in moving]
        if still:
            raise GraphError(
                f"{factor.label}: its clock needs the velocity of pose {still[0]}; add_imu or add_velocity"
            )
