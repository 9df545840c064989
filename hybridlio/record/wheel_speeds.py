"""Speeds of a vehicle's wheels, or velocities of its body, as smoothing takes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.setting_checks import check_positive, check_setting
from hybridlio.datasets.csv_rows import read_csv

_AXES = ("vx", "vy", "vz")


@dataclass(frozen=True, eq=False)
class WheelSpeeds:
    """Velocities in the axes of the IMU's frame, on the clock of the poses.

    Attributes:
        stamps_ns: ``(N,)`` int64, increasing.
        velocity_m_s: ``(N,)`` forward, along x, as wheels measure it; or ``(N, 3)``, as a Doppler sensor does.
        sigma_m_s: standard deviation of the mean speed from one pose to the next. 0.1 is 1 % of 10 m/s, as a tyre's
            radius varies.
        sideways_sigma_m_s: for forward speeds: of a velocity of zero sideways and up, for a vehicle whose wheels hardly
            slip (non-holonomic constraint); None where it may slip.
        position_m: ``(3,)`` in the IMU frame of the point that has this velocity: for wheels the middle of the axle
            that does not steer.

    Raises:
        DataError: arrays of other shapes, not finite, or stamps that do not increase.
        SettingError: a standard deviation that is not positive, or a position of not three finite numbers.
    """

    stamps_ns: Stamps
    velocity_m_s: Array
    sigma_m_s: float = 0.1
    sideways_sigma_m_s: float | None = None
    position_m: Array | None = None

    def __post_init__(self) -> None:
        stamps, velocity = np.asarray(self.stamps_ns), np.asarray(self.velocity_m_s, np.float64)
        if velocity.shape not in ((len(stamps),), (len(stamps), 3)) or len(stamps) < 2:
            raise DataError(f"wheel speeds: expected (N,) or (N, 3) for N of 2 or more stamps, got {velocity.shape}")
        if not np.isfinite(velocity).all() or (np.diff(stamps) <= 0).any():
            raise DataError("wheel speeds: speeds must be finite, and stamps must increase")
        check_positive(self, "sigma_m_s", *(["sideways_sigma_m_s"] if self.sideways_sigma_m_s is not None else []))
        where = np.zeros(3) if self.position_m is None else np.asarray(self.position_m)
        check_setting(
            self, "position_m", where.shape == (3,) and bool(np.isfinite(where).all()), "three finite numbers"
        )


def read_wheel_speeds(path: Path) -> WheelSpeeds:
    """Read a CSV file with columns ``stamp_ns`` or ``t_s``, ``vx``, and for velocities of three axes ``vy``, ``vz``.

    Raises:
        DataError: a column is missing, a row is malformed, or stamps do not increase; names the file.
    """
    header, rows = read_csv(path)
    time = next((name for name in ("stamp_ns", "t_s") if name in header), None)
    axes = [axis for axis in _AXES if axis in header]
    if time is None or axes not in (["vx"], list(_AXES)):
        found = ", ".join(header)
        raise DataError(f"{path}: the header must name stamp_ns or t_s, and vx or vx, vy, vz; found: {found}")
    columns = [header.index(name) for name in (time, *axes)]
    try:
        texts = [[row[column] for column in columns] for _, row in rows]
        unit = 1 if time == "stamp_ns" else NS_PER_S
        stamps = np.array([round(float(text[0]) * unit) if unit > 1 else int(text[0]) for text in texts], np.int64)
        values = np.array([[float(number) for number in text[1:]] for text in texts]).reshape(-1, len(axes))
        return WheelSpeeds(stamps, values[:, 0] if len(axes) == 1 else values)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: expected numbers ({error})") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
