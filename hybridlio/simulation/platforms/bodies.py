"""The bodies that carry sensors, and how each moves along the way.

Speeds and gaits are those of people and machines at work. A person walks at 1.2 to 1.5 m/s with 1.8 steps a second,
and the trunk rises and falls by 2 to 3 cm (Winter, "Biomechanics and Motor Control of Human Movement"). The other
figures are judgement: what videos and data of such platforms show.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Body:
    """How a body moves.

    Attributes:
        description: in words.
        speed_m_s: on a straight way.
        side_m_s2: largest sideways acceleration in bends, which slows it there.
        corner_m: length over which corners are rounded.
        height_m: of the lidar over the floor.
        step_hz: steps a second at full speed; 0 without legs.
        bounce_m, sway_m: amplitudes up and down with each step, and sideways with every second step.
        step_rad: amplitude of roll and pitch with the steps.
        tremor_rad: amplitude of small fast rotations: hands, motors or the ground.
        tremor_hz: lowest and highest frequency of these.
        look_rad: amplitude of slow turns of the head against the way, yaw and pitch.
        spins_per_s: fast turns a second, which a drone makes.
        climb_m: largest change of height over the way, which a drone makes.
        lever_m: largest distance of the IMU from the lidar on each axis.
    """

    description: str
    speed_m_s: float
    side_m_s2: float
    corner_m: float
    height_m: float
    step_hz: float = 0.0
    bounce_m: float = 0.0
    sway_m: float = 0.0
    step_rad: float = 0.0
    tremor_rad: float = 0.0
    tremor_hz: tuple[float, float] = (4.0, 9.0)
    look_rad: tuple[float, float] = (0.0, 0.0)
    spins_per_s: float = 0.0
    climb_m: float = 0.0
    lever_m: float = 0.1


BODIES: dict[str, Body] = {
    "handheld": Body(
        "carried by a walking person, who looks around",
        *(1.4, 1.2, 0.35, 1.35),
        step_hz=1.8, bounce_m=0.025, sway_m=0.02, step_rad=0.025, tremor_rad=0.004, look_rad=(0.6, 0.2), lever_m=0.15,
    ),
    "quadruped": Body(
        "a dog-like robot that trots",
        *(1.1, 1.5, 0.3, 0.6),
        step_hz=3.4, bounce_m=0.010, sway_m=0.008, step_rad=0.03, tremor_rad=0.005, tremor_hz=(7.0, 13.0),
    ),
    "robot": Body(
        "a wheeled ground robot",
        *(1.3, 0.5, 0.6, 0.7),
        tremor_rad=0.002, tremor_hz=(2.0, 8.0), lever_m=0.3,
    ),
    "drone": Body(
        "flies between obstacles, with turns of several 100 °/s",
        *(5.0, 5.0, 3.0, 1.5),
        tremor_rad=0.003, tremor_hz=(8.0, 14.0), look_rad=(0.4, 0.05), spins_per_s=0.35, climb_m=6.0,
    ),
    "car": Body(
        "a car or van",
        *(9.0, 2.0, 4.0, 1.9),
        tremor_rad=0.002, tremor_hz=(0.8, 2.5), lever_m=0.8,
    ),
}  # fmt: skip
