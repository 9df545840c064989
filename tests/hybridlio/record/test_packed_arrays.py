import numpy as np
import pytest

from hybridlio.record.loop_keyframes import LoopKeyframeSettings, compress
from hybridlio.record.packed_arrays import PackedArray, PackedCloud, PackedList, pack_arrays, unpack_arrays


@pytest.mark.parametrize(
    "array",
    [
        np.arange(24.0).reshape(2, 3, 4),
        np.array(["preintegration", "scan-matching"]),
        np.array([True, False]),
        np.empty((0, 6)),
        np.full((1, 6, 6), np.nan),
        np.arange(10, dtype=np.int64)[::2],
    ],
    ids=lambda array: f"{array.dtype.kind}{array.shape}",
)
def test_an_array_is_restored_bit_for_bit(array: np.ndarray):
    back = unpack_arrays(pack_arrays({"a": array}))["a"]
    assert back.dtype == array.dtype
    np.testing.assert_array_equal(back, array)


def test_covariances_take_less_memory(rng: np.random.Generator):
    halves = rng.standard_normal((50, 6, 6))
    covariances = halves @ halves.transpose(0, 2, 1)
    covariances = (covariances + covariances.transpose(0, 2, 1)) / 2
    assert len(PackedArray.of(covariances).data) < 0.7 * covariances.nbytes


@pytest.mark.parametrize("step", [1, 140, 256])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_a_cloud_is_restored_bit_for_bit_over_the_full_range(rng: np.random.Generator, step: int, count: int):
    cloud = rng.integers(-32768, 32768, (count, 3)).astype(np.int16)
    for row in range(min(count, 2)):
        cloud[row] = ([-32768, 32767, 0], [32767, -32768, -1])[row]
    back = PackedCloud.of(cloud, step).cloud()
    assert back.dtype == np.int16
    np.testing.assert_array_equal(back, cloud)


def test_a_keyframes_cloud_takes_less_memory(rng: np.random.Generator):
    ground = rng.uniform([-40, -40, -1.72], [40, 40, -1.68], (30_000, 3))
    walls = rng.uniform([-40, 9.98, -1.7], [40, 10.02, 6], (10_000, 3))
    cloud = compress(np.concatenate([ground, walls]).astype(np.float32), LoopKeyframeSettings(max_points=100_000))
    packed_cloud = PackedCloud.of(cloud, 140)
    assert len(packed_cloud.cells) + len(packed_cloud.inside) < 0.6 * cloud.nbytes


@pytest.mark.parametrize("count", [0, 1, 99, 100, 101, 150, 151, 377])
def test_a_packed_list_reads_like_a_list(count: int):
    items, kept = [(k, np.full(3, k)) for k in range(count)], PackedList[tuple[int, np.ndarray]]()
    for item in items:
        kept.append(item)
    assert len(kept) == count
    assert bool(kept) == bool(items)
    assert [k for k, _ in kept] == list(range(count))
    assert [k for k, _ in kept[1:-1:2]] == list(range(count))[1:-1:2]
    for place in range(-count, count):
        np.testing.assert_array_equal(kept[place][1], items[place][1])
    for place in (count, -count - 1):
        with pytest.raises(IndexError):
            kept[place]
