"""Simulate the drives that the shipped weights were trained on: ``python benchmarks/training_drives.py DIR``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hybridlio.simulation import SimulationConfig, simulate

SECONDS = 20.0
DRIVES: dict[int, dict[str, Any]] = {  # settings by seed
    1001: {"speed_m_s": 10},
    1002: {"speed_m_s": 14, "traffic_per_km": 30},
    1003: {"speed_m_s": 7, "parked": 0.9},
    1004: {"speed_m_s": 18, "traffic_per_km": 20},
    1006: {"speed_m_s": 12, "start_moving": False},
    1007: {"speed_m_s": 22, "traffic_per_km": 25, "parked": 0.2},
    1008: {"speed_m_s": 5, "traffic_per_km": 40},
    1010: {"speed_m_s": 9, "loops": True},
    1011: {"speed_m_s": 16, "parked": 0.8},
    1012: {"speed_m_s": 26, "traffic_per_km": 15},
    1013: {"speed_m_s": 8, "traffic_per_km": 5},
    1014: {"speed_m_s": 13, "parked": 0.1, "traffic_per_km": 35},
    1016: {"speed_m_s": 11, "traffic_per_km": 10},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="for the drives")
    folder = parser.parse_args().folder
    for seed, settings in DRIVES.items():
        print(simulate(folder, SimulationConfig(seed=seed, seconds=SECONDS, **settings)), flush=True)


if __name__ == "__main__":
    main()
