"""Options about GPS fixes, of the commands that use them."""

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
        metavar="X,Y,Z", help="The GPS antenna in the IMU's frame (metres); by default the recording's, or at the IMU."
    ),
]
MaxShift = Annotated[
    float | None,
    typer.Option(
        metavar="S", min=0.0, help="The clocks of fixes and scans are no farther apart (seconds); by default 2."
    ),
]
Outages = Annotated[
    list[str] | None,
    typer.Option(
        "--outage", metavar="A:B", help="Leave out fixes from A to B seconds after the first scan; may be repeated."
    ),
]


def gps_options(
    antenna: str | None, max_shift_s: float | None, outages: list[str] | None = None, start_ns: int = 0
) -> GpsOptions:
    """How fixes are used, of what was typed; outages are counted from ``start_ns``.

    Raises:
        ConfigError: an option is malformed.
    """
    from hybridlio.smoothing.gps_alignment import MAX_SHIFT_S
    from hybridlio.smoothing.gps_options import GpsOptions

    return GpsOptions(
        None if antenna is None else _antenna(antenna),
        MAX_SHIFT_S if max_shift_s is None else max_shift_s,
        [_outage(text, start_ns) for text in outages or ()],
    )


def _antenna(text: str) -> Array:
    import numpy as np

    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"--antenna {text!r}: give X,Y,Z in metres, in the IMU's frame") from None
    return np.array([x, y, z])


def _outage(text: str, start_ns: int) -> tuple[int, int]:
    try:
        first, last = (start_ns + round(float(end) * 1e9) for end in text.split(":"))
    except (ValueError, OverflowError):
        raise ConfigError(f"--outage {text!r}: give seconds after the first scan, such as 30:90") from None
    if first >= last:
        raise ConfigError(f"--outage {text!r}: its end is not after its start")
    return first, last
