import numpy as np

from hybridlio.registration.voxel_map import CellTable, cells_of


def test_a_cell_has_the_same_key_whatever_other_points_there_are(rng: np.random.Generator):
    points = rng.uniform(-50, 50, (3000, 3))
    labels, keys = cells_of(points, 2.0)
    assert (np.diff(keys) > 0).all()
    cells, inverse = np.unique(np.floor(points / 2.0), axis=0, return_inverse=True)
    assert len(keys) == len(cells)
    _, firsts = np.unique(inverse, return_index=True)
    np.testing.assert_array_equal(keys[labels], keys[labels[firsts]][inverse])
    some = rng.permutation(3000)[:700]
    fewer, theirs = cells_of(points[some], 2.0)
    np.testing.assert_array_equal(theirs[fewer], keys[labels[some]])


def test_an_empty_cloud_has_no_cells():
    labels, keys = cells_of(np.empty((0, 3)), 2.0)
    assert len(labels) == len(keys) == 0


def test_the_cell_table_counts_like_a_dictionary(rng: np.random.Generator):
    table, held, hit = CellTable(), {}, {}
    for time in range(30):
        keys = np.unique(rng.integers(0, 60, 20))
        added = rng.integers(0, 3, len(keys))
        for key, more in zip(keys.tolist(), added.tolist(), strict=True):
            if key in held or more:
                held[key], hit[key] = held.get(key, 0) + more, time
        table.record_hits(keys, added, time)
        if time % 7 == 6:
            table.drop_before(time - 3)
            held = {key: count for key, count in held.items() if hit[key] >= time - 3}
        asked = np.arange(-5, 70)
        np.testing.assert_array_equal(table.counts(asked), [held.get(key, 0) for key in asked.tolist()])
        np.testing.assert_array_equal(table.contains(asked), [key in held for key in asked.tolist()])
