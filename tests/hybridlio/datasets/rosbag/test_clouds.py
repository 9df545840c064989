"""Point clouds of every layout that the message type allows."""

from __future__ import annotations

from typing import Any

import bags
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlio.core.errors import DataError
from hybridlio.datasets.rosbag.clouds import cloud_columns
from hybridlio.datasets.rosbag.wire import read_header, read_livox

MAKER = bags.Messages(is_ros2=True)
AXES = [("x", "f4"), ("y", "f4"), ("z", "f4")]


def points(kinds: Any, shape: Any = 6) -> Any:
    rows = np.zeros(shape, kinds)
    for i, name in enumerate(rows.dtype.names or ()):
        rows[name] = np.arange(rows.size).reshape(shape) + 10 * i
    return rows


@settings(max_examples=50, deadline=None)
@given(
    kinds=st.lists(st.sampled_from(sorted(bags.KINDS)), min_size=3, max_size=6),
    order=st.permutations(["x", "y", "z"]),
    big=st.booleans(),
    gap=st.integers(0, 5),
)
def test_fields_of_any_type_order_gap_and_byte_order_are_read(
    kinds: list[str], order: list[str], big: bool, gap: int
) -> None:
    names = [*order, "a", "b", "c"][: len(kinds)]
    offsets, at = [], gap
    for kind in kinds:
        offsets.append(at)
        at += np.dtype(kind).itemsize + gap
    formats = [np.dtype(kind).newbyteorder(">" if big else "<") for kind in kinds]
    rows = points(np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at + 3}))
    message = MAKER.cloud(0, rows, is_bigendian=big)
    columns = cloud_columns(message)
    assert set(columns) == set(names)
    for name in names:
        np.testing.assert_array_equal(columns[name], rows[name])


def test_padded_rows_of_an_organised_cloud_are_read() -> None:
    rows = points(AXES, (3, 4))
    data = b"".join(row.tobytes() + b"\xff" * 5 for row in rows)
    for cut in (0, 5):  # some writers leave out the padding of the last row
        raw = np.frombuffer(data[: len(data) - cut], np.uint8)
        columns = cloud_columns(MAKER.cloud(0, rows, row_step=4 * 12 + 5, data=raw))
        np.testing.assert_array_equal(columns["y"], rows["y"].ravel())


def test_fields_of_several_values_and_repeated_names_are_no_columns() -> None:
    message = MAKER.cloud(0, points([*AXES, ("n", "f4"), ("m", "f4")]))
    message.fields[3].count = 2
    message.fields[4].name = "x"
    assert list(cloud_columns(message)) == ["x", "y", "z"]


def test_a_count_of_zero_means_a_scalar_and_a_row_step_of_zero_one_row() -> None:
    message = MAKER.cloud(0, points(AXES), row_step=0)
    for field in message.fields:
        field.count = 0
    assert cloud_columns(message)["z"].tolist() == [20, 21, 22, 23, 24, 25]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: setattr(m.fields[0], "name", "range"), "no field x; its fields are range, y, z"),
        (lambda m: setattr(m.fields[1], "datatype", 11), "field 'y' of the cloud has the unknown type 11"),
        (lambda m: setattr(m.fields[2], "offset", 9), "field 'z' of the cloud lies outside its 12 bytes per point"),
        (lambda m: setattr(m, "data", m.data[:-1]), "71 bytes, but 1 rows of 72; the message is truncated"),
        (lambda m: setattr(m, "width", 4_000_000_000), "the message is truncated"),
        (lambda m: (setattr(m, "height", 2), setattr(m, "row_step", 5)), "rows of the cloud have 5 bytes, too few"),
        (lambda m: setattr(m, "point_step", 0), "field 'x' of the cloud lies outside its 0 bytes per point"),
        (lambda m: setattr(m, "point_step", 2**32 - 1), "points of the cloud have 4294967295 bytes each"),
    ],
)
def test_a_cloud_that_does_not_fit_its_description_is_refused(change: Any, text: str) -> None:
    message = MAKER.cloud(0, points(AXES))
    change(message)
    with pytest.raises(DataError, match=text):
        cloud_columns(message)


@pytest.mark.parametrize("is_ros2", [False, True])
@pytest.mark.parametrize("frame", ["", "a", "abcd", "livox_frame"])
def test_livox_points_are_read_behind_frames_of_any_length(is_ros2: bool, frame: str) -> None:
    from hybridlio.core.sensors import Scan

    maker, rng = bags.Messages(is_ros2), np.random.default_rng(1)
    scan = Scan(10**18, rng.uniform(-9, 9, (7, 3)).astype(np.float32), np.full(7, 0.2, np.float32), np.arange(7) * 1000)
    name = "livox_ros_driver2/msg/CustomMsg"
    serialise = maker.store.serialize_cdr if is_ros2 else maker.store.serialize_ros1
    raw = bytes(serialise(maker.livox("livox_ros_driver2", scan, frame), name))
    timebase_ns, read = read_livox(raw, is_ros2)
    assert timebase_ns == 10**18
    assert read_header(raw, is_ros2).frame == frame
    np.testing.assert_array_equal(np.column_stack([read[axis] for axis in "xyz"]), scan.points)
    assert read["offset_time"].tolist() == [0, 1000, 2000, 3000, 4000, 5000, 6000]
    assert set(read["reflectivity"].tolist()) == {51}
    for size in range(0, len(raw) - 8, 7):
        with pytest.raises(DataError):
            read_livox(raw[:size], is_ros2)
