"""Where a recording was opened, so that a later command can open it again."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets.rosbag.choices import BagTopics


@dataclass(frozen=True)
class Source:
    """The arguments of :func:`hybridlio.datasets.registry.open_sequence`, and the part that was used.

    Attributes:
        path: of the recording or above it, absolute.
        sequence, reader: names, as found.
        raw_root, vertical_angle_deg, topics, rate_hz: as given.
        start, stop: first frame used, and the one after the last; None for all.
        step: every ``step``-th of these is used.
    """

    path: str
    sequence: str
    reader: str
    raw_root: str | None = None
    vertical_angle_deg: float | None = None
    topics: BagTopics = field(default_factory=BagTopics)
    rate_hz: float | None = None
    start: int = 0
    stop: int | None = None
    step: int = 1

    def part(self, start: int, stop: int) -> Source:
        """Return the source of frames ``start`` to ``stop`` (exclusive) of the part that this one names."""
        return replace(self, start=self.start + start * self.step, stop=self.start + stop * self.step)

    def every(self, step: int) -> Source:
        """Return the source of one in ``step`` of the frames that this one names."""
        return replace(self, step=self.step * step)

    def to_json_dict(self) -> dict[str, Any]:
        """Return all attributes as plain values."""
        return asdict(self)

    @classmethod
    def from_json_dict(cls, values: Any) -> Source:
        """Return the source that :meth:`to_json_dict` describes.

        Raises:
            DataError: it is no such description.
        """
        try:
            topics = BagTopics(**values["topics"])
            source = cls(**{**values, "topics": topics})
        except (TypeError, KeyError, ConfigError) as error:
            raise DataError(f"not the description of a recording ({error})") from None
        kinds = {"path": str, "sequence": str, "reader": str, "start": int, "stop": int, "step": int, "raw_root": str}
        for name, kind in kinds.items():
            value = getattr(source, name)
            if not isinstance(value, kind) and not (value is None and name in ("stop", "raw_root")):
                raise DataError(f"not the description of a recording: {name} is {value!r}")
        return source
