"""Show a finished run in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path

from hybridlio.core.files import user_path
from hybridlio.core.progress import Progress
from hybridlio.runs.run import Run
from hybridlio.viewing.rerun_scene import RerunScene
from hybridlio.viewing.rerun_stream import rerun_stream
from hybridlio.viewing.run_scene import scene_of
from hybridlio.viewing.scene import Scene


def view(
    run: str | Path | Run,
    save: str | Path | None = None,
    *,
    data: str | Path | None = None,
    scans: bool = True,
    progress: Progress | None = None,
) -> Scene:
    """Show a finished run in the Rerun viewer, or write it to a file that the viewer opens.

    Args:
        run: a run folder, smoothed or not, or a run in memory.
        save: a file ``*.rrd``, which appears whole; by default a viewer is opened.
        data: the recording, if it is not where the run found it.
        scans: show the points of every scan, for which the recording is read. The map needs no recording.
        progress: called after each scan.

    Returns:
        What is shown; its ``left_out`` says what cannot be, such as scans whose recording is gone.

    Raises:
        MissingDependencyError: Rerun is not installed.
        ConfigError: there is no display, or the file's name does not end in ``.rrd``.
        DataError: the run, the recording given, or the file's folder is wrong.
    """
    with rerun_stream("hybridlio" if isinstance(run, Run) else user_path(run).name, save) as stream:
        scene = scene_of(run, data, scans)
        drawn = RerunScene(stream)
        drawn.notes(scene.name, (*scene.notes, *scene.left_out))
        for name, path in scene.paths.items():
            drawn.add_path(name, path)
        for row, (scan, points, map_points) in enumerate(scene.with_clouds(), 1):
            drawn.add(scan, points, map_points)
            if progress is not None:
                progress("scans", row, len(scene.scans))
        drawn.flush()
        drawn.add_loops(scene.scans, scene.loops)
        if scene.fixes is not None:
            drawn.add_fixes(scene.fixes, scene.scans)
    return scene
