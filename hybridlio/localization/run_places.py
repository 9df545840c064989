"""The places of a finished run, with its odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory
from hybridlio.localization.map_places import MapPlaces
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.smoothing.loop_closure import keyframes_of, up_of
from hybridlio.smoothing.loop_verification import VerificationSettings
from hybridlio.smoothing.places import KeyframePlaces
from hybridlio.smoothing.step_uncertainty import OdometryChain


@dataclass(frozen=True, eq=False)
class RunPlaces:
    """A run whose places can be recognised.

    Attributes:
        keyframes: of the run.
        trajectory: its ``N`` poses.
        chain: uncertainty between them.
        map_places: the keyframes as places.
    """

    keyframes: LoopKeyframes
    trajectory: Trajectory
    chain: OdometryChain
    map_places: MapPlaces

    @classmethod
    def of(cls, record: Record, trajectory: Trajectory | None = None) -> RunPlaces:
        """Return the places of a run from its record.

        Args:
            record: of the run, with keyframes.
            trajectory: its poses, such as smoothed ones; by default those of the record.

        Raises:
            DataError: the record has no keyframes, or the trajectory other scans.
        """
        keyframes = keyframes_of(record)
        trajectory = trajectory or record.online
        if not np.array_equal(trajectory.stamps_ns, record.online.stamps_ns):
            raise DataError("the trajectory does not belong to this run: its stamps are others")
        if not len(keyframes):
            raise DataError("the run has no keyframes: its scans have too few points")
        chain = OdometryChain(trajectory, record.relative)
        places = KeyframePlaces(keyframes, chain, up_of(record), VerificationSettings().reach_m)
        return cls(keyframes, trajectory, chain, MapPlaces(places, trajectory.poses[keyframes.rows]))
