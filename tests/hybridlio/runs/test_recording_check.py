"""The check of a recording before a run."""

from dataclasses import replace

import numpy as np
import pytest
from handheld import Handheld, as_sequence, carried, changed, swept

from hybridlio.calibration.imu_check import moved
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.runs.recording_check import check_recording


@pytest.fixture(scope="module")
def walk() -> Handheld:
    return carried(np.random.default_rng(5), seconds=9.0, turning=0.6)


def test_an_offset_is_applied_and_noted(rng: np.random.Generator, walk: Handheld):
    late = as_sequence(rng, walk, moved(walk.imu, 0.05))
    found = check_recording(late)
    assert found.imu_time_offset_s == pytest.approx(-0.05, abs=2e-3)
    np.testing.assert_allclose(found.imu.stamps_ns, walk.imu.stamps_ns, atol=2e6)
    assert [note.kind for note in found.notes] == ["corrected"]


def test_scans_distorted_by_a_fast_hand_give_the_offset_that_compensates_them(rng: np.random.Generator):
    fast = carried(np.random.default_rng(6), seconds=8.0, turning=1.0)
    found = check_recording(swept(rng, fast, moved(fast.imu, 0.12)))
    assert found.imu_time_offset_s == pytest.approx(-0.12, abs=1e-3)


def test_a_recording_whose_clocks_agree_keeps_its_samples(rng: np.random.Generator, walk: Handheld):
    right = as_sequence(rng, walk)
    found = check_recording(right)
    assert found.imu is right.imu
    assert found.notes == ()
    assert found.imu_time_offset_s is None


def test_a_stated_offset_is_not_searched_for(rng: np.random.Generator, walk: Handheld):
    stated = replace(as_sequence(rng, walk, moved(walk.imu, 0.05)), imu_time_offset_s=0.0)
    assert check_recording(stated) is stated


def test_wrong_data_end_the_run_with_what_to_do(rng: np.random.Generator, walk: Handheld):
    swapped = changed(walk.imu, lambda w: w[:, [1, 0, 2]], lambda f: f[:, [1, 0, 2]])
    with pytest.raises(DataError, match=r"walk: the IMU's axes are mirrored.*Exchange or negate.*--no-check"):
        check_recording(as_sequence(rng, walk, swapped))


def test_a_recording_without_imu_passes_unchanged(rng: np.random.Generator, walk: Handheld):
    sequence = replace(as_sequence(rng, walk), imu=ImuSamples.empty())
    assert check_recording(sequence) is sequence


def test_a_recording_too_short_or_calm_to_find_the_offset_says_so(rng: np.random.Generator, walk: Handheld):
    late = as_sequence(rng, walk, moved(walk.imu, 0.05))
    calm = carried(np.random.default_rng(5), seconds=9.0, turning=0.002)
    for sequence, reason in (
        (late.part(0, 40), "too few scans could be compared"),
        (as_sequence(rng, calm), "the motion shows it only to "),
    ):
        found = check_recording(sequence)
        np.testing.assert_array_equal(found.imu.stamps_ns, sequence.imu.stamps_ns)
        assert found.imu_time_offset_s is None
        (note,) = found.notes
        assert f"offset of the IMU's clock was not found: {reason}" in note
        assert "state imu_time_offset_s" in note


def test_unreadable_scans_are_passed_over(rng: np.random.Generator, walk: Handheld):
    whole = as_sequence(rng, walk, moved(walk.imu, 0.05))

    def load(k: int) -> object:
        if k == 30:
            raise DataError("frame 30: broken")
        return whole.load_scan(k)

    found = check_recording(replace(whole, load_scan=load))
    assert found.imu_time_offset_s == pytest.approx(-0.05, abs=2e-3)
