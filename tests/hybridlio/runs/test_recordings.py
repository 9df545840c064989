from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.runs.recordings import Recording, find_recordings


def make_recording(folder: Path) -> Path:
    """Write a recording of one scan for the folder reader; its first point lies 10 m ahead."""
    (folder / "scans").mkdir(parents=True)
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-20.0, 20.0, (500, 3)), rng.uniform(0.0, 1.0, 500)]
    points[0] = 10.0, 0.0, 0.0, 0.5
    points.astype(np.float32).tofile(folder / "scans/000000.bin")
    (folder / "timestamps.txt").write_text("0.0\n")
    return folder


@pytest.fixture
def drives(tmp_path) -> Path:
    for name in ("north", "south", "west"):
        make_recording(tmp_path / "drives" / name)
    return tmp_path / "drives"


def names(found) -> list[str]:
    return [recording.name for recording in found]


def test_a_folder_of_several_recordings_gives_all_of_them(drives):
    assert names(find_recordings([drives])) == ["north", "south", "west"]


def test_sequence_names_choose_recordings_in_the_given_order(drives):
    found = find_recordings([drives], sequence="west,north")
    assert names(found) == ["west", "north"]
    assert all(len(recording.open()) == 1 for recording in found)


def test_a_pattern_gives_all_its_matches(drives):
    assert names(find_recordings([f"{drives}/*th"])) == ["north", "south"]


def test_a_recording_given_twice_is_found_once(drives):
    assert names(find_recordings([f"{drives}/*th", drives / "north"])) == ["north", "south"]


def test_a_text_list_has_paths_relative_to_its_folder_with_sequences_and_comments(drives):
    (drives / "list.txt").write_text("# mine\nnorth\n. west  # by name\n\n'south'\n")
    assert names(find_recordings([drives / "list.txt"])) == ["north", "west", "south"]


def test_a_yaml_list_has_paths_or_mappings(drives):
    (drives / "list.yaml").write_text("- north\n- {path: ., sequence: west, frames: '0:1'}\n")
    first, second = find_recordings([drives / "list.yaml"], frames=":")
    assert (first.name, first.frames) == ("north", ":")
    assert (second.name, second.frames) == ("west", "0:1")


def test_raw_root_in_a_list_is_relative_to_its_folder_and_as_an_option_to_the_current_one(drives, monkeypatch):
    (drives / "list.yaml").write_text("- {path: north, raw_root: raw}\n- south\n")
    monkeypatch.chdir(drives.parent)
    one, two = find_recordings([drives / "list.yaml"], raw_root="drives")
    assert one.raw_root == str(drives / "raw")
    assert two.raw_root == str(drives)


def test_the_vertical_angle_of_an_entry_takes_precedence_over_the_option(drives, monkeypatch):
    (drives / "list.yaml").write_text("- {path: north, vertical_angle_deg: 0}\n- south\n")
    own, other = find_recordings([drives / "list.yaml"], vertical_angle_deg=1.0)
    assert (own.vertical_angle_deg, other.vertical_angle_deg) == (0, 1.0)
    for angle_deg in (None, 0.0, 1.0):
        (x, _, z) = replace(own, vertical_angle_deg=angle_deg).open()[0].scan.points[0]
        assert np.rad2deg(np.arctan2(z, x)) == pytest.approx(angle_deg or 0.0, abs=1e-5)


def test_an_implausible_vertical_angle_is_an_error_before_any_recording_is_opened(tmp_path):
    with pytest.raises(ConfigError, match="vertical_angle_deg: must be within"):
        find_recordings([tmp_path / "gone"], vertical_angle_deg=9.0)


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("a.txt", "one two three\n", "line 1.*3 words"),
        ("a.txt", "'open\n", "line 1"),
        ("a.yaml", "path: x\n", "expected a list"),
        ("a.yaml", "- {path: x, speed: 3}\n", "entry 1: unknown key 'speed'"),
        ("a.yaml", "- {sequence: x}\n", "entry 1: expected a path"),
        ("a.yaml", "- x\n- {path: x, frames: 3}\n", "entry 2: frames '3': give a range"),
        ("a.yaml", "- {path: x, reader: tape}\n", "entry 1: unknown reader 'tape'"),
        ("a.yaml", "- {path: x, vertical_angle_deg: high}\n", "entry 1: vertical_angle_deg 'high': give a number"),
        ("a.yaml", "- {path: x, vertical_angle_deg: 9}\n", "entry 1: vertical_angle_deg: must be within ±5°, got 9"),
        ("a.yaml", "- [", r"a\.yaml: not YAML at line 1"),
    ],
)
def test_the_error_for_a_malformed_list_names_the_entry(tmp_path, file, text, words):
    (tmp_path / file).write_text(text)
    with pytest.raises(DataError, match=words):
        find_recordings([tmp_path / file])


def test_a_path_without_recording_is_kept_and_fails_when_opened(tmp_path):
    (gone,) = find_recordings([tmp_path / "gone"])
    assert gone.name == "gone"
    with pytest.raises(DataError, match="no such folder"):
        gone.open()


def test_an_empty_list_is_an_error(tmp_path):
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(ConfigError, match="no recording"):
        find_recordings([tmp_path / "empty.txt"])


def test_recordings_with_equal_names_get_unique_names_independent_of_their_order(tmp_path):
    one, two = make_recording(tmp_path / "a/drive"), make_recording(tmp_path / "b/drive")
    there, back = find_recordings([one, two]), find_recordings([two, one])
    assert len(set(names(there))) == 2
    assert {r.path: r.name for r in there} == {r.path: r.name for r in back}
    assert all(name.startswith("drive-") for name in names(there))


def test_names_are_valid_folder_names():
    (recording,) = find_recordings([Recording("/nowhere/../a b:c")])
    assert recording.name == "a_b_c"


def test_a_single_path_as_text_is_one_recording(drives):
    assert names(find_recordings(str(drives / "north"))) == ["north"]


@pytest.mark.parametrize(("given", "words"), [("none.yaml", "no such list file"), ("nope/*", "no path matches")])
def test_a_missing_list_or_a_pattern_without_match_is_an_error(tmp_path, given, words):
    with pytest.raises(ConfigError, match=words):
        find_recordings([tmp_path / given])


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("a\\0b", "cannot contain a NUL"),
        ("x" * 5000, "too long"),
        ("d/" * 3000, "too long"),
        ("~nobody-of-this-name/a", "unknown user"),
    ],
)
def test_an_impossible_path_in_a_list_is_one_clear_line(tmp_path, path, words):
    file = tmp_path / "list.yaml"
    file.write_text(f'- path: "{path}"\n')
    with pytest.raises(DataError, match=words) as raised:
        find_recordings([file])
    assert str(raised.value).startswith(f"{file}, entry 1: ")
    assert len(str(raised.value)) < 300
