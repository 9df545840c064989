"""Spikes in IMU samples. Filled gaps are tested with georeferencing, in smoothing/test_georeference.py."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.imu_faults import clipped, spikes
from hybridlio.datasets.registry import open_sequence, without_false_samples


def driving(rng: np.random.Generator, count: int = 1000) -> ImuSamples:
    """Hard turns and braking at 100 Hz, with vibration of 1 m/s²."""
    t = np.arange(count) / 100
    gyro = np.column_stack([0.1 * np.sin(9 * t), 0.2 * np.sin(5 * t), 1.2 * np.sin(2 * t)])
    accel = np.column_stack([7 * np.sin(t), 6 * np.cos(2 * t), np.full(count, 9.81)])
    noise = rng.normal(size=(2, count, 3))
    return ImuSamples(np.arange(count) * 10**7, gyro + 0.01 * noise[0], accel + noise[1])


@pytest.mark.parametrize(
    ("gyro", "accel"), [([0, 0, 35], None), ([20, 20, 20], None), (None, [0, 0, 1e3]), (None, [-300, 0, 0])]
)
@pytest.mark.parametrize("row", [0, 1, 500, 998, 999])
def test_a_spike_is_found_at_any_row(rng, row, gyro, accel):
    imu = driving(rng)
    for values, spike in ((imu.gyro_rad_s, gyro), (imu.accel_m_s2, accel)):
        if spike is not None:
            values[row] = spike
    assert spikes(imu).tolist() == [row]


def test_two_spikes_in_a_row_are_found(rng):
    imu = driving(rng)
    imu.gyro_rad_s[500:502] = 35.0
    assert spikes(imu).tolist() == [500, 501]


def test_driving_handheld_wrong_units_and_short_recordings_have_no_spikes(rng):
    imu = driving(rng)
    hand = ImuSamples(imu.stamps_ns, 4 * imu.gyro_rad_s, 3 * imu.accel_m_s2)
    degrees = ImuSamples(
        imu.stamps_ns, np.rad2deg(driving(rng).gyro_rad_s + 0.1 * rng.normal(size=(1000, 3))), imu.accel_m_s2
    )
    few = ImuSamples(np.arange(3), np.diag([0.0, 99.0, 0.0]), np.zeros((3, 3)))
    for one in (imu, hand, degrees, few, ImuSamples.empty()):
        assert len(spikes(one)) == 0


def test_opening_a_recording_drops_spikes_with_a_note(tiny_drive: Path, tmp_path: Path):
    date = shutil.copytree(tiny_drive.parent, tmp_path / tiny_drive.parent.name)
    clean = open_sequence(date)
    (rows,) = date.glob("*_extract/oxts/data")
    row = sorted(rows.iterdir())[150]
    fields = row.read_text().split()
    fields[17:20] = ["0", "0", "35"]  # wx wy wz
    row.write_text(" ".join(fields) + "\n")
    opened = open_sequence(date)
    assert len(opened.imu) == len(clean.imu) - 1
    assert np.abs(opened.imu.gyro_rad_s).max() < 2
    (note,) = set(opened.notes) - set(clean.notes)
    assert "dropped 1 IMU sample far from the neighbouring ones" in note


@pytest.mark.parametrize("step", [None, 0.001])
def test_clipped_rates_are_found_with_their_limit_and_others_are_not(rng, step):
    rates = driving(rng).gyro_rad_s
    rates = rates if step is None else step * np.round(rates / step)
    assert clipped(rates) == []
    limit = 1.0 if step is None else step * round(1.0 / step)
    cut = np.clip(rates, -10, limit)
    assert clipped(cut) == [(limit, int((cut[:, 2] == limit).sum()))]


def test_a_sensor_at_rest_or_constant_is_not_clipped(rng):
    assert clipped(np.zeros((100, 3))) == []
    assert clipped(0.01 * rng.integers(-2, 3, (10000, 3))) == []


def test_a_recording_whose_imu_is_clipped_says_so_in_one_line(rng, tiny_drive: Path):
    sequence = open_sequence(tiny_drive)
    imu = sequence.imu
    rates = imu.gyro_rad_s.copy()
    rates[:, 1] += np.sin(np.arange(len(rates)) / 5)
    cut = replace(sequence, imu=replace(imu, gyro_rad_s=np.clip(rates, -5, 0.8)))
    notes = [note for note in without_false_samples(cut).notes if "clipped" in note]
    assert len(notes) == 1
    assert "0.8 rad/s" in notes[0]
