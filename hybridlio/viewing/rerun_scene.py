"""Draw a run in Rerun's terms, scan by scan."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats
from hybridlio.core.trajectory import Trajectory
from hybridlio.sources.gate.gate_result import GATE_NIS
from hybridlio.viewing import colours
from hybridlio.viewing import rerun_layout as names
from hybridlio.viewing.scene import SUPPORTED, PlacedFixes, ViewedScan

if TYPE_CHECKING:
    import rerun as rr

# What is sent together, whichever comes first: ten scans cost a third of what each by itself would, and a viewer that
# is half a second late is still live.
_BLOCK_SCANS, _BLOCK_S = 10, 0.5
_ELLIPSOID_SIGMAS = 3.0
_LEAST_HALF_AXIS_M = 1e-3  # that is still drawn
_FREE_LENGTH_M = 5.0  # of the arrows along directions that a scan leaves free


class RerunScene:
    """Sends scans to a Rerun recording, some at a time.

    Args:
        stream: the recording, connected to a viewer or a file.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        import rerun

        self._rr: Any = rerun
        self._stream = stream
        self._block: list[ViewedScan] = []
        self._points: list[tuple[ViewedScan, Floats]] = []
        self._map: list[tuple[ViewedScan, Floats]] = []
        self._sent_s = time.perf_counter()
        self._last: ViewedScan | None = None  # of the block before
        self._ellipsoid_at: Array | None = None
        self._support: str | None = None
        self._describe()

    def notes(self, name: str, lines: Iterable[str]) -> None:
        """Show notes; those before are replaced."""
        text = "\n".join([f"# {name}", "", *(f"* {line}" for line in lines)])
        self._stream.log(names.NOTES, self._rr.TextDocument(text, media_type="text/markdown"), static=True)

    def add(self, scan: ViewedScan, points: Floats | None = None, map_points: Floats | None = None) -> None:
        """Show a scan, with its block.

        Args:
            scan: the scan.
            points: ``(N, 3)`` in the lidar frame; None leaves those of the scan before.
            map_points: ``(N, 3)`` in the lidar frame, which stay.
        """
        self._block.append(scan)
        self._points += [] if points is None else [(scan, points)]
        self._map += [] if map_points is None else [(scan, map_points)]
        is_old = time.perf_counter() - self._sent_s >= _BLOCK_S
        if len(self._block) >= _BLOCK_SCANS or is_old:
            self.flush()

    def flush(self) -> None:
        """Send what waits for its block."""
        block, self._block = self._block, []
        self._sent_s = time.perf_counter()
        if not block:
            return
        self._send_poses(names.LIDAR, block, np.array([scan.pose for scan in block]))
        self._send_clouds()
        self._send_path(block)
        self._send_series(block)
        self._send_doubts(block)
        self._send_free_directions(block)
        self._last = block[-1]

    def add_path(self, name: str, trajectory: Trajectory) -> None:
        """Show another trajectory in the same frame, as a whole."""
        line = self._rr.LineStrips3D([trajectory.poses[:, :3, 3]], colors=[colours.OTHER], labels=[name])
        self._stream.log(f"{names.OTHERS}/{name}", line, static=True)

    def add_loops(self, scans: Sequence[ViewedScan], loops: Sequence[tuple[int, int]]) -> None:
        """Show loops, given by the rows of their scans, from the time at which they close."""
        if loops:
            ends = [[scans[a].pose[:3, 3], scans[b].pose[:3, 3]] for a, b in loops]
            drawn = self._rr.LineStrips3D.columns(strips=ends, colors=[colours.LOOP] * len(ends))
            self._send(names.LOOPS, [scans[later] for _, later in loops], drawn)

    def add_fixes(self, fixes: PlacedFixes, scans: Sequence[ViewedScan]) -> None:
        """Show GPS fixes, their distances to the path, and these over time."""
        rr, count = self._rr, len(fixes.stamps_ns)
        if not count:
            return
        rows = np.searchsorted([scan.stamp_ns for scan in scans], fixes.stamps_ns).clip(0, len(scans) - 1)
        numbers = [scans[row].index for row in rows]
        colour = [colours.WRONG_FIX if wrong else colours.FIX for wrong in fixes.rejected]
        when = self._times(fixes.stamps_ns, numbers)
        radii = np.full(count, 0.15)
        lines = np.stack([fixes.positions_m, fixes.antennas_m], axis=1)
        self._stream.send_columns(
            names.FIXES, when, rr.Points3D.columns(positions=fixes.positions_m, colors=colour, radii=radii)
        )
        self._stream.send_columns(names.FIX_RESIDUALS, when, rr.LineStrips3D.columns(strips=list(lines), colors=colour))
        self._stream.send_columns(names.FIX_RESIDUAL, when, self._scalars(fixes.residuals_m))

    def _describe(self) -> None:
        """Send what never changes: axes, names and colours; load the scales of colours, which takes a while once."""
        colours.by_sigma([0.0])
        colours.by_height([0.0], 0.0)
        rr, log = self._rr, self._stream.log
        log(names.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log(names.LIDAR, rr.TransformAxes3D(2.0), static=True)
        log(names.INITIAL, rr.TransformAxes3D(1.0), static=True)
        pixels = [rr.Radius.ui_points(1.0)]
        log(names.POINTS, rr.Points3D.from_fields(colors=[colours.SCAN], radii=pixels), static=True)
        log(names.MAP, rr.Points3D.from_fields(radii=pixels), static=True)
        log(names.PATH, rr.LineStrips3D.from_fields(radii=[rr.Radius.ui_points(2.0)]), static=True)
        for entity, colour in ((names.FREE_SHIFT, colours.FREE_SHIFT), (names.FREE_TURN, colours.FREE_TURN)):
            log(entity, rr.Arrows3D.from_fields(colors=[colour]), static=True)
        for name, colour in colours.DOUBTFUL.items():
            mark = rr.Points3D.from_fields(colors=[colour], radii=[rr.Radius.ui_points(5.0)], labels=[name])
            log(names.doubts(name), mark, static=True)
        known = {SUPPORTED: colours.FINAL, **colours.DOUBTFUL}
        log(names.SUPPORT, rr.StateConfiguration(values=list(known), colors=list(known.values())), static=True)
        for entity, axes in (
            (names.ACCEL_BIAS, "xyz"),
            (names.GYRO_BIAS, "xyz"),
            (names.FIX_RESIDUAL, ("east", "north", "up")),
        ):
            log(entity, rr.SeriesLines(names=list(axes), colors=list(colours.XYZ)), static=True)
        gate = rr.SeriesLines(names=["innovation", "gate"], colors=[colours.FINAL, colours.WRONG_FIX])
        log(names.NIS, gate, static=True)

    def _send_poses(self, entity: str, scans: Sequence[ViewedScan], poses: Array) -> None:
        """Send poses ``(N, 4, 4)``."""
        turned = _quaternions(poses[:, :3, :3])
        self._send(entity, scans, self._rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=turned))

    def _send_clouds(self) -> None:
        """Send the points of scans, and those of the map."""
        columns = self._rr.Points3D.columns
        live, self._points = self._points, []
        if live:
            clouds = [points for _, points in live]
            together = columns(positions=np.concatenate(clouds)).partition([len(cloud) for cloud in clouds])
            self._send(names.POINTS, [scan for scan, _ in live], together)
        new, self._map = self._map, []
        for scan, points in new:
            at = se3.transform(scan.pose, points).astype(np.float32)
            colour = colours.by_height(at[:, 2], scan.pose[2, 3])
            self._send(names.MAP, [scan], columns(positions=at, colors=colour).partition([len(at)]))

    def _send_path(self, block: list[ViewedScan]) -> None:
        """Send the path since the block before, initial poses, and an ellipsoid every few metres."""
        rr = self._rr
        scans = block if self._last is None else [self._last, *block]
        if len(scans) > 1:
            at = np.array([scan.pose[:3, 3] for scan in scans])
            colour = colours.by_sigma([scan.position_sigma_m for scan in scans[1:]])
            steps = list(np.stack([at[:-1], at[1:]], axis=1))
            self._send(names.PATH, scans[1:], rr.LineStrips3D.columns(strips=steps, colors=colour))
        with_initial = [(scan, scan.initial) for scan in block if scan.initial is not None]
        if with_initial:
            poses = np.array([initial for _, initial in with_initial])
            self._send_poses(names.INITIAL, [scan for scan, _ in with_initial], poses)
        for scan in block:
            self._send_ellipsoid(scan)

    def _send_ellipsoid(self, scan: ViewedScan) -> None:
        """Send the position's 3σ ellipsoid, if the last one is far enough."""
        at, rr = scan.pose[:3, 3], self._rr
        if self._ellipsoid_at is not None and np.linalg.norm(at - self._ellipsoid_at) < _FREE_LENGTH_M:
            return
        self._ellipsoid_at = at
        variances, axes = np.linalg.eigh(scan.covariance[3:, 3:])
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        half = np.maximum(_ELLIPSOID_SIGMAS * np.sqrt(np.maximum(variances, 0.0)), _LEAST_HALF_AXIS_M)
        drawn = rr.Ellipsoids3D.columns(
            half_sizes=[half],
            centers=[at],
            quaternions=[_quaternions(scan.pose[:3, :3] @ axes)],
            colors=colours.by_sigma([scan.position_sigma_m]),
        )
        self._send(names.ELLIPSOIDS, [scan], drawn)

    def _send_series(self, block: list[ViewedScan]) -> None:
        residuals = np.array([scan.residual for scan in block])
        self._series(names.SIGMA_M, block, np.array([scan.position_sigma_m for scan in block]))
        self._series(names.SIGMA_DEG, block, np.array([scan.rotation_sigma_deg for scan in block]))
        self._series(names.RESIDUAL_M, block, np.linalg.norm(residuals[:, 3:], axis=1))
        self._series(names.RESIDUAL_DEG, block, np.rad2deg(np.linalg.norm(residuals[:, :3], axis=1)))
        tested = [scan for scan in block if np.isfinite(scan.nis)]
        self._series(names.NIS, tested, np.array([[scan.nis, GATE_NIS] for scan in tested]))
        known = [(scan, scan.inertial) for scan in block if scan.inertial is not None]
        scans = [scan for scan, _ in known]
        self._series(names.ACCEL_BIAS, scans, np.array([state.accel_bias_m_s2 for _, state in known]))
        self._series(names.GYRO_BIAS, scans, np.array([state.gyro_bias_rad_s for _, state in known]))
        self._series(names.SPEED, scans, np.array([np.linalg.norm(state.velocity_m_s) for _, state in known]))

    def _series(self, entity: str, scans: list[ViewedScan], values: Array) -> None:
        if scans:
            self._send(entity, scans, self._scalars(values))

    def _scalars(self, values: Array) -> Any:
        """Return scalars ``(N,)`` or ``(N, K)``, of which a row is one moment."""
        columns = self._rr.Scalars.columns(scalars=values.ravel())
        return columns if values.ndim == 1 else columns.partition([values.shape[1]] * len(values))

    def _send_doubts(self, block: list[ViewedScan]) -> None:
        """Send marks where scans do not count fully, and each change of their support."""
        for name in colours.DOUBTFUL:
            found = [scan for scan in block if scan.support == name]
            if found:
                marks = self._rr.Points3D.columns(positions=[scan.pose[:3, 3] for scan in found])
                self._send(names.doubts(name), found, marks)
        before = [self._support, *(scan.support for scan in block[:-1])]
        changed = [scan for scan, support in zip(block, before, strict=True) if scan.support != support]
        if changed:
            states = self._rr.StateChange.columns(state=[scan.support for scan in changed])
            self._send(names.SUPPORT, changed, states)
        self._support = block[-1].support

    def _send_free_directions(self, block: list[ViewedScan]) -> None:
        """Send arrows along the motions that scans leave free; none removes those of the scan before."""
        scans = block if self._last is None else [self._last, *block]
        if not any(len(scan.degenerate) for scan in scans):
            return
        counts = [len(scan.degenerate) for scan in block]
        free = _FREE_LENGTH_M * np.concatenate([scan.degenerate for scan in block])
        for entity, part in ((names.FREE_TURN, free[:, :3]), (names.FREE_SHIFT, free[:, 3:])):
            self._send(entity, block, self._rr.Arrows3D.columns(vectors=part).partition(counts))

    def _send(self, entity: str, scans: Sequence[ViewedScan], columns: Any) -> None:
        stamps = np.array([scan.stamp_ns for scan in scans], np.int64)
        self._stream.send_columns(entity, self._times(stamps, [scan.index for scan in scans]), columns)

    def _times(self, stamps_ns: Any, numbers: Sequence[int]) -> list[Any]:
        time = self._rr.TimeColumn(names.TIME, timestamp=stamps_ns.astype("datetime64[ns]"))
        return [time, self._rr.TimeColumn(names.SCAN_NUMBER, sequence=np.array(numbers, np.int64))]


def _quaternions(R: Array) -> Array:
    """Return the quaternions ``(..., 4)``, x y z w, of rotations ``(..., 3, 3)``."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_quat())
