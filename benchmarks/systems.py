"""The systems that benchmarks compare. Each is a function that takes a frame and returns an `Answer`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES


@dataclass(frozen=True)
class Answer:
    """A system's answer to one scan.

    Attributes:
        pose: ``(4, 4)`` lidar pose in the system's own world frame.
        stamp_ns: the time of the pose.
        covariance: ``(6, 6)`` relative to the first pose, rotation first; None from a system that has none.
        bridged: the system reports that it could not use the scan.
        degenerate: the system reports that the scan leaves a direction unconstrained.
        disagreed: the system reports that scan and IMU contradict each other.
    """

    pose: Array
    stamp_ns: int
    covariance: Array | None = None
    bridged: bool = False
    degenerate: bool = False
    disagreed: bool = False


Step = Callable[[Frame], Answer]
Make = Callable[[Sequence, int], Step]  # makes a system for a recording, with a number of threads


def ours(config: Config, _: Sequence, threads: int) -> Step:
    """Make hybridlio's odometry of a configuration, with everything loaded and compiled, as a stream has it."""
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.odometry.warm_up import warm_up

    odometry = Odometry(config=Config.model_validate(_with_threads(config.model_dump(), threads)))
    warm_up(odometry)

    def step(frame: Frame) -> Answer:
        estimate = odometry.step(frame)
        relative = estimate.relative
        disagreed = estimate.gate.verdict not in ("untested", "accepted")
        flags = (False, False) if relative is None else (not relative.ok, len(relative.degenerate) > 0)
        return Answer(estimate.pose, estimate.stamp_ns, estimate.covariance, *flags, disagreed)

    return step


def _with_threads(tree: dict[str, object], threads: int) -> dict[str, object]:
    return {
        key: _with_threads(value, threads) if isinstance(value, dict) else threads if key == "threads" else value
        for key, value in tree.items()
    }


