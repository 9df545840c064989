"""Warnings about intermediate results are held back, those of the last are shown, and nothing else is touched."""

from __future__ import annotations

import logging
import threading

import pytest

from hybridlio.runs.run_log import HeldBack

_log = logging.getLogger("hybridlio.somewhere")


def test_warnings_are_shown_when_asked_for_and_once(caplog):
    with HeldBack() as first:
        _log.warning("of the first round")
    with HeldBack() as last:
        _log.warning("of the last round")
    assert not caplog.records
    last.show()
    last.show()
    assert [record.getMessage() for record in caplog.records] == ["of the last round"]
    del first


def test_errors_notes_and_other_threads_are_not_held_back(caplog):
    caplog.set_level(logging.INFO, "hybridlio")
    with HeldBack():
        _log.info("a note")
        _log.error("an error")
        other = threading.Thread(target=_log.warning, args=("of another thread",))
        other.start()
        other.join()
    assert [record.getMessage() for record in caplog.records] == ["a note", "an error", "of another thread"]


def test_where_a_round_fails_its_warnings_are_shown(caplog):
    def fail() -> None:
        with HeldBack():
            _log.warning("the reason")
            raise ValueError("failed")

    with pytest.raises(ValueError, match="failed"):
        fail()
    assert [record.getMessage() for record in caplog.records] == ["the reason"]
    _log.warning("afterwards")
    assert len(caplog.records) == 2
