"""Tables in the paper's form: every figure is in its cell, and published ones are marked."""

from dataclasses import replace

import pytest

from hybridlio.learned.training.ablation_results import RowResult
from hybridlio.learned.training.comparison import KITTI, Line, tables, to_json_dict, to_markdown
from hybridlio.learned.training.published import published

PUBLISHED = {row.method: row for row in published(2)}
ON_KITTI = RowResult("paper", 9, 72, 1.0, {"00": (2.0, 1.0), "01": (4.0, 2.0)}, {"09": (3.0, 1.5)})
ON_OTHERS = replace(ON_KITTI, train={"town": (2.0, 1.0)}, test={"village": (3.0, 1.5), "yard": None})


def line(result, method="imu(w preprocess)", preset="paper", **changes):
    return Line(method, preset, () if result is None else (result,), PUBLISHED[method], **changes)


def test_on_kitti_measured_and_published_rows_stand_under_the_same_sequences():
    (rows,) = tables([line(ON_KITTI), line(None, "noimu", preset=None)]).values()
    measured, beside, alone = rows
    assert list(measured) == ["method", "figures", *KITTI, "train avg", "test avg"]
    assert measured["figures"] == "measured (paper)"
    assert beside["figures"] == alone["figures"] == "published"
    assert (measured["00"], beside["00"]) == ("2.00 / 1.00", "1.50 / 0.70")
    assert measured["02"] == beside["03"] == "–"
    assert (measured["train avg"], measured["test avg"]) == ("3.00 / 1.50", "3.00 / 1.50")
    assert beside["test avg"] == "2.03 / 1.14"


def test_on_other_recordings_published_averages_are_listed_and_sequences_get_a_separate_table():
    found = tables([line(ON_OTHERS)])
    (measured,), (figures,) = found["measured"], found["published, KITTI odometry"]
    assert measured["town"] == "2.00 / 1.00"
    assert measured["yard"] == "–"
    assert measured["test avg"] == "3.00 / 1.50"
    assert measured["published test avg"] == "2.03 / 1.14"
    assert figures["09"] == "2.24 / 1.13"


def test_a_failed_row_shows_the_reason_and_its_published_figures():
    lines = [line(ON_OTHERS), line(None, "noimu", "no-imu", error="training diverged at step 3")]
    text = to_markdown(2, lines, "9 steps a row")
    assert "* noimu: training diverged at step 3" in text
    assert "| noimu | measured (no-imu) | – | – | – | – | – |" in text
    assert "| noimu | published | 1.33 / 0.69 |" in text


@pytest.mark.parametrize("result", [ON_KITTI, ON_OTHERS], ids=["KITTI", "others"])
def test_the_files_hold_every_figure(result):
    lines = [line(result)]
    for rows in tables(lines).values():
        for row in rows:
            assert f"| {' | '.join(row.values())} |" in to_markdown(2, lines, "")
    (entry,) = to_json_dict(2, lines, "9 steps")["lines"]
    assert entry["results"][0]["test"] == dict(result.test)
    assert entry["published"]["t_rel_percent"]["test"] == 2.03


def test_several_seeds_are_their_mean_and_half_of_their_range():
    other = replace(ON_OTHERS, train={"town": (3.0, 1.0)}, test={"village": (4.0, 2.0), "yard": None})
    seeds = replace(line(ON_OTHERS), results=(ON_OTHERS, other))
    (measured,) = tables([seeds])["measured"]
    assert measured["town"] == "2.50 ± 0.50 / 1.00 ± 0.00"
    assert measured["test avg"] == "3.50 ± 0.50 / 1.75 ± 0.25"
    assert measured["yard"] == "–"
