"""Write a run as an MCAP file for Foxglove.

The messages are Foxglove's own (``foxglove.FrameTransform``, ``PointCloud``, ``Odometry``, …) in Protobuf: Foxglove
shows them without plugins, they carry their schema, and they do not depend on a ROS distribution as ROS's would.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import atomic_path, user_path
from hybridlio.core.geodesy import geodetic_from_enu
from hybridlio.core.progress import Progress
from hybridlio.runs.run import Run
from hybridlio.viewing import colours
from hybridlio.viewing.foxglove_messages import ENU, LIDAR, WORLD, Messages, import_foxglove
from hybridlio.viewing.run_scene import scene_of
from hybridlio.viewing.scene import SUPPORTED, Scene, ViewedScan

SUFFIX = ".mcap"
_MAP_POINTS = 1_000_000  # in the one message of the map: 12 MB, which Foxglove draws fluently
_ELLIPSOID_SIGMAS, _ELLIPSOID_EVERY_M = 3.0, 5.0
# The curves for Foxglove's plots; a message lacks what is not known.
_NUMBER = {"type": "number"}
_VECTOR = {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)}
_NUMBERS = ("position_sigma_m", "rotation_sigma_deg", "residual_m", "residual_deg", "innovation", "speed_m_s")
_VECTORS = ("accel_bias_m_s2", "gyro_bias_rad_s")
_DIAGNOSTICS: dict[str, Any] = {
    "type": "object",
    "title": "hybridlio.Diagnostics",
    "properties": {"scan": {"type": "integer"}, "support": {"type": "string"}}
    | dict.fromkeys(_NUMBERS, _NUMBER)
    | dict.fromkeys(_VECTORS, _VECTOR),
}


def export_mcap(
    run: str | Path | Run,
    path: str | Path,
    *,
    data: str | Path | None = None,
    scans: bool = False,
    progress: Progress | None = None,
) -> Scene:
    """Write a run as an MCAP file for Foxglove, compressed by Zstandard. The file appears whole.

    Args:
        run: a run folder, smoothed or not, or a run in memory.
        path: the file, ``*.mcap``.
        data: the recording, if it is not where the run found it.
        scans: write the points of every scan, for which the recording is read. The map needs no recording.
        progress: called after each scan.

    Returns:
        What is written; its ``left_out`` says what cannot be, such as scans whose recording is gone.

    Raises:
        MissingDependencyError: Foxglove's SDK is not installed.
        ConfigError: the file's name does not end in ``.mcap``.
        DataError: the run, the recording given, or the file's folder is wrong.
    """
    path = user_path(path)
    check_mcap_path(path)
    scene = scene_of(run, data, scans)
    with atomic_path(path) as part, _writing(path), _topics(part) as topics:
        _write_start(topics, scene)
        writer = _ScanWriter(topics)
        for row, (scan, points, _) in enumerate(scene.with_clouds(), 1):
            writer.write(scan, points)
            if progress is not None:
                progress("scans", row, len(scene.scans))
        _write_loops(topics, scene)
        _write_fixes(topics, scene)
    return scene


def check_mcap_path(path: Path) -> None:
    """Check that a file can be written, before the work begins.

    Raises:
        MissingDependencyError, ConfigError, DataError: as :func:`export_mcap`.
    """
    import_foxglove()
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path}: the file is named *{SUFFIX}")
    if not path.parent.is_dir():
        raise DataError(f"{path}: there is no folder {path.parent}")


class _Topics:
    """The topics of one file, made when first written to."""

    def __init__(self, foxglove: Any) -> None:
        self.messages = Messages()
        self._foxglove, self.context = foxglove, foxglove.Context()
        self._channels: dict[str, Any] = {}

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Write one of Foxglove's messages."""
        if topic not in self._channels:
            kind = getattr(self._foxglove.channels, f"{type(message).__name__}Channel")
            self._channels[topic] = kind(topic, context=self.context)
        self._channels[topic].log(message, log_time=stamp_ns)

    def write_json(self, topic: str, message: dict[str, Any], schema: dict[str, Any], stamp_ns: int) -> None:
        """Write a message of our own."""
        if topic not in self._channels:
            self._channels[topic] = self._foxglove.Channel(
                topic, schema=schema, message_encoding="json", context=self.context
            )
        self._channels[topic].log(message, log_time=stamp_ns)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn an error of Foxglove's writer, such as of a full disk, into one that names the file."""
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("FoxgloveError"):
            raise
        raise DataError(f"cannot write {path} ({error}); choose a place with free space") from error


@contextmanager
def _topics(path: Path) -> Iterator[_Topics]:
    foxglove = import_foxglove()
    topics = _Topics(foxglove)
    options = foxglove.mcap.MCAPWriteOptions(profile="")
    with foxglove.open_mcap(path, allow_overwrite=True, context=topics.context, writer_options=options):
        yield topics


