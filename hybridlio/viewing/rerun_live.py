"""Show a run in the Rerun viewer while it goes."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core.arrays import Array, Floats
from hybridlio.runs.run import Run
from hybridlio.viewing.placed_fixes import place_fixes
from hybridlio.viewing.rerun_scene import RerunScene
from hybridlio.viewing.run_scene import REFERENCE, reference_from
from hybridlio.viewing.scene import MAP_EVERY_M, ViewedScan, thinned

if TYPE_CHECKING:
    import rerun as rr

_log = logging.getLogger(__name__)

# Share of the run's processor time that showing may take, half of what a run with a viewer may lose
# (benchmarks/viewer.py). Where the points of all scans would take more, those of some scans are not shown.
_SHARE = 0.05


class LiveView:
    """Shows each scan of a run. An error of the viewer is logged once and ends the showing, not the run.

    Args:
        stream: the recording that the viewer shows.
        run: the run, new or resumed; its estimates so far are shown at once.
    """

    def __init__(self, stream: rr.RecordingStream, run: Run) -> None:
        self._run, self._scene = run, RerunScene(stream)
        self._scene.notes(run.sequence.name, run.sequence.notes)
        self._before: Array | None = None
        self._map_at: Array | None = None
        self._shown = 0
        self._is_broken = False
        self.spent_s = 0.0
        self._start_s = time.thread_time()

    def after_scan(self) -> None:
        """Show the estimates that are new."""
        if self._is_broken:
            return
        start_s = time.thread_time()
        try:
            while self._shown < len(self._run.estimates):
                self._show(self._shown)
                self._shown += 1
        except Exception as error:
            self._is_broken = True
            _log.warning("the viewer shows no more scans: %s: %s", type(error).__name__, error)
        self.spent_s += time.thread_time() - start_s

    def _show(self, row: int) -> None:
        estimate = self._run.estimates[row]
        scan = ViewedScan.of_estimate(estimate, self._before)
        self._before = scan.pose
        is_newest = row == len(self._run.estimates) - 1
        self._scene.add(scan, *(self._points(scan.pose) if is_newest else (None, None)))

    def _points(self, pose: Array) -> tuple[Floats | None, Floats | None]:
        """Return the newest scan's points, if there is time, and again if they are due for the map."""
        scan = getattr(self._run.odometry, "last_scan", None)
        is_due = self._map_at is None or np.linalg.norm(pose[:3, 3] - self._map_at) >= MAP_EVERY_M
        has_time = self.spent_s <= _SHARE * (time.thread_time() - self._start_s)
        if scan is None or not (is_due or has_time):
            return None, None
        points = thinned(scan).points
        if is_due:
            self._map_at = pose[:3, 3]
        return points, points if is_due else None

    def finish(self) -> None:
        """Show the rest: the reference, and the GPS fixes, which are aligned with the whole run."""
        run = self._run
        if self._is_broken or not run.estimates:
            return
        self._scene.flush()
        if run.sequence.reference is not None:
            self._scene.add_path(REFERENCE, reference_from(run.sequence.reference, run.skipped, run.done))
        record = run.record if run.sequence.gps else None
        if record is None:
            return
        fixes = place_fixes(record, run.trajectory)
        if fixes is not None:
            self._scene.add_fixes(fixes, [ViewedScan(e.index, e.stamp_ns, e.pose, e.covariance) for e in run.estimates])
