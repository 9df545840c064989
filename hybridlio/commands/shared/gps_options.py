"""Options about GPS fixes that several commands share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.core.errors import ConfigError

if TYPE_CHECKING:
    from hybridlio.core.arrays import Array
    from hybridlio.smoothing.gps_options import GpsOptions

Antenna = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="Position of the GPS antenna in the IMU frame (metres); default: as in the recording, or at the IMU.",
    ),
]
MaxShift = Annotated[
    float | None,
    typer.Option(metavar="S", min=0.0, help="Largest offset between the GPS and lidar clocks (seconds); default 2."),
]
Outages = Annotated[
    list[str] | None,
    typer.Option(
        "--outage",
        metavar="A:B",
        help="Ignore the fixes from A to B seconds after the first scan; may be repeated.",
    ),
]


def gps_options(
    antenna: str | None, max_shift_s: float | None, outages: list[str] | None = None, start_ns: int = 0
) -> GpsOptions:
    """Parse the options; outages count from ``start_ns``.

    Raises:
        ConfigError: an option is malformed.
    """
    from hybridlio.smoothing.gps_alignment import MAX_SHIFT_S
    from hybridlio.smoothing.gps_options import GpsOptions

    return GpsOptions(
        None if antenna is None else _parse_antenna(antenna),
        MAX_SHIFT_S if max_shift_s is None else max_shift_s,
        [_parse_outage(text, start_ns) for text in outages or ()],
    )


def _parse_antenna(text: str) -> Array:
    import numpy as np

    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"--antenna {text!r}: give X,Y,Z in metres, in the IMU frame") from None
    return np.array([x, y, z])


def _parse_outage(text: str, start_ns: int) -> tuple[int, int]:
    from hybridlio.core.sensors import NS_PER_S

    try:
        first, last = (start_ns + round(float(end) * NS_PER_S) for end in text.split(":"))
    except (ValueError, OverflowError):
        raise ConfigError(f"--outage {text!r}: give seconds after the first scan, such as 30:90") from None
    if first >= last:
        raise ConfigError(f"--outage {text!r}: the end must be after the start")
    return first, last
