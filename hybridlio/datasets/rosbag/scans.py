"""Scans of a bag, read when they are asked for: in order without going back, others from their time of receipt on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_format import PointFormat, StatedFormat, learn_format
from hybridlio.datasets.rosbag.bag import Bag, readable
from hybridlio.datasets.rosbag.clouds import LIVOX_TIMES, Columns, cloud_columns, livox_columns
from hybridlio.datasets.rosbag.topics import LIVOX_TYPES
from hybridlio.datasets.rosbag.wire import read_header

_MAX_SKIPPED = 5  # messages; reading on past them is quicker than to search a place in the bag


@dataclass
class BagScans:
    """Loads scan ``k`` of a bag. Copies in other processes open the bag again.

    Attributes:
        path: the bag.
        topic: the lidar's topic.
        stamps_ns: ``(N,)`` of the scans.
        messages: ``(N,)`` the position of each scan among the topic's messages.
        received_ns: of all messages of the topic.
        has_stamps: whether the stamps are those of the headers.
        bag: the open bag, or None to open it when needed.
        format: how columns are read, found by :meth:`learn`.
    """

    path: Path
    topic: str
    stamps_ns: Stamps
    messages: NDArray[np.intp]
    received_ns: Stamps
    has_stamps: bool
    bag: Bag | None = None
    format: PointFormat = field(default_factory=PointFormat)
    _at: int = 0
    _stream: Iterator[tuple[str, int, bytes]] | None = None
    _lock: Any = field(default_factory=threading.Lock)

    def __call__(self, k: int) -> Scan:
        """Load scan ``k``; a :class:`DataError` names frame and bag."""
        try:
            with self._lock:
                raw = self._message(int(self.messages[k]))
            return self._scan(raw, int(self.stamps_ns[k]))
        except DataError as error:
            self._stream = None
            text = str(error).removeprefix(f"{self.path}: ")
            raise DataError(f"frame {k}: {self.path}, {self.topic}: {text}") from None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "bag": None, "_stream": None, "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock())

    def learn(self, stated: StatedFormat, notes: Notes) -> None:
        """Find how columns are read from some scans, unless the user states it; scans that cannot be read are noted.

        Raises:
            DataError: no scan can be read, or the meaning of a column is not clear.
        """
        if stated.times is None and self._bag().topics[self.topic].type in LIVOX_TYPES:
            stated = replace(stated, times=LIVOX_TIMES)

        def columns_of(k: int) -> Columns:
            try:
                return self.columns(k)
            except DataError as error:
                notes.add(f"frame {k}: {error}")
                raise

        self.format = learn_format(self.stamps_ns, columns_of, notes, stated)

    def columns(self, k: int) -> Columns:
        """Return the columns of scan ``k``, as the message holds them.

        Raises:
            DataError: the message cannot be read.
        """
        with self._lock:
            raw = self._message(int(self.messages[k]))
        return self._columns(raw, int(self.stamps_ns[k]))

    def _columns(self, raw: bytes, stamp_ns: int) -> Columns:
        bag = self._bag()
        if bag.topics[self.topic].type in LIVOX_TYPES:
            return livox_columns(raw, bag.is_ros2, stamp_ns)
        with readable(self.path):  # a damaged definition of the message lacks attributes
            return cloud_columns(bag.decode(self.topic, raw))

    def _scan(self, raw: bytes, stamp_ns: int) -> Scan:
        if self.has_stamps and read_header(raw, self._bag().is_ros2).stamp_ns != stamp_ns:
            raise DataError("the bag has changed since it was opened")
        return self.format.scan(self._columns(raw, stamp_ns), stamp_ns)

    def _bag(self) -> Bag:
        if self.bag is None:
            self.bag = Bag(self.path)
        return self.bag

    def _message(self, position: int) -> bytes:
        """Return the message at a position, and stay behind it."""
        if self._stream is None or not 0 <= position - self._at <= _MAX_SKIPPED:
            start_ns = int(self.received_ns[position])
            # the stream leaves out messages that were received earlier, wherever they stand
            self._at = position - int((self.received_ns[:position] >= start_ns).sum())
            self._stream = self._bag().messages([self.topic], start_ns)
        for _, _, raw in self._stream:
            self._at += 1
            if self._at > position:
                return raw
        self._stream = None
        raise DataError("the message is missing, although the index counts it; the bag is damaged")
