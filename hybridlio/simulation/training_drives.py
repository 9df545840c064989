"""Drives that differ as much as a network should bear, drawn from seeds: data to train on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.simulation.config import SimulationConfig

# Wide enough that no real drive on roads lies outside: walking pace to a motorway, empty roads to a car every 17 m.
_SPEEDS_M_S = (2.0, 33.0)
_TRAFFIC_PER_KM = (0.0, 60.0)
_PARKED = (0.0, 0.9)
_SCENES = {"town": 0.85, "field": 0.12, "corridor": 0.03}  # few corridors: there the scans do not determine the motion
_HARD = 0.3  # share of drivers who brake and turn hard
_MOVING_START = 0.8
_LOOPS = 0.15
# Beams of specimens of one model lie some tenths of a degree apart; wide enough to cover that, not measured.
_ELEVATION_SCALE, _ELEVATION_SHIFT_DEG, _BEAM_DEG = 0.02, 0.2, 0.04
_COLUMN_SHARES = (0.4, 0.5, 0.67)  # of a revolution's columns; the networks' maps have a fifth, and rays cost time


def training_drive(seed: int, seconds: float, lidar: str = "hdl-64e") -> tuple[SimulationConfig, LidarModel]:
    """Draw the settings of a drive and a specimen of the lidar.

    Speed, traffic, parked cars, scene, driver and start differ from seed to seed, as do the elevations of the beams, a
    little, and the number of columns.

    Args:
        seed: of the drive and of its world.
        seconds: duration.
        lidar: a name of :data:`hybridlio.core.lidar_models.LIDAR_MODELS`.

    Raises:
        ConfigError: the lidar is unknown.
    """
    rng = np.random.default_rng([seed, 1])
    config = SimulationConfig(
        seed=seed,
        seconds=seconds,
        lidar=lidar,
        traffic_per_km=float(rng.uniform(*_TRAFFIC_PER_KM)),
        parked=float(rng.uniform(*_PARKED)),
        speed_m_s=float(rng.uniform(*_SPEEDS_M_S)),
        driving="hard" if rng.random() < _HARD else "calm",
        scene=str(rng.choice(list(_SCENES), p=list(_SCENES.values()))),  # type: ignore[arg-type]
        start_moving=bool(rng.random() < _MOVING_START),
        loops=bool(rng.random() < _LOOPS),
    )
    return config, specimen(LIDAR_MODELS[lidar], rng)


def specimen(model: LidarModel, rng: np.random.Generator) -> LidarModel:
    """Return a lidar whose beams lie a little elsewhere than the model's, with fewer columns."""
    scale, shift_deg = 1 + _ELEVATION_SCALE * rng.normal(), _ELEVATION_SHIFT_DEG * rng.normal()
    elevations = scale * np.array(model.elevations_deg) + shift_deg + _BEAM_DEG * rng.normal(size=model.beams)
    columns = int(rng.choice(_COLUMN_SHARES) * model.columns)
    return replace(model, elevations_deg=tuple(np.sort(elevations)[::-1].tolist()), columns=columns)
