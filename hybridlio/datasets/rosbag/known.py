"""Published data sets whose bags have fixed topics, and extrinsics that the bags lack.

Facts are the publishers', as evalio (github.com/contagon/evalio) gathers and its pipelines use them, and Ouster's
hardware manual for an Ouster's own IMU. A transform that the bag itself holds comes first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.rosbag.bag import Bag
from hybridlio.datasets.rosbag.choices import NONE, BagTopics


@dataclass(frozen=True, eq=False)
class KnownBag:
    """A data set as its bags show it.

    Attributes:
        name: for notes.
        lidar, imu: the topics to use.
        others: beginnings of the names of topics that its bags hold besides, each at least once.
        T_imu_lidar: ``(4, 4)``.
        reference: the topic of reference poses, ``none`` where topics of their type hold none; None to choose by type.
    """

    name: str
    lidar: str
    imu: str
    others: tuple[str, ...]
    T_imu_lidar: Array
    reference: str | None = None

    def fits(self, bag: Bag) -> bool:
        """Return whether a bag is of this data set."""
        names = bag.topics.keys()
        return {self.lidar, self.imu} <= names and all(any(n.startswith(o) for n in names) for o in self.others)

    def filled(self, wanted: BagTopics) -> BagTopics:
        """Return the topics that the user names, and those of the data set where he names none."""
        return replace(
            wanted,
            lidar=wanted.lidar or self.lidar,
            imu=wanted.imu or self.imu,
            reference=wanted.reference or self.reference,
        )


def _pose(quaternion_xyzw: list[float], position: list[float]) -> Array:
    return se3.make(Rotation.from_quat(quaternion_xyzw).as_matrix(), position)


_SPIRES_CAM_LIDAR = _pose(
    [0.5023769275907106, 0.49990425097844265, -0.49648618825384844, 0.5012131556048427],
    [0.003242860366163889, -0.07368532755947366, -0.05485800045216396],
)
_SPIRES_CAM_IMU = _pose(
    [-0.003150684959962717, 0.7095105504964175, -0.7046875827967661, 0.0005124164367280889],
    [-0.005000230026155717, -0.0031440163748744266, -0.07336562959794378],
)
# github.com/Hilti-Research/hilti-slam-challenge-2023: documentation/hardware/Robot.md, groundtruth_2023
_HILTI_ROBOT_LIDAR_IMU = np.array(
    [
        [0.9993809082422996, -0.003397272928783347, 0.03501797791768812, -0.13406141062872667],
        [-0.0036988105559615262, -0.9999566093030182, 0.008549755065630918, -0.010899820828818012],
        [0.03498741261178718, -0.0086739868491098, -0.9993501102771111, 0.006109253103427932],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
# The IMU in the sensor's frame, in which later drivers publish points. The driver of 2020 publishes them in the
# lidar's frame, which is turned by 180° about z and 36.18 mm higher.
_T_OUSTER_IMU_SENSOR = se3.make(np.eye(3), [-0.006253, 0.011775, -0.007645])
_T_OUSTER_SENSOR_LIDAR = se3.make(np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 0.03618])
KNOWN = (
    KnownBag(
        "Newer College 2020",
        "/os1_cloud_node/points",
        "/os1_cloud_node/imu",
        ("/camera/",),
        np.asarray(_T_OUSTER_IMU_SENSOR @ _T_OUSTER_SENSOR_LIDAR),
    ),
    KnownBag(
        "Newer College 2021",
        "/os_cloud_node/points",
        "/os_cloud_node/imu",
        ("/alphasense_driver_ros/",),
        _pose([0.0032925, -0.004627, -0.0024302, 0.99998], [0.013801, -0.012207, -0.01514]),
    ),
    KnownBag(
        "Hilti 2021", "/os_cloud_node/points", "/os_cloud_node/imu", ("/alphasense/", "/livox/"), _T_OUSTER_IMU_SENSOR
    ),
    KnownBag(
        "Hilti 2022 and 2023 (handheld)",
        "/hesai/pandar",
        "/alphasense/imu",
        (),
        _pose([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0], [-0.001, -0.00855, 0.055]),
    ),
    KnownBag(
        "Hilti 2023 (robot)",
        "/rslidar_points",
        "/imu/data",
        ("/oak_cam_", "/track_odometry"),
        se3.inverse(_HILTI_ROBOT_LIDAR_IMU),
        reference=NONE,  # its odometry is that of the tracks
    ),
    KnownBag(
        "Oxford Spires",
        "/hesai/pandar",
        "/alphasense_driver_ros/imu",
        (),
        np.asarray(se3.inverse(_SPIRES_CAM_IMU) @ _SPIRES_CAM_LIDAR),
    ),
)


def known_bag(bag: Bag, wanted: BagTopics, notes: Notes) -> KnownBag | None:
    """Return the data set that a bag is of, and note it; None for other bags, or if the user wants other topics."""
    found = next((known for known in KNOWN if known.fits(bag)), None)
    if found is None or {wanted.lidar, wanted.imu} - {None, found.lidar, found.imu}:
        return None
    notes.found(f"topics are those of {found.name}: {found.lidar} and {found.imu} are used")
    return found
