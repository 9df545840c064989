"""Where a bag's sensors are mounted: by ``calibration.yaml`` beside it, or by its tree of frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Calibration
from hybridlio.datasets.calibration_yaml import StatedCalibration
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.rosbag.bag import Bag, Topic, readable
from hybridlio.datasets.rosbag.choices import BagTopics
from hybridlio.datasets.rosbag.known import KnownBag
from hybridlio.datasets.rosbag.topics import TRANSFORM_TYPES
from hybridlio.datasets.rosbag.transforms import FrameTree

_MATRIX = "T_imu_lidar:\n  - [1, 0, 0, 0.1]\n  - [0, 1, 0, 0.0]\n  - [0, 0, 1, 0.3]\n  - [0, 0, 0, 1]"
_FRAMES_LISTED = 12  # in an error: more frames no longer fit three lines of 80 columns


@dataclass
class Mounting:
    """Frames of the sensors and the transforms between them.

    Attributes:
        bag: the bag, to read ``/tf`` from if ``/tf_static`` does not suffice.
        tree: the frames of ``/tf_static``; those of ``/tf`` are added when needed.
        wanted: frames that the user names.
        frames: frames of the messages' headers, by kind of topic.
        notes: receives what is assumed.
        known: the published data set that the bag is of, or None.
    """

    bag: Bag
    tree: FrameTree
    wanted: BagTopics
    frames: dict[str, str]
    notes: Notes
    known: KnownBag | None = None
    _has_moving: bool = False

    @property
    def lidar_frame(self) -> str:
        """The lidar's frame: the user's, or that of the messages."""
        return (self.wanted.lidar_frame or self.frames.get("lidar", "")).lstrip("/")

    @property
    def imu_frame(self) -> str:
        """The IMU's frame: the user's, or that of the messages."""
        return (self.wanted.imu_frame or self.frames.get("imu", "")).lstrip("/")

    def calibration(self, stated: StatedCalibration, has_imu: bool, has_gps: bool) -> Calibration:
        """Return the extrinsics: those that ``calibration.yaml`` gives and, without ``T_imu_lidar`` in it, the frames'.

        Raises:
            DataError: there is an IMU and no transform.
        """
        given = stated.calibration
        T_imu_lidar = given.T_imu_lidar
        if has_imu and "T_imu_lidar" not in stated.keys:
            T_imu_lidar = self._imu_lidar(calibration_file(self.bag.path))
        antenna = given.antenna_imu_m
        if antenna is None and has_gps and has_imu:
            T_imu_gps = self.find(self.imu_frame, self.frames.get("gps", ""))
            antenna = None if T_imu_gps is None else T_imu_gps[:3, 3]
        return Calibration(T_imu_lidar, given.T_camera_lidar, antenna)

    def lidar_other(self, frame: str, name: str, stated: StatedCalibration) -> Array:
        """Return ``T_first_other`` of another lidar: what ``calibration.yaml`` states for its topic, or by the frames.

        Raises:
            DataError: neither gives it.
        """
        given = stated.lidars.get(name)
        T = given if given is not None else self.find(self.lidar_frame, frame)
        if T is None:
            raise DataError(
                f"{self.bag.path}: no fixed transform between the lidars' frames {self.lidar_frame!r} and {frame!r}; "
                f"write the pose of {name} in the first lidar's frame to {calibration_file(self.bag.path)}:\n"
                f"lidars:\n  {name}: {{translation: [0.0, 1.2, 0.0], roll_pitch_yaw_deg: [0, 0, 90]}}"
            )
        if given is None and frame == self.lidar_frame:
            self.notes.add(f"{name} has the frame of the first lidar, {frame!r}: its points are taken as they are")
        return T

    def body_lidar(self, body_frame: str, topic: Topic, calibration: Calibration) -> Array:
        """Return ``T_body_lidar`` of the frame whose poses a reference topic gives; what is assumed is noted."""
        found = self.find(body_frame, self.lidar_frame) if body_frame else None
        if found is not None:
            self.notes.add(
                f"reference poses: {topic.name} ({topic.type}), of the frame {body_frame!r}; if they are the robot's "
                "own estimate and no truth, leave them out with --reference-topic none"
            )
            return found
        why = f"no transform from {body_frame!r} to the lidar is known" if body_frame else "it names no body frame"
        self.notes.add(f"reference poses: {topic.name} ({topic.type}); {why}: they are taken as the IMU's poses")
        return calibration.T_imu_lidar

    def find(self, target: str, source: str) -> Array | None:
        """Return ``T_target_source`` by the frames of the bag, or None."""
        if not target or not source:
            return None
        T = self.tree.find(target, source)
        if T is None and not self._has_moving:
            self._has_moving = True
            names = [t.name for t in self.bag.topics.values() if t.type in TRANSFORM_TYPES]
            for name, _, raw in self.bag.messages([name for name in names if not name.endswith("_static")]):
                with readable(self.bag.path):
                    self.tree.add(self.bag.decode(name, raw))
            T = self.tree.find(target, source)
        return T

    def _imu_lidar(self, file: Path) -> Array:
        imu, lidar = self.imu_frame, self.lidar_frame
        T = self.find(imu, lidar) if self.known is None or imu != lidar else None
        if T is None and self.known is not None:
            self.notes.found(f"T_imu_lidar is that which is published for {self.known.name}")
            return self.known.T_imu_lidar
        if T is None:
            raise DataError(self._unknown(imu, lidar, file))
        if imu == lidar:
            self.notes.add(
                f"IMU and lidar have the same frame {imu!r}: T_imu_lidar is taken as the identity; if they are mounted "
                f"apart, write it to {file}"
            )
        return np.asarray(T)

    def _unknown(self, imu: str, lidar: str, file: Path) -> str:
        names = self.tree.names()
        listed = ", ".join(names[:_FRAMES_LISTED]) + (", …" if len(names) > _FRAMES_LISTED else "")
        known = f"the frames of /tf_static and /tf are: {listed}" if names else "the bag has no /tf_static and no /tf"
        if loose := self.tree.unfixed():
            known += f"; not fixed, as they move or have several parents: {', '.join(loose[:_FRAMES_LISTED])}"
        empty = [option for option, frame in (("--imu-frame", imu), ("--lidar-frame", lidar)) if not frame]
        why = f"messages name no frame, give {' and '.join(empty)}" if empty else known
        return (
            f"{self.bag.path}: no fixed transform between the IMU's frame {imu!r} and the lidar's frame {lidar!r}; "
            f"{why}. Name other frames with --imu-frame and --lidar-frame, or write the transform, which maps lidar "
            f"points into the IMU's frame, to {file}:\n{_MATRIX}"
        )


def calibration_file(path: Path) -> Path:
    """Return where the ``calibration.yaml`` of a bag belongs: in its folder, or beside its file."""
    return (path if path.is_dir() else path.parent) / "calibration.yaml"
