"""The tree of frames that a bag's ``/tf_static`` and ``/tf`` describe."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError

# A sensor's mount: repeated transforms of the same edge agree to float rounding. Beyond a millimetre or 0.1° it is a
# joint, or the vehicle's motion.
_MAX_SHIFT_M, _MAX_TURN_RAD = 1e-3, 2e-3

MIN_NORM = 1e-6  # of a quaternion: a rotation's is 1, and float32 leaves six digits of it


@dataclass
class _Edge:
    """The pose of a frame in its parent, and whether other values of it have been seen."""

    parent: str
    T_parent_child: Array
    moves: bool = False


@dataclass
class FrameTree:
    """Frames and the fixed transforms between them.

    Attributes:
        edges: the parent of each frame, by the frame's name.
    """

    edges: dict[str, _Edge] = field(default_factory=dict)

    def add(self, message: Any) -> None:
        """Add the transforms of a ``tf2_msgs/TFMessage``.

        Of an edge that repeats the first is kept; it is marked as moving if another differs.

        Raises:
            DataError: a transform is not finite, or its quaternion is zero.
        """
        for stamped in message.transforms:
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            known = self.edges.get(child)
            if known is not None and known.moves:
                continue
            move = stamped.transform
            T = pose_of(move.translation, move.rotation, f"transform from {child!r} to {parent!r}")
            self.connect(parent, child, T)

    def connect(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Add one transform; frames are marked as moving if earlier ones differ, also where they close a loop."""
        known = self.edges.get(child)
        if known is None:
            closed = self._up(parent).get(child)
            self.edges[child] = _Edge(parent, T_parent_child)
            if closed is not None and _differ(se3.inverse(closed), T_parent_child):
                self._loosen(child)
        elif known.parent != parent or _differ(known.T_parent_child, T_parent_child):
            known.moves = True

    def _loosen(self, frame: str) -> None:
        """Mark the frames of the loop through a frame as moving: their transforms contradict each other."""
        while not (edge := self.edges[frame]).moves:
            edge.moves, frame = True, edge.parent

    def find(self, target: str, source: str) -> Array | None:
        """Return ``T_target_source``, ``(4, 4)``; None if frames are unknown, unconnected or move to each other."""
        if target == source:
            return np.eye(4)
        up_target, up_source = self._up(target), self._up(source)
        shared = next((frame for frame in up_source if frame in up_target), None)
        if shared is None:
            return None
        return np.asarray(se3.inverse(up_target[shared]) @ up_source[shared])

    def _up(self, frame: str) -> dict[str, Array]:
        """Return the poses of ``frame`` in itself and each ancestor that it does not move relative to."""
        found, T = {frame: np.eye(4)}, np.eye(4)
        while (edge := self.edges.get(frame)) is not None and not edge.moves and edge.parent not in found:
            T = edge.T_parent_child @ T
            frame = edge.parent
            found[frame] = T
        return found

    def unfixed(self) -> tuple[str, ...]:
        """Return the names of the frames whose pose in their parent changes, or that have several parents, sorted."""
        return tuple(sorted(child for child, edge in self.edges.items() if edge.moves))

    def names(self) -> tuple[str, ...]:
        """Return the names of all frames, sorted."""
        return tuple(sorted({*self.edges, *(edge.parent for edge in self.edges.values())}))


def pose_of(translation: Any, rotation: Any, name: str) -> Array:
    """Return a ``(4, 4)`` pose from a message's vector ``x y z`` and quaternion ``x y z w``.

    Raises:
        DataError: a number is not finite, or the quaternion is zero.
    """
    from scipy.spatial.transform import Rotation

    position = np.array([translation.x, translation.y, translation.z])
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    if not np.isfinite([*position, *quaternion]).all() or not MIN_NORM < np.abs(quaternion).max() < 1 / MIN_NORM:
        raise DataError(f"{name}: expected finite numbers and a quaternion that is not zero")
    return se3.make(Rotation.from_quat(quaternion).as_matrix(), position)


def _differ(a: Array, b: Array) -> bool:
    step = se3.log(se3.inverse(a) @ b)
    return bool(np.linalg.norm(step[3:]) > _MAX_SHIFT_M or np.linalg.norm(step[:3]) > _MAX_TURN_RAD)
