"""How far the position may be off beside what the graph knows, because scans, map and IMU contradict each other.

Where neither scans nor IMU are shown to be right, the path since the IMU last confirmed the scans is doubted, by its
length. That is so in two cases:

* Scans that are believed without the IMU move abruptly and contradict it grossly, as after a false start, whose speed
  changes with every scan.
* The scans no longer fit the map as the scans before did, as where they jump, or the sensor was carried to another
  place. While such scans are bridged, the next one may still show that nothing was lost. The doubt stays once the path
  goes on from a scan that fits poorly, or a new map begins because none fits the old one.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.estimates import RelativePose
from hybridlio.sources.gate.usual_fit import UsualFit

NEW_MAP = "new_map"  # in the details of a failed relative pose: the residual source has begun a new map at its scan


class PositionDoubt:
    """Follows the steps of a run.

    Args:
        confirmed_after: number of accepted steps in a row by which the IMU confirms the path.
    """

    def __init__(self, confirmed_after: int) -> None:
        self._confirmed_after = confirmed_after
        self._fit = UsualFit()
        self._stays_m2 = 0.0
        self._unconfirmed_m = 0.0  # length of the path since the IMU last confirmed it
        self._accepted_in_a_row = 0
        self._contradicted = False  # a scan has contradicted the IMU grossly; the IMU has not agreed since
        self._misfit = False  # scans that fit poorly have contradicted the IMU, or failed; the IMU has not agreed since

    @property
    def m2(self) -> float:
        """Variance of the position, per axis."""
        return self._stays_m2 + (self._unconfirmed_m**2 if self._misfit and self._accepted_in_a_row == 0 else 0.0)

    @property
    def lasting_m(self) -> float:
        """The part that stays, as a standard deviation."""
        return float(np.sqrt(self._stays_m2))

    def learn(self, measured: RelativePose, own: RelativePose, verdict: str, is_gross: bool, is_doubtful: bool) -> None:
        """Take a step.

        Args:
            measured: the residual source's relative pose.
            own: the same, from where the scan before was found.
            verdict: the innovation gate's.
            is_gross: whether the step contradicts the IMU grossly.
            is_doubtful: whether the scans are believed without the IMU, move abruptly and contradict it grossly.
        """
        self._note_path(own, verdict)
        self._note_fit(measured, verdict, is_gross)
        if is_doubtful or self._goes_on_from_misfit(measured, verdict):
            self._stays_m2, self._unconfirmed_m = self._stays_m2 + self._unconfirmed_m**2, 0.0

    def _note_path(self, own: RelativePose, verdict: str) -> None:
        """Add the step to the path that the IMU has not confirmed; it confirms the path by agreeing for a while."""
        self._accepted_in_a_row = self._accepted_in_a_row + 1 if verdict == "accepted" else 0
        is_path = own.ok or "matched" in own.details  # of a scan that matched nowhere, the bridge
        self._unconfirmed_m += float(np.linalg.norm(own.pose[:3, 3])) if is_path else 0.0
        if self._accepted_in_a_row >= self._confirmed_after:
            self._unconfirmed_m = 0.0

    def _note_fit(self, measured: RelativePose, verdict: str, is_gross: bool) -> None:
        """Note whether scans fit the map poorly since one contradicted the IMU grossly, or match nowhere.

        The scan that contradicts may itself fit well, on the few points that it shares with the map.
        """
        is_refused = is_gross and verdict in ("undecided", "rejected", "relocated")
        is_confirmed = self._accepted_in_a_row >= self._confirmed_after
        self._contradicted = (self._contradicted or is_refused) and not is_confirmed
        self._misfit = self._misfit and not is_confirmed
        if self._contradicted or not measured.ok:
            self._misfit = self._misfit or self._fit.is_poor(measured.details)
        elif verdict == "accepted":
            self._fit.learn(measured.details)

    def _goes_on_from_misfit(self, measured: RelativePose, verdict: str) -> bool:
        """Whether the path goes on from a scan that does not fit the map, and by more than the IMU's bridge."""
        if not self._misfit:
            return False
        if not measured.ok:
            return NEW_MAP in measured.details
        is_followed = verdict in ("accepted", "down-weighted") and self._fit.is_poor(measured.details)
        return is_followed or verdict in ("untested", "IMU left out", "relocated")
