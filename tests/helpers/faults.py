"""Faults of sensors, clocks and mounting, put into a simulated recording; its truth stays as it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, ImuSamples, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.faults import block_sector, imu_gap

Fault = Callable[[Sequence], Sequence]


def no_scans(start_s: float, end_s: float) -> Fault:
    """Empty scans, as of a lidar that is unplugged."""
    return lambda sequence: block_sector(sequence, start_s, end_s, width_deg=360.0)


def no_imu(start_s: float, end_s: float) -> Fault:
    return lambda sequence: imu_gap(sequence, start_s, end_s)


def both(*faults: Fault) -> Fault:
    def inject(sequence: Sequence) -> Sequence:
        for fault in faults:
            sequence = fault(sequence)
        return sequence

    return inject


def half_missing(start_s: float, end_s: float) -> Fault:
    return lambda sequence: block_sector(sequence, start_s, end_s, middle_deg=90.0)


def on_imu(change: Callable[[ImuSamples, float], ImuSamples]) -> Fault:
    """Change the samples; ``change`` also gets the first scan's stamp, in nanoseconds."""
    return lambda sequence: replace(sequence, imu=change(sequence.imu, int(sequence.stamps_ns[0])))


def frozen(start_s: float, end_s: float) -> Fault:
    """A driver that repeats its last sample."""

    def change(imu: ImuSamples, first_ns: float) -> ImuSamples:
        seconds = (imu.stamps_ns - first_ns) / NS_PER_S
        during = (seconds >= start_s) & (seconds < end_s)
        last = int(np.flatnonzero(during)[0]) - 1
        gyro, accel = imu.gyro_rad_s.copy(), imu.accel_m_s2.copy()
        gyro[during], accel[during] = gyro[last], accel[last]
        return ImuSamples(imu.stamps_ns, gyro, accel)

    return on_imu(change)


def late(seconds: float) -> Fault:
    """Samples whose stamps are late by a constant."""
    return on_imu(lambda imu, _: replace(imu, stamps_ns=imu.stamps_ns + round(seconds * NS_PER_S)))


def jittered(sigma_s: float) -> Fault:
    """Stamps that scatter, in order."""

    def change(imu: ImuSamples, _: float) -> ImuSamples:
        scatter = np.random.default_rng(5).normal(0, sigma_s * NS_PER_S, len(imu)).astype(np.int64)
        return replace(imu, stamps_ns=np.maximum.accumulate(np.sort(imu.stamps_ns + scatter) + np.arange(len(imu))))

    return on_imu(change)


def clipped(gyro_rad_s: float, accel_m_s2: float) -> Fault:
    """A sensor whose range is too small."""

    def change(imu: ImuSamples, _: float) -> ImuSamples:
        gyro, accel = (
            np.clip(values, -most, most)
            for values, most in ((imu.gyro_rad_s, gyro_rad_s), (imu.accel_m_s2, accel_m_s2))
        )
        return ImuSamples(imu.stamps_ns, gyro, accel)

    return on_imu(change)


def scaled(gyro: float = 1.0, accel: float = 1.0) -> Fault:
    """Samples in another unit."""
    return on_imu(lambda imu, _: ImuSamples(imu.stamps_ns, imu.gyro_rad_s * gyro, imu.accel_m_s2 * accel))


def rate(every: int) -> Fault:
    """Keep every n-th sample."""
    return on_imu(lambda imu, _: ImuSamples(imu.stamps_ns[::every], imu.gyro_rad_s[::every], imu.accel_m_s2[::every]))


def repeated_stamps(sequence: Sequence) -> Sequence:
    imu = sequence.imu
    stamps = imu.stamps_ns.copy()
    stamps[50] = stamps[49]
    return replace(sequence, imu=replace(imu, stamps_ns=stamps))


