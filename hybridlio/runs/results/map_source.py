"""What a map is made of: a recording, and the poses of a run folder or of a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.trajectory import Trajectory, read_trajectory
from hybridlio.datasets.registry import open_sequence, reopen
from hybridlio.datasets.sequence import Sequence, frame_range
from hybridlio.datasets.source import Source
from hybridlio.record.record import Record
from hybridlio.runs.folder import RECORD, SMOOTHED, StoredRun, is_run_folder, read_run
from hybridlio.smoothing.georeference import georeference

_UNSUPPORTED = ("bridged", "rejected")  # lists of frames in metrics.json whose poses no scan supports


@dataclass(frozen=True, eq=False)
class MapSource:
    """A recording with lidar poses for its scans.

    Attributes:
        sequence: the recording.
        trajectory: lidar poses ``T_world_lidar``.
        poses_from: the run folder or the file that they come from.
        skip: frames whose pose is not supported by their scan; left out of a map.
        folder: the run folder, or None for poses from a file.
        origin: of the world frame on Earth, once georeferenced; then the frame is east-north-up.
        crs: of the world frame, where the run was localised in a map that states one.
    """

    sequence: Sequence
    trajectory: Trajectory
    poses_from: Path
    skip: frozenset[int] = frozenset()
    folder: Path | None = None
    origin: GeodeticPoint | None = None
    crs: str | None = None

    @property
    def name(self) -> str:
        """The recording's name."""
        return self.sequence.name

    def part(self, frames: str | None) -> MapSource:
        """Return the frames ``A:B``, as a Python slice.

        Raises:
            ConfigError, DataError: it is not a range, or is empty.
        """
        if frames is None:
            return self
        start, stop = frame_range(frames)
        first = slice(start, stop).indices(len(self.sequence))[0]
        skip = frozenset(k - first for k in self.skip)
        return replace(self, sequence=self.sequence.part(start, stop), skip=skip)

    def georeferenced(self) -> MapSource:
        """Return the source with its poses aligned with the run's GPS fixes, east-north-up.

        Raises:
            DataError: there is no run folder with fixes.
            EstimationError: fewer than three fixes lie in the run's time.
        """
        places = [] if self.folder is None else [self.folder / RECORD, self.folder.parent / RECORD]
        path = next((p for p in places if p.is_file()), None)
        if path is None:
            raise DataError(f"{self.name}: georeferencing needs a run folder with {RECORD}, which holds the GPS fixes")
        placed = georeference(Record.load(path), self.trajectory)
        return replace(self, trajectory=placed.trajectory, origin=placed.origin, crs=None)


def open_map_source(run: Path, data: Path | None = None, poses: Path | None = None) -> MapSource:
    """Open the recording and the poses for a map.

    Args:
        run: a run folder; of one that was smoothed in place, the smoothed poses are used. With ``poses`` it may be the
            recording itself.
        data: the recording, if it is not where the run found it.
        poses: a file of lidar poses (TUM or KITTI format) that replace the run's.

    Raises:
        ConfigError: the run does not say where its recording is, and ``data`` is not given.
        DataError: run, recording or poses cannot be read.
    """
    if poses is None and is_run_folder(run / SMOOTHED):
        run = run / SMOOTHED
    stored = read_run(run) if poses is None or is_run_folder(run) else None
    sequence = _sequence(run, data, stored)
    if poses is not None:
        camera = sequence.calibration.T_camera_lidar if sequence.pose_file_frame == "camera" else None
        trajectory = read_trajectory(poses, sequence.stamps_ns, camera)
        return MapSource(sequence, trajectory, poses, folder=run if stored else None)
    assert stored is not None
    skip = frozenset(int(k) for name in _UNSUPPORTED for k in stored.metrics.get(name, ()))
    return MapSource(sequence, stored.trajectory, run, skip, run, crs=stored.metrics.get("crs"))


def _sequence(run: Path, data: Path | None, stored: StoredRun | None) -> Sequence:
    if stored is None:
        return open_sequence(run if data is None else data)
    known = stored.metrics.get("recording")
    if known is not None:
        return reopen(Source.from_json_dict(known), data)
    if data is None:
        raise ConfigError(f"{run} does not say where its recording is; give it with --data")
    return open_sequence(data, sequence=str(stored.metrics["sequence"]))
