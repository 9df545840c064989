"""A quick path of the lidar through consecutive scans, by registration alone, for checks that precede a run.

Next to scan matching it thins scans more and estimates no covariance, does not examine degenerate directions, and does
not relocate: it ends where a scan does not fit. Its turns are as accurate where surroundings constrain them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from hybridlio.calibration.turns import GyroPath
from hybridlio.cloud.deskew import constant_twist, deskew, sweep_motion
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Mask
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.registration.icp import register
from hybridlio.registration.information import weak_basis
from hybridlio.registration.local_map import LocalMap
from hybridlio.registration.motion_search import best_start, fits_better, motions
from hybridlio.registration.results import Registration
from hybridlio.sources.scene_scale import SceneScale
from hybridlio.sources.settings import ScanMatchingSettings
from hybridlio.sources.thinned_scan import ThinnedScan, thin

# Voxels over those of scan matching: some 1,000 points a scan are left; three times more make turns no more accurate.
_COARSER_MAP, _COARSER_SOURCE = 4 / 3, 1.5
_LEAST_MEASURED = 5_000  # a quarter of scan matching's, for the same reason
# First kernel, in greatest distances of a match: 0.25 m of 1 m, at which a point 10 m away moves where the rate has
# changed by 0.25 rad/s since the last step. Wider ones find false fits.
_KERNEL = 0.25
# A path slides along a road or turns too little while most points still match, but they lie farther from the surfaces:
# by 1.6 to 2.5 times on the drive with hard driving. Where all is well the distances vary by 15 %.
_LOST_RATIO, _SETTLED_SCANS, _JUDGING_SCANS = 1.5, 10, 30
_ABOUT_NS = NS_PER_S // 40  # a quarter of a scan before and after its stamp
# Of an axis of rotation in the weak directions, in squared length: along them a pose stays where it started, so more
# than a third of the turn about the axis would be that of the start, such as the gyroscope's.
_LARGEST_WEAK_SHARE = 0.1
_FIRST_REPETITIONS = 2  # of the first step, when its speed is known and both scans are compensated with it


class ScanPath:
    """Registers scans to a local map of the scans before.

    Args:
        calibration: of the IMU.
        imu: samples that compensate motion and propose rotations, on the scans' clock and free of bias; may be empty.
    """

    def __init__(self, calibration: Calibration, imu: ImuSamples) -> None:
        self._calibration, self._imu = calibration, imu
        self._origin_ns = int(imu.stamps_ns[0]) if len(imu) else 0
        self._gyro = GyroPath(imu, self._origin_ns) if len(imu) > 1 else None
        self._settings = ScanMatchingSettings()
        self._map = LocalMap(self._settings.local_map)
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._sigmas_m: list[float] = []
        self._measured: list[Mask] = []
        self._first: tuple[Scan, ImuSamples] | None = None

    @property
    def trajectory(self) -> Trajectory:
        """The lidar's poses so far, in the frame of the first scan."""
        return Trajectory(np.array(self._stamps, np.int64), np.array(self._poses).reshape(-1, 4, 4))

    @property
    def measured(self) -> Mask:
        """``(N-1, 3)`` whether the scans determine the turns between the poses, about each of the lidar's axes."""
        poses = np.array(self._measured).reshape(-1, 3)
        return np.asarray(poses[1:] & poses[:-1])

    @property
    def sigma_m(self) -> float:
        """Median over the scans of their points' standard deviation from the map; 0 for none."""
        return float(np.median(self._sigmas_m)) if self._sigmas_m else 0.0

    def add(self, scan: Scan) -> bool:
        """Register the next scan, and return whether it fits; otherwise the path is as before.

        Args:
            scan: after the last one.
        """
        sweep_imu = _during(scan, self._imu)
        if self._first is None:
            self._first = scan, sweep_imu
            self._settings = _scaled_settings(scan)
            return self._start(np.eye(4), scan.stamp_ns + NS_PER_S)
        if len(self._poses) > 1:
            dt, before = scan.stamp_ns - self._stamps[-1], self._stamps[-1] - self._stamps[-2]
            twist = se3.log(se3.between(self._poses[-2], self._poses[-1])) * (dt / before)
            return self._register(scan, sweep_imu, se3.exp(twist), self._turned(scan, se3.exp(twist)))
        step = self._search(scan, sweep_imu)
        for _ in range(_FIRST_REPETITIONS):
            if step is None or not self._start(step, scan.stamp_ns) or not self._register(scan, sweep_imu, step):
                return False
            step = self._poses.pop()
            self._stamps.pop()
            self._measured.pop()
        assert step is not None
        fits = self._register(scan, sweep_imu, step)
        self._settings = _coarser(self._settings)
        return fits

    def _turned(self, scan: Scan, step: Array) -> Array | None:
        """Return a step with its rotation by the gyroscope; None where the samples do not cover it.

        Rotations of a sensor in a hand change more from step to step than its velocity does.
        """
        starts, ends = (np.array([(t - self._origin_ns) / NS_PER_S]) for t in (self._stamps[-1], scan.stamp_ns))
        if self._gyro is None or not self._gyro.covers(starts, ends)[0]:
            return None
        R_imu_lidar = self._calibration.T_imu_lidar[:3, :3]
        turn = se3.so3_exp(self._gyro.turns(starts, ends)[0] @ R_imu_lidar)
        return se3.make(turn, step[:3, 3])

    def _start(self, step: Array, end_ns: int) -> bool:
        """Make a map of the first scan alone, compensated for its motion to the next one."""
        assert self._first is not None
        scan, sweep_imu = self._first
        points = self._compensated(scan, sweep_imu, step, scan.stamp_ns, end_ns).points
        self._map = LocalMap(self._settings.local_map)
        self._map.insert(points, np.eye(4))
        self._stamps, self._poses, self._measured = [scan.stamp_ns], [np.eye(4)], [np.ones(3, bool)]
        return len(points) >= self._settings.min_points and self._map.surface is not None

    def _search(self, scan: Scan, sweep_imu: ImuSamples) -> Array | None:
        """Return the first step, whose speed is unknown; None without enough points."""
        start_ns, surface, settings = self._stamps[-1], self._map.surface, self._settings
        thinned = self._compensated(scan, sweep_imu, np.eye(4), start_ns, scan.stamp_ns)
        if len(thinned.points) < settings.min_points or surface is None:
            return None
        dt_s = (scan.stamp_ns - start_ns) / NS_PER_S
        starts = motions(settings.start_speeds_m_s, settings.start_rates_deg_s, dt_s)
        if len(sweep_imu):  # of all candidates the best, if the gyroscope is right; else one of those above is
            rates = (sweep_imu.gyro_rad_s @ self._calibration.T_imu_lidar[:3, :3]).mean(axis=0)
            turn = se3.make(se3.so3_exp(rates * dt_s), np.zeros(3))
            starts += [step @ turn for step in motions(settings.start_speeds_m_s, (0.0,), dt_s)]
        return best_start(surface, thinned.source, thinned.points, starts, settings.registration)

    def _register(self, scan: Scan, sweep_imu: ImuSamples, step: Array, turned: Array | None = None) -> bool:
        """Register from a step, or from the same with another rotation if the scan fits better there."""
        thinned = self._compensated(scan, sweep_imu, step, self._stamps[-1], scan.stamp_ns)
        surface, settings = self._map.surface, self._settings
        if len(thinned.points) < settings.min_points or surface is None:
            return False
        start, kernel_m = self._poses[-1] @ step, _KERNEL * settings.registration.max_distance_m
        threads = settings.registration.threads
        if turned is not None:
            other = self._poses[-1] @ turned
            start = other if fits_better(surface, thinned.source, other, start, kernel_m, threads) else start
        found = register(surface, thinned.source, start, settings.registration, kernel_m)
        usual_m = self.sigma_m if len(self._sigmas_m) >= _SETTLED_SCANS else np.inf
        if found.matched < settings.min_matched or found.sigma_m > _LOST_RATIO * usual_m:
            return False
        self._sigmas_m.append(found.sigma_m)
        self._stamps.append(scan.stamp_ns)
        self._poses.append(found.pose)
        self._measured.append(_measured_axes(found, surface.normal_noise.largest))
        if self._map.needs_keyframe(found.pose):
            self._map.insert(thinned.points, found.pose)
        else:
            self._map.rebuild_if_due()
        return True

    def _compensated(self, scan: Scan, sweep_imu: ImuSamples, step: Array, start_ns: int, end_ns: int) -> ThinnedScan:
        """Return the scan compensated and thinned."""
        if scan.time_offsets_ns is not None:
            frame = Frame(0, scan, sweep_imu=sweep_imu)
            twist = constant_twist(step, start_ns, end_ns)
            scan = deskew(scan, sweep_motion(frame, twist, np.zeros(3), self._calibration))
        return thin(scan, self._settings)


