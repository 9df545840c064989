import pickle
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import ImuNoise
from hybridlio.odometry.config import Config, config_to_yaml, load_config, parse_config
from hybridlio.registration.settings import LocalMapSettings, RegistrationSettings
from hybridlio.smoothing.loop_candidates import CandidateSettings
from hybridlio.smoothing.loop_consistency import ConsistencySettings
from hybridlio.smoothing.loop_verification import VerificationSettings
from hybridlio.smoothing.place_recognition import DescriptorSettings
from hybridlio.sources.settings import ScanMatchingSettings


def leaves(settings: Any, above: str = "") -> Iterator[tuple[str, float]]:
    """Yield every number in a tree of dataclasses with its path."""
    for f in fields(settings):
        value = getattr(settings, f.name)
        if is_dataclass(value):
            yield from leaves(value, f"{above}{f.name}.")
        elif isinstance(value, int | float):
            yield f"{above}{f.name}", value


def test_the_defaults_round_trip_through_yaml(tmp_path: Path):
    (tmp_path / "my.yaml").write_text(config_to_yaml(Config()))
    assert load_config(tmp_path / "my.yaml") == Config()


def test_changed_settings_round_trip_through_yaml(tmp_path: Path):
    changed = parse_config(
        {
            "initial_pose": "kalman",
            "imu_noise": {"gyro_rad_s_sqrt_hz": 1e-4},
            "scan_matching": {
                "target": "last-scan",
                "start_speeds_m_s": [0.0, 12.5],
                "registration": {"kernel_m": 0.2},
                "local_map": {"voxel_m": 0.5},
            },
            "lstm": {"weights": "mine.safetensors"},
            "network": {"refine_steps": 3, "start_speeds_m_s": [0.0]},
        },
        "here",
    )
    (tmp_path / "my.yaml").write_text(config_to_yaml(changed))
    again = load_config(tmp_path / "my.yaml")
    assert again == changed
    assert again.imu_noise == ImuNoise(gyro_rad_s_sqrt_hz=1e-4)
    assert again.scan_matching.start_speeds_m_s == (0.0, 12.5)
    assert (again.lstm.weights, again.network.refine_steps) == ("mine.safetensors", 3)
    assert again != Config()


def test_the_yaml_holds_every_setting_as_a_plain_value():
    tree = yaml.safe_load(config_to_yaml(Config()))
    assert set(tree) == set(Config.model_fields)
    assert tree["scan_matching"]["registration"]["max_iterations"] == Config().scan_matching.registration.max_iterations
    assert tree["scan_matching"]["local_map"]["voxel_m"] > 0


def test_settings_missing_in_a_file_keep_their_defaults(tmp_path: Path):
    (tmp_path / "part.yaml").write_text("scan_matching:\n  registration:\n    kernel_m: 0.3\n")
    config = load_config(tmp_path / "part.yaml")
    assert config.scan_matching.registration.kernel_m == 0.3
    assert config.scan_matching.registration.max_iterations == Config().scan_matching.registration.max_iterations
    assert config.initial_pose == Config().initial_pose


def test_an_empty_file_gives_the_defaults(tmp_path: Path):
    for text in ("", "# nothing\n", "{}\n"):
        (tmp_path / "empty.yaml").write_text(text)
        assert load_config(tmp_path / "empty.yaml") == Config()


