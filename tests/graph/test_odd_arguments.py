"""Whatever is given as a key, pose, noise or name, there is a result or one clear error, and the graph stays."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from graph_calls import CALLS, ODD, content, small_graph

from hybridlio.core.errors import HybridLioError


@pytest.mark.parametrize("name", CALLS)
def test_an_odd_argument_gives_a_result_or_an_error_that_leaves_the_graph_unchanged(name, tmp_path, monkeypatch):
    monkeypatch.chdir(Path(tmp_path))
    graph = small_graph()
    before, same, said = content(graph), [], []
    for value in ODD:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                CALLS[name](graph, value)
            graph = small_graph()
        except HybridLioError as error:
            said.append(str(error))
            same.append(content(graph) == before)
    assert all(same)
    assert not [text for text in said if "\n" in text or not text]
