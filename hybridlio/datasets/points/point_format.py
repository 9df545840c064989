"""From the columns of a scan file to a scan: unit, points that are no returns, and times, found once a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array, Floats, Mask, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import MAX_RANGE_M, Scan
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.own_vehicle import note_vehicle
from hybridlio.datasets.points.plausible_ranges import NO_LIDARS_MEDIAN, check_ranges
from hybridlio.datasets.points.point_times import PointTimes, StatedTimes, find_point_times

Columns = Mapping[str, NDArray[Any]]

SAMPLES = 5  # scans that are looked at to find the format: enough to see a pattern, 0.2 s to read
MORE_SAMPLES = 21  # if those do not agree: some bad scans among them no longer decide; 1 s to read

_INTENSITIES = ("intensity", "reflectivity", "reflectance", "remission")
_FULL_SCALES = (1.0, 255.0, 65535.0)  # of intensities: the smallest that holds them
_MM = 1e-3
_FEW = 100  # points; of coordinates in metres nearly none is a whole number
_SURE_MM_RANGE = 5000.0  # median of whole numbers from which they are no centimetres: those would be 50 m and more
_SAME_RANGE_M = 0.002  # of one no-return code, also where coordinates are rounded to millimetres
_MIN_CODE_SHARE, _MIN_CODE_POINTS = 0.005, 20  # of a scan at its largest range; surfaces leave a few points there
_BESIDE_CODE = 10  # times that range: nothing is there beside a code, and more than at the edge of any smooth surface
_MIN_CODE_ELEVATIONS_RAD = 0.03  # standard deviation: a code fills many beams, a real ring of equal ranges only one


@dataclass(frozen=True)
class Box:
    """A box in the lidar frame with sides along its axes; corners in metres."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def holds(self, points: Floats) -> Mask:
        """Return which of points ``(N, 3)`` lie inside, ``(N,)``."""
        inside = (points >= np.array(self.low_m, np.float32)) & (points <= np.array(self.high_m, np.float32))
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True)
class StatedFormat:
    """What a user states about points; None where it is to be found.

    Attributes:
        times: about their times.
        limits_m: smallest and largest range of points to use.
        vehicle: a box around the vehicle, whose points are left out.
    """

    times: StatedTimes | None = None
    limits_m: tuple[float, float] | None = None
    vehicle: Box | None = None


@dataclass(frozen=True)
class PointFormat:
    """How the columns of a recording's scans are read.

    Attributes:
        scale_m: metres in one unit of x, y and z.
        no_return_m: range at which the sensor writes beams without a return, or None.
        times: the convention of the points' times; None if there are none.
        limits_m: smallest and largest range of points to use, as the user states; None for all.
        vehicle: a box whose points are left out, as the user states.
    """

    scale_m: float = 1.0
    no_return_m: float | None = None
    times: PointTimes | None = None
    limits_m: tuple[float, float] | None = None
    vehicle: Box | None = None

    @np.errstate(invalid="ignore", over="ignore")  # damaged files hold any bits
    def scan(self, columns: Columns, stamp_ns: int) -> Scan:
        """Return the scan of the columns, without points that are not finite, at the origin or no returns.

        Raises:
            DataError: x, y or z is missing, no point is left, or times are unusable.
        """
        points = self._points(columns)
        keep = self._returns(points)
        if not keep.all():
            points, columns = points[keep], _rows(columns, keep)
        offsets = None if self.times is None else self.times.offsets_ns(columns, stamp_ns)
        scan = Scan(stamp_ns, points, _intensity(columns), offsets)
        if not len(scan):
            far = "; all are over 10 km away, as in a map's frame, and must be in the lidar's" if len(points) else ""
            raise DataError(f"the scan has no finite points{far}")
        return scan

    def _points(self, columns: Columns) -> Floats:
        xyz = coordinates(columns)
        if self.scale_m != 1.0:
            xyz = xyz.astype(np.float64) * self.scale_m
        return xyz.astype(np.float32, copy=False)

    def _returns(self, points: Floats) -> Mask:
        plain = self.no_return_m is None and self.limits_m is None and self.vehicle is None
        if plain and len(points) and points[:, 0].all() and np.isfinite([points.min(), points.max()]).all():
            return np.ones(len(points), dtype=bool)  # the usual case, found without arrays of sums
        sums = _sums(points)
        keep = np.asarray((sums > 0) & (sums < np.inf), dtype=bool)
        if self.no_return_m is not None:
            keep &= np.abs(_ranges(points) - self.no_return_m) > _SAME_RANGE_M
        if self.limits_m is not None:
            ranges = _ranges(points)
            keep &= (ranges >= self.limits_m[0]) & (ranges <= self.limits_m[1])
        if self.vehicle is not None:
            keep &= ~self.vehicle.holds(points)
        return keep


