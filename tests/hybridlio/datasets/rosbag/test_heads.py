"""Opening a bag reads the first bytes of its clouds, and nothing else of them, wherever the storage allows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bags
import pytest

from hybridlio.datasets.rosbag.bag import Bag
from hybridlio.datasets.rosbag.heads import HEAD_BYTES

# name of the bag -> (ROS 2, storage, compression)
FORMATS = {
    "plain.bag": (False, "", ""),
    "lz4.bag": (False, "", "lz4"),
    "sqlite3": (True, "sqlite3", ""),
    "sqlite3-file": (True, "sqlite3", "file"),
    "sqlite3-message": (True, "sqlite3", "message"),
    "mcap": (True, "mcap", ""),
    "mcap-storage": (True, "mcap", "storage"),
}


@pytest.fixture(params=FORMATS)
def bag(request: pytest.FixtureRequest, drive_with_times: Any, tmp_path: Path) -> tuple[str, Bag]:
    is_ros2, storage, compress = FORMATS[request.param]
    maker = bags.Messages(is_ros2)
    path = bags.write(tmp_path / request.param, maker, drive_with_times.messages(maker), storage, compress)
    return request.param, Bag(path)


def test_heads_are_the_starts_of_the_same_messages_in_the_same_order(bag: tuple[str, Bag]) -> None:
    topics = list(bag[1].topics)
    whole = list(bag[1].messages(topics))
    heads = list(bag[1].messages_and_heads(topics, ["/points"]))
    for topic in topics:  # messages of different topics that came at one time may change places
        ours, theirs = ([m for m in messages if m[0] == topic] for messages in (heads, whole))
        assert [at for _, at, _ in ours] == [at for _, at, _ in theirs]
        for (_, _, head), (_, _, raw) in zip(ours, theirs, strict=True):
            assert raw.startswith(head)
            assert len(head) >= (min(HEAD_BYTES, len(raw)) if topic == "/points" else len(raw))
    assert [at for _, at, _ in heads] == [at for _, at, _ in whole]


def test_of_clouds_without_compression_only_heads_are_read(bag: tuple[str, Bag]) -> None:
    name, opened = bag
    if name in ("lz4.bag", "sqlite3-message", "mcap-storage"):
        pytest.skip("compressed data cannot be read in part")
    sizes = {len(raw) for topic, _, raw in opened.messages_and_heads(["/points"], ["/points"])}
    assert sizes == {HEAD_BYTES}


def test_a_topic_that_is_not_asked_for_is_left_out(bag: tuple[str, Bag]) -> None:
    assert {topic for topic, _, _ in bag[1].messages_and_heads(["/points"], ["/points"])} == {"/points"}