def clock_step(sequence: Sequence) -> Sequence:
    """Stamps that go back by a second on the way."""
    stamps = sequence.stamps_ns.copy()
    stamps[len(stamps) // 2 :] -= NS_PER_S
    return replace(sequence, stamps_ns=stamps)


def shifted(nanoseconds: int) -> Fault:
    """Move every stamp by the same time."""

    def inject(sequence: Sequence) -> Sequence:
        def load(k: int) -> Scan:
            scan = sequence.load_scan(k)
            return replace(scan, stamp_ns=scan.stamp_ns + nanoseconds)

        reference = sequence.reference
        assert reference is not None
        return replace(
            sequence,
            stamps_ns=sequence.stamps_ns + nanoseconds,
            load_scan=load,
            imu=replace(sequence.imu, stamps_ns=sequence.imu.stamps_ns + nanoseconds),
            reference=replace(reference, stamps_ns=reference.stamps_ns + nanoseconds),
        )

    return inject


def on_points(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Fault:  # type: ignore[type-arg]
    """Change the points ``(N, 3)`` of every scan but the first, which the run starts from."""

    def inject(sequence: Sequence) -> Sequence:
        def load(k: int) -> Scan:
            scan = sequence.load_scan(k)
            if not k:
                return scan
            points = change(scan.points.astype(np.float64), np.random.default_rng([7, k]))
            return Scan(scan.stamp_ns, points.astype(np.float32))

        return replace(sequence, load_scan=load)

    return inject


def _some(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:  # type: ignore[type-arg]
    return rng.random(len(points)) < share


def random_points(share: float) -> Fault:
    """A share of the points anywhere within 40 m."""

    def change(points, rng):  # type: ignore[no-untyped-def]
        wrong = _some(points, share, rng)
        points[wrong] = rng.uniform([-40, -40, -3], [40, 40, 10], (int(wrong.sum()), 3))
        return points

    return on_points(change)


def ghosts(share: float) -> Fault:
    """A share of the points once more at twice their range, as reflections show them."""
    return on_points(lambda points, rng: np.concatenate([points, 2 * points[_some(points, share, rng)]]))


def rain(share: float) -> Fault:
    """A share of the points at drops within 8 m of the lidar, along the same rays."""

    def change(points, rng):  # type: ignore[no-untyped-def]
        wet, ranges_m = _some(points, share, rng), np.linalg.norm(points, axis=1)
        near_m = rng.uniform(1, 8, int(wet.sum()))
        points[wet] *= (np.minimum(near_m, ranges_m[wet]) / ranges_m[wet])[:, None]
        return points

    return on_points(change)


def glass(side_m: float, share: float) -> Fault:
    """A pane beside the vehicle that moves with it, and reflects a share of the rays on that side."""

    def change(points, rng):  # type: ignore[no-untyped-def]
        hit = (points[:, 1] > side_m) & _some(points, share, rng)
        points[hit] *= (side_m / points[hit, 1])[:, None]
        return points

    return on_points(change)


def swapped(frame: int) -> Fault:
    """The points of two consecutive scans in each other's place."""
    return rearranged(lambda k: {frame: frame + 1, frame + 1: frame}.get(k, k))


def rearranged(source: Callable[[int], int]) -> Fault:
    """Scan ``k`` has the points of scan ``source(k)``."""

    def inject(sequence: Sequence) -> Sequence:
        def load(k: int) -> Scan:
            return replace(sequence.load_scan(source(k)), stamp_ns=int(sequence.stamps_ns[k]))

        return replace(sequence, load_scan=load)

    return inject


def carried(frame: int, frames: int) -> Fault:
    """From a frame on, scans and samples are those of some frames later: the sensor was switched off and carried.

    Nothing measures how it was carried. The reference is the path that scans and samples show: it goes on from where
    the sensor was switched off, by the motion from where it was switched on.
    """

    def inject(sequence: Sequence) -> Sequence:
        stamps, imu = sequence.stamps_ns, sequence.imu
        jump_ns = int(stamps[frame + frames] - stamps[frame])
        before, after = imu.stamps_ns < stamps[frame], imu.stamps_ns >= stamps[frame + frames]
        left = ImuSamples(
            np.r_[imu.stamps_ns[before], imu.stamps_ns[after] - jump_ns],
            np.vstack([imu.gyro_rad_s[before], imu.gyro_rad_s[after]]),
            np.vstack([imu.accel_m_s2[before], imu.accel_m_s2[after]]),
        )
        reference = sequence.reference
        assert reference is not None
        poses = reference.poses.copy()
        back = poses[frame] @ se3.inverse(poses[frame + frames])
        poses[frame:-frames] = back @ poses[frame + frames :]
        path = replace(reference, poses=poses)
        return replace(rearranged(lambda k: k if k < frame else k + frames)(sequence), imu=left, reference=path)

    return inject


def unreadable(*frames: int) -> Fault:
    def inject(sequence: Sequence) -> Sequence:
        def load(k: int) -> Scan:
            if k in frames:
                raise DataError(f"frame {k}: the file is cut off")
            return sequence.load_scan(k)

        return replace(sequence, load_scan=load)

    return inject


def extrinsics(change: Callable[[np.ndarray], np.ndarray]) -> Fault:  # type: ignore[type-arg]
    """A calibration that is not that of the vehicle."""

    def inject(sequence: Sequence) -> Sequence:
        calibration = sequence.calibration
        return replace(sequence, calibration=replace(calibration, T_imu_lidar=change(calibration.T_imu_lidar)))

    return inject


def turned_by(degrees: float) -> Fault:
    """Extrinsics with a wrong yaw."""
    return extrinsics(lambda T: T @ se3.exp(np.array([0, 0, np.radians(degrees), 0, 0, 0])))


def upside_down(sequence: Sequence) -> Sequence:
    """A lidar that hangs, with the right extrinsics."""
    turn = se3.exp(np.array([np.pi, 0, 0, 0, 0, 0]))

    def load(k: int) -> Scan:
        scan = sequence.load_scan(k)
        return replace(scan, points=se3.transform(turn, scan.points.astype(np.float64)).astype(np.float32))

    reference, calibration = sequence.reference, sequence.calibration
    assert reference is not None
    return replace(
        sequence,
        load_scan=load,
        calibration=replace(calibration, T_imu_lidar=calibration.T_imu_lidar @ se3.inverse(turn)),
        reference=replace(reference, poses=turn @ reference.poses @ se3.inverse(turn)),
    )
