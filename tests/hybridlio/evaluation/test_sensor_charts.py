"""The report's charts of biases and GPS fixes."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.report import ReportData, analyse, charts


def read(packed: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"])


def drawn(**more: Any) -> dict[str, Any]:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    data = ReportData("line", Trajectory(np.arange(5) * 10**8, poses, np.tile(np.eye(6) * 1e-4, (5, 1, 1))), **more)
    return charts(data, analyse(data))


def test_biases_are_drawn_in_their_units_with_95_percent_bands():
    biases = np.arange(30.0).reshape(5, 6)
    traces = drawn(biases=biases, bias_sigmas=np.full((5, 6), 0.1))["biases"]["data"]
    lines = [trace for trace in traces if trace["name"] in "xyz"]
    np.testing.assert_allclose([read(one["y"]) for one in lines[:3]], biases[:, :3].T)
    np.testing.assert_allclose([read(one["y"]) for one in lines[3:]], np.degrees(biases[:, 3:].T), rtol=1e-6)
    np.testing.assert_allclose(read(traces[1]["y"]) - read(traces[0]["y"]), 2 * 1.96 * 0.1, rtol=1e-4)


def test_biases_without_standard_deviations_have_no_band_and_unknown_ones_no_chart():
    assert len(drawn(biases=np.ones((5, 6)), bias_sigmas=np.full((5, 6), np.nan))["biases"]["data"]) == 6
    assert "biases" not in drawn(biases=np.full((5, 6), np.nan))
    assert "biases" not in drawn()


def test_fixes_are_drawn_with_residuals_over_time_and_ellipses_on_the_map():
    fixes, residuals = np.array([[1.0, 2, 0], [3, 4, 0]]), np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    found = drawn(
        fixes_m=fixes,
        fix_covariances_m2=np.tile(np.diag([4.0, 1.0, 9.0]), (2, 1, 1)),
        fix_times_s=np.array([0.1, 0.3]),
        fix_residuals_m=residuals,
    )
    np.testing.assert_allclose([read(one["y"]) for one in found["fixes"]["data"]], residuals.T)
    (ellipses,) = (trace for trace in found["map"]["data"] if trace["name"] == "95 % of fixes")
    x, y = read(ellipses["x"]), read(ellipses["y"])
    half = np.sqrt(5.991)  # of χ² with two degrees of freedom, 95 %
    np.testing.assert_allclose([np.nanmin(x), np.nanmax(x)], [1 - 2 * half, 3 + 2 * half], atol=0.01)
    np.testing.assert_allclose([np.nanmin(y), np.nanmax(y)], [2 - half, 4 + half], atol=0.01)
