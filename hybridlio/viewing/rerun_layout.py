"""The layout of a run in the Rerun viewer, and the names of what is in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlio.viewing.colours import DOUBTFUL

if TYPE_CHECKING:
    import rerun.blueprint as rrb

TIME, SCAN_NUMBER = "time", "scan"  # timelines
WORLD, LIDAR, POINTS, INITIAL = "world", "world/lidar", "world/lidar/points", "world/initial"
FREE_SHIFT, FREE_TURN = "world/lidar/free_translation", "world/lidar/free_rotation"
PATH, MAP, ELLIPSOIDS, DOUBTS, OTHERS = "world/path", "world/map", "world/covariance", "world/doubtful", "world/paths"
FIXES, FIX_RESIDUALS, LOOPS = "world/gps/fixes", "world/gps/residuals", "world/loops"
SUPPORT, NOTES = "scans/support", "notes"
SIGMA_M, SIGMA_DEG = "series/sigma/position_m", "series/sigma/rotation_deg"
RESIDUAL_M, RESIDUAL_DEG = "series/residual/translation_m", "series/residual/rotation_deg"
NIS, SPEED = "series/innovation", "series/speed_m_s"
ACCEL_BIAS, GYRO_BIAS, FIX_RESIDUAL = "series/accel_bias_m_s2", "series/gyro_bias_rad_s", "series/gps_residual_m"

_BACKGROUND = (24, 26, 30)  # dark in the viewer's light theme too, in which scans would not be seen
_EYE_M = (-35.0, -20.0, 30.0)  # behind the lidar and above it, to see as far as a street is wide


def doubts(support: str) -> str:
    """Return where scans of one support are marked."""
    return f"{DOUBTS}/{support.replace(' ', '_')}"


_STAYS = (PATH, MAP, ELLIPSOIDS, LOOPS, FIXES, FIX_RESIDUALS, *map(doubts, DOUBTFUL))


def layout() -> rrb.Blueprint:
    """Return the layout: the world in 3D, the support of the scans below it, time series and notes beside it."""
    import rerun.blueprint as rrb

    until_now = rrb.VisibleTimeRanges([_until_now(rrb, name) for name in (TIME, SCAN_NUMBER)])
    world = rrb.Spatial3DView(
        origin=WORLD,
        name="World",
        overrides={entity: [until_now] for entity in _STAYS},
        background=_BACKGROUND,
        # Rerun's distance follows the size of what it tracks: at the lidar's axes it would be too near to see anything.
        eye_controls=rrb.EyeControls3D(position=_EYE_M, look_target=(0.0, 0.0, 0.0), tracking_entity=f"/{POINTS}"),
    )
    support = rrb.StateTimelineView(origin="scans", name="Support of the scans")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(world, support, row_shares=[6, 1]),
            rrb.Vertical(
                rrb.Tabs(_plot(rrb, "Position σ [m]", SIGMA_M), _plot(rrb, "Rotation σ [°]", SIGMA_DEG)),
                rrb.Tabs(
                    _plot(rrb, "Residual [m]", RESIDUAL_M),
                    _plot(rrb, "Residual [°]", RESIDUAL_DEG),
                    _plot(rrb, "Innovation, scan against IMU (χ², 6)", NIS),
                ),
                rrb.Tabs(
                    _plot(rrb, "Gyroscope bias [rad/s]", GYRO_BIAS),
                    _plot(rrb, "Accelerometer bias [m/s²]", ACCEL_BIAS),
                    _plot(rrb, "Speed [m/s]", SPEED),
                ),
                rrb.Tabs(
                    rrb.TextDocumentView(origin=NOTES, name="Notes"), _plot(rrb, "GPS residual [m]", FIX_RESIDUAL)
                ),
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIME, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plot(rrb: Any, name: str, entity: str) -> Any:
    return rrb.TimeSeriesView(origin=entity, name=name)


def _until_now(rrb: Any, timeline: str) -> Any:
    return rrb.VisibleTimeRange(
        timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
