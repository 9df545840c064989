from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from hybridlio.simulation.chain import Chain, ChainSettings, make_chain
from hybridlio.simulation.drive.path import SmoothPath


@pytest.fixture(scope="session")
def chain() -> Callable[..., Chain]:
    """Return a function that makes a drive from a seed, an optional path and :class:`ChainSettings` by name."""

    def make(seed: int, path: SmoothPath | None = None, **settings: Any) -> Chain:
        return make_chain(seed, ChainSettings(**settings), path)

    return make
