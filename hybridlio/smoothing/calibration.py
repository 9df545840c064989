"""Calibration as a part of smoothing: which parameters are variables, what is known of them before, and the result.

A parameter has one to three components. In each direction of their space the measurements of a run carry some
information; where it is not clearly more than that of the prior, the run's motion does not determine the parameter in
this direction, and it stays at its prior.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.files import write_atomically
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import Calibration
from hybridlio.core.setting_checks import check_positive

CALIBRATED = ("time_offset", "extrinsics", "lever_arm", "gps_clock")
OF_IMU, OF_GPS = ("time_offset", "extrinsics"), ("lever_arm", "gps_clock")
IMU_SCALE = "imu_scale"  # which a whole recording shows, and no graph has as a variable
# Information of the measurements over that of the prior, in a direction that counts as determined: a tenth of the
# prior's error is then left in the estimate at most.
_DETERMINED = 10.0
# Names of a vector's components: of a matrix, row by row.
_AXES = {3: tuple("xyz"), 9: tuple(row + column for row in "xyz" for column in "xyz")}
_ALONG_AXIS = 0.98  # component of a unit vector that is called by the axis' name: within 11 degrees
_UNITS = {"time_offset": (1e3, "ms"), "gps_clock": (1e3, "ms"), "rotation": (np.rad2deg(1.0), "°")} | dict.fromkeys(
    ("gyro_scale", "accel_scale"), (1e2, "%")
)
_METRES = (1e2, "cm")
_SI_UNITS = {"time_offset": "s", "gps_clock": "s", "rotation": "rad"} | dict.fromkeys(
    ("gyro_scale", "accel_scale"), "ratio"
)
_FRAMES = ("frames", "imu_frame", "lidar_frame")  # keys of calibration.yaml that T_imu_lidar takes the place of


@dataclass(frozen=True)
class CalibrationPriors:
    """Which parameters to calibrate, and how well they are known before.

    Attributes:
        names: of :data:`CALIBRATED`.
        rotation_sigma_rad: of ``T_imu_lidar`` about each axis; 3° is what a hand measures.
        translation_sigma_m: of ``T_imu_lidar`` along each axis, from a drawing or a ruler.
        time_offset_sigma_s: of the IMU's stamps; drivers that stamp on arrival are late by less.
        lever_arm_sigma_m: of the antenna along each axis: the size of a car's roof.

    Raises:
        SettingError: a value is not positive.
        ConfigError: an unknown name.
    """

    names: Sequence[str]
    rotation_sigma_rad: float = 0.05
    translation_sigma_m: float = 0.3
    time_offset_sigma_s: float = 0.1
    lever_arm_sigma_m: float = 2.0

    def __post_init__(self) -> None:
        sigmas = [name for name in vars(self) if name != "names"]
        check_positive(self, *sigmas)
        if isinstance(self.names, str):
            raise ConfigError(f"calibrate takes several names, such as ({self.names!r},), got {self.names!r}")
        for name in self.names:
            if name not in CALIBRATED:
                raise ConfigError(f"calibrate: there is no {name!r}; choose of {', '.join(CALIBRATED)}")

    @property
    def antenna_sigma_m(self) -> float | None:
        """Standard deviation of the antenna's position, or None if it is not calibrated."""
        return self.lever_arm_sigma_m if "lever_arm" in self.names else None

    def check_sensors(self, has_imu: bool, has_gps: bool) -> None:
        """Raise ConfigError where a parameter's sensor is not used."""
        for name in self.names:
            if name in OF_IMU and not has_imu:
                raise ConfigError(f"calibrate: {name} needs IMU samples, and the run has none")
            if name in OF_GPS and not has_gps:
                raise ConfigError(f"calibrate: {name} needs GPS fixes; give gps=True")


class Estimated:
    """What calibrated parameters of runs and calibration variables of pose graphs have in common.

    Attributes:
        covariance: ``(d, d)``.
        undetermined: ``(u, d)`` unit vectors of the directions that nothing determines.
    """

    covariance: Array
    undetermined: Array

    @property
    def sigmas(self) -> Array:
        """Standard deviations ``(d,)`` of the components."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def is_determined(self) -> bool:
        """Whether the measurements determine it in every direction."""
        return not len(self.undetermined)


@dataclass(frozen=True, eq=False)
class Parameter(Estimated):
    """A calibrated parameter.

    Attributes:
        name: ``rotation``, ``translation`` (of ``T_imu_lidar``), ``time_offset``, ``lever_arm``, ``gps_clock``,
            ``gyro_scale`` or ``accel_scale``.
        change: ``(d,)`` estimate minus what was stated; rad, m or s. A rotation's is a rotation vector in the lidar
            frame (right perturbation), a translation's is in the IMU frame, a scale's the matrix's elements by rows.
        covariance: ``(d, d)``; in undetermined directions that of the prior.
        prior_sigma: standard deviation of each component before.
        undetermined: ``(u, d)`` unit vectors of the directions that the motion does not determine.
    """

    name: str
    change: Array
    covariance: Array
    prior_sigma: float
    undetermined: Array

    def scaled(self, factor: float) -> Parameter:
        """Return it with the variances of what the motion determines multiplied by a factor."""
        held = self.prior_sigma**2 * self.undetermined.T @ self.undetermined
        return replace(self, covariance=factor * (self.covariance - held) + held)

    @property
    def doubt(self) -> str | None:
        """What is not known, or None."""
        if self.is_determined:
            return None
        if len(self.change) == len(_AXES[9]):  # a matrix, whose elements have priors of their own
            elements = ", ".join(map(_direction, self.undetermined))
            return f"{self.name}: the motion hardly shows {elements}; known little better than from a data sheet"
        if len(self.undetermined) == len(self.change):
            return f"{self.name}: the motion does not determine it; it stays as stated"
        along = " and ".join(map(_direction, self.undetermined))
        return f"{self.name}: the motion does not determine it along {along}; there it stays as stated"

    def __str__(self) -> str:
        factor, unit = _UNITS.get(self.name, _METRES)
        columns = [
            f"{value:+.3g} ± {sigma:.2g}"
            for value, sigma in zip(factor * self.change, factor * self.sigmas, strict=True)
        ]
        if len(columns) == len(_AXES[9]):  # of a matrix: those along the axes, and the largest one across
            across = factor * np.abs(self.change.reshape(3, 3) * (1 - np.eye(3))).max()
            return f"{self.name} {', '.join(columns[::4])} {unit}, up to {across:.2g} {unit} across axes"
        return f"{self.name} {', '.join(columns)} {unit}"


def _direction(vector: Array) -> str:
    largest = int(np.abs(vector).argmax())
    if abs(vector[largest]) > _ALONG_AXIS and len(vector) in _AXES:
        return _AXES[len(vector)][largest]
    return f"({', '.join(f'{value:.2f}' for value in vector * np.sign(vector[largest]))})"


def undetermined_directions(covariance: Array, prior_sigma: float) -> Array:
    """Return unit vectors ``(u, d)`` of the directions in which a posterior covariance is close to the prior's."""
    variances, directions = np.linalg.eigh(covariance / prior_sigma**2)
    # posterior = 1 / (1 + r) of the prior, for information r of the measurements
    return np.asarray(directions.T[variances > 1 / (1 + _DETERMINED)])


