"""The paper's figures: tables 1 to 5 of UnDeepLIO, on KITTI odometry."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

from hybridlio.core.errors import ConfigError

TRAIN, TEST = "train", "test"
_AVERAGES = {"train_avg": TRAIN, "test_avg": TEST}
_METRICS = ("t_rel_percent", "r_rel_deg_per_100m")


@dataclass(frozen=True)
class PublishedRow:
    """A row of one of the paper's tables.

    Attributes:
        method: name in the paper.
        t_rel_percent, r_rel_deg_per_100m: as printed, by KITTI sequence ``00`` to ``10``, and the means over training
            (``train``) and test sequences (``test``); None if no figure is published.
    """

    method: str
    t_rel_percent: Mapping[str, float | None]
    r_rel_deg_per_100m: Mapping[str, float | None]


def published(table: int) -> tuple[PublishedRow, ...]:
    """Return the rows of a table in their order.

    Raises:
        ConfigError: the number is not 1 to 5.
    """
    text = resources.files("hybridlio.learned.training").joinpath("published.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    for row in rows:
        if int(row.pop("table")) == table:
            metric, method = row.pop("metric"), row.pop("method")
            found.setdefault(method, {})[metric] = {_AVERAGES.get(k, k): _number(v) for k, v in row.items()}
    if not found:
        raise ConfigError(f"table {table} is not in the paper; choose 1 to 5")
    return tuple(PublishedRow(method, *(figures[metric] for metric in _METRICS)) for method, figures in found.items())


def _number(text: str) -> float | None:
    return None if text in ("x", "NA") else float(text)
