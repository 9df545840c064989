"""An unfinished run of another version, whose files lack a value or hold one more, is refused by one clear line."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from resumed import without_points

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import Frame, ImuSamples
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.record import journal
from hybridlio.record.plain_values import decode, encode
from hybridlio.runs.run import Run, finish_run
from hybridlio.runs.unfinished import keeper as keeper_module
from hybridlio.runs.unfinished.keeper import Keeper
from hybridlio.runs.unfinished.kept import read_kept, resume_run
from hybridlio.runs.whole_folder import JOURNAL, STATE

_LENGTH = struct.Struct("<Q")


def named_values(node: Any, is_object: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the attributes of every object in an encoded tree."""
    if isinstance(node, dict):
        if is_object:
            yield node
        for one in node.values():
            yield from named_values(one)
    elif isinstance(node, list):
        for one in node[1:]:
            yield from named_values(one, node[0] == "o")


def changed(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield encoded values with each attribute of each object renamed in turn, and with one more."""
    (length,) = _LENGTH.unpack(data[: _LENGTH.size])
    tree, rest = json.loads(data[_LENGTH.size : _LENGTH.size + length]), data[_LENGTH.size + length :]

    def packed() -> bytes:
        text = json.dumps(tree).encode()
        return _LENGTH.pack(len(text)) + text + rest

    for attributes in named_values(tree[0]):
        before = dict(attributes)
        for name in (*before, "brand_new"):
            attributes.clear()  # renamed, not removed, so that later references to its objects stay right
            attributes.update({key + "_before" * (key == name): value for key, value in before.items()})
            if name == "brand_new":
                attributes[name] = None
            yield name, packed()
        attributes.clear()
        attributes.update(before)


@pytest.fixture(scope="module", params=["early", "late", "IMU starts late"])
def stopped(request: pytest.FixtureRequest, frames: list[Frame]) -> tuple[list[Frame], list[Any], dict[str, Any]]:
    """Frames, their estimates and the state after them, with a search for the start, a map, or a late IMU."""
    used = frames[: 8 if request.param == "late" else 3]
    if request.param == "IMU starts late":
        used = [replace(frame, imu=ImuSamples.empty()) for frame in used]
    odometry = Odometry()
    estimates = [odometry.step(frame) for frame in used]
    state = odometry.state()
    assert state is not None
    return used, estimates, state


def test_each_attribute_of_a_state_is_asked_for(stopped: tuple[list[Frame], list[Any], dict[str, Any]]) -> None:
    _, _, state = stopped
    count = 0
    for name, data in changed(encode(state)):
        with pytest.raises(DataError, match=f"'{name}' is (missing|not known)"):
            decode(data)
        count += 1
    assert count > 100


@pytest.mark.parametrize("part", [None, "residual", "gate", "start_search"])
def test_each_value_of_a_state_is_asked_for(
    part: str | None, stopped: tuple[list[Frame], list[Any], dict[str, Any]]
) -> None:
    used, estimates, state = stopped
    values = state if part is None else state[part]
    if values is None:
        return
    for name in (*values, "brand_new"):
        other = {k: v for k, v in values.items() if k != name} if name in values else values | {name: 0}
        with pytest.raises(DataError, match=f"'{name}' is (missing|not known)"):
            Odometry().resume(without_points(used, estimates), other if part is None else state | {part: other})


@pytest.fixture(scope="module")
def kept(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, run = tmp_path_factory.mktemp("kept"), Run(sequence.part(0, 6), Odometry())
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"_BLOCK_SCANS": 3, "_BLOCK_S": 1e9, "_STATE_SHARE": 1e9}.items():
            patch.setattr(keeper_module, name, value)
        with Keeper(folder, run, Config()) as keeper:
            finish_run(run, keeper=keeper)
    return folder


def rewritten(source: Path, target: Path, number: int, values: dict[str, Any]) -> None:
    """Write a file of blocks with another block of this number."""
    contents = [content for _, content in journal.blocks(source)]
    contents[number] = encode(values)
    with target.open("wb") as file:
        for content in contents:
            journal.append_block(file, content)


@pytest.mark.parametrize(("file", "block"), [(JOURNAL, 0), (JOURNAL, 1), (STATE, 0)], ids=["header", "block", "state"])
def test_a_run_of_another_version_is_refused_with_what_to_do(
    file: str, block: int, kept: Path, tmp_path: Path, sequence: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.fdatasync", lambda _: None)  # a busy disk takes a second
    values = decode([content for _, content in journal.blocks(kept / file)][block])
    for name in (JOURNAL, STATE):
        (tmp_path / name).write_bytes((kept / name).read_bytes())
    for name in values.keys() - {"keyframes" if file == STATE else ""}:  # those are the journal's
        rewritten(kept / file, tmp_path / file, block, {k: v for k, v in values.items() if k != name})
        with pytest.raises(DataError, match=f"{file}: written by another version .*'{name}' is missing.*--overwrite"):
            resume_run(tmp_path, sequence.part(0, 6), Config(), Odometry())
        if file == STATE:  # which smoothing does not need
            assert read_kept(tmp_path) is not None
    assert resume_run(kept, sequence.part(0, 6), Config(), Odometry())[0].done == 6


def test_settings_that_one_version_does_not_have_are_no_other_options(
    kept: Path, tmp_path: Path, sequence: Sequence
) -> None:
    header = decode(next(content for _, content in journal.blocks(kept / JOURNAL)))
    (tmp_path / STATE).write_bytes((kept / STATE).read_bytes())
    header["settings"]["scan_matching"]["older"] = 1
    rewritten(kept / JOURNAL, tmp_path / JOURNAL, 0, header)
    with pytest.raises(ConfigError, match=r"another version .*\(scan_matching.older\); resume it with that version"):
        resume_run(tmp_path, sequence.part(0, 6), Config(), Odometry())
