import errno
import os
import socket
import stat
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import atomic_path, locked, opened_npz, read_yaml, write_atomically


def test_text_and_bytes_are_written_unchanged_and_folders_made(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a" / "b" / "text.txt", "σ\r\n1\n")
    write_atomically(tmp_path / "raw.bin", b"\x00\xff")
    assert (tmp_path / "a" / "b" / "text.txt").read_bytes() == "σ\r\n1\n".encode()
    assert (tmp_path / "raw.bin").read_bytes() == b"\x00\xff"


def test_nothing_but_the_file_is_left_in_the_folder(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a.txt", "1")
    write_atomically(tmp_path / "a.txt", "2")
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "2"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failed_or_interrupted_write_keeps_the_old_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def write_half() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_the_temporary_name_keeps_folder_and_suffix_so_that_savez_writes_where_asked(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a.npz") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".npz")
        np.savez(temporary, x=np.arange(3))
        assert not (tmp_path / "a.npz").exists()
    assert np.load(tmp_path / "a.npz")["x"].tolist() == [0, 1, 2]


def test_the_file_has_the_permissions_of_a_plain_write(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    write_atomically(tmp_path / "whole", "")
    assert stat.S_IMODE((tmp_path / "whole").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_a_path_that_cannot_be_written_is_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"file/a\.txt.*(Not a directory|exists)"):
        write_atomically(tmp_path / "file" / "a.txt", "1")
    (tmp_path / "folder" / "x").mkdir(parents=True)
    with pytest.raises(DataError, match="folder"):
        write_atomically(tmp_path / "folder", "1")


def test_an_error_about_another_file_passes_unchanged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="elsewhere"), atomic_path(tmp_path / "a.txt"):
        (tmp_path / "elsewhere").read_text()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a: 1\nb: [1, 2\n", r"my\.yaml: not YAML at line 3: "),
        (b"\xff\xfe", r"my\.yaml: not YAML: "),
        (None, r"my\.yaml: cannot be read \(No such file"),
    ],
)
def test_invalid_yaml_is_named_in_one_line(tmp_path: Path, content: bytes | None, words: str) -> None:
    if content is not None:
        (tmp_path / "my.yaml").write_bytes(content)
    for error in (DataError, ConfigError):
        with pytest.raises(error, match=words) as raised:
            read_yaml(tmp_path / "my.yaml", error)
        assert "\n" not in str(raised.value)


def test_a_lock_is_held_by_one_at_a_time(tmp_path: Path) -> None:
    lock_file = tmp_path / "new" / "lock"
    with locked(lock_file) as holder:
        assert holder is None
        with locked(lock_file, wait=False) as holder:
            assert holder == f"process {os.getpid()} on {socket.gethostname()}"
    with locked(lock_file, wait=False) as holder:
        assert holder is None
    assert not lock_file.exists()


def test_a_lock_that_cannot_be_created_names_its_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"), locked(tmp_path / "file" / "lock"):
        pass


def test_a_lock_on_a_full_disk_is_an_error_that_names_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(DataError, match=f"cannot write to {tmp_path}: No space left"), locked(tmp_path / "lock"):
        pass
    assert not (tmp_path / "lock").exists()


def test_an_archive_that_unpacks_to_far_more_than_its_file_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "bomb.npz", points=np.broadcast_to(np.float64(0), (40_000_000,)))
    with pytest.raises(ValueError, match=r"0\.3 MB unpack to 320 MB"), opened_npz(tmp_path / "bomb.npz"):
        pass


def test_an_array_that_announces_more_than_it_holds_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    np.savez(tmp_path / "lies.npz", points=np.zeros((9, 3)))
    data = (tmp_path / "lies.npz").read_bytes()
    (tmp_path / "lies.npz").write_bytes(data.replace(b"(9, 3), }       ", b"(9999999, 3), } "))
    with pytest.raises((ValueError, BadZipFile), match=r"announces more|CRC"), opened_npz(tmp_path / "lies.npz"):
        pass


def test_an_archive_of_arrays_comes_back(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "good.npz", points=np.eye(3), count=5)
    with opened_npz(tmp_path / "good.npz") as file:
        assert int(file["count"]) == 5
        np.testing.assert_array_equal(file["points"], np.eye(3))
