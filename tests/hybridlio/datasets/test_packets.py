"""Captures of raw packets, on real ones: points, times and IMU as the vendors' libraries decode them."""

from __future__ import annotations

import pickle
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.registry import locate


@pytest.fixture
def lidars(shared_data: Path) -> Path:
    return shared_data / "other_lidars"


OUSTER = "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
VELODYNE = {"sample_velodyne_vlp16_gps.pcap": (4, 16), "sample_velodyne_hdl32.pcap": (3, 32)}


def test_an_ousters_packets_give_the_scans_and_samples_that_were_exported_from_them(lidars: Path) -> None:
    pytest.importorskip("ouster.sdk")
    assert locate(lidars / OUSTER)[0] == "ouster"
    sequence, exported = open_sequence(lidars / OUSTER), open_sequence(lidars / "ouster_os1_128_imu")
    np.testing.assert_array_equal(sequence.stamps_ns, exported.stamps_ns)
    np.testing.assert_array_equal(sequence.imu.stamps_ns, exported.imu.stamps_ns)
    np.testing.assert_allclose(sequence.imu.gyro_rad_s, exported.imu.gyro_rad_s, atol=1e-6)
    np.testing.assert_allclose(sequence.imu.accel_m_s2, exported.imu.accel_m_s2, atol=1e-5)
    np.testing.assert_allclose(sequence.calibration.T_imu_lidar, exported.calibration.T_imu_lidar, atol=1e-6)
    for k in range(3):
        ours, theirs = sequence[k].scan, exported[k].scan
        assert len(ours) == len(theirs)
        order, other = (np.lexsort(scan.points.T) for scan in (ours, theirs))
        np.testing.assert_allclose(ours.points[order], theirs.points[other], atol=1e-3)
        assert ours.time_offsets_ns is not None
        assert theirs.time_offsets_ns is not None
        assert np.ptp(ours.time_offsets_ns) == np.ptp(theirs.time_offsets_ns)


def test_an_osf_file_gives_the_scans_of_the_packets_it_was_made_from(lidars: Path, tmp_path: Path) -> None:
    sdk = pytest.importorskip("ouster.sdk")
    from ouster.sdk import osf

    source = sdk.open_source(str(lidars / OUSTER), sensor_idx=0, meta=[str(lidars / "OS-1-128_v2.3.0_1024x10.json")])
    writer = osf.Writer(str(tmp_path / "drive.osf"), list(source.sensor_info))
    for frames in source:
        writer.save(0, frames[0])
    writer.close()
    packets, made = open_sequence(lidars / OUSTER), open_sequence(tmp_path / "drive.osf")
    np.testing.assert_array_equal(made.stamps_ns, packets.stamps_ns)
    for k in range(len(packets)):
        np.testing.assert_array_equal(made[k].scan.points, packets[k].scan.points)


def test_both_returns_of_an_ouster_are_points(lidars: Path) -> None:
    sdk = pytest.importorskip("ouster.sdk")
    from ouster.sdk import core

    from hybridlio.datasets.packets.ouster import returned

    source = sdk.open_source(str(lidars / OUSTER), sensor_idx=0, meta=[str(lidars / "OS-1-128_v2.3.0_1024x10.json")])
    frame, place = next(iter(source))[0], core.XYZLut(source.sensor_info[0])
    farther = np.where(frame.field("RANGE") > 0, frame.field("RANGE") + 500, 0).astype(np.uint32)
    frame.add_field("RANGE2", farther)
    valid = np.flatnonzero(np.asarray(frame.status) & 1)
    first, second = (returned(frame, place, valid, suffix) for suffix in ("", "2"))
    apart = np.linalg.norm(second[0] - first[0], axis=1)
    np.testing.assert_allclose(apart, 0.5, atol=1e-6)
    np.testing.assert_array_equal(first[2], second[2])


@pytest.mark.parametrize("name", VELODYNE)
def test_a_velodynes_packets_give_one_scan_a_turn(lidars: Path, name: str) -> None:
    pytest.importorskip("velodyne_decoder")
    assert locate(lidars / name)[0] == "velodyne"
    sequence = open_sequence(lidars / name)
    scans, beams = VELODYNE[name]
    assert len(sequence) == scans
    steps = np.diff(sequence.stamps_ns[:-1]) / 1e9
    np.testing.assert_allclose(steps, 0.1, atol=0.02)
    for frame in sequence:
        x, y, z = frame.scan.points.T
        elevations = np.degrees(np.arctan2(z, np.hypot(x, y)))
        assert len(np.unique(np.round(elevations))) <= 2 * beams
        assert frame.scan.time_offsets_ns is not None
        assert -0.12e9 < frame.scan.time_offsets_ns.min() < 0


