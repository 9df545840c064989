import csv

import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.learned.paper_tables import TABLES
from hybridlio.learned.training.published import published


def test_the_figures_are_the_papers():
    ours = {row.method: row for row in published(1)}["Ours-easy+imu"]
    assert (ours.t_rel_percent["09"], ours.r_rel_deg_per_100m["test"]) == (2.24, 1.14)
    assert ours.t_rel_percent["03"] is None
    with_sources = {row.method for row in published(1)}
    assert {"LOAM(w/ map)", "LeGO-LOAM(w/ map)", "Cho et al.", "Nubert et al.", "SelfVoxeLO"} <= with_sources


@pytest.mark.parametrize("number", TABLES)
def test_every_row_of_a_comparison_has_published_figures(number):
    methods = {row.method for row in published(number)}
    assert {row.published for row in TABLES[number] if row.preset} <= methods


@pytest.mark.parametrize("number", range(1, 6))
def test_averages_over_the_test_sequences_are_those_of_the_sequences(number):
    """If a table's test sequences are 09 and 10, their mean equals the printed average up to rounding."""
    for row in published(number):
        if row.method.startswith(("LOAM", "LeGO", "Self", "Ours-hard")):
            continue
        for figures in (row.t_rel_percent, row.r_rel_deg_per_100m):
            assert figures["test"] == pytest.approx((figures["09"] + figures["10"]) / 2, abs=0.02)


def test_the_file_cites_its_sources(project_root):
    text = (project_root / "learned" / "training" / "published.csv").read_text()
    assert "UnDeepLIO" in text.splitlines()[0]
    assert len(list(csv.reader(text.splitlines()[1:]))) == 1 + 2 * sum(len(published(n)) for n in range(1, 6))


def test_another_table_is_refused():
    with pytest.raises(ConfigError, match="1 to 5"):
        published(6)
