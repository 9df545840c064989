"""Hard cases by name: worlds, sensors and ways of driving that odometry finds hard, and faults put into a recording.

The cases of one seed share road and town as far as they can, so that each can be held against ``normal``.
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

_SPEED_M_S, _HARD_SPEED_M_S = 10.0, 16.0


@dataclass(frozen=True)
class Scenario:
    """One hard case.

    Attributes:
        what: in words.
        settings: of the simulated drive, beside its length and seed.
        fault: what is done to the recording; it is given the recording and the drive's seed.
    """

    what: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    fault: Callable[[Sequence, int], Sequence] | None = None


def _blocked(sequence: Sequence, _seed: int) -> Sequence:
    middle_s = sequence.duration_s / 2
    return block_sector(sequence, middle_s - 2.5, middle_s + 2.5)


def _gap(sequence: Sequence, _seed: int) -> Sequence:
    middle_s = sequence.duration_s / 2
    return imu_gap(sequence, middle_s - 0.5, middle_s + 0.5)


SCENARIOS: dict[str, Scenario] = {
    "normal": Scenario("a town with some traffic, 64 beams, calm driving"),
    "corridor": Scenario("smooth parallel walls: hardly anything says how far one went", {"scene": "corridor"}),
    "field": Scenario("open ground and a few distant trees", {"scene": "field"}),
    "hard-driving": Scenario(
        "brakes at 7 m/s² and bends at 6 m/s² from 16 m/s", {"driving": "hard", "speed_m_s": _HARD_SPEED_M_S}
    ),
    "heavy-traffic": Scenario("eight times the moving cars", {"traffic_per_km": 96.0}),
    "16-beam": Scenario("a sensor of 16 beams", {"lidar": "16-beam"}),
    "distortion": Scenario("the car moves during a sweep, and points carry times", {"motion_distortion": True}),
    "dropped-scans": Scenario("a fifth of the scans is lost", fault=lambda s, seed: drop_scans(s, 0.2, seed)),
    "blocked": Scenario("the front half of each scan is blocked for 5 s", fault=_blocked),
    "imu-gap": Scenario("no inertial samples for 1 s", fault=_gap),
    "imu-bias": Scenario("biases three times what is assumed", fault=lambda s, seed: imu_bias(s, 3.0, seed)),
}


def scenario_config(name: str, seed: int, length_m: float) -> SimulationConfig:
    """The simulated drive of a scenario.

    Raises:
        ConfigError: there is no such scenario; lists those there are.
    """
    settings = {"seed": seed, "length_m": length_m, "speed_m_s": _SPEED_M_S, **_scenario(name).settings}
    return SimulationConfig.model_validate(settings)


def open_scenario(
    name: str, out: Path, seed: int = 1, length_m: float = 300.0, progress: Progress | None = None
) -> Sequence:
    """A scenario's recording, simulated below ``out`` unless it is there; faults are put in while it is read.

    Scenarios that differ in nothing but a fault share one drive on disk.

    Args:
        name: one of :data:`SCENARIOS`.
        out: a folder for the drives of all scenarios, one below it for each.
        seed, length_m: of the drive.
        progress: as of :func:`hybridlio.simulation.simulate.simulate`.

    Raises:
        ConfigError: there is no such scenario.
        DataError: ``out`` holds other drives.
    """
    scenario = _scenario(name)
    world = name if scenario.settings else "normal"
    sequence = open_sequence(simulate(Path(out) / world, scenario_config(name, seed, length_m), progress))
    return sequence if scenario.fault is None else scenario.fault(sequence, seed)


def _scenario(name: str) -> Scenario:
    if name not in SCENARIOS:
        raise ConfigError(f"unknown scenario {name!r}; choose one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name]
