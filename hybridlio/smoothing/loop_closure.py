"""Loop closure: finds where a run returns to a place, and the relative pose of its two visits.

Candidates that odometry allows and whose descriptors are similar are verified by registration; the verified loops that
agree with odometry and with one another are kept. Wrong loops that remain are left to the robust solve
(:mod:`hybridlio.graph.run.loop_factors`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.errors import DataError
from hybridlio.core.progress import Progress
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.smoothing.loop_candidates import Candidate, CandidateFinder, CandidateSettings
from hybridlio.smoothing.loop_consistency import (
    ConsistencySettings,
    LoopArrays,
    TravelledOdometry,
    largest_consistent_set,
    odometry_chi2,
    pairwise_chi2,
    supported,
)
from hybridlio.smoothing.loop_verification import PreparedPlaces, Verdict, VerificationSettings, Verifier
from hybridlio.smoothing.loops import Loop, LoopSearch, RejectedLoop
from hybridlio.smoothing.places import KeyframePlaces
from hybridlio.smoothing.step_uncertainty import OdometryChain


@dataclass(frozen=True)
class LoopSettings:
    """Settings of loop closure, by stage.

    Attributes:
        candidates: which keyframes are compared.
        verification: which registrations are accepted.
        consistency: which of the verified loops are kept.
    """

    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)


def find_loops(record: Record, settings: LoopSettings | None = None, progress: Progress | None = None) -> LoopSearch:
    """Find the loops of a run from its record alone.

    Args:
        record: of the run, with keyframes.
        settings: limits of each stage.
        progress: called with ``loops``, the keyframes done and the keyframes in total.

    Raises:
        DataError: the record has no keyframes, or they do not belong to it.
    """
    settings = settings or LoopSettings()
    keyframes = keyframes_of(record)
    chain = OdometryChain(record.online, record.relative)
    rows = keyframes.rows
    places = KeyframePlaces(keyframes, chain, up_of(record), settings.verification.reach_m)
    prepared = PreparedPlaces(places, settings.verification)
    verifier = Verifier(prepared, prepared, settings.verification)
    finder = CandidateFinder(chain, rows, places, settings.candidates)
    seconds = {"candidates": 0.0, "verification": 0.0, "consistency": 0.0}
    found: list[tuple[Candidate, Verdict]] = []
    for k in range(len(keyframes)):
        began = time.perf_counter()
        candidates = finder.add(k)
        chosen = time.perf_counter()
        found += [(one, verifier.verify(one.earlier, one.later, one.guesses)) for one in candidates]
        seconds["candidates"] += chosen - began
        seconds["verification"] += time.perf_counter() - chosen
        if progress is not None:
            progress("loops", k + 1, len(keyframes))
    began = time.perf_counter()
    verified, rejected = _by_verdict(found, rows)
    loops, inconsistent = select_consistent(verified, chain, settings.consistency)
    seconds["consistency"] = time.perf_counter() - began
    return LoopSearch(len(keyframes), len(found), len(verified), loops, (*rejected, *inconsistent), seconds)


def select_consistent(
    verified: list[Loop], chain: OdometryChain, settings: ConsistencySettings
) -> tuple[tuple[Loop, ...], tuple[RejectedLoop, ...]]:
    """Return the loops that agree with odometry and with one another, and the others with the reason.

    A loop must also be supported by another one nearby: a single wrong loop often agrees with uncertain odometry.
    """
    bound = chi_square_quantile(settings.inlier_share, 6)
    chi2 = odometry_chi2(_arrays(verified), chain, settings.odometry_scale) if verified else np.empty(0)
    rejected = [
        _inconsistent(one, f"contradicts odometry (χ² {x:.0f})")
        for one, x in zip(verified, chi2, strict=True)
        if x > bound
    ]
    left = [one for one, x in zip(verified, chi2, strict=True) if x <= bound]
    kept, others = mutually_consistent(left, chain, settings)
    return kept, (*rejected, *others)


def mutually_consistent(
    loops: list[Loop], chain: TravelledOdometry, settings: ConsistencySettings
) -> tuple[tuple[Loop, ...], tuple[RejectedLoop, ...]]:
    """Return the largest set of loops, each supported by another nearby, that agree; and the others with the reason."""
    if not loops:
        return (), ()
    arrays, bound = _arrays(loops), chi_square_quantile(settings.inlier_share, 6)
    agree = pairwise_chi2(arrays, chain, settings.odometry_scale) <= bound
    has_support = supported(arrays, agree, chain.travelled_m, settings)
    kept = np.zeros(len(loops), bool)
    kept[has_support] = largest_consistent_set(agree[np.ix_(has_support, has_support)])
    rejected = [
        _inconsistent(one, "contradicts other loops" if is_supported else "no other loop nearby agrees")
        for one, is_supported, is_kept in zip(loops, has_support, kept, strict=True)
        if not is_kept
    ]
    return tuple(one for one, is_kept in zip(loops, kept, strict=True) if is_kept), tuple(rejected)


def keyframes_of(record: Record) -> LoopKeyframes:
    """Return the record's keyframes.

    Raises:
        DataError: it has none, or they do not belong to it.
    """
    keyframes = record.keyframes
    if keyframes is None:
        raise DataError("the record has no keyframes, which loop closure needs; run the odometry again")
    stamps = record.online.stamps_ns
    if len(keyframes) and (keyframes.rows[-1] >= len(stamps) or (stamps[keyframes.rows] != keyframes.stamps_ns).any()):
        raise DataError("the keyframes do not belong to this record: they are of another run; run the odometry again")
    return keyframes


def up_of(record: Record) -> Array:
    """Return up ``(3,)`` in the first scan's frame; the lidar's z axis without inertial data."""
    if not record.start.has_imu:
        return np.array([0.0, 0.0, 1.0])
    return record.start.up_in_lidar(record.calibration)


def _by_verdict(found: list[tuple[Candidate, Verdict]], rows: Index) -> tuple[list[Loop], list[RejectedLoop]]:
    loops, rejected = [], []
    for candidate, verdict in found:
        earlier, later = int(rows[candidate.earlier]), int(rows[candidate.later])
        if verdict.reason:
            rejected.append(RejectedLoop(earlier, later, "verification", verdict.reason))
        else:
            loops.append(Loop(earlier, later, verdict.pose, verdict.covariance, verdict.matched, verdict.cost))
    return loops, rejected


def _inconsistent(loop: Loop, reason: str) -> RejectedLoop:
    return RejectedLoop(loop.earlier, loop.later, "consistency", reason)


def _arrays(loops: list[Loop]) -> LoopArrays:
    return LoopArrays(
        np.array([one.earlier for one in loops], np.int64),
        np.array([one.later for one in loops], np.int64),
        se3.orthonormalise(np.array([one.pose for one in loops])),
        np.array([one.covariance for one in loops]),
    )
