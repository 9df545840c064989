"""What a reader of a report should know first: whether the trajectory, and the figures on it, can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybridlio.core.tables import counted
from hybridlio.evaluation.consistency import Anees
from hybridlio.evaluation.report_data import Findings, ReportData

Level = Literal["good", "doubtful", "bad"]

# ANEES of poses relative to the first between which σ is right within a factor of 2
_HONEST = (0.25, 4.0)
_MANY = 0.02  # share of the scans; single bridged scans are normal, and bridged well by the IMU
_MANY_DEGENERATE = 0.1


@dataclass(frozen=True)
class Statement:
    """One sentence on the run, and whether it is good news."""

    level: Level
    text: str


def statements(data: ReportData, findings: Findings) -> list[Statement]:
    """Return what is known about the trust that a run deserves, the gravest first."""
    found = [Statement("bad", doubt) for doubt in data.reference_doubts]
    found += [Statement("doubtful", doubt) for doubt in data.recording_doubts]
    found += [*_flags(data), *_consistency(data, findings), *_uncertainty(data)]
    order: dict[Level, int] = {"bad": 0, "doubtful": 1, "good": 2}
    return sorted(found, key=lambda statement: order[statement.level])


def headline(found: list[Statement], name: str = "") -> tuple[Level, str]:
    """Return the gravest level, and a sentence that sums up; it names the trajectory where there are others."""
    worse = [statement for statement in found if statement.level != "good"]
    if not worse:
        return "good", f"Nothing here contradicts {name or 'this trajectory'}."
    level: Level = "bad" if any(statement.level == "bad" for statement in worse) else "doubtful"
    return (
        level,
        f"Check {'this point' if len(worse) == 1 else f'these {len(worse)} points'} before you use {name or 'it'}.",
    )


def _flags(data: ReportData) -> list[Statement]:
    """Return statements on scans that could not be used, do not constrain the motion, or conflict with the IMU."""
    scans, out = len(data.estimate), []
    words = {
        "bridged": ("bridged by the initial pose, as the scan could not be used", _MANY),
        "degenerate": ("with an unconstrained direction", _MANY_DEGENERATE),
    }
    for name, rows in data.flagged.items():
        text, many = words.get(name, (f"in conflict with the IMU: {name}", _MANY))
        if not len(rows):
            continue
        level: Level = "doubtful" if len(rows) > many * scans else "good"
        out.append(Statement(level, f"{counted(len(rows), 'scan')} of {scans} {text}."))
    if not any(len(rows) for rows in data.flagged.values()) and data.ok is not None:
        out.append(Statement("good", "Every scan was used, and none conflicts with the IMU."))
    return out


def _consistency(data: ReportData, findings: Findings) -> list[Statement]:
    """Return a statement on the covariances of the poses, if there is a reference that can tell."""
    if findings.poses is None or data.reference_doubts:
        return []
    parts = {"position": findings.poses.consistency.position, "rotation": findings.poses.consistency.rotation}
    return [
        Statement(_level(result), f"{name.capitalize()} errors are {_words(result)}.") for name, result in parts.items()
    ]


def _level(result: Anees) -> Level:
    return "good" if result.value <= _HONEST[1] else "bad"


def _words(result: Anees) -> str:
    ratio = float(np.sqrt(result.value))
    if result.value < _HONEST[0]:
        return f"{ratio:.2g} times their standard deviations: the covariances are cautious"
    if result.value > _HONEST[1]:
        return f"{ratio:.2g} times their standard deviations: the covariances are far too small"
    return f"{ratio:.2g} times their standard deviations, as they should be"


def _uncertainty(data: ReportData) -> list[Statement]:
    if data.estimate.covariances is None or len(data.estimate) < 2:
        return []
    last = data.estimate.covariances[-1]
    sigma_m, sigma_deg = np.sqrt(last[3:, 3:].trace()), np.degrees(np.sqrt(last[:3, :3].trace()))
    length = data.estimate.length_m
    return [
        Statement(
            "good",
            f"After {length:,.0f} m the position is known to ±{sigma_m:.2g} m and the orientation to ±{sigma_deg:.2g}° "
            "(one standard deviation, relative to the first scan).",
        )
    ]
