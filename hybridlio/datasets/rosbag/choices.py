"""Topics and frames of a bag as the user chooses them; quick to import, for the command line's options."""

from __future__ import annotations

from dataclasses import dataclass, fields

from hybridlio.core.errors import ConfigError

NONE = "none"  # an option's value to use no topic of a kind


@dataclass(frozen=True)
class BagTopics:
    """Topics and frames that the user names; None to choose by type, ``none`` to use no such topic.

    Attributes:
        lidar, imu, gps, reference: names of topics.
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
        if self.lidar == NONE:
            raise ConfigError("--lidar-topic: odometry needs a lidar; give the name of its topic")
        for option in fields(self):
            if getattr(self, option.name) == "":
                raise ConfigError(f"{option_of(option.name)}: the name is empty")


NO_CHOICE = BagTopics()


def option_of(name: str) -> str:
    """Return the command line's option for an attribute of :class:`BagTopics`."""
    return f"--{name.replace('_', '-')}" + ("" if name.endswith("_frame") else "-topic")
