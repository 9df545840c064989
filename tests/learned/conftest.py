"""Small training shards of a box-shaped room seen by a moving sensor, so that tests need no simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.cloud.projection import vertex_map
from hybridlio.core import se3
from hybridlio.learned.data.shards import ScanRecord, Shard, write_shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import save_weights
from hybridlio.learned.settings import LossSettings, NetworkSettings, OptimiserSettings, Recipe

GEOMETRY = MapGeometry(20.0, -20.0, 12, 60)
SEEN_GEOMETRY = MapGeometry(40.0, -40.0, 40, 180)
NETWORK = NetworkSettings(
    geometry=GEOMETRY,
    siamese="twins",
    normalisation="group",
    imu_hidden=8,
    imu_layers=1,
    stem=8,
    stages=(8, 16),
    blocks=1,
    features=16,
    vertex_scale_m=10.0,
)
RECIPE = Recipe(
    "tiny",
    NETWORK,
    LossSettings(reduction="mean"),
    OptimiserSettings(epochs=3, batch=4, learning_rate=2e-3, step_epochs=2),
)


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread: small networks are slower on two, and tests run in parallel."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def seen_room(T_world_lidar: np.ndarray, half: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (N, 3) in the lidar frame, on the walls of a box around the world's origin."""
    rays = rng.normal(size=(1500, 3)) * [1.0, 1.0, 0.25]
    return hit_walls(rays / np.linalg.norm(rays, axis=1, keepdims=True), T_world_lidar, half)


def hit_walls(rays: np.ndarray, T_world_lidar: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where unit rays (N, 3), lidar frame, meet the walls of the box, and the walls' normals."""
    turned = rays @ T_world_lidar[:3, :3].T
    ranges = (half * np.sign(turned) - T_world_lidar[:3, 3]) / turned
    wall = ranges.argmin(axis=1)
    normals = -np.eye(3)[wall] * np.sign(turned[np.arange(len(wall)), wall])[:, None]
    points = rays * ranges.min(axis=1, keepdims=True)
    return points.astype(np.float32), (normals @ T_world_lidar[:3, :3]).astype(np.float32)


def room_records(count: int, seed: int) -> list[ScanRecord]:
    """Return scans of a room on a winding path, with IMU rows that match each step."""
    rng = np.random.default_rng(seed)
    half, T = rng.uniform([6, 5, 2], [9, 8, 3]), np.eye(4)
    records = []
    for k in range(count):
        xi = rng.normal(size=6) * [0.0, 0.0, 0.05, 0.25, 0.1, 0.0]
        step = se3.exp(xi)
        T = T @ step if k else T
        if np.abs(T[:3, 3]).max() > 3.0:
            T[:3, 3] *= 0.0
            step = None
        points, normals = seen_room(T, half, rng)
        imu = np.tile(np.r_[xi[:3] / 0.1, xi[3:] * 4 + [0, 0, 9.81]], (15, 1)).astype(np.float32)
        known = k > 0 and step is not None
        records.append(
            ScanRecord(
                vertex_map(points, GEOMETRY),
                points[:400],
                normals[:400],
                imu=imu if known else None,
                dt_s=0.1,
                initial=step if known else None,
                reference=step if known else None,
            )
        )
    return records


@pytest.fixture(scope="session")
def room_shards(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two shards of synthetic rooms: 17 training scans, and 9 scans of another room."""
    folder = tmp_path_factory.mktemp("rooms")
    write_shard(folder / "one", room_records(17, 1), "room one", GEOMETRY, 15)
    write_shard(folder / "two", room_records(9, 2), "room two", GEOMETRY, 15)
    return folder / "one", folder / "two"


@pytest.fixture
def rooms(room_shards: tuple[Path, Path]) -> tuple[Shard, Shard]:
    """The two shards, opened."""
    return Shard(room_shards[0]), Shard(room_shards[1])


@pytest.fixture
def winding(tmp_path: Path) -> Shard:
    """A drive of 12 scans without gaps, with a velocity at each but the first; its steps are synthetic."""
    rng = np.random.default_rng(5)
    records = []
    for k, record in enumerate(room_records(12, 3)):
        step = se3.exp(rng.normal(size=6) * [0, 0, 0.02, 0.1, 0.05, 0]) @ se3.exp([0, 0, 0, 0.5, 0, 0])
        velocity = np.array([5.0, 0, 0]) if k else None
        imu = np.zeros((15, 6), np.float32)
        records.append(replace(record, reference=step, imu=imu, velocity_m_s=velocity))
    write_shard(tmp_path / "winding", records, "winding", GEOMETRY, 15)
    return Shard(tmp_path / "winding")


@dataclass(frozen=True, eq=False)
class ScanMaps:
    """A prepared scan."""

    points: np.ndarray
    vertex_map: np.ndarray = field(init=False)
    usable: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertex_map", vertex_map(self.points, SEEN_GEOMETRY))


@pytest.fixture
def seen() -> Callable[..., ScanMaps]:
    """Simulate a spinning lidar's scan of a box-shaped room, from a pose, with 1 cm of noise."""
    elevations, azimuths = np.deg2rad(np.arange(-39, 40, 2)), np.deg2rad(np.arange(1, 360, 2))
    up, around = (angles.ravel() for angles in np.meshgrid(elevations, azimuths, indexing="ij"))
    rays = np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])

    def see(T_world_lidar: np.ndarray, half: tuple[float, float, float] = (8.0, 6.0, 2.5), seed: int = 0) -> ScanMaps:
        rng = np.random.default_rng(seed)
        points, normals = hit_walls(rays, T_world_lidar, np.array(half))
        return ScanMaps((points + normals * rng.normal(size=(len(points), 1)) * 0.01).astype(np.float32))

    return see


@pytest.fixture
def seeing_recipe() -> Recipe:
    """The tiny recipe with the map geometry of ``seen``."""
    return replace(RECIPE, network=replace(NETWORK, geometry=SEEN_GEOMETRY))


@pytest.fixture
def tiny_recipe() -> Recipe:
    """A recipe that trains in a second."""
    return RECIPE


@pytest.fixture
def weights(seeing_recipe: Recipe, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes untrained weights, with changed settings, whose δT is nearly the identity."""

    def write(**changes: Any) -> Path:
        recipe = replace(seeing_recipe, network=replace(seeing_recipe.network, residual_scale=1e-6, **changes))
        torch.manual_seed(0)
        save_weights(tmp_path / "w.safetensors", OdometryNetwork(recipe.network), recipe, {})
        return tmp_path / "w.safetensors"

    return write
