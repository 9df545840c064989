"""Simulation of a platform, written as a plain folder."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.files import locked, write_atomically
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import ImuSamples, Scan
from hybridlio.core.trajectory import write_tum
from hybridlio.datasets.protection import check_output
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.recording import PlatformRecording, plan

FORMAT_VERSION = 1
_SCAN = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]


def simulate_platform(out: Path, config: PlatformConfig, progress: Progress | None = None) -> Path:
    """Simulate a recording of a platform and write it below ``out`` as a plain folder.

    The recording appears when it is complete. Until then it is in a hidden folder of ``out``, from which a later run
    with the same settings resumes. A finished recording with the same settings is not simulated again.

    Args:
        out: the folder to write to; created if missing.
        config: the settings.
        progress: called after each scan with an empty stage, scans done and scans in total.

    Returns:
        The recording's folder, ``OUT/<scene>-<platform>-<lidar>-<seed>``: scans with point times, 200 Hz inertial data,
        calibration, exact poses, and the settings in ``simulation.json``.

    Raises:
        DataError: ``out`` holds another recording in its place, or cannot be written to.
        ConfigError: ``out`` is or lies inside a recording.
    """
    check_output(out, may_hold=True)
    done, partial = Path(out) / config.name, Path(out) / f".partial-{config.name}"
    description = describe(config)
    if done.exists():
        _require_same(done, description)
        return done
    with locked(Path(out) / f".lock-{config.name}"):
        if not done.exists():
            _start(partial, description)
            _write(partial, plan(config), progress)
            partial.rename(done)
    return done


def describe(config: PlatformConfig) -> dict[str, Any]:
    """Return the content of ``simulation.json``."""
    return {"version": FORMAT_VERSION, "platform": json.loads(config.model_dump_json())}


def _start(partial: Path, description: dict[str, Any]) -> None:
    """Prepare the hidden folder; leftovers of a run with other settings are removed."""
    path = partial / "simulation.json"
    if partial.exists() and not (path.is_file() and json.loads(path.read_text()) == description):
        shutil.rmtree(partial)
    write_atomically(path, json.dumps(description, indent=2) + "\n")


def _require_same(done: Path, description: dict[str, Any]) -> None:
    path = done / "simulation.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise DataError(f"{done} exists and is no simulated recording; choose another folder") from None
    if _completed(found) != description:
        raise DataError(f"{path} describes a recording with other settings; choose another folder or seed")


def _completed(found: Any) -> Any:
    """Return the description with defaults for settings that did not exist when it was written."""
    if not isinstance(found, dict) or not isinstance(found.get("platform"), dict):
        return found
    return {**found, "platform": json.loads(PlatformConfig().model_dump_json()) | found["platform"]}


def _write(folder: Path, recording: PlatformRecording, progress: Progress | None) -> None:
    stamps = recording.scan_stamps_ns
    for k in range(len(stamps)):
        place = folder / "scans" / f"{k:06d}.npy"
        if not place.exists():
            write_atomically(place, _scan_bytes(recording.scan(k)))
        if progress is not None:
            progress("", k + 1, len(stamps))
    write_atomically(folder / "timestamps.txt", "".join(f"{stamp}\n" for stamp in stamps))
    write_atomically(folder / "imu.csv", _imu_csv(recording.imu_samples()))
    write_atomically(folder / "calibration.yaml", _calibration(recording))
    write_tum(folder / "poses_tum.txt", recording.reference())


def _scan_bytes(scan: Scan) -> bytes:
    """Return a scan as ``.npy``: columns by name, times in ns from the scan's stamp."""
    rows = np.zeros(len(scan), _SCAN)
    for axis, name in enumerate("xyz"):
        rows[name] = scan.points[:, axis]
    rows["intensity"], rows["t"] = scan.intensity, scan.time_offsets_ns
    buffer = io.BytesIO()
    np.save(buffer, rows)
    return buffer.getvalue()


def _imu_csv(imu: ImuSamples) -> str:
    rows = ["stamp_ns,gx,gy,gz,ax,ay,az"]
    for stamp, gyro, accel in zip(imu.stamps_ns, imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        rows.append(",".join([str(stamp), *(f"{v:.9g}" for v in (*gyro, *accel))]))
    return "\n".join(rows) + "\n"


def _calibration(recording: PlatformRecording) -> str:
    """Return ``calibration.yaml``: the extrinsics, and what the times mean. The IMU's noise is left to be found."""
    rows = "".join(f"  - [{', '.join(f'{v:.15g}' for v in row)}]\n" for row in recording.T_imu_lidar)
    return f"T_imu_lidar:\n{rows}point_times: {{column: t, unit: ns, origin: stamp}}\n"
