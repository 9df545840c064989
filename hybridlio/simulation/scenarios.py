"""Scenarios by name: worlds, sensors and driving that are hard for odometry, and faults injected into a recording.

The scenarios of one seed share road and town as far as possible, so that each can be compared with ``normal``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybridlio.core.errors import ConfigError
from hybridlio.core.progress import Progress
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.faults import block_sector, drop_scans, imu_bias, imu_gap
from hybridlio.simulation.simulate import simulate

_SPEED_M_S, _HARD_SPEED_M_S = 10.0, 16.0  # ordinary and fast driving in a town: 36 and 58 km/h
# Faults that a robust system should survive: fifty scans with half a view, ten without inertial data, every fifth scan
# lost, and biases at the edge of what the noise model allows.
_BLOCKED_S, _IMU_GAP_S = 5.0, 1.0
_DROPPED_SHARE, _BIAS_SIGMAS = 0.2, 3.0


@dataclass(frozen=True)
class Scenario:
    """One scenario.

    Attributes:
        description: in words.
        settings: of the simulated drive, besides length and seed.
        fault: injects a fault; takes the recording and the drive's seed.
    """

    description: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    fault: Callable[[Sequence, int], Sequence] | None = None


def _blocked(sequence: Sequence, _seed: int) -> Sequence:
    middle_s = sequence.duration_s / 2
    return block_sector(sequence, middle_s - _BLOCKED_S / 2, middle_s + _BLOCKED_S / 2)


def _gap(sequence: Sequence, _seed: int) -> Sequence:
    middle_s = sequence.duration_s / 2
    return imu_gap(sequence, middle_s - _IMU_GAP_S / 2, middle_s + _IMU_GAP_S / 2)


SCENARIOS: dict[str, Scenario] = {
    "normal": Scenario("a town with some traffic, 64 beams, calm driving"),
    "corridor": Scenario("smooth parallel walls, which hardly constrain the motion along them", {"scene": "corridor"}),
    "field": Scenario("open ground and a few distant trees", {"scene": "field"}),
    "hard-driving": Scenario(
        "braking at 7 m/s² and bends at 6 m/s², from 16 m/s", {"driving": "hard", "speed_m_s": _HARD_SPEED_M_S}
    ),
    "heavy-traffic": Scenario("eight times as many moving cars", {"traffic_per_km": 96.0}),
    "rain": Scenario("violent rain, 50 mm/h, whose drops return light", {"rain_mm_h": 50.0}),
    "dust": Scenario("a drifting cloud of dust every 10 m", {"dust_per_km": 100.0}),
    "16-beam": Scenario("a lidar with 16 beams", {"lidar": "16-beam"}),
    "distortion": Scenario("the car moves during a sweep, and points have times", {"motion_distortion": True}),
    "dropped-scans": Scenario(
        "a fifth of the scans is lost", fault=lambda s, seed: drop_scans(s, _DROPPED_SHARE, seed)
    ),
    "blocked": Scenario("the front half of each scan is blocked for 5 s", fault=_blocked),
    "imu-gap": Scenario("no inertial samples for 1 s", fault=_gap),
    "imu-bias": Scenario("biases of three standard deviations", fault=lambda s, seed: imu_bias(s, _BIAS_SIGMAS, seed)),
}


def scenario_config(name: str, seed: int, length_m: float) -> SimulationConfig:
    """Return the settings of a scenario's drive.

    Raises:
        ConfigError: there is no such scenario; the message lists all.
    """
    settings = {"seed": seed, "length_m": length_m, "speed_m_s": _SPEED_M_S, **_scenario(name).settings}
    return SimulationConfig.model_validate(settings)


def open_scenario(
    name: str, out: Path, seed: int = 1, length_m: float = 300.0, progress: Progress | None = None
) -> Sequence:
    """Open a scenario's recording, simulated below ``out`` if it does not exist; faults are injected on reading.

    Scenarios that differ only in a fault share one drive on disk.

    Args:
        name: one of :data:`SCENARIOS`.
        out: a folder for the drives of all scenarios, each in its own folder.
        seed, length_m: of the drive.
        progress: see :func:`hybridlio.simulation.simulate.simulate`.

    Raises:
        ConfigError: there is no such scenario.
        DataError: ``out`` holds drives with other settings.
    """
    scenario = _scenario(name)
    world = name if scenario.settings else "normal"
    sequence = open_sequence(simulate(Path(out) / world, scenario_config(name, seed, length_m), progress))
    return sequence if scenario.fault is None else scenario.fault(sequence, seed)


def _scenario(name: str) -> Scenario:
    if name not in SCENARIOS:
        raise ConfigError(f"unknown scenario {name!r}; choose one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name]