def _rows(columns: Columns, keep: Mask) -> Columns:
    return columns if keep.all() else {name: values[keep] for name, values in columns.items()}


def coordinates(columns: Columns) -> NDArray[Any]:
    """Return x, y and z ``(N, 3)`` in the unit and type of the columns.

    Raises:
        DataError: one is missing.
    """
    if not {"x", "y", "z"} <= columns.keys():
        raise DataError(f"expected fields x y z, found {' '.join(columns) or 'none'}")
    # NumPy joins values at odd addresses, as in most bags, a third as quickly as it copies them and joins the copies
    x, y, z = (
        column if column.flags.aligned else column.copy() for column in (columns["x"], columns["y"], columns["z"])
    )
    return np.column_stack([x, y, z])


def sampled(count: int, samples: int = SAMPLES) -> list[int]:
    """Return the indices of the scans to look at, spread over a recording of ``count`` scans."""
    return sorted({round(k) for k in np.linspace(0, count - 1, samples)}) if count else []


def learn_format(
    stamps_ns: Stamps, columns_of: Callable[[int], Columns], notes: Notes, stated: StatedFormat | None = None
) -> PointFormat:
    """Find the format of a recording from some of its scans, from more of them if those do not agree.

    Args:
        stamps_ns: ``(N,)`` of all scans.
        columns_of: reads the columns of scan ``k``; its :class:`DataError` names frame or file.
        notes: receives the findings, and scans that cannot be read.
        stated: what the user states.

    Raises:
        DataError: no scan can be read, or the meaning of the columns is not clear.
    """
    step_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else None
    for samples in (SAMPLES, MORE_SAMPLES):
        found: list[tuple[int, Columns]] = []
        errors: list[DataError] = []
        for k in sampled(len(stamps_ns), samples):
            try:
                found.append((int(stamps_ns[k]), columns_of(k)))
            except DataError as error:
                errors.append(error)
        try:
            if not found and errors:
                raise errors[0]
            return find_format(found, step_ns, notes, stated)
        except DataError:
            if samples == MORE_SAMPLES or samples >= len(stamps_ns):
                raise
    raise AssertionError  # the last number of samples returns or raises


@np.errstate(invalid="ignore", over="ignore")  # damaged files hold any bits
def find_format(
    samples: Sequence[tuple[int, Columns]], step_ns: int | None, notes: Notes, stated: StatedFormat | None = None
) -> PointFormat:
    """Find the format of a recording from stamp and columns of some of its scans; note what is unusual.

    Args:
        samples: at the indices of :func:`sampled`, without scans that cannot be read.
        step_ns: median distance between the stamps; None if there is one scan.
        notes: receives the findings.
        stated: what the user states.

    Raises:
        DataError: x, y or z is missing, or the meaning of the points' times is not clear.
    """
    stated = stated or StatedFormat()
    scale_m = _scale_m([coordinates(columns) for _, columns in samples], notes)
    plain = PointFormat(scale_m)
    seen, shares = [], []
    for _, columns in samples:
        cloud = plain._points(columns)
        seen.append(cloud[plain._returns(cloud)])
        shares += [float((_sums(cloud) == 0).mean())] if len(cloud) else []
    if zeros := float(np.mean(shares or [0.0])):
        notes.found(f"points at the origin, {zeros:.1%} of a scan, are left out: beams without a return")
    ranges = [_ranges(points) for points in seen]
    found = PointFormat(scale_m, _no_return_m(seen, ranges, notes), None, stated.limits_m, stated.vehicle)
    code_m = np.inf if found.no_return_m is None else found.no_return_m - _SAME_RANGE_M
    check_ranges([of_scan[of_scan < code_m] for of_scan in ranges], MAX_RANGE_M, notes)
    if stated.vehicle is None:
        note_vehicle(seen, notes)
    valid = [(stamp, _rows(columns, found._returns(plain._points(columns)))) for stamp, columns in samples]
    return replace(found, times=find_point_times(valid, step_ns, notes, stated.times))


