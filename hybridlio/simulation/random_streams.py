"""Random streams of a simulated drive."""

from __future__ import annotations

from enum import IntEnum


class RandomStream(IntEnum):
    """What a stream of random numbers decides.

    Generators are seeded with ``[seed, stream]``, so that streams are independent: a change of one part of the
    simulation, such as traffic, leaves the others as they are.
    """

    ROAD = 1
    GROUND = 2
    LAND = 3
    LAYOUT = 4
    TRAFFIC = 5
    IMU = 6
    ITEM = 7  # and the item's number
    GPS = 8
    SCAN = 9  # and the scan's number
    DROPPED_SCANS = 11
    IMU_BIAS = 12
    SCENE = 13
    MOTION = 14
    MOUNT = 15
    AIR = 16  # and the scan's number
    DUST = 17
    PEOPLE = 18  # and the person's number
    IMU_SCALE = 19
    LIDAR_ERRORS = 20
