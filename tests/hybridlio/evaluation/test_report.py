import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.charts.path_charts import map_figure
from hybridlio.evaluation.charts.plotly import Figure, thinned, thinned_peaks
from hybridlio.evaluation.evaluate import Steps, evaluate
from hybridlio.evaluation.metrics_table import format_metrics
from hybridlio.evaluation.report import ReportData, analyse, charts, write_report
from hybridlio.evaluation.trust import headline, statements

SIGMAS = [*np.radians([0.03, 0.03, 0.05]).tolist(), 0.02, 0.01, 0.02]


def run(n: int = 400, seed: int = 5, claim: float = 1.0) -> ReportData:
    """Return a drive through bends at 10 Hz, whose step covariances are ``claim`` times too small."""
    rng = np.random.default_rng(seed)
    time = np.arange(n - 1) * 0.1
    yaw_rate = 0.05 * np.sin(time / 7) + 0.04 * np.sin(time / 23)
    speed_m = 1.0 + 0.3 * np.sin(time / 11)
    zero = np.zeros(n - 1)
    true_steps = se3.exp(np.column_stack([zero, 0.002 * np.sin(time / 5), yaw_rate, speed_m, zero, zero]))
    covariance = np.diag(np.square(SIGMAS))
    final = true_steps @ se3.exp(-rng.normal(size=(n - 1, 6)) * SIGMAS)
    initial = true_steps @ se3.exp(rng.normal(size=(n - 1, 6)) * np.array(SIGMAS) * 6)
    reference, poses, covariances = [np.eye(4)], [np.eye(4)], [np.zeros((6, 6))]
    for true_step, step in zip(true_steps, final, strict=True):
        reference.append(reference[-1] @ true_step)
        poses.append(poses[-1] @ step)
        covariances.append(se3.compose_covariance(covariances[-1], step, covariance))
    stamps = 1_317_384_506_000_000_000 + np.arange(n) * 100_000_000
    ok, degenerate = np.ones(n - 1, bool), np.zeros(n - 1, bool)
    ok[[99, 199, 200, 201]] = False
    degenerate[300:310] = True
    return ReportData(
        name="town <1>",
        estimate=Trajectory(stamps, np.array(poses), np.array(covariances) / claim),
        reference=Trajectory(stamps, se3.exp([0, 0, 0.8, 20, 10, 3]) @ np.array(reference)),
        estimate_name="smoothed",
        others={"before smoothing": Trajectory(stamps, np.array(poses) @ se3.exp(rng.normal(0, 0.02, (n, 6))))},
        initial_poses=initial,
        final_poses=final,
        step_covariances=np.tile(covariance / claim, (n - 1, 1, 1)),
        timings_s={
            name: rng.gamma(9, mean / 9, n) for name, mean in (("prepare", 0.011), ("match", 0.016), ("graph", 0.004))
        },
        ok=ok,
        degenerate=degenerate,
        facts={"initial pose": "preintegration", "residual": "scan-matching", "backend": "incremental"},
        config="odometry:\n  residual: scan-matching\n  voxel_m: 0.5\n",
        warnings=["The IMU has a gap of 0.42 s before scan 100."],
    )