def _write_start(topics: _Topics, scene: Scene) -> None:
    """Write what is seen from the start: the whole map and the whole paths, notes, and the frame of the fixes."""
    make, first_ns = topics.messages, scene.scans[0].stamp_ns
    for note in (*scene.notes, *scene.left_out):
        topics.write("/log", make.log(first_ns, note, is_warning=note in scene.left_out), first_ns)
    poses = np.array([scan.pose for scan in scene.scans])
    topics.write("/path", make.path(first_ns, poses), first_ns)
    colour = colours.by_sigma([scan.position_sigma_m for scan in scene.scans]).tolist()
    topics.write("/path/uncertainty", make.lines(first_ns, "path", poses[:, :3, 3], colour, strip=True), first_ns)
    for name, other in scene.paths.items():
        topics.write(f"/path/{name}", make.path(first_ns, other.poses), first_ns)
    if scene.clouds:
        topics.write("/map", make.cloud(first_ns, WORLD, _whole_map(scene, poses)), first_ns)
    if scene.fixes is not None:
        topics.write("/tf", make.transform(first_ns, ENU, WORLD, scene.fixes.T_enu_world), first_ns)


def _whole_map(scene: Scene, poses: Array) -> Floats:
    """Return the map's points ``(N, 3)`` in the world, one in n of them where there are too many."""
    total = sum(len(points) for _, points in scene.clouds)
    share = min(1.0, _MAP_POINTS / max(total, 1))
    out = []
    for row, points in scene.clouds:
        kept = np.linspace(0, len(points) - 1, int(share * len(points))).astype(np.intp)
        out.append(se3.transform(poses[row], points[kept]).astype(np.float32))
    return np.concatenate(out)


class _ScanWriter:
    """Writes the scans of a run in order."""

    def __init__(self, topics: _Topics) -> None:
        self._topics = topics
        self._ellipsoid_at: Array | None = None

    def write(self, scan: ViewedScan, points: Floats | None) -> None:
        """Write a scan's pose, covariance and diagnostics, and its points where there are any."""
        make, at_ns, write = self._topics.messages, scan.stamp_ns, self._topics.write
        write("/tf", make.transform(at_ns, WORLD, LIDAR, scan.pose), at_ns)
        write("/odometry", make.odometry(scan), at_ns)
        if scan.initial is not None:
            write("/initial_pose", make.stamped_pose(at_ns, scan.initial), at_ns)
        if points is not None:
            write("/scan", make.cloud(at_ns, LIDAR, points), at_ns)
        self._topics.write_json("/diagnostics", _diagnostics(scan), _DIAGNOSTICS, at_ns)
        if scan.support != SUPPORTED:
            write("/doubtful", make.mark(scan, colours.DOUBTFUL[scan.support]), at_ns)
            write("/log", make.log(at_ns, f"scan {scan.index}: {scan.support}", is_warning=True), at_ns)
        position = scan.pose[:3, 3]
        if self._ellipsoid_at is None or np.linalg.norm(position - self._ellipsoid_at) >= _ELLIPSOID_EVERY_M:
            self._ellipsoid_at = position
            colour = colours.by_sigma([scan.position_sigma_m])[0].tolist()
            write("/covariance", make.ellipsoid(scan, _ELLIPSOID_SIGMAS, colour), at_ns)


def _diagnostics(scan: ViewedScan) -> dict[str, Any]:
    out: dict[str, Any] = {
        "scan": scan.index,
        "support": scan.support,
        "position_sigma_m": scan.position_sigma_m,
        "rotation_sigma_deg": scan.rotation_sigma_deg,
        "residual_m": float(np.linalg.norm(scan.residual[3:])),
        "residual_deg": float(np.rad2deg(np.linalg.norm(scan.residual[:3]))),
    }
    if np.isfinite(scan.nis):
        out["innovation"] = scan.nis
    if (known := scan.inertial) is not None:
        out["speed_m_s"] = float(np.linalg.norm(known.velocity_m_s))
        biases = known.accel_bias_m_s2, known.gyro_bias_rad_s
        out |= {name: dict(zip("xyz", bias.tolist(), strict=True)) for name, bias in zip(_VECTORS, biases, strict=True)}
    return out


def _write_loops(topics: _Topics, scene: Scene) -> None:
    for earlier, later in scene.loops:
        a, b = scene.scans[earlier], scene.scans[later]
        ends = np.array([a.pose[:3, 3], b.pose[:3, 3]])
        line = topics.messages.lines(b.stamp_ns, f"loop {a.index}-{b.index}", ends, [colours.LOOP] * 2)
        topics.write("/loops", line, b.stamp_ns)


def _write_fixes(topics: _Topics, scene: Scene) -> None:
    """Write the fixes with lines to the antenna, and on Earth where their frame's place is known."""
    fixes, make = scene.fixes, topics.messages
    if fixes is None:
        return
    enu = se3.transform(fixes.T_enu_world, fixes.positions_m)
    geodetic = None if fixes.origin is None else geodetic_from_enu(enu, fixes.origin)
    for k, stamp in enumerate(fixes.stamps_ns.tolist()):
        colour = colours.WRONG_FIX if fixes.rejected[k] else colours.FIX
        ends = np.array([fixes.positions_m[k], fixes.antennas_m[k]])
        topics.write("/gps/residuals", make.lines(stamp, f"fix {k}", ends, [colour] * 2), stamp)
        if geodetic is not None:
            topics.write("/gps/fix", make.fix(stamp, geodetic[k], float(fixes.sigmas_m[k])), stamp)
