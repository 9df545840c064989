"""Reading YAML: every malformed or hostile file is one clear line, within a second."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import read_yaml

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(f'*{a}' for _ in range(9))}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE = {
    "date": ("a: 2026-13-45", "month must be in"),
    "time": ("a: 2026-01-01 25:00:00", "hour must be in"),
    "bool": ("a: !!bool foo", "unknown value 'foo'"),
    "int": ("a: !!int x", "invalid literal"),
    "float": ("a: !!float x", "could not convert"),
    "timestamp": ("a: !!timestamp x", "not YAML"),
    "binary": ("a: !!binary aGk=", "bytes"),
    "set": ("a: !!set {b}", "set"),
    "python": ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
    "brackets": ("[" * 10_000, "line 1: nested more than 50 deep"),
    "blocks": ("".join(" " * k + "a:\n" for k in range(200)), "nested more than 50"),
    "recursive list": ("T_imu_lidar: &a [*a]", r"line 1: the alias \*a contains itself"),
    "recursive mapping": ("a: &a\n  b: [1, *a]", "line 2: the alias"),
    "laughs": (LAUGHS, "more than 500000 values"),
    "20 digits": ("a: 12345678901234567890", "more than 64 bits"),
    "5000 digits": ("a: " + "1" * 5000, "not YAML"),
    "hexadecimal": ("a: [0x" + "f" * 40 + "]", "more than 64 bits"),
    "list as key": ("? [a]\n: b", "unhashable"),
    "unknown alias": ("a: *b", "undefined alias"),
    "control characters": ("a: \x1b[31m", "not YAML"),
    "two documents": ("a: 1\n---\nb: 2", "another document"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_clear_line_that_names_it(tmp_path: Path, name: str) -> None:
    text, words = HOSTILE[name]
    (tmp_path / "my.yaml").write_text(text)
    for error in (DataError, ConfigError):
        start = time.perf_counter()
        with pytest.raises(error, match=words) as raised:
            read_yaml(tmp_path / "my.yaml", error)
        assert str(raised.value).startswith(f"{tmp_path / 'my.yaml'}: ")
        assert "\n" not in str(raised.value)
        assert len(str(raised.value)) < 400
        assert time.perf_counter() - start < 5


def test_a_file_that_is_too_large_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "large.yaml").write_bytes(b"#" * (9 << 20))
    with pytest.raises(DataError, match="over 8 MiB"):
        read_yaml(tmp_path / "large.yaml")
    with pytest.raises(DataError, match="cannot be read"):
        read_yaml(tmp_path)


def test_ordinary_content_is_unchanged(tmp_path: Path) -> None:
    text = "a: &x {b: [1, -2.5, true, null, text, 9223372036854775807]}\nc: *x\nd: 2011_09_26\n"
    (tmp_path / "my.yaml").write_text("\ufeff" + text, encoding="utf-8")
    inner = {"b": [1, -2.5, True, None, "text", 2**63 - 1]}
    assert read_yaml(tmp_path / "my.yaml") == {"a": inner, "c": inner, "d": 20110926}
    (tmp_path / "my.yaml").write_text("")
    assert read_yaml(tmp_path / "my.yaml") is None


def test_mutated_files_give_a_value_or_one_clear_line(tmp_path: Path) -> None:
    random = np.random.default_rng(20)
    seeds = [text.encode() for text, _ in HOSTILE.values() if len(text) < 300]
    seeds += [b"T_imu_lidar:\n  - [1, 0, 0, 0.1]\n  - [0, 1, 0, 0.0]\nlidar: hdl-64e\nclock: {offset_s: 0.02}\n"]
    pieces = [
        b"&a ",
        b"*a",
        b"!!",
        b"[",
        b"]",
        b"{",
        b"}",
        b": ",
        b"- ",
        b"? ",
        b"\n",
        b"2026-02-31",
        b"1e999",
        b"\xff",
    ]
    path = tmp_path / "my.yaml"
    for _ in range(150):
        data = bytearray(seeds[random.integers(len(seeds))])
        for _ in range(random.integers(1, 5)):
            at = int(random.integers(len(data) + 1))
            data[at : at + int(random.integers(3))] = pieces[random.integers(len(pieces))]
        path.write_bytes(bytes(data))
        with contextlib.suppress(DataError):  # any other error fails the test
            read_yaml(path)
