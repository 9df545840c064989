"""Values as bytes: what comes back is equal bit for bit, and nothing but hybridlio's own classes can be made."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.cloud.kd_tree import GrowingKdTree
from hybridlio.core.errors import HybridLioError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import ImuSamples
from hybridlio.record.plain_values import decode, encode, restore, state_of
from hybridlio.sources.gate.gate_result import GateResult
from hybridlio.sources.scan_matching import ScanMatching

MALFORMED = (ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError, struct.error, HybridLioError)


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -3,
        2**70,
        0.1,
        float("inf"),
        "text ☃",
        b"\x00\xff",
        (1, [2, (3,)]),
        {"a": {}, 5: "five"},
        np.float32(0.1),
    ],
)
def test_a_plain_value_comes_back_with_its_type(value: Any) -> None:
    found = decode(encode(value))
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(12)[::3],
        np.array([np.nan, -0.0, 5e-324]),
        np.empty((0, 3), np.float32),
        np.array([True, False]),
        np.array(["a", "läng"]),
    ],
    ids=["C", "Fortran", "strided", "odd-floats", "empty", "flags", "text"],
)
def test_an_array_comes_back_bit_for_bit_and_in_its_order(array: np.ndarray[Any, Any]) -> None:
    found = decode(encode([array]))[0]
    assert found.dtype == array.dtype
    assert found.tobytes() == array.tobytes()
    assert found.flags.c_contiguous or not array.flags.c_contiguous
    assert found.flags.f_contiguous or not array.flags.f_contiguous
    assert found.flags.writeable


def test_an_object_met_twice_stays_one_object() -> None:
    pose = RelativePose(np.eye(4), np.eye(6), "test", details={"points": 3.0})
    one, two = decode(encode([pose, pose]))
    assert one is two
    assert one.details == {"points": 3.0}


def test_a_growing_tree_finds_the_same_points_again(rng: np.random.Generator) -> None:
    points = rng.normal(size=(400, 3)) * 10
    tree = GrowingKdTree(points[:300], 1).extended(points, 1)
    found = decode(encode(tree))
    queries = rng.normal(size=(50, 3)) * 10
    for a, b in zip(tree.several_nearest(queries, 3, 1), found.several_nearest(queries, 3, 1), strict=True):
        assert np.array_equal(a, b)
    assert found.appended_ratio == tree.appended_ratio


def test_restoring_sets_the_attributes_and_keeps_what_is_not_state() -> None:
    class Source:
        NOT_STATE = ("network",)

        def __init__(self, step: int, network: object) -> None:
            self.step, self.network = step, network

    network = object()
    target = Source(0, network)
    restore(target, decode(encode(state_of(Source(7, object())))))
    assert target.step == 7
    assert target.network is network


def test_the_state_of_a_source_is_restored_in_place() -> None:
    source = ScanMatching()
    source._stamp_ns = 5
    target = ScanMatching()
    restore(target, decode(encode(state_of(source))))
    assert target._stamp_ns == 5
    assert target._map.keyframes == 0


@pytest.mark.parametrize("value", [object(), Path("x"), np.array([object()]), {1: {2: lambda: 0}}])
def test_other_classes_cannot_be_stored(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be stored"):
        encode(value)


def tampered(tree: Any, layouts: Any = (), classes: Any = (), data: bytes = b"") -> bytes:
    text = json.dumps([tree, layouts, list(range(len(layouts))), classes]).encode()
    return struct.pack("<Q", len(text)) + text + data


@pytest.mark.parametrize(
    "data",
    [
        tampered(["o", 0, {}], classes=["os:system"]),
        tampered(["o", 0, {}], classes=["hybridlio.core.files:os.system"]),
        tampered(["o", 0, {}], classes=["hybridlio.core.files:make_folder"]),
        tampered(["o", 0, {}], classes=["hybridlio.nothing:Nothing"]),
        tampered(["a", 0], layouts=[["|O", [1], "C"]], data=bytes(8)),
        tampered(["a", 0], layouts=[["<f8", [10**12], "C"]], data=bytes(8)),
        tampered(["a", 0], layouts=[["<f8", [-1], "C"]], data=bytes(8)),
        tampered(["r", 3]),
        tampered(["x", 0]),
        b"",
        b"\xff" * 40,
    ],
)
def test_bytes_from_elsewhere_make_no_object_and_take_no_memory(data: bytes) -> None:
    with pytest.raises(MALFORMED):
        decode(data)


def test_a_dataclass_is_checked_when_it_is_read() -> None:
    data = encode(ImuSamples(np.array([1, 2]), np.zeros((2, 3)), np.zeros((2, 3))))
    with pytest.raises(HybridLioError, match="time does not increase"):
        decode(data.replace(np.array([1, 2]).tobytes(), np.array([2, 1]).tobytes()))
    assert decode(encode(GateResult("accepted", 3.5))) == GateResult("accepted", 3.5)
