"""Fixtures for all tests: real recordings, random numbers, a small drive, untrained weights. Limits threads."""

from __future__ import annotations

import os

if os.environ.get("PYTEST_XDIST_WORKER"):  # before NumPy and PyTorch load: one thread for each worker
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import fcntl
import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The checkout's root."""
    return ROOT


@pytest.fixture
def rng() -> np.random.Generator:
    """A random generator with the same seed in every test."""
    return np.random.default_rng(20240229)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of packed real recordings; without it the test is skipped."""
    folder = Path(os.environ.get("HYBRIDLIO_SHARED_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "unpack.py").is_file():
        pytest.skip(f"no real recordings at {folder} (set HYBRIDLIO_SHARED_DATA to the folder that holds unpack.py)")
    return folder


@pytest.fixture(scope="session")
def unpacked_recordings(shared_data: Path) -> Path:
    """The real recordings in KITTI's layout, unpacked once for all workers and later runs."""
    default = Path(tempfile.gettempdir()) / f"hybridlio-recordings-{os.getuid()}"
    cache = Path(os.environ.get("HYBRIDLIO_CACHE", default))
    cache.mkdir(parents=True, exist_ok=True)
    script = shared_data / "unpack.py"
    version = hashlib.sha256(script.read_bytes()).hexdigest()
    done = cache / "unpacked.sha256"
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file closes, even if the worker dies
        if not (done.is_file() and done.read_text() == version):
            subprocess.run([sys.executable, str(script), str(cache)], check=True, stdout=subprocess.DEVNULL)
            done.write_text(version)
    return cache


@pytest.fixture(scope="session")
def kitti_raw_root(unpacked_recordings: Path) -> Path:
    """The folder that holds ``2011_09_26/2011_09_26_drive_0005_sync`` (154 scans), ``0048`` (22) and ``0060`` (20)."""
    return unpacked_recordings / "kitti_raw"


@pytest.fixture(scope="session")
def kitti_odometry_root(unpacked_recordings: Path) -> Path:
    """The folder that holds ``sequences/00`` (10 scans) and ``poses`` (ground truth in the camera frame)."""
    return unpacked_recordings / "kitti_odometry"


@pytest.fixture(scope="session")
def tiny_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive of 25 scans with a 16-beam sensor, started at 10 m/s. Tests must not change it."""
    from hybridlio.simulation import SimulationConfig, simulate

    return simulate(tmp_path_factory.mktemp("drive"), SimulationConfig(seconds=2.5, seed=3, lidar="16-beam"))


@pytest.fixture(scope="session")
def untrained_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained weights for the 16-beam lidar.

    Their LSTMs keep the last velocity without rotation. Their residual is that of the projective steps alone, which
    corrects errors of about 0.1 m.
    """
    import torch

    from hybridlio.cloud.map_geometry import MAP_GEOMETRIES
    from hybridlio.learned.networks.odometry_network import OdometryNetwork
    from hybridlio.learned.networks.weights import save_weights
    from hybridlio.learned.settings import NetworkSettings, Recipe

    small: dict[str, Any] = {
        "imu_hidden": 8,
        "imu_layers": 1,
        "stem": 8,
        "stages": (8, 16),
        "blocks": 1,
        "features": 16,
    }
    settings = NetworkSettings(
        geometry=MAP_GEOMETRIES["16-beam"], siamese="twins", normalisation="group", velocity=True, projective_steps=4,
        residual_scale=1e-9, **small,
    )  # fmt: skip
    torch.manual_seed(0)
    network = OdometryNetwork(settings)
    assert network.imu_network is not None
    for layer in (network.imu_network.translation, network.imu_network.rotation):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    save_weights(path, network, Recipe("untrained", settings), {"data": "none"})
    return path
