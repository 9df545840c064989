"""Which topics, frames and clocks of a bag are used, and what is said where that is in doubt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.rosbag.bag import Bag
from hybridlio.datasets.rosbag.choices import BagTopics

STAMP = 1_700_000_000_000_000_000


class TestChoice:
    def test_several_lidars_are_listed_with_types_counts_rates_and_the_option_to_copy(self, small: Any) -> None:
        bag = small.write(small.standard(), small.clouds("/filtered", count=2))
        with pytest.raises(DataError) as caught:
            open_sequence(bag)
        first, *rows = str(caught.value).splitlines()
        assert first.endswith(
            "small.bag: 2 lidar topics; choose one, for example --lidar-topic /points, or several to merge them"
        )
        assert [row.split() for row in rows] == [
            ["/filtered", "sensor_msgs/PointCloud2", "2", "10.0", "Hz"],
            ["/points", "sensor_msgs/PointCloud2", "4", "10.0", "Hz"],
        ]

    @pytest.mark.parametrize("name", ["small.bag", "small"])
    def test_the_rate_of_a_topic_that_starts_late_is_its_own(self, name: str, small: Any, small_2: Any) -> None:
        bags = small if name.endswith(".bag") else small_2
        late = [(t + 60 * 10**9, *rest) for t, *rest in bags.imu("/late")]
        topics = Bag(bags.write(bags.standard(), late, name=name)).topics
        rates = {topic: round(found.rate_hz, 6) for topic, found in topics.items()}
        assert rates == {"/points": 10.0, "/imu": 100.0, "/late": 100.0, "/tf_static": 0.0}

    def test_a_chosen_topic_is_used_with_and_without_its_slash(self, small: Any) -> None:
        bag = small.write(small.standard(), small.clouds("/filtered", count=2))
        for name in ("/filtered", "filtered"):
            assert len(open_sequence(bag, topics=BagTopics(lidar=name))) == 2

    def test_several_imus_are_an_error_and_none_leaves_them_out(self, small: Any) -> None:
        bag = small.write(small.standard(), small.imu("/other"))
        with pytest.raises(DataError, match="2 imu topics; choose one, for example --imu-topic /imu"):
            open_sequence(bag)
        assert len(open_sequence(bag, topics=BagTopics(imu="none")).imu) == 0

    def test_a_wrong_topic_is_named_with_those_that_fit(self, small: Any) -> None:
        bag = small.write(small.standard())
        with pytest.raises(
            DataError, match=r"--imu-topic /points: its type is sensor_msgs/PointCloud2; topics:\n  /imu "
        ):
            open_sequence(bag, topics=BagTopics(imu="/points"))
        with pytest.raises(DataError, match=r"--lidar-topic /gone: no such topic; topics:\n  /points "):
            open_sequence(bag, topics=BagTopics(lidar="/gone"))

    def test_a_bag_without_clouds_lists_its_topics(self, small: Any) -> None:
        with pytest.raises(DataError, match=r"no topic of point clouds .*Its topics:\n  /imu +sensor_msgs/Imu +37 "):
            open_sequence(small.write(small.imu()))

    def test_several_reference_topics_are_noted_and_none_is_used(self, small: Any) -> None:
        poses = [
            (t, topic, "nav_msgs/msg/Odometry", small.maker.odometry(t, np.eye(4), "imu"))
            for t in range(STAMP, STAMP + 4 * 10**8, 10**8)
            for topic in ("/wheel", "/truth")
        ]  # fmt: skip
        bag = small.write(small.standard(), poses)
        sequence = open_sequence(bag)
        assert sequence.reference is None
        assert any("choose by --reference-topic: /truth (nav_msgs/Odometry), /wheel" in n for n in sequence.notes)
        assert open_sequence(bag, topics=BagTopics(reference="/truth")).reference is not None

    def test_the_lidar_cannot_be_none_and_names_not_empty(self) -> None:
        with pytest.raises(ConfigError, match="--lidar-topic: odometry needs a lidar"):
            BagTopics(lidar="none")
        with pytest.raises(ConfigError, match="--imu-frame: the name is empty"):
            BagTopics(imu_frame="")


class TestExtrinsics:
    def test_they_follow_a_chain_of_frames(self, small: Any) -> None:
        T = np.eye(4)
        T[0, 3] = 2.0
        chain = small.maker.tf(
            small.maker.transform(0, "/imu", "mast", T), small.maker.transform(0, "mast", "lidar", T)
        )
        bag = small.write(small.clouds(), small.imu(), [(STAMP, "/tf_static", "tf2_msgs/msg/TFMessage", chain)])
        np.testing.assert_allclose(open_sequence(bag).calibration.T_imu_lidar[:3, 3], [4, 0, 0])

    def test_without_transforms_the_error_says_where_to_write_one(self, small: Any) -> None:
        with pytest.raises(DataError) as caught:
            open_sequence(small.write(small.clouds(), small.imu()))
        text = str(caught.value)
        assert "no fixed transform between the IMU's frame 'imu' and the lidar's frame 'lidar'" in text
        assert "the bag has no /tf_static and no /tf" in text
        assert "--imu-frame and --lidar-frame" in text
        assert f"to {small.folder / 'calibration.yaml'}" in text
        assert "T_imu_lidar:\n  - [1, 0, 0, 0.1]" in text

    def test_unconnected_frames_are_listed(self, small: Any) -> None:
        with pytest.raises(DataError, match="the frames of /tf_static and /tf are: base, lidar"):
            open_sequence(small.write(small.clouds(), small.imu(), [small.mount(parent="base")]))

    def test_named_frames_replace_those_of_messages(self, small: Any) -> None:
        bag = small.write(small.clouds(), small.imu(), [small.mount(parent="base")])
        sequence = open_sequence(bag, topics=BagTopics(imu_frame="base"))
        np.testing.assert_allclose(sequence.calibration.T_imu_lidar[:3, 3], [0.5, 0, 0])

    def test_a_calibration_file_beside_the_bag_comes_first(self, small: Any) -> None:
        bag = small.write(small.standard())
        rows = "[[1, 0, 0, 7], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
        (small.folder / "calibration.yaml").write_text(f"T_imu_lidar: {rows}\n")
        assert open_sequence(bag).calibration.T_imu_lidar[0, 3] == 7

    def test_fixed_transforms_on_tf_are_used(self, small: Any) -> None:
        fixed = [small.mount("/tf", at=k * 10**8) for k in range(3)]
        np.testing.assert_allclose(
            open_sequence(small.write(small.clouds(), small.imu(), fixed)).calibration.T_imu_lidar[0, 3], 0.5
        )

    def test_frames_that_move_to_each_other_are_not_extrinsics(self, small: Any) -> None:
        moving = [small.mount("/tf", x_m=k, at=k * 10**8) for k in range(3)]
        with pytest.raises(DataError, match="no fixed transform between"):
            open_sequence(small.write(small.clouds(), small.imu(), moving))

    def test_one_frame_for_both_is_noted(self, small: Any) -> None:
        sequence = open_sequence(small.write(small.clouds(), small.imu(frame="lidar")))
        np.testing.assert_array_equal(sequence.calibration.T_imu_lidar, np.eye(4))
        assert any("the same frame 'lidar': T_imu_lidar is taken as the identity" in note for note in sequence.notes)

    def test_messages_without_frames_need_the_options(self, small: Any) -> None:
        with pytest.raises(DataError, match="messages name no frame, give --imu-frame"):
            open_sequence(small.write(small.clouds(), small.imu(frame=""), [small.mount()]))

    def test_a_lidar_alone_needs_no_extrinsics(self, small: Any) -> None:
        sequence = open_sequence(small.write(small.clouds()))
        assert any("no inertial data" in note for note in sequence.notes)

    def test_a_zero_quaternion_is_refused(self, small: Any) -> None:
        mount = small.mount()
        mount[3].transforms[0].transform.rotation.w = 0.0
        with pytest.raises(DataError, match="transform from 'lidar' to 'imu': expected finite numbers"):
            open_sequence(small.write(small.clouds(), small.imu(), [mount]))


class TestMeasurements:
    def test_missing_returns_of_organised_clouds_are_left_out(self, small: Any) -> None:
        points = np.ones((2, 3), [("X", "<f4"), ("Y", "<f4"), ("Z", "<f4"), ("t", "<u4")])
        points["X"][0, 1], points["Z"][1, 2] = np.nan, np.inf
        points["t"] = np.arange(6).reshape(2, 3) * 15_000_000
        clouds = [
            (t, "/points", "sensor_msgs/msg/PointCloud2", small.maker.cloud(t, points))
            for t in range(STAMP, STAMP + 4 * 10**8, 10**8)
        ]
        scan = open_sequence(small.write(clouds, small.imu(), [small.mount()]))[1].scan
        assert len(scan) == 4
        assert scan.time_offsets_ns is not None
        assert scan.time_offsets_ns.tolist() == [0, 30_000_000, 45_000_000, 60_000_000]

    def test_forces_in_g_are_scaled_with_a_note(self, small: Any) -> None:
        sequence = open_sequence(small.write(small.clouds(), small.imu(factor=1 / 9.81), [small.mount()]))
        np.testing.assert_allclose(sequence.imu.accel_m_s2[:, 2], 9.80665)
        assert any("/imu: the median specific force is 1: read in g" in note for note in sequence.notes)

    def test_units_beyond_any_gyroscope_and_forces_in_mg_are_read_as_in_csv_files(self, small: Any) -> None:
        imu = small.imu(factor=1000 / 9.81)
        for _, _, _, message in imu:
            message.angular_velocity.x = 90.0
        sequence = open_sequence(small.write(small.clouds(), imu, [small.mount()]))
        np.testing.assert_allclose(sequence.imu.accel_m_s2[:, 2], 9.80665)
        np.testing.assert_allclose(sequence.imu.gyro_rad_s[:, 0], np.pi / 2)
        for text in ("read in mg", "angular velocities reach 90: read in °/s"):
            assert any(text in note for note in sequence.notes)

    def test_zero_stamps_are_replaced_by_times_of_receipt(self, small: Any) -> None:
        content = small.standard()
        for _, _, name, message in content:
            if name == "sensor_msgs/msg/PointCloud2":
                message.header.stamp.sec = message.header.stamp.nanosec = 0
        sequence = open_sequence(small.write(content))
        assert sequence.stamps_ns.tolist() == [STAMP + k * 10**8 for k in range(4)]
        assert any("/points: the headers' stamps are zero; times of receipt are used" in n for n in sequence.notes)
        assert len(sequence[2].scan) == 30

    def test_a_single_message_without_a_stamp_is_dropped(self, small: Any) -> None:
        content = small.standard()
        content[1][3].header.stamp.sec = content[1][3].header.stamp.nanosec = 0
        sequence = open_sequence(small.write(content))
        assert len(sequence) == 3
        assert [len(frame.scan) for frame in sequence] == [30, 30, 30]
        assert any("/points: dropped 1 message without a stamp" in note for note in sequence.notes)

    def test_stamps_are_used_though_messages_were_received_much_later(self, small: Any) -> None:
        content = [(t + 10**11, *rest) for t, *rest in small.standard()]
        sequence = open_sequence(small.write(content))
        assert sequence.stamps_ns[0] == STAMP
        assert any("/points: stamps are 100.000 s before the times of receipt" in n for n in sequence.notes)

    def test_different_clocks_of_lidar_and_imu_are_noted(self, small: Any) -> None:
        late = [(t + 300_000_000, *rest) for t, *rest in small.imu()]
        sequence = open_sequence(small.write(small.clouds(), late, [small.mount()]))
        assert any("the clocks of lidar and IMU may differ" in note for note in sequence.notes)

    def test_fixes_have_their_covariances_and_the_first_is_the_origin(self, small: Any) -> None:
        maker, places = small.maker, [(49.0, 8.4, 110.0), (49.00001, 8.4, 110.0), (0.0, 0.0, 0.0)]
        fixes = [
            (STAMP + k * 10**8, "/fix", "sensor_msgs/msg/NavSatFix",
             maker.fix(STAMP + k * 10**8, place, np.diag([1.0, 2.0, 3.0]), status=-1 if k == 2 else 0))
            for k, place in enumerate(places)
        ]  # fmt: skip
        fixes.append(
            (
                STAMP + 3 * 10**8,
                "/fix",
                "sensor_msgs/msg/NavSatFix",
                maker.fix(STAMP + 3 * 10**8, places[0], np.zeros(9), kind=0),
            )
        )
        sequence = open_sequence(small.write(small.standard(), fixes))
        assert len(sequence.gps) == 3
        assert sequence.gps[0].origin is not None
        assert sequence.gps[0].origin.latitude_deg == 49.0
        np.testing.assert_allclose(sequence.gps[1].position_m, [0, 1.112, 0], atol=1e-3)
        np.testing.assert_allclose(sequence.gps[0].covariance_m2, np.diag([1.0, 2.0, 3.0]))
        np.testing.assert_allclose(sequence.gps[2].covariance_m2, 25 * np.eye(3))
        assert any("/fix: 1 of 4 messages have no fix" in note for note in sequence.notes)
        assert any("/fix: 1 fix without covariance; 5 m are assumed" in note for note in sequence.notes)

    @pytest.mark.parametrize("child", ["imu", ""])
    def test_reference_poses_of_the_imu_become_those_of_the_lidar(self, small: Any, child: str) -> None:
        content = []
        for k in range(4):
            T = np.eye(4)
            T[:2, :2] = [[np.cos(k / 9), -np.sin(k / 9)], [np.sin(k / 9), np.cos(k / 9)]]
            t = STAMP + k * 10**8
            content.append((t, "/truth", "nav_msgs/msg/Odometry", small.maker.odometry(t, T, child)))
        sequence = open_sequence(small.write(small.standard(), content))
        assert sequence.reference is not None
        expected = [0.5 * (np.cos(3 / 9) - 1), 0.5 * np.sin(3 / 9), 0]  # the lidar is 0.5 m in front of the IMU
        np.testing.assert_allclose(sequence.reference.poses[3, :3, 3], expected, atol=1e-9)
        assert any("taken as the IMU's poses" in note for note in sequence.notes) == (child == "")


def test_a_batch_list_may_name_topics(small: Any) -> None:
    from hybridlio.runs.recordings import find_recordings

    small.write(small.standard(), small.clouds("/filtered", count=2))
    (small.folder / "list.yaml").write_text("- {path: small.bag, topics: {lidar: /filtered}}\n")
    (one,) = find_recordings([small.folder / "list.yaml"], topics=BagTopics(lidar="/points"))
    assert one.topics == BagTopics(lidar="/filtered")
    assert len(one.open()) == 2
    (small.folder / "bad.yaml").write_text("- {path: small.bag, topics: {radar: /x}}\n")
    with pytest.raises(DataError, match=r"entry 1: topics .* keys of lidar, imu, gps, reference, imu_frame"):
        find_recordings([small.folder / "bad.yaml"])


@pytest.mark.parametrize("lidars", ["[/points, /other]", "/points,/other"])
def test_a_batch_list_may_name_several_lidars(small: Any, lidars: str) -> None:
    from hybridlio.runs.recordings import find_recordings

    small.write(small.standard(), small.clouds("/other"))
    (small.folder / "list.yaml").write_text(
        f"- path: small.bag\n  topics: {{lidar: '{lidars}'}}\n".replace("'[", "[").replace("]'", "]")
    )
    (recording,) = find_recordings([small.folder / "list.yaml"])
    assert recording.topics.lidars == ("/points", "/other")
    assert len(recording.open()[0].scan) == 60


def test_commands_take_the_options(small: Any, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from hybridlio.commands.app import app

    bag = small.write(small.standard())
    refused = CliRunner().invoke(app, ["odometry", str(bag), "--imu-topic", "/points", "-o", str(tmp_path / "run")])
    assert refused.exit_code == 2
    assert "--imu-topic /points: its type is sensor_msgs/PointCloud2" in refused.output


def test_commands_take_several_lidars(small: Any) -> None:
    from typer.testing import CliRunner

    from hybridlio.commands.app import app

    bag = small.write(small.standard(), small.clouds("/other"))
    shown = CliRunner().invoke(app, ["info", str(bag), "--lidar-topic", "/points", "--lidar-topic", "/other"])
    assert shown.exit_code == 0, shown.output
    assert "60 points a scan" in shown.output
    assert "/other has the frame of the first lidar" in " ".join(shown.output.split())


def test_one_topic_is_not_merged_with_itself(small: Any) -> None:
    bag = small.write(small.standard())
    with pytest.raises(DataError, match="--lidar-topic: /points is named twice"):
        open_sequence(bag, topics=BagTopics(lidar="/points,points"))