class Page(HTMLParser):
    """Collect what a page would load, and check that its tags are closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        if tag not in ("meta", "img", "br", "link", "input", "hr"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def data() -> ReportData:
    return run()


@pytest.fixture(scope="module")
def html(data: ReportData, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "new" / "report.html"
    write_report(path, data)
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    return path.read_text()


def test_the_page_is_well_formed_and_loads_nothing(html: str) -> None:
    page = Page(html)
    assert page.open == []
    assert page.sources == []
    outside = re.sub(r'<script type="(application/json|text/plain)".*?</script>', "", html, flags=re.DOTALL)
    assert not re.search(r"https?:|url\(|@import|<link|fetch\(", outside)
    assert "default-src 'none'" in html
    assert len(html) < 6e6


def test_the_page_contains_the_metrics_of_the_evaluation(data: ReportData, html: str) -> None:
    assert data.reference is not None
    assert data.final_poses is not None
    assert data.step_covariances is not None
    steps = Steps(data.final_poses, data.step_covariances)
    for heading, value in format_metrics(evaluate(data.estimate, data.reference, steps=steps)).items():
        assert heading in html
        assert f"<td>{value}</td>" in html
    for average in evaluate(data.estimate, data.reference).segments:
        assert f"<td>{average.t_rel_percent:.3f}</td>" in html


def rows_of(html: str) -> list[list[str]]:
    """Return the cells of all rows of tables."""
    rows = re.findall(r"<tr>(.*?)</tr>", html, flags=re.DOTALL)
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows]


def test_the_page_lists_bridged_and_degenerate_stretches_warnings_and_settings(html: str) -> None:
    flagged = [row[:2] for row in rows_of(html) if row[0] in ("bridged", "degenerate")]
    assert flagged == [["bridged", "100"], ["bridged", "200–202"], ["degenerate", "301–310"]]  # step k leads to k + 1
    for text in ("gap of 0.42 s", "voxel_m: 0.5", "preintegration", "before smoothing", "numpy"):
        assert text in html


def test_listed_scans_are_numbered_as_in_the_recording(data: ReportData, tmp_path: Path) -> None:
    write_report(tmp_path / "r.html", dataclasses.replace(data, first_scan=7))
    listed = [row[1] for row in rows_of((tmp_path / "r.html").read_text()) if row[0] in ("bridged", "degenerate")]
    assert listed == ["107", "207–209", "308–317"]


def test_names_are_escaped(html: str) -> None:
    assert "town &lt;1&gt;" in html
    assert "town <1>" not in html


def test_inconsistent_covariances_get_a_verdict(data: ReportData, tmp_path: Path) -> None:
    assert analyse(data).steps.consistency.rotation.consistent  # type: ignore[union-attr]
    write_report(tmp_path / "r.html", dataclasses.replace(run(claim=9.0), others={}, timings_s={}, initial_poses=None))
    assert re.search(r"<td>σ (2\.9\d?|3|3\.\d+) times too small</td>", (tmp_path / "r.html").read_text())


def test_nothing_in_the_data_ends_a_script(data: ReportData, tmp_path: Path) -> None:
    hostile = "</script><img src=x onerror=alert(1)><b>"
    named = dataclasses.replace(data, name=hostile, estimate_name=hostile, warnings=[hostile], facts={hostile: hostile})
    write_report(tmp_path / "r.html", named)
    html = (tmp_path / "r.html").read_text()
    assert "<img" not in html
    assert html.count("<script") == html.count("</script>") == 3
    assert json.loads(figures_of(html))["map"]["data"]


def figures_of(html: str) -> str:
    (found,) = re.findall(r'id="figures">(.*?)</script>', html, flags=re.DOTALL)
    return found


EVERY_FIGURE = {"map", "space", "timeline", "drift", "steps", "timing", "nees", "sigma_steps", "sigma_poses"}
GONE_WITH = {
    "reference": EVERY_FIGURE - {"map", "space", "timeline", "timing"},
    "initial_poses": set(),
    "final_poses": {"nees", "sigma_steps"},
    "step_covariances": {"nees", "sigma_steps"},
    "ok": set(),
    "degenerate": set(),
}


@pytest.mark.parametrize("absent", GONE_WITH)
def test_missing_data_remove_only_the_figures_that_need_them(data: ReportData, absent: str) -> None:
    assert set(charts(data, analyse(data))) == EVERY_FIGURE
    less = dataclasses.replace(data, **{absent: None})
    assert set(charts(less, analyse(less))) == EVERY_FIGURE - GONE_WITH[absent]


def test_an_estimate_alone_has_a_report(data: ReportData, tmp_path: Path) -> None:
    write_report(tmp_path / "r.html", ReportData("bare", data.estimate))
    text = (tmp_path / "r.html").read_text()
    assert Page(text).open == []
    assert re.findall("<h2>(.*?)</h2>", text) == ["Where it went"]
    assert "There is no reference" in " ".join(text.split())


@pytest.mark.parametrize(
    ("poses", "text"),
    [(1, "the estimate has 1 pose;"), (2, "ATE [m]"), (40, "too short for KITTI")],
)
def test_a_short_run_has_a_report(data: ReportData, tmp_path: Path, poses: int, text: str) -> None:
    short = Trajectory(data.estimate.stamps_ns[:poses], data.estimate.poses[:poses])
    write_report(tmp_path / "r.html", ReportData("short", short, data.reference))
    assert text in (tmp_path / "r.html").read_text()


def test_a_reference_at_other_times_is_a_warning(data: ReportData, tmp_path: Path) -> None:
    assert data.reference is not None
    elsewhen = Trajectory(data.reference.stamps_ns - 10**18, data.reference.poses)
    write_report(tmp_path / "r.html", dataclasses.replace(data, reference=elsewhen))
    assert "only 0 poses at common times" in (tmp_path / "r.html").read_text()


def values_of(numbers: dict[str, str]) -> np.ndarray:
    """Return the numbers of a trace."""
    values = np.frombuffer(base64.b64decode(numbers["bdata"]), "<f4").astype(np.float64)
    return values.reshape([int(n) for n in numbers["shape"].split(",")]) if "shape" in numbers else values


def trace(figure: Figure, name: str) -> dict[str, Any]:
    (found,) = [trace for trace in figure["data"] if trace["name"] == name]
    return found


def xy(figure: Figure, name: str) -> np.ndarray:
    found = trace(figure, name)
    return np.column_stack([values_of(found[axis]) for axis in "xy"])


def test_the_map_shows_the_data(data: ReportData) -> None:
    figure = charts(data, analyse(data))["map"]
    assert data.reference is not None
    assert data.estimate.covariances is not None
    np.testing.assert_allclose(xy(figure, "reference"), data.reference.poses[:, :2, 3], atol=1e-4)
    laid = data.reference.poses[0] @ data.estimate.poses
    np.testing.assert_allclose(xy(figure, "smoothed"), laid[:, :2, 3], atol=1e-4)
    np.testing.assert_allclose(xy(figure, "bridged"), laid[[100, 200, 201, 202], :2, 3], atol=1e-4)
    hover = values_of(trace(figure, "smoothed")["customdata"])
    off = np.linalg.norm(laid[:, :3, 3] - data.reference.poses[:, :3, 3], axis=1)
    np.testing.assert_allclose(hover[:, 0], data.estimate.times_s, atol=1e-4)
    np.testing.assert_allclose(
        hover[:, 3] ** 2, data.estimate.covariances[:, 3:, 3:].trace(axis1=1, axis2=2), rtol=1e-4
    )
    np.testing.assert_allclose(hover[:, 4], off, atol=1e-4)


def test_ellipses_hold_the_reference_in_95_percent_of_runs() -> None:
    inside = []
    for seed in range(40):
        data = dataclasses.replace(run(n=250, seed=seed), others={})
        assert data.reference is not None
        outlines = np.split(xy(map_figure(data, analyse(data)), "95 % of position"), range(34, 34 * 24, 34))
        end, true = outlines[-1][:33], data.reference.poses[-1, :2, 3]
        corners, to_true = np.diff(end, axis=0), true - end[:-1]
        turns = corners[:, 0] * to_true[:, 1] - corners[:, 1] * to_true[:, 0]
        inside.append(len(set(np.sign(turns))) == 1)  # the point is on the same side of every edge
    assert 0.85 <= np.mean(inside) <= 1.0


def test_points_of_the_scans_lie_below_the_path(data: ReportData) -> None:
    rng = np.random.default_rng(3)
    with_points = dataclasses.replace(data, map_points=rng.uniform(-50, 50, (5000, 3)))
    (image,) = charts(with_points, analyse(with_points))["map"]["layout"]["images"]
    assert data.reference is not None
    centre = (data.reference.poses[0] @ [0, 0, 0, 1])[:2]
    found = np.array([image["x"] + image["sizex"] / 2, image["y"] - image["sizey"] / 2])
    np.testing.assert_allclose(found, centre, atol=3.0)


def test_the_timeline_shows_both_alignments(data: ReportData) -> None:
    assert data.reference is not None
    evaluation = evaluate(data.estimate, data.reference)
    figure = charts(data, analyse(data))["timeline"]
    start, whole = (values_of(trace(figure, f"error, aligned {how}")["y"]) for how in ("at the start", "as a whole"))
    assert start[0] == pytest.approx(0, abs=1e-6)
    assert start[-1] == pytest.approx(evaluation.end_error_m, abs=1e-4)
    assert np.sqrt((whole**2).mean()) == pytest.approx(evaluation.ate_m, rel=0.1)  # ATE aligns positions alone


def test_errors_of_other_trajectories_are_on_the_same_axes(data: ReportData) -> None:
    assert data.reference is not None
    late = Trajectory(data.estimate.stamps_ns[5:], data.estimate.poses[5:])
    both = dataclasses.replace(data, others={"late": late})
    figure = charts(both, analyse(both))["timeline"]
    start, whole = (trace(figure, f"late, {how}") for how in ("at the start", "as a whole"))
    np.testing.assert_allclose(values_of(start["x"]), data.estimate.times_s[5:], atol=1e-3)
    evaluation = evaluate(late, data.reference)
    assert values_of(start["y"])[-1] == pytest.approx(evaluation.end_error_m, abs=1e-4)
    assert np.sqrt((values_of(whole["y"]) ** 2).mean()) == pytest.approx(evaluation.ate_m, rel=0.1)
    assert start["line"]["dash"] == "dash"


def test_the_headline_names_the_trajectory_where_there_are_several(data: ReportData) -> None:
    several = dataclasses.replace(data, others={"late": data.estimate})
    found = statements(several, analyse(several))
    assert "this trajectory" not in headline(found, "mine")[1]
    assert "mine" in headline(found, "mine")[1]


def test_long_runs_stay_small_and_keep_their_peaks() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=100_000)
    values[77_777] = 50
    kept = thinned_peaks(values, 1000)
    assert len(kept) <= 1000
    assert 77_777 in kept
    assert {0, 99_999} <= set(thinned(100_000, 1000).tolist())


def test_a_reference_that_contradicts_itself_greys_its_figures(data: ReportData, tmp_path: Path) -> None:
    doubts = ["The reference contradicts the forward speed."]
    write_report(tmp_path / "r.html", dataclasses.replace(data, reference_doubts=doubts))
    html = (tmp_path / "r.html").read_text()
    assert html.index(doubts[0]) < html.index('class="tiles"')
    assert html.count('class="tile grey"') == 4  # all but the speed
    assert 'class="tile"><span>speed' in html


def test_the_error_for_arrays_of_wrong_shape_names_them(data: ReportData) -> None:
    with pytest.raises(DataError, match=r"final_poses must have the shape \(399, 4, 4\) for 400 poses, not \(400"):
        dataclasses.replace(data, final_poses=data.estimate.poses)
    with pytest.raises(DataError, match=r"timings_s\['match'\]"):
        dataclasses.replace(data, timings_s={"match": np.array([0.1, np.nan])})


def test_doubts_about_the_recording_are_points_to_check(data: ReportData, tmp_path: Path) -> None:
    doubted = dataclasses.replace(data, warnings=["doubtful: the clocks disagree", "found: a column of times"])
    found = statements(doubted, analyse(doubted))
    assert [one.text for one in found if one.level == "doubtful"][:1] == ["the clocks disagree"]
    write_report(tmp_path / "doubted.html", doubted)
    assert (tmp_path / "doubted.html").read_text().count("the clocks disagree") == 1
