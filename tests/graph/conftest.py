from __future__ import annotations

from collections.abc import Callable

import pytest

from hybridlio.simulation.chain import Chain, make_chain


@pytest.fixture(scope="session")
def chain() -> Callable[..., Chain]:
    """Return :func:`make_chain`, which makes drives."""
    return make_chain