def kiss_icp(sequence: Sequence, threads: int, max_range_m: float = 100.0) -> Step:
    """Make KISS-ICP with its defaults for a largest range: voxels of a hundredth of it.

    It compensates motion, to the end of the sweep, only where points carry times.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew = sequence[0].scan.time_offsets_ns is not None
    config.data.max_range = max_range_m
    config.mapping.voxel_size = max_range_m / 100
    config.registration.max_num_threads = threads
    system = KissICP(config)

    def step(frame: Frame) -> Answer:
        offsets = frame.scan.time_offsets_ns
        times = np.empty(0) if offsets is None else (offsets - offsets.min()) / max(np.ptp(offsets), 1)
        system.register_frame(frame.scan.points.astype(np.float64), times)
        return Answer(np.array(system.last_pose), _end_of_sweep_ns(frame))

    return step


def rko_lio(sequence: Sequence, threads: int) -> Step:
    """Make RKO-LIO with its defaults. Its poses are the IMU's.

    It rejects scans whose times are all equal, and extrinsics whose rotation has rounding errors.
    """
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    system = LIO(LIOConfig(deskew=sequence[0].scan.time_offsets_ns is not None, max_num_threads=threads))
    T_imu_lidar = se3.orthonormalise(sequence.calibration.T_imu_lidar)
    fed = 0

    def step(frame: Frame) -> Answer:
        nonlocal fed
        imu, scan = sequence.imu, frame.scan
        # as its own pipeline does: all samples up to the end of the sweep, which may be after the scan's stamp
        first, fed = fed, int(np.searchsorted(imu.stamps_ns, _end_of_sweep_ns(frame), side="right"))
        for k in range(first, fed):
            system.add_imu_measurement(imu.accel_m_s2[k], imu.gyro_rad_s[k], int(imu.stamps_ns[k]))
        offsets = np.zeros(len(scan), np.int64) if scan.time_offsets_ns is None else scan.time_offsets_ns
        times = scan.stamp_ns + offsets
        if scan.time_offsets_ns is None:
            times[0] -= 1000
        system.register_scan(scan.points.astype(np.float64), times, T_imu_lidar)
        return Answer(se3.inverse(T_imu_lidar) @ system.pose() @ T_imu_lidar, _end_of_sweep_ns(frame))

    return step


def small_gicp_odometry(_: Sequence, threads: int) -> Step:
    """Make scan-to-map GICP: scans thinned to 0.25 m, a map of 1 m Gaussian voxels, started by constant velocity."""
    import small_gicp

    voxels: small_gicp.GaussianVoxelMap | None = None
    pose, last_step = np.eye(4), np.eye(4)

    def step(frame: Frame) -> Answer:
        nonlocal voxels, pose, last_step
        points = frame.scan.points.astype(np.float64)
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.25, num_threads=threads)
        if voxels is None:
            voxels = small_gicp.GaussianVoxelMap(1.0)
        else:
            # small_gicp's result is no closer to a rotation than its start, and the deviation more than doubles with
            # every step
            start = se3.orthonormalise(pose @ last_step)
            found = se3.orthonormalise(small_gicp.align(voxels, cloud, start, num_threads=threads).T_target_source)
            last_step, pose = se3.between(pose, found), found
        voxels.insert(cloud, pose)
        return Answer(pose, frame.scan.stamp_ns)

    return step


def open3d_icp(_: Sequence, __: int) -> Step:
    """Make scan-to-scan point-to-plane ICP: scans thinned to 0.5 m, started by constant velocity.

    Open3D takes its number of threads from OpenMP's environment variable, which the process is started with.
    """
    import open3d as o3d

    icp, search = o3d.pipelines.registration, o3d.geometry.KDTreeSearchParamHybrid(radius=1.5, max_nn=20)
    target: o3d.geometry.PointCloud | None = None
    pose, last_step = np.eye(4), np.eye(4)

    def step(frame: Frame) -> Answer:
        nonlocal target, pose, last_step
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(frame.scan.points.astype(np.float64)))
        cloud = cloud.voxel_down_sample(0.5)
        cloud.estimate_normals(search)
        if target is not None:
            plane = icp.TransformationEstimationPointToPlane()
            last_step = np.array(icp.registration_icp(cloud, target, 1.0, last_step, plane).transformation)
            pose = pose @ last_step
        target = cloud
        return Answer(pose, frame.scan.stamp_ns)

    return step


def _end_of_sweep_ns(frame: Frame) -> int:
    offsets = frame.scan.time_offsets_ns
    return frame.scan.stamp_ns + (int(offsets.max()) if offsets is not None and len(offsets) else 0)


PEERS: dict[str, tuple[str, Make]] = {  # name: (the package that it needs, how it is made)
    "kiss-icp": ("kiss_icp", kiss_icp),
    "rko_lio": ("rko_lio", rko_lio),
    "small_gicp": ("small_gicp", small_gicp_odometry),
    "open3d-icp": ("open3d", open3d_icp),
}
_NEED_IMU = ("rko_lio",)


def our_systems(initial_poses: str, residuals: str, backends: str) -> dict[str, Make]:
    """Make every combination of the comma-separated names.

    ``each`` in place of names tries all implementations of that seam with the default of the other two.
    """
    default = Config()
    asked = {"initial_pose": initial_poses, "residual": residuals, "backend": backends}
    known: dict[str, Iterable[str]] = {
        "initial_pose": INITIAL_POSE_SOURCES,
        "residual": RESIDUAL_SOURCES,
        "backend": BACKENDS,
    }
    named = {seam: text.split(",") if text != "each" else [getattr(default, seam)] for seam, text in asked.items()}
    chosen = [dict(zip(named, names, strict=True)) for names in product(*named.values())]
    for seam in (seam for seam, text in asked.items() if text == "each"):
        chosen += [{**chosen[0], seam: name} for name in known[seam] if name not in ("identity", "none")]
    configs = [default.model_copy(update=names) for names in chosen]
    return {f"{c.initial_pose} + {c.residual} + {c.backend}": partial(ours, c) for c in configs}


def peer_systems(names: str, sequence: Sequence) -> dict[str, Make]:
    """Return the named peers that can run on the recording. Print which of them are not installed."""
    from importlib.util import find_spec

    out = {}
    for name in (name for name in names.split(",") if name):
        package, make = PEERS[name]
        if find_spec(package) is None:
            print(f"{name} is not installed: pip install 'hybridlio[peers]'")
        elif len(sequence.imu) or name not in _NEED_IMU:
            out[name] = make
    return out


def add_system_options(parser: ArgumentParser) -> None:
    """Add the options that select systems and their number of threads."""
    default = {"--initial-pose": "preintegration", "--residual": "scan-matching", "--backend": "fixed-lag"}
    for option, names in default.items():
        parser.add_argument(option, default=names, metavar="A,B,…", help="names, or 'each' (default: %(default)s)")
    parser.add_argument("--peers", default=",".join(PEERS), metavar="A,B,…", help="'' for none (default: all)")
    parser.add_argument("--threads", type=int, default=2, help="of each system (default: %(default)s)")


def chosen_systems(options: Namespace, sequence: Sequence) -> dict[str, Make]:
    """Return the systems that the options select, ours first."""
    found = our_systems(options.initial_pose, options.residual, options.backend)
    return found | peer_systems(options.peers, sequence)
