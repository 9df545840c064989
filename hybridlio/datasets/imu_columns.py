"""Columns of an IMU's CSV file: the names and units that recorders and data sets give them.

Known are the names of this project (``gx_deg_s``), of EuRoC (``w_RS_S_x [rad s^-1]``), of ``rostopic echo -p`` and
other exports of ROS messages (``field.angular_velocity.x``, ``header.stamp.secs``), and the usual ones (``gyro_x``,
``acc_x (g)``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridlio.datasets.csv_times import ColumnError, TimeColumn, name_and_unit, plain_name, time_column

STANDARD_GRAVITY_M_S2 = 9.80665  # the unit g, by definition; not the gravity of a place

_GYRO = "gyroscope|gyro|gyr|angularvelocity|angvel|angularrate|rotationrate|omega|wrss|w|g"
_ACCEL = "linearacceleration|linacc|acceleration|accelerometer|accel|acc|specificforce|arss|a"
_AXIS = re.compile(rf"(?P<gyro>{_GYRO})(?P<axis>[xyz])|(?P<accel>{_ACCEL})(?P<axis2>[xyz])")
_UNITS = "rad_s|deg_s|dps|mdps|mrad_s|m_s2|g|mg"  # at the end of a name
_RATES = {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": np.pi / 180, "mdeg/s": np.pi / 180_000}
_FORCES = {"m/s2": 1.0, "g": STANDARD_GRAVITY_M_S2, "mg": STANDARD_GRAVITY_M_S2 * 1e-3}
_SAME = {
    **{"rad_s": "rad/s", "rads-1": "rad/s", "rad/sec": "rad/s", "mrad_s": "mrad/s", "deg_s": "deg/s", "°/s": "deg/s"},
    **{"dps": "deg/s", "deg/sec": "deg/s", "degs-1": "deg/s", "mdps": "mdeg/s", "m_s2": "m/s2", "ms-2": "m/s2"},
    **{"m/s/s": "m/s2", "m/sec2": "m/s2", "g's": "g", "gs": "g"},
}


@dataclass(frozen=True)
class ImuColumns:
    """Where the values are in a row.

    Attributes:
        time: of the samples.
        values: for gx gy gz ax ay az the column and the factor to rad/s or m/s²; None if the header gives no unit.
    """

    time: TimeColumn
    values: tuple[tuple[int, float | None], ...]


def imu_columns(header: Sequence[str]) -> ImuColumns:
    """Find the columns of an IMU's CSV file.

    Raises:
        ColumnError: a column is missing, or a unit is unknown.
    """
    found: dict[str, tuple[int, float | None]] = {}
    for column, name in enumerate(header):
        known = _axis(name)
        if known is None or (known[0] in found and _is_linear(name)):
            continue
        if known[0] in found and not _is_linear(header[found[known[0]][0]]):
            raise ColumnError(f"has {known[0]} twice, as '{header[found[known[0]][0]]}' and '{name}'; keep one of them")
        found[known[0]] = column, known[1]
    lacking = [kind + axis for kind in "ga" for axis in "xyz" if kind + axis not in found]
    if lacking:
        raise ColumnError(f"lacks {', '.join(lacking)}")
    return ImuColumns(time_column(header), tuple(found[kind + axis] for kind in "ga" for axis in "xyz"))


def _is_linear(name: str) -> bool:
    """Return whether a column is of a linear acceleration, which beside another one is that without gravity."""
    return plain_name(name).startswith("lin")


def _axis(name: str) -> tuple[str, float | None] | None:
    """Return which of gx gy gz ax ay az a column is, and its factor; None for another column."""
    base, unit = name_and_unit(name, _UNITS)
    match = _AXIS.fullmatch(base)
    if match is None:
        return None
    kind, units = ("g", _RATES) if match["gyro"] else ("a", _FORCES)
    if unit is None:
        return kind + match["axis" if kind == "g" else "axis2"], None
    plain = re.sub(r"[\s^*·]", "", unit).replace("²", "2").replace("⁻¹", "-1").replace("⁻2", "-2")
    plain = _SAME.get(plain, plain)
    if plain not in units:
        raise ColumnError(f"has the unknown unit '{unit}' in '{name}'; known: {', '.join(units)}")
    return kind + match["axis" if kind == "g" else "axis2"], units[plain]
