"""Topics and frames of a bag as the user chooses them; quick to import, for the command line's options."""

from __future__ import annotations

from dataclasses import dataclass, fields

from hybridlio.core.errors import ConfigError

NONE = "none"  # an option's value to use no topic of a kind


@dataclass(frozen=True)
class BagTopics:
    """Topics and frames that the user names; None to choose by type, ``none`` to use no such topic.

    Attributes:
        lidar: name of the topic of clouds, or of several, separated by commas, whose scans are merged.
        imu, gps, reference: names of topics.
        imu_frame, lidar_frame: names of frames, in place of those in the messages' headers.

    Raises:
        ConfigError: the lidar is ``none``, or a name is empty.
    """

    lidar: str | None = None
    imu: str | None = None
    gps: str | None = None
    reference: str | None = None
    imu_frame: str | None = None
    lidar_frame: str | None = None

    def __post_init__(self) -> None:
        if NONE in self.lidars:
            raise ConfigError("--lidar-topic: odometry needs a lidar; give the name of its topic")
        for option in fields(self):
            if getattr(self, option.name) == "":
                raise ConfigError(f"{option_of(option.name)}: the name is empty")
        if "" in self.lidars or len(set(self.lidars)) < len(self.lidars):
            raise ConfigError(f"--lidar-topic {self.lidar}: give different names")

    @property
    def lidars(self) -> tuple[str, ...]:
        """Names of the lidars' topics, the first one first; none to choose by type."""
        return () if self.lidar is None else tuple(name.strip() for name in self.lidar.split(","))


NO_CHOICE = BagTopics()


def option_of(name: str) -> str:
    """Return the command line's option for an attribute of :class:`BagTopics`."""
    return f"--{name.replace('_', '-')}" + ("" if name.endswith("_frame") else "-topic")