@pytest.mark.parametrize(
    ("tree", "path"),
    [
        ({"inital_pose": "kalman"}, "inital_pose"),
        ({"imu_noise": {"gyro": 1.0}}, "imu_noise.gyro"),
        ({"scan_matching": {"voxel_m": 1.0}}, "scan_matching.voxel_m"),
        ({"scan_matching": {"registration": {"kernel": 1.0}}}, "scan_matching.registration.kernel"),
        ({"scan_matching": {"local_map": {"voxel": 1.0}}}, "scan_matching.local_map.voxel"),
        ({"network": {"steps": 1}}, "network.steps"),
        ({"lstm": {"weight": "a"}}, "lstm.weight"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_unknown_key_is_named_with_its_path(tmp_path: Path, tree: dict, path: str):
    (tmp_path / "my.yaml").write_text(yaml.safe_dump(tree))
    with pytest.raises(ConfigError) as error:
        load_config(tmp_path / "my.yaml")
    assert f"{path}: " in str(error.value)
    assert "my.yaml" in str(error.value)
    assert "hybridlio config" in str(error.value)


@pytest.mark.parametrize(
    ("tree", "path"),
    [
        ({"scan_matching": {"target": "nearest"}}, "scan_matching.target"),
        ({"scan_matching": {"min_points": "many"}}, "scan_matching.min_points"),
        ({"scan_matching": 3}, "scan_matching"),
        ({"backend": 7}, "backend"),
        ({"network": {"min_cells": 0}}, "network.min_cells"),
        ({"network": {"refine_steps": "some"}}, "network.refine_steps"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_value_of_the_wrong_type_is_named_with_its_path(tree: dict, path: str):
    with pytest.raises(ConfigError, match=rf"here: {path}"):
        parse_config(tree, "here")


def test_every_mistake_is_named():
    with pytest.raises(ConfigError, match=r"one: .*two: "):
        parse_config({"one": 1, "two": 2}, "here")


@pytest.mark.parametrize("tree", [["a", "list"], "a word", 7])
def test_a_file_without_named_settings_is_refused(tree: object):
    with pytest.raises(ConfigError, match="here: "):
        parse_config(tree, "here")


def test_a_file_that_is_not_yaml_is_named(tmp_path: Path):
    (tmp_path / "broken.yaml").write_text("scan_matching: [1, 2\n")
    with pytest.raises(ConfigError, match=r"broken\.yaml: not YAML"):
        load_config(tmp_path / "broken.yaml")


def test_a_binary_file_is_named(tmp_path: Path):
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(ConfigError, match=r"bytes\.yaml"):
        load_config(tmp_path / "bytes.yaml")


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read"):
        load_config(tmp_path / "nowhere.yaml")


def test_settings_are_immutable():
    with pytest.raises((ValueError, AttributeError)):
        Config().backend = "none"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("tree", "meant"),
    [
        ({"inital_pose": "kalman"}, "initial_pose"),
        ({"scan_matching": {"map_voxl_m": 1.0}}, "scan_matching.map_voxel_m"),
        ({"scan_matching": {"kernel_m": 1.0}}, "scan_matching.registration.kernel_m"),
    ],
)
def test_a_misspelt_or_misplaced_key_gets_a_suggestion(tree: dict, meant: str):
    with pytest.raises(ConfigError, match=rf"unknown key \(did you mean {re.escape(meant)}\?\)"):
        parse_config(tree, "here")


SETTINGS = {
    name: getattr(Config(), name) for name in ("scan_matching", "recent_scans", "network", "keyframes")
} | {"imu_noise": ImuNoise()}  # fmt: skip


@pytest.mark.parametrize("value", [-1, float("nan")])
@pytest.mark.parametrize("path", [f"{above}.{path}" for above, tree in SETTINGS.items() for path, _ in leaves(tree)])
def test_a_negative_or_missing_number_is_named_with_its_path(path: str, value: float):
    tree: dict | float = value
    for key in reversed(path.split(".")):
        tree = {key: tree}
    with pytest.raises(ConfigError, match=rf"here: {re.escape(path)}: ") as error:
        parse_config(tree, "here")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changed", "wanted"),
    [
        ({"scan_matching": {"min_range_m": 50.0, "max_range_m": 40.0}}, "scan_matching.max_range_m: must be above min"),
        ({"scan_matching": {"min_matched": 1.1}}, "scan_matching.min_matched: must be between 0 and 1, got 1.1"),
        (
            {"scan_matching": {"start_speeds_m_s": []}},
            "scan_matching.start_speeds_m_s: must be a list of one number",
        ),
        ({"network": {"start_speeds_m_s": []}}, "network.start_speeds_m_s: must be a list of one number or more"),
        ({"keyframes": {"max_range_m": 1e6}}, "keyframes.max_range_m: must be above 0 and below 164"),
        ({"imu_noise": {"gyro_rad_s_sqrt_hz": float("inf")}}, "imu_noise.gyro_rad_s_sqrt_hz: must be finite"),
        (
            {"recent_scans": {"shared": 1.0}, "keyframes": {"voxel_m": 0.0}},
            "recent_scans.shared: .*; keyframes.voxel_m",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_all_numbers_out_of_range_are_named(changed: dict, wanted: str):
    with pytest.raises(ConfigError, match=wanted):
        parse_config(changed, "here")


@pytest.mark.parametrize(
    ("make", "wanted"),
    [
        (lambda: ScanMatchingSettings(map_voxel_m=-1), "ScanMatchingSettings.map_voxel_m: must be above 0, got -1"),
        (lambda: ScanMatchingSettings(target="map"), "ScanMatchingSettings.target: must be local-map or last-scan"),
        (lambda: RegistrationSettings(threads=0), "RegistrationSettings.threads: must be above 0, got 0"),
        (lambda: LocalMapSettings(radius_m=float("nan")), "LocalMapSettings.radius_m: must be above 0, got nan"),
        (lambda: VerificationSettings(neighbours=4), "VerificationSettings.neighbours: must be 5 or more"),
        (lambda: LocalMapSettings(neighbours=4), "LocalMapSettings.neighbours: must be from 5"),
        (lambda: VerificationSettings(max_cost=1.5), "VerificationSettings.max_cost: must be between 0 and 1, got 1.5"),
        (lambda: CandidateSettings(compared=0), "CandidateSettings.compared: must be above 0, got 0"),
        (lambda: ConsistencySettings(inlier_share=1.0), "ConsistencySettings.inlier_share: must be above 0 and below"),
        (lambda: DescriptorSettings(beside_m=()), "DescriptorSettings.beside_m: must be one position at least"),
        (
            lambda: ImuNoise(gyro_rad_s_sqrt_hz=-1),
            "ImuNoise.gyro_rad_s_sqrt_hz: must be finite and not negative",
        ),
    ],
)
def test_settings_made_in_python_are_checked_too(make: Callable[[], object], wanted: str):
    with pytest.raises(ConfigError, match=re.escape(wanted)) as error:
        make()
    assert str(pickle.loads(pickle.dumps(error.value))) == str(error.value)  # as between the processes of a batch


@pytest.mark.parametrize(
    ("settings", "wanted"),
    [
        ({"backend": "isam2"}, "unknown backend 'isam2'"),
        ({"backend": 3}, "backend: input should be a valid string"),
        ({"scan_matching": 5}, "scan_matching: expected keys with values, got 5"),
        ({"scan_matching": {"registration": [1]}}, "scan_matching.registration: expected keys with values, got [1]"),
        ({"nonsense": 1}, "nonsense: unknown key"),
        ({"scan_matching": {"covariance_scale": 1e300}}, "scan_matching.covariance_scale: must be at most 1e+06"),
        ({"scan_matching": {"local_map": {"neighbours": 1000000}}}, "local_map.neighbours: must be from 5"),
    ],
)
def test_wrong_settings_given_in_python_are_one_line(settings: dict[str, Any], wanted: str):
    with pytest.raises(ConfigError, match=re.escape(wanted)) as error:
        Config(**settings)
    assert "\n" not in str(error.value)