def undetermined_elements(covariance: Array, prior_sigmas: Array) -> Array:
    """Return unit vectors ``(u, d)`` of the components whose posterior variance is close to the prior's ``(d,)``."""
    d = len(prior_sigmas)
    return np.asarray(np.eye(d)[np.diag(covariance) / prior_sigmas**2 > 1 / (1 + _DETERMINED)])


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The calibration that a smoothing found.

    Attributes:
        calibration: the extrinsics and the antenna, with what was not calibrated as it was.
        imu_time_offset_s: seconds to add to the IMU's stamps, as the recording has them, to bring them to the poses'
            clock.
        gps_time_offset_s: seconds to add to the fixes' stamps.
        imu_scale: of the samples as they were recorded.
        parameters: what was calibrated, with its uncertainty.
    """

    calibration: Calibration
    imu_time_offset_s: float
    gps_time_offset_s: float
    parameters: tuple[Parameter, ...]
    imu_scale: ImuScale = field(default_factory=ImuScale)

    def parameter(self, name: str) -> Parameter:
        """Return a parameter by name.

        Raises:
            ConfigError: it was not calibrated.
        """
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise ConfigError(f"{name} was not calibrated; {', '.join(one.name for one in self.parameters)} were")

    @property
    def doubts(self) -> tuple[str, ...]:
        """What the motion does not determine."""
        return tuple(parameter.doubt for parameter in self.parameters if parameter.doubt is not None)

    def summary(self) -> str:
        """Return the parameters' changes on one line."""
        return "; ".join(map(str, self.parameters))

    def save(self, path: str | os.PathLike[str], others: Mapping[str, Any] | None = None) -> None:
        """Write a ``calibration.yaml``, with standard deviations, for a plain folder of scans or ``hybridlio smooth``.

        Args:
            path: of the file.
            others: keys of the recording's own file, which stay where they state something else.
        """
        content = {key: value for key, value in (others or {}).items() if key not in _FRAMES}
        content["T_imu_lidar"] = self.calibration.T_imu_lidar.tolist()
        names = {parameter.name for parameter in self.parameters}
        if "lever_arm" in names and self.calibration.antenna_imu_m is not None:
            content["antenna_imu_m"] = self.calibration.antenna_imu_m.tolist()
        if "time_offset" in names:
            content["imu_time_offset_s"] = self.imu_time_offset_s
        if "gyro_scale" in names:
            content["imu_scale"] = {"gyro": self.imu_scale.gyro.tolist(), "accel": self.imu_scale.accel.tolist()}
        content["sigmas"] = {
            f"{one.name}_{_SI_UNITS.get(one.name, 'm')}": one.sigmas.tolist() for one in self.parameters
        }
        comments = "".join(f"# {doubt}\n" for doubt in self.doubts)
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        write_atomically(Path(path), comments + text)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content for ``metrics.json``."""
        antenna = self.calibration.antenna_imu_m
        return {
            "T_imu_lidar": self.calibration.T_imu_lidar.tolist(),
            "antenna_imu_m": None if antenna is None else antenna.tolist(),
            "imu_time_offset_s": self.imu_time_offset_s,
            "gps_time_offset_s": self.gps_time_offset_s,
            "imu_scale": {"gyro": self.imu_scale.gyro.tolist(), "accel": self.imu_scale.accel.tolist()},
            "parameters": {
                one.name: {"change": one.change.tolist(), "sigmas": one.sigmas.tolist(), "doubt": one.doubt}
                for one in self.parameters
            },
        }


def moved_extrinsics(T_imu_lidar: Array, rotation: Array, translation: Array) -> Array:
    """Return extrinsics turned by a rotation vector in the lidar frame and moved by a vector in the IMU frame."""
    R = T_imu_lidar[:3, :3] @ se3.so3_exp(rotation)
    return se3.make(R, T_imu_lidar[:3, 3] + translation)
