from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.runs.recordings import Recording, find_recordings


def make_recording(folder: Path) -> Path:
    """A folder of one scan, as the folder reader takes it."""
    (folder / "scans").mkdir(parents=True)
    np.zeros((1, 4), np.float32).tofile(folder / "scans/000000.bin")
    (folder / "timestamps.txt").write_text("0.0\n")
    return folder


@pytest.fixture
def drives(tmp_path) -> Path:
    for name in ("north", "south", "west"):
        make_recording(tmp_path / "drives" / name)
    return tmp_path / "drives"


def names(found) -> list[str]:
    return [recording.name for recording in found]


def test_a_folder_of_several_recordings_stands_for_all_of_them(drives):
    assert names(find_recordings([drives])) == ["north", "south", "west"]


def test_sequences_choose_among_them_in_the_order_asked_for(drives):
    found = find_recordings([drives], sequence="west,north")
    assert names(found) == ["west", "north"]
    assert all(len(recording.open()) == 1 for recording in found)


def test_a_pattern_stands_for_what_it_matches(drives):
    assert names(find_recordings([f"{drives}/*th"])) == ["north", "south"]


def test_each_recording_is_found_once_however_often_it_is_meant(drives):
    assert names(find_recordings([f"{drives}/*th", drives / "north"])) == ["north", "south"]


def test_a_text_list_holds_paths_from_its_own_folder_with_sequences_and_comments(drives):
    (drives / "list.txt").write_text("# mine\nnorth\n. west  # by name\n\n'south'\n")
    assert names(find_recordings([drives / "list.txt"])) == ["north", "west", "south"]


def test_a_yaml_list_holds_paths_or_mappings(drives):
    (drives / "list.yaml").write_text("- north\n- {path: ., sequence: west, frames: '0:1'}\n")
    first, second = find_recordings([drives / "list.yaml"], frames=":")
    assert (first.name, first.frames) == ("north", ":")
    assert (second.name, second.frames) == ("west", "0:1")


def test_the_raw_root_of_a_list_starts_from_its_own_folder_and_that_of_an_option_from_the_current_one(
    drives, monkeypatch
):
    (drives / "list.yaml").write_text("- {path: north, raw_root: raw}\n- south\n")
    monkeypatch.chdir(drives.parent)
    one, two = find_recordings([drives / "list.yaml"], raw_root="drives")
    assert one.raw_root == str(drives / "raw")
    assert two.raw_root == str(drives)


def test_points_are_raised_as_a_recording_says_and_else_as_the_option_does(drives, monkeypatch):
    (drives / "list.yaml").write_text("- {path: north, vertical_angle_deg: 0}\n- south\n")
    own, other = find_recordings([drives / "list.yaml"], vertical_angle_deg=1.0)
    assert (own.vertical_angle_deg, other.vertical_angle_deg) == (0, 1.0)
    np.array([[10.0, 0.0, 0.0, 0.5]], np.float32).tofile(drives / "north/scans/000000.bin")
    for angle_deg in (None, 0.0, 1.0):
        (x, _, z) = replace(own, vertical_angle_deg=angle_deg).open()[0].scan.points[0]
        assert np.rad2deg(np.arctan2(z, x)) == pytest.approx(angle_deg or 0.0, abs=1e-5)


def test_an_angle_that_is_no_calibration_error_is_refused_before_any_recording_is_looked_for(tmp_path):
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
def test_a_malformed_list_is_refused_with_the_place(tmp_path, file, text, words):
    (tmp_path / file).write_text(text)
    with pytest.raises(DataError, match=words):
        find_recordings([tmp_path / file])


def test_what_holds_no_recording_is_kept_and_fails_when_it_is_opened(tmp_path):
    (gone,) = find_recordings([tmp_path / "gone"])
    assert gone.name == "gone"
    with pytest.raises(DataError, match="no such folder"):
        gone.open()


def test_an_empty_list_is_refused(tmp_path):
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(ConfigError, match="no recording"):
        find_recordings([tmp_path / "empty.txt"])


def test_recordings_of_one_name_get_names_of_their_own_that_depend_on_nothing_else(tmp_path):
    one, two = make_recording(tmp_path / "a/drive"), make_recording(tmp_path / "b/drive")
    there, back = find_recordings([one, two]), find_recordings([two, one])
    assert len(set(names(there))) == 2
    assert {r.path: r.name for r in there} == {r.path: r.name for r in back}
    assert all(name.startswith("drive-") for name in names(there))


def test_names_are_good_for_folders():
    (odd,) = find_recordings([Recording("/nowhere/../a b:c")])
    assert odd.name == "a_b_c"


def test_a_single_path_as_text_is_one_recording_and_not_its_letters(drives):
    assert names(find_recordings(str(drives / "north"))) == ["north"]


@pytest.mark.parametrize(("given", "words"), [("none.yaml", "no such list file"), ("nope/*", "no path matches")])
def test_a_list_or_pattern_that_stands_for_nothing_is_refused(tmp_path, given, words):
    with pytest.raises(ConfigError, match=words):
        find_recordings([tmp_path / given])
