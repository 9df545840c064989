"""Pose graphs as NumPy archives: everything that a graph holds, to the last bit, without pickles."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.files import UNREADABLE_NPZ, opened_npz, write_atomically
from hybridlio.core.geodesy import check_geodetic
from hybridlio.core.sensors import ImuSamples
from hybridlio.graph.formats.npz_calibration import add_calibrations, calibration_arrays
from hybridlio.graph.formats.npz_marginals import marginal_arrays, marginals
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CALIBRATION_KINDS, chosen
from hybridlio.graph.model.edge_table import FORMS
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, check_key
from hybridlio.graph.model.measurements import CODE, OF_LANDMARKS, Factor, Kind
from hybridlio.graph.model.new_factors import check_vector
from hybridlio.graph.model.noise import Noise, NoiseInput, Robust, make_noise, make_robust

_FORMAT = "hybridlio pose graph 1"
# earlier releases, which would lose landmarks, calibration variables or marginals, refuse these
_FORMAT_WITH_LANDMARKS, _FORMAT_WITH_CALIBRATION = "hybridlio pose graph 2", "hybridlio pose graph 3"
_FORMAT_WITH_MARGINALS = "hybridlio pose graph 4"
_FORMATS = (_FORMAT, _FORMAT_WITH_LANDMARKS, _FORMAT_WITH_CALIBRATION, _FORMAT_WITH_MARGINALS)
_IN_COLUMNS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if kind != "marginal")
_NO_ROBOT = -1  # in the robots' column, of an integer key


def write_npz(data: GraphData, path: str | os.PathLike[str]) -> None:
    """Write all of a graph.

    Raises:
        DataError: the file cannot be written.
    """
    keys = data.keys
    key_table = _key_table([(key,) for key in keys], 1)
    arrays: dict[str, Any] = {
        "format": np.array(_format_of(data)),
        "dimension": np.array(data.dimension),
        "next_id": np.array(data.next_id),
        "keys": key_table,
        "initial": data.initial_values,
        "fixed": np.array([key in data.fixed for key in keys], dtype=bool),
    }
    if data.origin is not None:
        arrays["origin"] = np.array(data.origin)
    if len(data.landmarks):
        arrays["landmark_keys"] = _key_table([(key,) for key in data.landmarks.keys], 1)
        arrays["landmark_initial"] = data.landmarks.initial_values
    if data.calibrations:
        arrays |= calibration_arrays(data)
    if len(data.edges):
        arrays |= {f"between_{name}": column for name, column in _edge_columns(data, key_table[:, 0]).items()}
    code = [factor.label for factor in data.other_factors.values() if factor.kind in CODE]
    if code:
        raise GraphError(f"{path}: {code[0]} and {len(code) - 1} more are a user's code, which no file holds")
    arrays |= marginal_arrays(data)
    for kind in _IN_COLUMNS:
        of_kind = {factor_id: factor for factor_id, factor in data.other_factors.items() if factor.kind == kind}
        if of_kind:
            arrays |= {f"{kind}_{name}": column for name, column in _factor_columns(of_kind).items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(path, buffer.getvalue())


def _format_of(data: GraphData) -> str:
    if any(factor.kind == "marginal" for factor in data.other_factors.values()):
        return _FORMAT_WITH_MARGINALS
    if data.calibrations:
        return _FORMAT_WITH_CALIBRATION
    return _FORMAT_WITH_LANDMARKS if len(data.landmarks) else _FORMAT


def _edge_columns(data: GraphData, keys: Any) -> dict[str, Any]:
    table = data.edges
    kernels = [table.robust.get(factor_id) for factor_id in table.ids.tolist()]
    return {
        "id": table.ids,
        "keys": keys[table.ends],
        "measured": table.measured,
        "kernel": np.array([kernel.kernel if kernel else "" for kernel in kernels]),
        "width": np.array([kernel.width if kernel else np.nan for kernel in kernels]),
        "noise_form": np.array(FORMS)[table.form],
        "noise": table.noise_values,
    }


def _key_table(keys: list[tuple[Key, ...]], width: int) -> Any:
    """Return keys as ``(M, width, 2)`` robots and indices."""
    rows = [[(_NO_ROBOT, key) if isinstance(key, int) else key for key in row] for row in keys]
    return np.array(rows, dtype=np.int64).reshape(-1, width, 2)


def _factor_columns(by_id: dict[int, Factor]) -> dict[str, Any]:
    factors = list(by_id.values())
    columns: dict[str, Any] = {
        "id": np.array(list(by_id), dtype=np.int64),
        "keys": _key_table([factor.keys for factor in factors], len(factors[0].keys)),
        "measured": np.array([factor.measured for factor in factors]),
        "kernel": np.array([factor.robust.kernel if factor.robust else "" for factor in factors]),
        "width": np.array([factor.robust.width if factor.robust else np.nan for factor in factors]),
    }
    landmarks: list[tuple[Key, ...]] = [(factor.landmark,) for factor in factors if factor.landmark is not None]
    if landmarks:
        columns["landmark"] = _key_table(landmarks, 1)
    if any(factor.calibration for factor in factors):
        columns["calibration"] = np.array([json.dumps(factor.calibration) for factor in factors])
    noises = [factor.noise for factor in factors if factor.noise is not None]
    if noises:
        columns["noise_form"] = np.array([noise.form for noise in noises])
        columns["noise"] = np.array([np.diag(n.values) if n.form == "sigmas" else n.values for n in noises])
    samples = [factor.samples for factor in factors if factor.samples is not None]
    if samples:
        columns["sample_count"] = np.array([len(part) for part in samples], dtype=np.int64)
        columns["stamps_ns"] = np.concatenate([part.stamps_ns for part in samples])
        columns["gyro_rad_s"] = np.concatenate([part.gyro_rad_s for part in samples])
        columns["accel_m_s2"] = np.concatenate([part.accel_m_s2 for part in samples])
    return columns


def read_npz(path: str | os.PathLike[str]) -> GraphData:
    """Read what :func:`write_npz` wrote.

    Raises:
        DataError: the file cannot be read, is damaged, or is not a pose graph.
    """
    path = Path(path)
    try:
        with opened_npz(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        if str(arrays["format"]) not in _FORMATS:
            raise DataError(f"{path}: has format {arrays['format']!s}; this release reads {_FORMATS[-1]}")
        return _assemble(arrays)
    except OSError as error:
        raise DataError(f"cannot read {path}: {error}") from error
    except UNREADABLE_NPZ as error:
        raise DataError(f"{path}: not a pose graph, or a damaged one: {error}") from error


def _assemble(arrays: dict[str, Any]) -> GraphData:
    data = GraphData(int(arrays["dimension"]))  # type: ignore[arg-type]
    if "origin" in arrays:
        latitude_deg, longitude_deg, height_m = arrays["origin"].tolist()
        data.set_origin(check_geodetic(latitude_deg, longitude_deg, height_m, "origin"))
    _add_poses(data, arrays)
    _add_landmarks(data, arrays)
    add_calibrations(data, arrays)
    by_id = marginals(data, arrays)
    for kind in _IN_COLUMNS:
        prefix = f"{kind}_"
        columns = {name[len(prefix) :]: value for name, value in arrays.items() if name.startswith(prefix)}
        if columns:
            by_id |= _factors(kind, columns)
    for factor_id in sorted(by_id):
        factor = by_id[factor_id]
        if missing := [key for key in factor.keys if key not in data]:
            raise DataError(f"{factor.label}: no pose has key {missing[0]}")
        if factor.landmark is not None and factor.landmark not in data.landmarks:
            raise DataError(f"{factor.label}: no landmark has key {factor.landmark}")
        chosen(data.calibrations, factor.calibration, CALIBRATION_KINDS, factor.label)
        data.add_factor(factor, factor_id)
    data.next_id = max(data.next_id, int(arrays["next_id"]))
    return data


def _add_poses(data: GraphData, arrays: dict[str, Any]) -> None:
    size = len(co.IDENTITY[data.dimension])
    initial = arrays["initial"].reshape(-1, size)
    for (key,), coordinates, fixed in zip(_key_rows(arrays["keys"]), initial, arrays["fixed"], strict=True):
        if key in data:
            raise DataError(f"pose {key} occurs twice")
        unknown = np.isnan(coordinates).all()
        data.add_pose(key, None if unknown else check_vector(coordinates, size, f"pose {key}"))
        if fixed:
            data.fix(key)


def _add_landmarks(data: GraphData, arrays: dict[str, Any]) -> None:
    if "landmark_keys" not in arrays:
        return
    initial = arrays["landmark_initial"].reshape(-1, data.dimension)
    for (key,), point in zip(_key_rows(arrays["landmark_keys"]), initial, strict=True):
        if key in data or key in data.landmarks:
            raise DataError(f"landmark {key} has the key of another pose or landmark")
        unknown = np.isnan(point).all()
        data.landmarks.add(key, None if unknown else check_vector(point, data.dimension, f"landmark {key}"))


def _key_rows(table: Any) -> list[tuple[Key, ...]]:
    return [
        tuple(check_key(index if robot == _NO_ROBOT else (robot, index)) for robot, index in row)
        for row in table.tolist()
    ]


def _factors(kind: Kind, columns: dict[str, Any]) -> dict[int, Factor]:
    found = {}
    samples = _samples(columns) if kind == "imu" else []
    landmarks = [key for (key,) in _key_rows(columns["landmark"])] if kind in OF_LANDMARKS else []
    for row, (factor_id, keys) in enumerate(zip(columns["id"].tolist(), _key_rows(columns["keys"]), strict=True)):
        measured = columns["measured"][row]
        name = f"{kind} {keys}"
        noise = None if kind == "imu" else _noise(columns, row, name)
        kernel = str(columns["kernel"][row])
        robust: Robust | None = make_robust((kernel, float(columns["width"][row])), 1, name) if kernel else None
        measured = check_vector(measured, len(measured), name)
        sample, landmark = samples[row] if samples else None, landmarks[row] if landmarks else None
        names = tuple(json.loads(str(columns["calibration"][row]))) if "calibration" in columns else ()
        found[factor_id] = Factor(kind, keys, measured, noise, robust, sample, landmark, calibration=names)
    return found


def _noise(columns: dict[str, Any], row: int, name: str) -> Noise:
    form, values = str(columns["noise_form"][row]), np.array(columns["noise"][row])
    values = np.diagonal(values).copy() if form == "sigmas" else values
    return make_noise(name, len(values), NoiseInput(**{form: values}))


def _samples(columns: dict[str, Any]) -> list[ImuSamples]:
    ends = np.cumsum(columns["sample_count"])[:-1]
    parts = (np.split(columns[name], ends) for name in ("stamps_ns", "gyro_rad_s", "accel_m_s2"))
    return [ImuSamples(*part) for part in zip(*parts, strict=True)]
