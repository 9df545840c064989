"""The fixed-lag backend of a run against GTSAM's own ``IncrementalFixedLagSmoother`` on the same factors.

    python benchmarks/fixed_lag.py [--steps 600] [--seeds 1 2 3] [--lag 100] [--back 2 5]

Simulated drives go through three backends in turns, scan by scan: `incremental`, which keeps everything, `fixed-lag`,
and the smoother with the same lag and parameters. Prints the processor time of an update, and how far the newest state
of each is from that of `incremental`, in its standard deviations.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import State
from hybridlio.graph.base.isam import _RELINEARISATION_THRESHOLDS, _WILDFIRE_THRESHOLD, make_isam_params
from hybridlio.graph.run.fixed_lag_backend import FixedLagBackend
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import WARM_UP_STEPS, IncrementalBackend
from hybridlio.simulation.chain import ChainSettings, make_chain


class GtsamFixedLag(IncrementalBackend):
    """The incremental backend whose solver is GTSAM's smoother, once the start is over."""

    name = "GTSAM's smoother"
    _removes_factors = True

    def __init__(self, steps: InertialSteps, lag_scans: int) -> None:
        super().__init__(steps)
        self._lag = float(lag_scans)

    def _solve(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, order: gtsam.KeyGroupMap | None) -> None:
        if self._k < WARM_UP_STEPS:
            super()._solve(graph, values, order)
            if self._k == WARM_UP_STEPS - 1:
                params = make_isam_params(_RELINEARISATION_THRESHOLDS, _WILDFIRE_THRESHOLD)
                params.findUnusedFactorSlots = True
                self._smoother = gtsam.IncrementalFixedLagSmoother(self._lag, params)
                self._smoother.update(self._graph, self._values, _stamps(self._values))
                self._isam = self._smoother.getISAM2()
            return
        self._smoother.update(graph, values, _stamps(values))
        self._isam = self._smoother.getISAM2()


def _stamps(values: gtsam.Values) -> Any:  # GTSAM's stubs want a mapping whose keys may be anything like an int
    return {key: float(gtsam.Symbol(key).index()) for key in list(values.keys())}


def apart(state: State, whole: State) -> float:
    """Return the largest difference of two states' poses in standard deviations of the second."""
    xi = se3.log(se3.between(state.T_world_imu, whole.T_world_imu))
    return float(np.abs(xi / np.sqrt(np.diag(whole.covariance)[:6])).max())


def main() -> None:
    """Print times and differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--lag", type=int, default=100)
    parser.add_argument(
        "--back", type=int, nargs="*", default=[], help="also poses relative to the scans so far before"
    )
    options = parser.parse_args()
    spent: dict[str, list[float]] = {}
    differences: dict[str, list[float]] = {}
    for seed in options.seeds:
        drive = make_chain(seed, ChainSettings(steps=options.steps, drift_share=0.1, back=tuple(options.back)))
        steps = InertialSteps(drive.calibration, drive.noise)
        backends = [
            IncrementalBackend(steps), FixedLagBackend(steps, options.lag), GtsamFixedLag(steps, options.lag),
        ]  # fmt: skip
        for backend in backends:
            backend.start(drive.start)
        for frame, relative in zip(drive.frames[1:], drive.relative, strict=True):
            for backend in backends:
                begin = time.process_time()
                backend.update(frame, relative)
                spent.setdefault(backend.name, []).append(time.process_time() - begin)
            for backend in backends[1:]:
                differences.setdefault(backend.name, []).append(apart(backend._state, backends[0]._state))
    for name, times in spent.items():
        off = differences.get(name, [0.0])
        print(
            f"{name:18} mean {1e3 * np.mean(times):6.2f} ms, 99 % {1e3 * np.quantile(times, 0.99):6.2f} ms; "
            f"from incremental at most {max(off):.3f} σ, on average {np.mean(off):.4f} σ"
        )


if __name__ == "__main__":
    main()
