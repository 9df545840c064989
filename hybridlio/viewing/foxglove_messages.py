"""Poses, clouds and drawings as Foxglove's messages, which its panels show without plugins or ROS."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats
from hybridlio.core.errors import MissingDependencyError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.viewing.colours import Colour
from hybridlio.viewing.scene import ViewedScan

WORLD, LIDAR, IMU, ENU = "map", "lidar", "imu", "enu"  # frames; the first as ROS names it (REP 105)
_FLOAT_BYTES = 4


def import_foxglove() -> Any:
    """Return the module ``foxglove``.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import foxglove
        import foxglove.messages
    except ImportError as error:
        raise MissingDependencyError("MCAP files need Foxglove's SDK: pip install 'hybridlio[foxglove]'") from error
    return foxglove


class Messages:
    """Makes Foxglove's messages."""

    def __init__(self) -> None:
        self._fox: Any = import_foxglove().messages

    def stamp(self, stamp_ns: int) -> Any:
        """Return a time."""
        return self._fox.Timestamp(*divmod(stamp_ns, NS_PER_S))

    def transform(self, stamp_ns: int, parent: str, child: str, T_parent_child: Array) -> Any:
        """Return the pose ``(4, 4)`` of a frame in its parent."""
        x, y, z, w = Rotation.from_matrix(T_parent_child[:3, :3]).as_quat().tolist()
        return self._fox.FrameTransform(
            timestamp=self.stamp(stamp_ns),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=self._fox.Vector3(**_xyz(T_parent_child[:3, 3])),
            rotation=self._fox.Quaternion(x=x, y=y, z=z, w=w),
        )

    def odometry(self, scan: ViewedScan) -> Any:
        """Return a scan's pose with its covariance, and its velocity where that is known."""
        R, fox = scan.pose[:3, :3], self._fox
        # Foxglove has the position first, and errors along the axes of the parent frame as ROS has them; ours are of a
        # right perturbation, along the lidar's axes, rotation first.
        turn = np.zeros((6, 6))
        turn[:3, 3:] = turn[3:, :3] = R
        covariance = turn @ scan.covariance @ turn.T
        known = scan.inertial
        velocity = None if known is None else fox.Vector3(**_xyz(R.T @ known.velocity_m_s))
        return fox.Odometry(
            timestamp=self.stamp(scan.stamp_ns),
            frame_id=WORLD,
            body_frame_id=LIDAR,
            pose=self.pose(scan.pose),
            linear_velocity=velocity,
            pose_covariance=covariance.ravel().tolist(),
        )

    def pose(self, T: Array) -> Any:
        """Return a pose ``(4, 4)``."""
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        orientation = self._fox.Quaternion(x=x, y=y, z=z, w=w)
        return self._fox.Pose(position=self._fox.Vector3(**_xyz(T[:3, 3])), orientation=orientation)

    def stamped_pose(self, stamp_ns: int, T: Array) -> Any:
        """Return a pose ``(4, 4)`` in the world."""
        return self._fox.PoseInFrame(timestamp=self.stamp(stamp_ns), frame_id=WORLD, pose=self.pose(T))

    def path(self, stamp_ns: int, poses: Array) -> Any:
        """Return poses ``(N, 4, 4)`` in the world."""
        return self._fox.PosesInFrame(
            timestamp=self.stamp(stamp_ns), frame_id=WORLD, poses=[self.pose(T) for T in poses]
        )

    def cloud(self, stamp_ns: int, frame: str, points: Floats) -> Any:
        """Return points ``(N, 3)``."""
        fox = self._fox
        kind = fox.PackedElementFieldNumericType.Float32
        fields = [fox.PackedElementField(name=name, offset=k * _FLOAT_BYTES, type=kind) for k, name in enumerate("xyz")]
        return fox.PointCloud(
            timestamp=self.stamp(stamp_ns),
            frame_id=frame,
            pose=self.pose(np.eye(4)),
            point_stride=3 * _FLOAT_BYTES,
            fields=fields,
            data=np.ascontiguousarray(points, dtype="<f4").tobytes(),
        )

    def lines(
        self, stamp_ns: int, name: str, points: Array, colours: Iterable[Sequence[int]], strip: bool = False
    ) -> Any:
        """Return lines in the world.

        Args:
            stamp_ns: when they are drawn; they stay.
            name: replaces what was drawn under the same name.
            points: ``(N, 3)``, the ends of ``N/2`` lines, or the corners of one with ``strip``.
            colours: one for each point.
            strip: whether it is one line.
        """
        fox = self._fox
        kind = fox.LinePrimitiveLineType.LineStrip if strip else fox.LinePrimitiveLineType.LineList
        line = fox.LinePrimitive(
            type=kind,
            pose=self.pose(np.eye(4)),
            thickness=2.0,
            scale_invariant=True,
            points=[fox.Point3(**_xyz(at)) for at in points],
            colors=[self._colour(colour) for colour in colours],
        )
        return self._drawn(stamp_ns, name, lines=[line])

    def ellipsoid(self, scan: ViewedScan, sigmas: float, colour: Sequence[int]) -> Any:
        """Return the ellipsoid of a position's covariance, of some standard deviations."""
        variances, axes = np.linalg.eigh(scan.covariance[3:, 3:])
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        pose = se3.make(scan.pose[:3, :3] @ axes, scan.pose[:3, 3])
        size = self._fox.Vector3(**_xyz(2 * sigmas * np.sqrt(np.maximum(variances, 0.0))))
        sphere = self._fox.SpherePrimitive(pose=self.pose(pose), size=size, color=self._colour(colour, 0.5))
        return self._drawn(scan.stamp_ns, f"covariance of scan {scan.index}", spheres=[sphere])

    def mark(self, scan: ViewedScan, colour: Colour) -> Any:
        """Return a ball where a scan was taken."""
        size = self._fox.Vector3(x=0.5, y=0.5, z=0.5)
        sphere = self._fox.SpherePrimitive(pose=self.pose(scan.pose), size=size, color=self._colour(colour))
        return self._drawn(scan.stamp_ns, f"{scan.support}, scan {scan.index}", spheres=[sphere])

    def fix(self, stamp_ns: int, geodetic: Array, sigma_m: float) -> Any:
        """Return a GPS fix: latitude, longitude (degrees) and height, with a standard deviation of all axes."""
        fox = self._fox
        return fox.LocationFix(
            timestamp=self.stamp(stamp_ns),
            frame_id=ENU,
            latitude=float(geodetic[0]),
            longitude=float(geodetic[1]),
            altitude=float(geodetic[2]),
            position_covariance=(np.eye(3) * sigma_m**2 / 3).ravel().tolist(),
            position_covariance_type=fox.LocationFixPositionCovarianceType.Approximated,
        )

    def log(self, stamp_ns: int, text: str, is_warning: bool) -> Any:
        """Return a line for the log panel."""
        level = self._fox.LogLevel.Warning if is_warning else self._fox.LogLevel.Info
        return self._fox.Log(timestamp=self.stamp(stamp_ns), level=level, message=text, name="hybridlio")

    def _drawn(self, stamp_ns: int, name: str, **primitives: Any) -> Any:
        fox = self._fox
        entity = fox.SceneEntity(timestamp=self.stamp(stamp_ns), frame_id=WORLD, id=name, **primitives)
        return fox.SceneUpdate(entities=[entity])

    def _colour(self, colour: Sequence[int], alpha: float = 1.0) -> Any:
        r, g, b = (float(value) / 255 for value in colour)
        return self._fox.Color(r=r, g=g, b=b, a=alpha)


def _xyz(values: Array) -> dict[str, float]:
    x, y, z = map(float, values)
    return {"x": x, "y": y, "z": z}