def _measured_axes(found: Registration, normal_noise: float) -> Mask:
    """Return ``(3,)`` which rotations a registration determines."""
    weak, _ = weak_basis(found.hessian, found.lever_arms_m, normal_noise)
    return np.asarray((weak[:3] ** 2).sum(axis=1) < _LARGEST_WEAK_SHARE)


def _during(scan: Scan, imu: ImuSamples) -> ImuSamples:
    """Return the samples during a scan's sweep, or about its stamp if its points have no times."""
    times = scan.time_offsets_ns
    if times is None or not len(times):
        return imu.between(scan.stamp_ns - _ABOUT_NS, scan.stamp_ns + _ABOUT_NS)
    return imu.between(scan.stamp_ns + int(times.min()), scan.stamp_ns + int(times.max()))


def _scaled_settings(scan: Scan) -> ScanMatchingSettings:
    """Return scan matching's settings at the scale of the scene, which changes little within a stretch."""
    scale = SceneScale(ScanMatchingSettings())
    thinned = thin(scan, scale.settings)
    scale.observe(thinned.view_m, len(thinned.points), len(scan))
    return scale.settings


def _coarser(fine: ScanMatchingSettings) -> ScanMatchingSettings:
    """Return the settings for all but the first step, whose search needs more points."""
    return replace(
        fine,
        map_voxel_m=_COARSER_MAP * fine.map_voxel_m,
        source_voxel_m=_COARSER_SOURCE * fine.source_voxel_m,
        least_measured=_LEAST_MEASURED,
    )


def scan_paths(scans: Iterable[Scan], calibration: Calibration, imu: ImuSamples) -> list[ScanPath]:
    """Return the lidar's path through scans, two or more in each; a new one begins after each scan that does not fit.

    Args:
        scans: in order of time.
        calibration, imu: see :class:`ScanPath`.
    """
    paths = [ScanPath(calibration, imu)]
    for scan in scans:
        if not paths[-1].add(scan):
            paths.append(ScanPath(calibration, imu))
            paths[-1].add(scan)
    return [path for path in paths if len(path.trajectory) > 1]


def best_paths(paths: Iterable[ScanPath]) -> list[ScanPath]:
    """Return the paths of one recording, without those whose scans lie far from their maps, after a false first fit.

    Such a path goes on as consistently as a right one, at another speed or turning all the time.
    """
    known = [path for path in paths if path.sigma_m > 0]
    least_m = min((path.sigma_m for path in known if len(path.trajectory) >= _JUDGING_SCANS), default=np.inf)
    right = [path for path in known if path.sigma_m < _LOST_RATIO * least_m]
    return sorted(right, key=lambda path: int(path.trajectory.stamps_ns[0]))
