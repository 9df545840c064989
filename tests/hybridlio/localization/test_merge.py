"""Runs of one town join in one world; a run of another town stays out, and so do false joins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mapped_towns import MappedTown, TownDrive

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.localization import merge as merging
from hybridlio.localization.joins import join_runs
from hybridlio.localization.merge import Merged, merge
from hybridlio.localization.run_places import RunPlaces
from hybridlio.smoothing.loops import Loop, LoopSearch


@pytest.fixture(scope="module")
def begun_elsewhere(again: TownDrive) -> TownDrive:
    """The second half of the second drive."""
    return again.part(50)


@pytest.fixture(scope="module")
def merged(town: MappedTown, begun_elsewhere: TownDrive, elsewhere: TownDrive) -> Merged:
    return merge([town.record, begun_elsewhere.record(), elsewhere.part(0, 60).record()])


def test_two_drives_from_different_starts_join_within_centimetres(
    merged: Merged, town: MappedTown, begun_elsewhere: TownDrive
):
    first, second, _ = merged.trajectories
    assert first is not None
    assert second is not None
    true = se3.between(town.drive.truth[0], town.drive.truth)
    assert np.linalg.norm(first.poses[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.3  # its odometry's drift
    near = [
        int(np.linalg.norm(town.drive.truth[:, :3, 3] - pose[:3, 3], axis=1).argmin()) for pose in begun_elsewhere.truth
    ]
    apart = se3.between(first.poses[near], second.poses)
    wrong = se3.log(se3.between(apart, se3.between(town.drive.truth[near], begun_elsewhere.truth)))
    assert np.sqrt((wrong[:, 3:] ** 2).sum(axis=1).mean()) < 0.03
    assert np.linalg.norm(wrong[:, 3:], axis=1).max() < 0.1


def test_the_covariances_of_both_are_those_of_their_errors(
    merged: Merged, town: MappedTown, begun_elsewhere: TownDrive
):
    for drive, found in zip((town.drive, begun_elsewhere), merged.trajectories, strict=False):
        assert found is not None
        assert found.covariances is not None
        errors = se3.log(se3.between(found.poses, se3.between(town.drive.truth[0], drive.truth)))
        consistency = pose_consistency(errors[1:], found.covariances[1:])
        assert 0.1 < consistency.position.value < 4.0
        assert 0.1 < consistency.rotation.value < 4.0


def test_a_run_of_another_town_is_not_joined(merged: Merged):
    assert merged.unjoined == [2]
    assert merged.trajectories[2] is None
    assert {(one.earlier, one.later): len(one.joins) >= 3 for one in merged.joins} == {
        (0, 1): True, (0, 2): False, (1, 2): False,
    }  # fmt: skip


def test_false_joins_are_outvoted(town: MappedTown, begun_elsewhere: TownDrive, monkeypatch: pytest.MonkeyPatch):
    first, second = RunPlaces.of(town.record), RunPlaces.of(begun_elsewhere.record())
    whole, recognise, calls = join_runs((first, second), (0, 1)), first.map_places.recognise, []

    def sometimes_wrong(others: object, k: int) -> object:
        calls.append(k)
        found = recognise(others, k)  # type: ignore[arg-type]
        if k % 4:
            return found
        wrong = se3.exp(np.array([0, 0, 0.1 * k, 5.0, -3.0 * k, 0]))
        return [replace(one, verdict=replace(one.verdict, pose=one.verdict.pose @ wrong)) for one in found]

    monkeypatch.setattr(first.map_places, "recognise", sometimes_wrong)
    some = join_runs((first, second), (0, 1))
    assert len(calls) == len(second.keyframes)
    rows = {(one.earlier, one.later) for one in whole.joins}
    assert 3 <= len(some.joins) < len(whole.joins)
    assert {(one.earlier, one.later) for one in some.joins} <= rows
    assert some.rejected > whole.rejected


def test_one_run_alone_is_refused(town: MappedTown):
    with pytest.raises(ConfigError, match="two runs or more"):
        merge([town.record])


def test_loops_of_a_run_count_and_false_ones_do_not(
    town: MappedTown, begun_elsewhere: TownDrive, monkeypatch: pytest.MonkeyPatch
):
    rows = RunPlaces.of(town.record).keyframes.rows
    true = se3.between(town.drive.truth[rows[0]], town.drive.truth[rows[-1]])
    near = np.diag([1e-6] * 3 + [1e-4] * 3)
    right = [Loop(int(rows[0]), int(rows[-1]), true, near, 1.0, 0.0), Loop(int(rows[1]), int(rows[-1]),
             se3.between(town.drive.truth[rows[1]], town.drive.truth[rows[-1]]), near, 1.0, 0.0)]  # fmt: skip
    false = Loop(int(rows[0]), int(rows[-2]), true @ se3.exp([0, 0, 0.5, 3, 3, 0]), near, 1.0, 0.0)

    def found(record, settings, progress):
        of_first = len(record.online) == len(town.record.online)
        return LoopSearch(1, 1, 1, (*right, false) if of_first else (), (), {})

    monkeypatch.setattr(merging, "find_loops", found)
    merged = merge([town.record, begun_elsewhere.record()])
    assert merged.loops == (tuple(right), ())
    assert merged.to_json_dict()["loops"] == [2, 0]
    first = merged.trajectories[0]
    assert first is not None
    off = se3.log(se3.between(se3.between(first.poses[rows[0]], first.poses[rows[-1]]), true))
    assert np.linalg.norm(off[3:]) < 0.03