def _scale_m(clouds: list[NDArray[Any]], notes: Notes) -> float:
    """Return metres in one unit of the coordinates: 0.001 for whole numbers that are too large for metres."""
    if any((cloud != np.round(cloud))[np.isfinite(cloud)].any() for cloud in (cloud[:_FEW] for cloud in clouds)):
        return 1.0  # the usual case
    finite = [cloud[np.isfinite(cloud).all(axis=1)].astype(np.float64) for cloud in clouds]
    finite = [cloud for cloud in finite if len(cloud)]
    if not finite:
        return 1.0
    whole = all((cloud == np.round(cloud)).all() for cloud in finite)
    medians = [float(np.median(_ranges(cloud[cloud.any(axis=1)]))) for cloud in finite if cloud.any()]
    typical = float(np.median(medians or [0.0]))
    if not whole or typical < NO_LIDARS_MEDIAN:
        return 1.0
    text = f"coordinates are whole numbers with a median range of {typical:.0f}: read as millimetres"
    if typical < _SURE_MM_RANGE:
        notes.add(f"{text}; if they are in another unit, write metres")
    else:
        notes.found(text)
    return _MM


def _no_return_m(clouds: list[Floats], ranges_m: list[Array], notes: Notes) -> float | None:
    """Return the exact range that a sensor writes for beams without a return; None if there is no such range.

    It is the largest range of most scans, at many points in many directions.
    """
    codes, shares = [], []
    for cloud, ranges in zip(clouds, ranges_m, strict=True):
        largest = ranges.max(initial=0.0)
        at = ranges > largest - _SAME_RANGE_M
        near = (ranges > largest - _BESIDE_CODE * _SAME_RANGE_M).sum() - at.sum()
        if at.sum() < max(_MIN_CODE_POINTS, _MIN_CODE_SHARE * len(cloud)) or near > at.sum():
            continue
        if np.std(np.arcsin(cloud[at, 2] / ranges[at])) > _MIN_CODE_ELEVATIONS_RAD:
            codes.append(float(np.median(ranges[at])))
            shares.append(float(at.mean()))
    if not codes or 2 * len(codes) <= len(clouds) or np.ptp(codes) > _SAME_RANGE_M or codes[0] >= MAX_RANGE_M:
        return None
    notes.add(
        f"points at exactly {codes[0]:.3f} m, {np.mean(shares):.1%} of a scan, are left out: the code of beams without "
        "a return"
    )
    return float(np.median(codes))


def _sums(points: Floats) -> Floats:
    """Return the sums of the coordinates' sizes; NaN or infinite where a coordinate is.

    A product with ones is far quicker than all() or any() along rows of three.
    """
    return np.asarray(np.abs(points) @ np.ones(3, np.float32))


def _ranges(points: NDArray[Any]) -> Array:
    wide = points.astype(np.float64)
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", wide, wide)))


def _intensity(columns: Columns) -> Floats | None:
    values = next((columns[name] for name in _INTENSITIES if name in columns), None)
    if values is None:
        return None
    scaled = values.astype(np.float32)  # a copy, without the gaps between points
    largest = scaled.max(initial=0)
    if not np.isfinite(largest):
        largest = scaled[np.isfinite(scaled)].max(initial=0)
    full_scale = next((scale for scale in _FULL_SCALES if largest <= scale), _FULL_SCALES[-1])
    if full_scale != 1.0:
        scaled /= np.float32(full_scale)
    return scaled
