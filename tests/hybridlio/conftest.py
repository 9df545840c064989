"""Fixtures: a simulated drive, its frames, and a finished run over it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import ok

from hybridlio.core.sensors import Frame, ImuNoise
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.source_settings import LstmSettings, NetworkResidualSettings
from hybridlio.odometry.config import Config
from hybridlio.odometry.setup import Setup


@pytest.fixture(scope="session")
def sequence(tiny_drive: Path) -> Sequence:
    return open_sequence(tiny_drive)


@pytest.fixture(scope="session")
def frames(sequence: Sequence) -> list[Frame]:
    """All 25 frames; do not modify them."""
    return list(sequence)


@pytest.fixture(scope="session")
def first_frames(frames: list[Frame]) -> list[Frame]:
    """Eight frames, enough for contract tests."""
    return frames[:8]


@pytest.fixture(scope="session")
def learned_config(untrained_weights: Path) -> Config:
    """A configuration with weights for the drive's lidar; the shipped ones are for another lidar."""
    path = str(untrained_weights)
    return Config(lstm=LstmSettings(path, "cpu"), network=NetworkResidualSettings(path, "cpu", min_cells=200))


@pytest.fixture(scope="session")
def setup(sequence: Sequence, learned_config: Config) -> Setup:
    return Setup(learned_config, sequence.calibration, ImuNoise())


@pytest.fixture
def without_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the report and its plots, which take a second."""
    monkeypatch.setattr("hybridlio.runs.write.write_pages", lambda *_: None)


@pytest.fixture(scope="session")
def finished_run(tiny_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run over the whole drive, without its report; do not modify it."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hybridlio.runs.write.write_pages", lambda *_: None)
        ok("odometry", tiny_drive, "-o", folder)
    return folder


@pytest.fixture
def plain_logging() -> Iterator[None]:
    """Reset the library's logger, which the commands configure."""
    yield
    logger = logging.getLogger("hybridlio")
    logger.handlers.clear()
    logger.setLevel(logging.NOTSET)
    logger.propagate = True
