"""The fixed-lag backend: agreement with the incremental one, and constant memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.graph.run import isam_backend as online
from hybridlio.graph.run.fixed_lag_backend import FixedLagBackend
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import IncrementalBackend


def drive_through(backend: IncrementalBackend, chain: Any, with_imu: bool = True) -> list[int]:
    """Run the chain through a backend; return the number of its variables after each step."""
    backend.start(chain.start if with_imu else replace(chain.start, has_imu=False))
    sizes = []
    for frame, relative in zip(chain.frames[1:], chain.relative, strict=True):
        backend.update(frame if with_imu else replace(frame, imu=ImuSamples.empty()), relative)
        sizes.append(backend._isam.getLinearizationPoint().size())
    return sizes


@pytest.mark.parametrize("drift_share", [None, 0.1])
@pytest.mark.parametrize("with_imu", [True, False], ids=["imu", "no imu"])
def test_the_newest_state_agrees_with_the_incremental_backend(
    chain: Callable[..., Any], with_imu: bool, drift_share: float | None
) -> None:
    drive = chain(seed=5, steps=150, drift_share=drift_share)
    lagged = FixedLagBackend(InertialSteps(drive.calibration, drive.noise), lag_scans=30)
    whole = IncrementalBackend(InertialSteps(drive.calibration, drive.noise))
    drive_through(lagged, drive, with_imu)
    drive_through(whole, drive, with_imu)
    sigmas = np.sqrt(np.diag(whole._state.covariance))[:6]
    apart = se3.log(se3.between(lagged._state.T_world_imu, whole._state.T_world_imu))
    assert (np.abs(apart) < 0.02 * sigmas).all()
    used = slice(None) if with_imu else slice(6)
    for mine, theirs in (
        (lagged._state.covariance[used, used], whole._state.covariance[used, used]),
        (lagged.last_step().covariance, whole.last_step().covariance),
    ):
        spread = np.sqrt(np.diag(theirs))
        assert (np.abs(mine - theirs) < 0.02 * np.outer(spread, spread)).all()


def test_the_number_of_variables_stops_growing_at_the_lag(chain: Callable[..., Any]) -> None:
    drive = chain(seed=6, steps=200, drift_share=0.1)
    sizes = drive_through(FixedLagBackend(InertialSteps(drive.calibration, drive.noise), lag_scans=40), drive)
    assert sizes[20] > sizes[10]
    assert max(sizes) == max(sizes[-40:]) == max(sizes[:100]) <= 5 * 82 < 5 * 200
    assert min(sizes[60:]) >= 5 * 40


def test_new_factors_reuse_the_slots_of_removed_ones(chain: Callable[..., Any]) -> None:
    drive = chain(seed=6, steps=200, drift_share=0.1)
    slots = {}
    for name, backend in (("whole", IncrementalBackend), ("lagged", partial(FixedLagBackend, lag_scans=40))):
        made = backend(InertialSteps(drive.calibration, drive.noise))
        drive_through(made, drive)
        slots[name] = made._isam.getFactorsUnsafe()
    assert slots["whole"].nrFactors() == slots["whole"].size() > 4 * 200
    assert slots["lagged"].size() < 1.5 * 4 * 82  # the lag and one batch of scans


def test_a_lag_shorter_than_the_warm_up_is_an_error() -> None:
    with pytest.raises(ConfigError, match="too short"):
        FixedLagBackend(InertialSteps(Calibration(), ImuNoise()), lag_scans=5)


@pytest.mark.parametrize(("bias_sigma_m_s2", "most_changed"), [(0.1, 0.0), (ImuNoise().accel_bias_sigma_m_s2, 0.05)])
def test_a_step_far_from_the_start_updates_only_recent_variables(
    bias_sigma_m_s2: float, most_changed: float, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There, rotating the whole path by a milliradian moves all recent scans by the same metre.

    A larger bias is not told from gravity's direction on a path without turns, and both wander: all variables are
    linearised anew now and then.
    """
    noise = ImuNoise(accel_bias_sigma_m_s2=bias_sigma_m_s2)
    touched: list[int] = []
    make = online.incremental_solver

    class Counting:
        def __init__(self, *settings: Any) -> None:
            self._solver = make(*settings)

        def update(self, graph: gtsam.NonlinearFactorGraph, *arguments: Any) -> None:
            result = self._solver.update(graph, *arguments)
            touched.extend(
                [result.getVariablesReeliminated()] if graph.size() else []
            )  # not when scans are marginalised

        def __getattr__(self, name: str) -> Any:
            return getattr(self._solver, name)

    monkeypatch.setattr(online, "incremental_solver", Counting)
    backend = FixedLagBackend(InertialSteps(Calibration(), noise))
    sigmas = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]
    for k in range(1000):
        stamps = k * 10**8 + np.arange(11) * 10**7
        accel = np.array([0.0, 0.0, 9.81]) + 0.1 * rng.standard_normal((11, 3))
        imu = ImuSamples(stamps, 0.01 * rng.standard_normal((11, 3)), accel)
        if not k:
            backend.start(start_state(0, imu, noise))
        step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]) + sigmas * rng.standard_normal(6))
        scan = Scan(int(stamps[-1]), np.empty((0, 3), np.float32))
        covariance = np.diag(sigmas**2)
        relative = RelativePose(step, covariance, "test", drift=0.1 * covariance)
        backend.update(Frame(k + 1, scan, imu, calibration=Calibration()), relative)
    assert (np.array(touched[-600:]) >= 100).mean() <= most_changed