def with_second_returns(capture: bytes, farther: int) -> bytes:
    """Return a VLP-16's capture as of its mode of two returns, every other point with a farther one.

    In that mode twelve blocks of a packet are six firings, the last return before the strongest, and byte 1204 is 0x39
    (manual of the VLP-16, section 9.3). ``farther`` is in steps of 2 mm.
    """
    out, at = [capture[:24]], 24
    while at < len(capture):
        seconds, micros, size, _ = struct.unpack_from("<IIII", capture, at)
        packet, at = capture[at + 16 : at + 16 + size], at + 16 + size
        halves = [packet] if size != 1248 else [_six_firings(packet, half, farther) for half in range(2)]
        out += [struct.pack("<IIII", seconds, micros, len(half), len(half)) + half for half in halves]
    return b"".join(out)


def _six_firings(packet: bytes, half: int, farther: int) -> bytes:
    blocks = b""
    for k in range(6 * half, 6 * half + 6):
        strongest = packet[42 + 100 * k : 142 + 100 * k]
        last = bytearray(strongest)
        for channel in range(1, 32, 2):
            (distance,) = struct.unpack_from("<H", last, 4 + 3 * channel)
            struct.pack_into("<H", last, 4 + 3 * channel, distance + farther if distance else 0)
        blocks += bytes(last) + strongest
    (start_us,) = struct.unpack_from("<I", packet, 1242)
    return packet[:42] + blocks + struct.pack("<I", start_us + half * round(6 * 110.592)) + b"\x39" + packet[1247:]


def test_both_returns_of_a_velodyne_are_points(lidars: Path, tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    single = lidars / next(iter(VELODYNE))
    (tmp_path / "dual.pcap").write_bytes(with_second_returns(single.read_bytes(), 500))
    one, both = open_sequence(single), open_sequence(tmp_path / "dual.pcap")
    assert len(both) == len(one)
    near, far = (np.linalg.norm(sequence[1].scan.points, axis=1) for sequence in (one, both))
    assert len(far) == pytest.approx(1.5 * len(near), rel=0.1)  # every other point has a second one, a metre farther
    assert np.mean(far > near.max() + 0.2) == pytest.approx(1 / 3 * np.mean(near > near.max() - 0.8), abs=0.02)
    for sequence in (one, both):
        offsets = sequence[1].scan.time_offsets_ns
        assert offsets is not None
        assert offsets.min() / 1e6 == pytest.approx(-99.5, abs=1.0)


@pytest.mark.parametrize("name", [OUSTER, *VELODYNE])
def test_scans_load_in_any_order_and_in_other_processes(lidars: Path, name: str) -> None:
    pytest.importorskip("ouster.sdk" if name == OUSTER else "velodyne_decoder")
    sequence = open_sequence(lidars / name)
    last = len(sequence) - 1
    forwards = [sequence[k].scan.points for k in range(len(sequence))]
    copy = pickle.loads(pickle.dumps(sequence))
    for k in (last, 0, 1, last):
        np.testing.assert_array_equal(copy[k].scan.points, forwards[k])


@pytest.mark.parametrize(
    ("name", "module", "remedy"),
    [
        (OUSTER, "ouster", "pip install --no-deps ouster-sdk more-itertools"),
        (next(iter(VELODYNE)), "velodyne_decoder", r"pip install 'hybridlio\[velodyne\]'"),
    ],
)
def test_without_the_library_one_line_says_what_to_install(
    lidars: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str, remedy: str
) -> None:
    for loaded in [known for known in sys.modules if known.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DataError, match=remedy) as caught:
        open_sequence(lidars / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [OUSTER, *VELODYNE])
def test_a_truncated_capture_gives_the_turns_before_its_end_or_one_error(
    lidars: Path, tmp_path: Path, name: str
) -> None:
    pytest.importorskip("ouster.sdk" if name == OUSTER else "velodyne_decoder")
    whole = open_sequence(lidars / name)
    path = tmp_path / name
    shutil.copyfile(lidars / name, path)
    for file in lidars.glob("OS*.json"):
        shutil.copyfile(file, tmp_path / file.name)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    cut = open_sequence(path)
    assert 0 < len(cut) <= len(whole)
    np.testing.assert_array_equal(cut[0].scan.points, whole[0].scan.points)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=name.replace(".", r"\.")):
        open_sequence(path)
