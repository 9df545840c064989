"""Opening a bag reads the first bytes of its clouds, and little else of them, wherever the storage allows it."""

from __future__ import annotations

import bz2
import io
from pathlib import Path
from typing import Any

import bags
import lz4.frame
import numpy as np
import pytest

from hybridlio.datasets.rosbag.bag import Bag
from hybridlio.datasets.rosbag.chunk_start import ChunkStart
from hybridlio.datasets.rosbag.heads import HEAD_BYTES

# name of the bag -> (ROS 2, storage, compression)
FORMATS = {
    "plain.bag": (False, "", ""),
    "lz4.bag": (False, "", "lz4"),
    "bz2.bag": (False, "", "bz2"),
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
    content = list(drive_with_times.messages(maker))
    content = content[:60] if compress == "bz2" else content  # bzip2 is slow
    path = bags.write(tmp_path / request.param, maker, content, storage, compress)
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


def test_of_clouds_only_heads_are_read(bag: tuple[str, Bag]) -> None:
    name, opened = bag
    if name == "sqlite3-message":
        pytest.skip("a message that is compressed by itself is read whole")
    sizes = {len(raw) for topic, _, raw in opened.messages_and_heads(["/points"], ["/points"])}
    assert sizes == {HEAD_BYTES}


def test_the_rate_of_a_topic_is_that_between_its_own_first_and_last_message(bag: tuple[str, Bag]) -> None:
    received: dict[str, list[int]] = {}
    for topic, at, _ in bag[1].messages(list(bag[1].topics)):
        received.setdefault(topic, []).append(at)
    for name, topic in bag[1].topics.items():
        span_s = (max(received[name]) - min(received[name])) / 1e9
        assert topic.rate_hz == pytest.approx((topic.count - 1) / span_s if span_s else 0.0)


def test_a_topic_that_is_not_asked_for_is_left_out(bag: tuple[str, Bag]) -> None:
    assert {topic for topic, _, _ in bag[1].messages_and_heads(["/points"], ["/points"])} == {"/points"}


@pytest.mark.parametrize("kind", ["lz4", "bz2"])
def test_a_compressed_chunk_is_decompressed_no_farther_than_it_is_read(kind: str) -> None:
    data = np.random.default_rng(0).bytes(3_000_000)
    compress, make = {
        "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
        "bz2": (bz2.compress, bz2.BZ2Decompressor),
    }[kind]
    packed = compress(data)
    file = io.BytesIO(b"before" + packed + b"after")
    start = ChunkStart(file, 6, len(packed), make())
    start.seek(100)
    assert start.read(1000) == data[100:1100]
    assert file.tell() < len(packed) / 2  # bzip2's blocks are of 900 kB
    start.seek(50, 1)
    assert start.read(10**9) == data[1150:]
    assert start.read(5) == b""
    start.seek(0)
    assert start.read(10) == data[:10]
