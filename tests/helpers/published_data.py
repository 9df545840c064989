"""Write a ride in the layouts of published data sets, as their publishers specify them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rides import Ride, iso, put, put_oxts
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.datasets.published import helipr, mulran, nclt, newer_college

FRD: Array = np.diag([1.0, -1.0, -1.0, 1.0])  # forward, right, down in forward, left, up
US = 1000


@dataclass(frozen=True)
class Written:
    """A ride as it was written, and what the reader must make of it.

    Attributes:
        path: to open.
        ride: the ride that was written.
        T_ride_imu: axes of the written IMU in the ride's (forward, left, up).
        point_error_m: resolution of the written points.
        has_imu: whether the layout holds an IMU that is used.
        span_s: seconds from a scan's first point to the last; 0 without times.
    """

    path: Path
    ride: Ride
    T_ride_imu: Array
    point_error_m: float = 0.0
    has_imu: bool = True
    span_s: float = 0.0


def on_clock(ride: Ride, unit_ns: int) -> Ride:
    """Return the ride from a start that is a whole number of a unit."""
    return replace(ride, start_ns=ride.start_ns // unit_ns * unit_ns)


def columns(ride: Ride, k: int) -> dict[str, Array]:
    points = ride.points(k)
    return dict(zip(("x", "y", "z", "intensity"), points.T.astype(np.float32), strict=True))


def offsets_ns(count: int) -> Stamps:
    return np.linspace(0, 99_000_000, count).astype(np.int64)


def structured(kinds: list[tuple[str, str]], values: dict[str, Array]) -> bytes:
    rows = np.zeros(len(values["x"]), kinds)
    for name, column in values.items():
        if name in (rows.dtype.names or ()):
            rows[name] = column
    return rows.tobytes()


def floats(values: Array) -> str:
    return ",".join(repr(float(value)) for value in np.ravel(values))


def quaternion(T: Array) -> list[float]:
    return [float(value) for value in Rotation.from_matrix(T[:3, :3]).as_quat()]


def pose_rows(stamps: Stamps, poses: Array, time: Callable[[int], str]) -> str:
    """Return rows of a time, a position and a quaternion x y z w."""
    return "".join(
        f"{time(int(t))} {' '.join(repr(float(v)) for v in [*T[:3, 3], *quaternion(T)])}\n"
        for t, T in zip(stamps, poses, strict=True)
    )


def world(ride: Ride) -> Array:
    return np.asarray(ride.T_enu_imu(ride.stamps_ns))


def write_kitti_360(root: Path) -> Written:
    """Poses are of the body with forward, right, down; navigation rows have forward, left, up."""
    ride, name = Ride(), "2013_05_28_drive_0000_sync"
    T_frd_lidar = FRD @ ride.T_imu_lidar
    T_velo_cam = se3.inverse(ride.T_camera_lidar)
    T_pose_cam = T_frd_lidar @ T_velo_cam
    drive = root / "data_3d_raw" / name
    put(root / "calibration/calib_cam_to_velo.txt", " ".join(map(repr, T_velo_cam[:3].ravel().tolist())))
    put(
        root / "calibration/calib_cam_to_pose.txt",
        f"image_00: {' '.join(map(repr, T_pose_cam[:3].ravel().tolist()))}\n",
    )
    put(drive / "velodyne_points/timestamps.txt", "".join(f"{iso(t)}\n" for t in ride.stamps_ns))
    poses = world(ride) @ FRD
    rows = "".join(f"{k} {' '.join(map(repr, T[:3].ravel().tolist()))}\n" for k, T in enumerate(poses))
    put(root / f"data_poses/{name}/poses.txt", rows)
    put_oxts(root / f"data_poses/{name.replace('_sync', '_extract')}/oxts", ride, ride.imu_stamps_ns(10))
    for k in range(ride.count):
        put(drive / f"velodyne_points/data/{k:010d}.bin", ride.points(k).astype("<f4").tobytes())
    return Written(drive, ride, np.eye(4))


def write_nuscenes(root: Path) -> Written:
    ride, tables = on_clock(Ride(), US), root / "v1.0-mini"
    us = [int(t) // US for t in ride.stamps_ns]
    q, scene = quaternion(ride.T_imu_lidar), {"name": "scene-0061", "token": "s"}
    put(tables / "scene.json", json.dumps([scene, {"name": "scene-0103", "token": "other"}]))
    put(
        tables / "sample.json", json.dumps([{"token": "a", "scene_token": "s"}, {"token": "b", "scene_token": "other"}])
    )
    mount = {"token": "c", "rotation": [q[3], *q[:3]], "translation": ride.T_imu_lidar[:3, 3].tolist()}
    put(tables / "calibrated_sensor.json", json.dumps([mount]))
    data, egos = [], []
    for k, T in enumerate(world(ride)):
        name = f"{'samples' if k % 10 == 0 else 'sweeps'}/LIDAR_TOP/n__LIDAR_TOP__{us[k]}.pcd.bin"
        q = quaternion(T)
        egos.append(
            {"token": f"e{k}", "rotation": [q[3], *q[:3]], "translation": T[:3, 3].tolist(), "timestamp": us[k]}
        )
        row = {"filename": name, "sample_token": "a", "timestamp": us[k], "calibrated_sensor_token": "c"}
        data.append({**row, "ego_pose_token": f"e{k}"})
        put(root / name, np.column_stack([ride.points(k), np.arange(50 + k) % 32]).astype("<f4").tobytes())
    camera = {**data[0], "filename": "samples/CAM_FRONT/x.jpg"}
    put(tables / "sample_data.json", json.dumps([camera, *data[::-1], {**data[0], "sample_token": "b"}]))
    put(tables / "ego_pose.json", json.dumps(egos))
    imu = ride.imu(ride.imu_stamps_ns(10))
    rows = zip(imu.stamps_ns.tolist(), imu.gyro_rad_s.tolist(), imu.accel_m_s2.tolist(), strict=True)
    messages = [{"utime": t // US, "rotation_rate": w, "linear_accel": a, "q": [1, 0, 0, 0]} for t, w, a in rows]
    put(root / "can_bus/scene-0061_ms_imu.json", json.dumps(messages))
    return Written(tables / "scene-0061", ride, np.eye(4))


def write_nclt(root: Path) -> Written:
    """The body's and the IMU's axes are forward, right, down."""
    ride = on_clock(Ride(T_imu_lidar=FRD @ nclt.T_IMU_LIDAR), US)
    folder = root / "2012-01-08"
    for k, t in enumerate(ride.stamps_ns):
        found = columns(ride, k)
        units = {axis: (sign * found[axis] + 100) / 0.005 for axis, sign in (("x", 1), ("y", -1), ("z", -1))}
        rounded = {axis: np.round(values) for axis, values in units.items()}
        kinds = [("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("i", "u1"), ("l", "u1")]
        put(folder / f"velodyne_sync/{t // US}.bin", structured(kinds, {**rounded, "i": found["intensity"] * 255}))
    imu = ride.imu(ride.imu_stamps_ns(10))
    sign = np.array([1, -1, -1])
    rows = zip(imu.stamps_ns.tolist(), imu.accel_m_s2 * sign, imu.gyro_rad_s * sign, strict=True)
    put(folder / "ms25.csv", "".join(f"{t // US},0.1,0.2,0.3,{floats(a)},{floats(w)}\n" for t, a, w in rows))
    T_imu_body = se3.inverse(se3.make(np.eye(3), [-0.11, -0.18, -0.71]))
    bodies = FRD @ world(ride) @ FRD @ T_imu_body  # in a frame of north, east, down
    angles = Rotation.from_matrix(bodies[:, :3, :3]).as_euler("xyz")
    truth = zip(ride.stamps_ns.tolist(), bodies[:, :3, 3], angles, strict=True)
    text = "".join(f"{t // US},{floats(p)},{floats(a)}\n" for t, p, a in truth)
    put(root / "ground_truth/groundtruth_2012-01-08.csv", f"1,nan,nan,nan,nan,nan,nan\n{text}")
    return Written(folder, ride, FRD, point_error_m=0.003)


def _xsens(ride: Ride) -> str:
    imu = ride.imu(ride.imu_stamps_ns(10))
    rows = zip(imu.stamps_ns.tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True)
    return "".join(f"{t},0,0,0,1,0,0,0,{floats(w)},{floats(a)},0.1,0.2,0.3\n" for t, w, a in rows)


def write_mulran(root: Path) -> Written:
    ride = Ride(T_imu_lidar=mulran.T_IMU_LIDAR)
    folder = root / "DCC01"
    for k, t in enumerate(ride.stamps_ns):
        put(folder / f"Ouster/{t}.bin", ride.points(k).astype("<f4").tobytes())
    put(folder / "xsens_imu.csv", _xsens(ride))
    bases = world(ride) @ ride.T_imu_lidar @ se3.inverse(mulran.T_BASE_LIDAR)
    rows = zip(ride.stamps_ns.tolist(), bases[:, :3], strict=True)
    put(folder / "global_pose.csv", "".join(f"{t},{floats(T)}\n" for t, T in rows))
    return Written(folder, ride, np.eye(4))


def write_helipr(root: Path) -> Written:
    ride = Ride(T_imu_lidar=helipr.T_IMU_OUSTER)
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]
    kinds += [("reflectivity", "<u2"), ("ring", "<u2"), ("ambient", "<u2")]
    for k, t in enumerate(ride.stamps_ns):
        values = columns(ride, k) | {"t": offsets_ns(50 + k)}
        put(root / f"LiDAR/Ouster/{t}.bin", structured(kinds, values))
    put(root / "Inertial_data/xsens_imu.csv", _xsens(ride))
    poses = world(ride) @ ride.T_imu_lidar
    put(root / "LiDAR_GT/global_Ouster_gt.txt", pose_rows(ride.stamps_ns, poses, str))
    return Written(root / "LiDAR/Ouster", ride, np.eye(4), span_s=0.099)


def write_boreas(root: Path) -> Written:
    ride, folder = on_clock(Ride(), US), root / "boreas-2021-09-02-11-42"
    kinds = [(name, "<f4") for name in ("x", "y", "z", "intensity", "ring", "t")]
    for k, t in enumerate(ride.stamps_ns):
        values = columns(ride, k) | {"t": offsets_ns(50 + k) / 1e9 - 0.05}
        put(folder / f"lidar/{t // US}.bin", structured(kinds, values))
    rows = []
    for t, T in zip(ride.stamps_ns.tolist(), world(ride) @ ride.T_imu_lidar, strict=True):
        roll, pitch, yaw = -Rotation.from_matrix(T[:3, :3]).as_euler("XYZ")
        rows.append(f"{t // US},{floats(T[:3, 3])},0,0,0,{floats(np.array([roll, pitch, yaw]))},0,0,0\n")
    put(
        folder / "applanix/lidar_poses.csv",
        "GPSTime,easting,northing,altitude,ve,vn,vu,r,p,h,wz,wy,wx\n" + "".join(rows),
    )
    return Written(folder, ride, np.eye(4), has_imu=False, span_s=0.099)


def pcd(values: dict[str, Array]) -> bytes:
    names = " ".join(values)
    sizes, kinds, ones = (" ".join([text] * len(values)) for text in ("4", "F", "1"))
    count = len(values["x"])
    head = f"VERSION 0.7\nFIELDS {names}\nSIZE {sizes}\nTYPE {kinds}\nCOUNT {ones}\nWIDTH {count}\nHEIGHT 1\n"
    body = structured([(name, "<f4") for name in values], values)
    return f"{head}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n".encode() + body


def write_newer_college(root: Path) -> Written:
    ride, folder = Ride(T_imu_lidar=newer_college.T_IMU_OUSTER_LIDAR), root / "01_short_experiment"
    for k, t in enumerate(ride.stamps_ns.tolist()):
        name = f"raw_format/ouster_scan/cloud_{t // 10**9}_{t % 10**9}.pcd"
        put(folder / name, pcd(columns(ride, k)))
    imu = ride.imu(ride.imu_stamps_ns(10))
    rows = zip(imu.stamps_ns.tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True)
    head = "#counter,sec,nsec,wx,wy,wz,ax,ay,az\n"
    text = "".join(f"{k},{t // 10**9},{t % 10**9},{floats(w)},{floats(a)}\n" for k, (t, w, a) in enumerate(rows))
    put(folder / "raw_format/ouster_imu/ouster_imu.csv", head + text)
    T_base_lidar = se3.make(Rotation.from_quat([0, 0, 0.924, 0.383]).as_matrix(), [-0.084, -0.025, 0.050])
    bases = world(ride) @ ride.T_imu_lidar @ se3.inverse(T_base_lidar)
    text = pose_rows(ride.stamps_ns, bases, lambda t: f"{t // 10**9},{t % 10**9}").replace(" ", ",")
    put(folder / "ground_truth/registered_poses.csv", f"#sec,nsec,x,y,z,qx,qy,qz,qw\n{text}")
    return Written(folder, ride, np.eye(4))


def write_argoverse_2(root: Path) -> Written:
    import pyarrow as pa
    from pyarrow import feather

    ride, folder = Ride(T_imu_lidar=np.eye(4)), root / "0a1b"
    (folder / "sensors/lidar").mkdir(parents=True)
    for k, t in enumerate(ride.stamps_ns):
        found = columns(ride, k)
        extra = {"laser_number": np.arange(50 + k).astype(np.uint8), "offset_ns": offsets_ns(50 + k).astype(np.int32)}
        feather.write_feather(pa.table({**found, **extra}), folder / f"sensors/lidar/{t}.feather")
    poses = world(ride)
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    table = {"timestamp_ns": ride.stamps_ns, "qw": q[:, 3], "qx": q[:, 0], "qy": q[:, 1], "qz": q[:, 2]}
    table |= {f"t{axis}_m": poses[:, i, 3] for i, axis in enumerate("xyz")}
    feather.write_feather(pa.table(table), folder / "city_SE3_egovehicle.feather")
    return Written(folder, ride, np.eye(4), has_imu=False)


def write_apollo(root: Path) -> Written:
    ride, folder = on_clock(Ride(), US), root / "ColumbiaPark"
    for k in range(ride.count):
        put(folder / f"pcds/{k + 1}.pcd", pcd(columns(ride, k)))
    poses = pose_rows(ride.stamps_ns, world(ride) @ ride.T_imu_lidar, lambda t: f"{t // 10**9}.{t % 10**9:09d}")
    text = "".join(f"{k + 1} {row}\n" for k, row in enumerate(poses.splitlines()))
    put(folder / "poses/gt_poses.txt", text)
    return Written(folder, ride, np.eye(4), has_imu=False)


WRITERS: dict[str, Callable[[Path], Written]] = {
    "kitti-360": write_kitti_360,
    "nuscenes": write_nuscenes,
    "nclt": write_nclt,
    "mulran": write_mulran,
    "helipr": write_helipr,
    "boreas": write_boreas,
    "newer-college": write_newer_college,
    "argoverse-2": write_argoverse_2,
    "apollo": write_apollo,
}
