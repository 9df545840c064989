"""A mapped town, another drive through it, and one through another town."""

from __future__ import annotations

import pytest
from mapped_towns import MappedTown, TownDrive, town_drive

from hybridlio.localization.open_map import map_of_record


@pytest.fixture(scope="session")
def town() -> MappedTown:
    """A town with the map of a first drive."""
    drive = town_drive(9601)
    record = drive.record()
    return MappedTown(drive, record, map_of_record(record))


@pytest.fixture(scope="session")
def again() -> TownDrive:
    """A second drive through the town, with other traffic and other parked cars."""
    return town_drive(9601, 9701)


@pytest.fixture(scope="session")
def elsewhere() -> TownDrive:
    """A drive through another town."""
    return town_drive(9602)
