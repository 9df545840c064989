"""The learned sources in the odometry."""

from dataclasses import replace
from functools import partial

import numpy as np
from stand_ins import FEW

import hybridlio as hl
from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.cloud.preparation import PreparationOptions, prepare
from hybridlio.core import se3
from hybridlio.learned.source_settings import LstmSettings
from hybridlio.learned.sources.lstm_initial_pose import LstmInitialPose
from hybridlio.learned.sources.network_residual import NetworkResidual
from hybridlio.runs.run import run_odometry

GEOMETRY = MapGeometry(16.0, -16.0, 16, 180)


def test_both_run_in_the_odometry_as_user_supplied_objects(weights, tiny_drive):
    path = str(weights(geometry=GEOMETRY))

    def prepare_for(recipe):
        assert recipe.network.geometry == GEOMETRY
        return partial(prepare, options=PreparationOptions(geometry=GEOMETRY, loss_points=2000, threads=1))

    residual = NetworkResidual(prepare_for, replace(FEW, weights=path, refine_steps=10))
    sequence = hl.open_sequence(tiny_drive).part(0, 8)
    true = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])
    steps = {}
    for initial_pose in (LstmInitialPose(LstmSettings(path)), "preintegration"):
        odometry = hl.Odometry(initial_pose=initial_pose, residual=residual)
        steps[initial_pose] = [odometry.step(frame).relative for frame in sequence][1:]
    untrained, found = steps.values()
    assert [step.source for step in untrained] == ["network" if step.ok else "lstm" for step in untrained]
    assert [step.source for step in found] == ["network"] * 7
    # Gauss-Newton steps on the loss replace the untrained network; the drive starts at 10 m/s
    errors = [np.linalg.norm((step.pose - T)[:3, 3]) for step, T in zip(found, true, strict=True)]
    assert max(errors) < 0.1


def test_a_pair_on_which_the_network_fails_is_listed_and_gets_no_weight(weights, tiny_drive, monkeypatch, caplog):
    path = str(weights(geometry=GEOMETRY, projective_steps=3))
    options = PreparationOptions(geometry=GEOMETRY, loss_points=2000, threads=1)
    residual = NetworkResidual(lambda _: partial(prepare, options=options), replace(FEW, weights=path, refine_steps=0))
    ask, count = residual._corrected, iter(range(99))

    def failing(*given):
        answer = ask(*given)
        return answer + (next(count) == 4) * np.eye(4)[:, [3, 0, 1, 2]].T

    monkeypatch.setattr(residual, "_corrected", failing)
    sequence = hl.open_sequence(tiny_drive).part(0, 12)
    run = run_odometry(sequence, hl.Odometry(residual=residual))
    assert run.stopped is None
    assert run.bridged == [5]
    assert "frame 5: bridged" in caplog.text
    relative = run.estimates[5].relative
    assert (relative.source, relative.ok) == ("preintegration", False)
    assert relative.details["cost"] > relative.details["initial_cost"]
    end = se3.between(run.trajectory.poses[-1], sequence.reference.poses[run.done - 1])
    assert np.linalg.norm(end[:3, 3]) < 0.15
