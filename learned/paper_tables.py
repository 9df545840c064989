"""The comparisons that the paper prints as tables 1 to 5, as presets, and its splits of KITTI odometry.

Source: UnDeepLIO, "Ablation Study".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from hybridlio.core.errors import ConfigError
from hybridlio.learned.settings import NetworkSettings

SPLITS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = MappingProxyType(
    {
        "easy": (tuple(f"{n:02}" for n in range(9)), ("09", "10")),
        "hard": (tuple(f"{n:02}" for n in range(7)), ("07", "08", "09", "10")),
    }
)
"""KITTI odometry sequences to train on and to test on, by the name of the split."""


@dataclass(frozen=True)
class TableRow:
    """A row of one of the paper's tables.

    Attributes:
        published: name of the method there, as in the published figures.
        preset: name of the preset that it stands for.
        split: split of KITTI odometry, where a table has rows of both; None takes the one that the user asks for.
    """

    published: str
    preset: str
    split: str | None = None

    @property
    def name(self) -> str:
        """Name that is unique among the rows of the table."""
        return self.preset if self.split is None else f"{self.preset}-{self.split}"


TABLES: Mapping[int, tuple[TableRow, ...]] = MappingProxyType(
    {
        1: (
            TableRow("Nubert et al.", "nubert", "easy"),
            TableRow("Cho et al.", "cho", "easy"),
            TableRow("Ours-easy", "no-imu", "easy"),
            TableRow("Ours-easy+imu", "paper", "easy"),
            TableRow("Ours-hard", "no-imu", "hard"),
            TableRow("Ours-hard+imu", "paper", "hard"),
        ),
        2: (
            TableRow("imu(w preprocess)", "paper"),
            TableRow("imu(w/o preprocess)", "imu-feature"),
            TableRow("noimu", "no-imu"),
        ),
        3: (
            TableRow("imu(w normal, w dist)", "paper"),
            TableRow("imu(w normal, w/o dist)", "normals-joined"),
            TableRow("imu(w/o normal, w/o dist)", "normals-none"),
            TableRow("noimu(w normal, w dist)", "no-imu"),
            TableRow("noimu(w normal, w/o dist)", "no-imu-normals-joined"),
            TableRow("noimu(w/o normal, w/o dist)", "no-imu-normals-none"),
        ),
        4: (
            TableRow("imu(w attention)", "paper"),
            TableRow("imu(w fc+activation)", "mlp"),
            TableRow("noimu(w attention)", "no-imu"),
            TableRow("noimu(w fc+activation)", "no-imu-mlp"),
        ),
        5: (
            TableRow("imu(w point-to-plane))+point-to-point", "paper"),
            TableRow("imu(w/o point-to-plane)+point-to-point", "without-plane-to-plane"),
            TableRow("imu(w point-to-plane)+pixel-to-pixel", "same-pixel"),
            TableRow("noimu(w point-to-plane)+point-to-point", "no-imu"),
            TableRow("noimu(w/o point-to-plane)+point-to-point", "no-imu-without-plane-to-plane"),
            TableRow("noimu(w point-to-plane))+pixel-to-pixel", "no-imu-same-pixel"),
        ),
    }
)
"""Rows of tables 1 to 5 that are presets. The other rows of table 1 have published figures only.

Table 5's "w/o point-to-plane" is read as without plane-to-plane: without the distance to planes no gradient would reach
a translation, yet its published drift is 2 %; the paper mixes up the two names in its overall loss as well. The preset
``without-point-to-plane`` is the literal reading.
"""


def split(name: str, network: NetworkSettings) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the KITTI odometry sequences to train on and to test on, without 03 where the network needs an IMU.

    Raises:
        ConfigError: the split is unknown; lists the known ones.
    """
    if name not in SPLITS:
        raise ConfigError(f"unknown split {name!r}; choose one of {', '.join(SPLITS)}")
    train, test = SPLITS[name]
    needs_imu = network.imu in ("initial-pose", "feature")
    return tuple(s for s in train if not (needs_imu and s == "03")), test


def table(number: int) -> tuple[TableRow, ...]:
    """Return the rows of one of the paper's tables.

    Raises:
        ConfigError: the number is not 1 to 5.
    """
    if number not in TABLES:
        raise ConfigError(f"table {number} is not a comparison; choose one of {', '.join(map(str, TABLES))}")
    return TABLES[number]
