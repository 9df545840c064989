"""Forms in which people write a rigid transform in a YAML file.

* four rows of four numbers;
* a mapping of ``translation`` in metres and one rotation: ``quaternion_xyzw``, ``quaternion_wxyz``,
  ``roll_pitch_yaw_deg`` or ``roll_pitch_yaw_rad`` (R = Rz(yaw) Ry(pitch) Rx(roll), as ROS has it), or ``rotation``,
  three rows of three numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError

HOW_TO_WRITE = (
    "write the transform T_imu_lidar, which maps lidar points into the IMU's frame, such as\n"
    "T_imu_lidar:\n  - [1, 0, 0, 0.1]\n  - [0, 1, 0, 0.0]\n  - [0, 0, 1, 0.3]\n  - [0, 0, 0, 1]"
)
ROTATIONS = ("quaternion_xyzw", "quaternion_wxyz", "roll_pitch_yaw_deg", "roll_pitch_yaw_rad", "rotation")

_MAX_ANGLE_RAD = 6.3  # a whole turn, and rounding
_MAX_NORM_ERROR = 1e-2  # of a quaternion; two decimals of each number keep it below


def parse_transform(name: str, value: Any) -> Array:
    """Return the transform ``(4, 4)`` that a YAML value states.

    Args:
        name: the key, for messages.
        value: in one of the forms above.

    Raises:
        DataError: the value has none of the forms, or is not rigid.
    """
    if isinstance(value, dict):
        return _from_parts(name, value)
    matrix = _numbers(value)
    if matrix.shape == (7,):
        raise DataError(
            f"{name}: seven numbers do not say the order of the quaternion; write 'translation: [x, y, z]' and "
            "'quaternion_xyzw: […]' or 'quaternion_wxyz: […]'"
        )
    if matrix.shape != (4, 4):
        raise DataError(f"{name} must be four rows of four numbers, or translation and rotation; {HOW_TO_WRITE}")
    return se3.check_pose(matrix, name)


def _from_parts(name: str, parts: dict[str, Any]) -> Array:
    stated = [key for key in ROTATIONS if key in parts]
    if len(stated) != 1 or set(parts) != {"translation", *stated}:
        raise DataError(
            f"{name}: expected 'translation' and one of {', '.join(ROTATIONS)}; found {', '.join(map(str, parts))}"
        )
    kind = stated[0]
    translation, numbers = _numbers(parts["translation"]), _numbers(parts[kind])
    if translation.shape != (3,):
        raise DataError(f"{name}: translation must be three numbers in metres")
    size = {"quaternion_xyzw": 4, "quaternion_wxyz": 4, "rotation": 9}.get(kind, 3)
    if numbers.size != size or not np.isfinite(numbers).all():
        raise DataError(f"{name}: {kind} must be {size} finite numbers")
    return se3.check_pose(se3.make(_rotation(name, kind, numbers.ravel()), translation), name)


def _rotation(name: str, kind: str, numbers: Array) -> Array:
    from scipy.spatial.transform import Rotation

    if kind == "rotation":
        return numbers.reshape(3, 3)
    if kind == "roll_pitch_yaw_rad" and np.abs(numbers).max() > _MAX_ANGLE_RAD:
        raise DataError(f"{name}: {kind} has an angle beyond a whole turn; for degrees write roll_pitch_yaw_deg")
    if kind.startswith("roll"):
        return np.asarray(Rotation.from_euler("ZYX", numbers[::-1], degrees=kind.endswith("deg")).as_matrix())
    norm = float(np.linalg.norm(numbers))
    if abs(norm - 1) > _MAX_NORM_ERROR:
        raise DataError(f"{name}: {kind} has the norm {norm:.3f}; a rotation has 1")
    return np.asarray(Rotation.from_quat(numbers if kind == "quaternion_xyzw" else np.roll(numbers, -1)).as_matrix())


def _numbers(value: Any) -> Array:
    try:
        return np.array(value, dtype=np.float64)
    except (ValueError, TypeError):
        return np.empty(0)
