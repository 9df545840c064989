"""Odd but whole bags: they are read rightly, or one line says why not."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.rosbag.bag import Bag
from hybridlio.datasets.rosbag.measurements import Log
from hybridlio.datasets.rosbag.wire import Header


def without(message: Any, *parts: str) -> None:
    """Make an inertial message say that it does not measure some of its parts."""
    for part in parts:
        getattr(message, f"{part}_covariance")[0] = -1.0
        vector = getattr(message, part)
        vector.x = vector.y = vector.z = 0.0


@pytest.mark.parametrize("ros", ["small", "small_2"])
@pytest.mark.parametrize("part", ["angular_velocity", "linear_acceleration"])
def test_an_imu_that_does_not_measure_a_part_is_refused(ros: str, part: str, request: Any) -> None:
    small = request.getfixturevalue(ros)
    imu = small.imu()
    for _, _, _, message in imu:
        without(message, part)
    path = small.write(small.clouds(), imu, [small.mount()], name="small.bag" if ros == "small" else "small")
    with pytest.raises(DataError, match=f"hold no {part.replace('_', ' ')}.*--imu-topic none"):
        open_sequence(path)


def test_single_inertial_messages_without_values_are_dropped_and_counted(small: Any) -> None:
    imu = small.imu()
    without(imu[5][3], "angular_velocity")
    sequence = open_sequence(small.write(small.clouds(), imu, [small.mount()]))
    assert len(sequence.imu) == len(imu) - 1
    assert any("dropped 1 row" in note for note in sequence.notes)


def test_values_beside_an_unknown_covariance_are_used(small: Any) -> None:
    imu = small.imu()
    for _, _, _, message in imu:
        message.linear_acceleration_covariance[0] = -1.0
    assert len(open_sequence(small.write(small.clouds(), imu, [small.mount()])).imu) == len(imu)


def test_clouds_of_both_byte_orders_in_one_topic_are_read(small: Any) -> None:
    clouds = small.clouds()
    expected = open_sequence(small.write(clouds, small.imu(), [small.mount()], name="one.bag"))
    for _, _, _, message in clouds[::2]:
        message.data = message.data.reshape(-1, 4)[:, ::-1].ravel()
        message.is_bigendian = True
    mixed = open_sequence(small.write(clouds, small.imu(), [small.mount()], name="mixed.bag"))
    for k in range(len(expected)):
        np.testing.assert_array_equal(mixed[k].scan.points, expected[k].scan.points)


def transforms(small: Any, *edges: tuple[str, str, float]) -> list[Any]:
    """A message of ``/tf_static`` with frames along x."""
    parts = []
    for parent, child, x_m in edges:
        T = np.eye(4)
        T[0, 3] = x_m
        parts.append(small.maker.transform(0, parent, child, T))
    return [(small.start_ns, "/tf_static", "tf2_msgs/msg/TFMessage", small.maker.tf(*parts))]


@pytest.mark.parametrize(
    ("edges", "names"),
    [
        ((("imu", "lidar", 0.5), ("lidar", "imu", 0.5)), "imu, lidar"),  # a loop that does not close
        ((("base", "lidar", 0.5), ("mast", "lidar", 1.0), ("base", "imu", 0.1)), "lidar"),  # two parents
    ],
)
def test_frames_that_contradict_each_other_are_named_and_not_used(small: Any, edges: Any, names: str) -> None:
    path = small.write(small.clouds(), small.imu(), transforms(small, *edges))
    with pytest.raises(DataError, match=f"several parents: {names}\\."):
        open_sequence(path)


def test_a_loop_of_frames_that_closes_is_used(small: Any) -> None:
    path = small.write(small.clouds(), small.imu(), transforms(small, ("imu", "lidar", 0.5), ("lidar", "imu", -0.5)))
    assert open_sequence(path).calibration.T_imu_lidar[0, 3] == pytest.approx(0.5)


def test_an_mcap_file_of_another_system_is_not_called_damaged(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        schema = writer.register_schema("Sample", "jsonschema", b"{}")
        channel = writer.register_channel("/sample", "json", schema)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"{}")
        writer.finish()
    with pytest.raises(DataError, match="of another system, not of ROS 2") as refused:
        open_sequence(path)
    assert "damaged" not in str(refused.value)


@pytest.mark.parametrize(("received_ns", "is_damaged"), [(2**63 - 1, False), (2**63, True), (2**64 - 1, True)])
def test_a_time_of_receipt_that_no_stamp_can_hold_is_one_clear_error(received_ns: int, is_damaged: bool) -> None:
    log = Log()
    header = Header(1, "imu", 0, "<")
    if not is_damaged:
        log.add(header, received_ns)
        assert len(log) == 1
        return
    with pytest.raises(DataError, match="after the year 2262"):
        log.add(header, received_ns)
    assert len(log) == 0


def test_messages_whose_damaged_definition_lacks_fields_are_one_clear_error(
    small: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = small.write(small.clouds(), small.imu(), [small.mount()])
    monkeypatch.setattr(Bag, "decode", lambda *_: SimpleNamespace(header=None))
    with pytest.raises(DataError, match=r"truncated or damaged \('types.SimpleNamespace' object has no attribute"):
        open_sequence(path)
