"""``hybridlio report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands.common import Overwrite, Verbose, guarded
from hybridlio.commands.evaluate import load_pair
from hybridlio.commands.terminal import print_result, print_table, print_warning


@guarded
def report(
    estimates: Annotated[
        list[Path],
        typer.Argument(
            metavar="EST…", help="Estimates to compare: run folders, TUM or KITTI files.", show_default=False
        ),
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="GT",
            help="The ground truth: a TUM or KITTI file, a run folder, or a recording with a reference. "
            "Default: the reference stored in the first run folder.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The page to write.")] = Path("report.html"),
    overwrite: Overwrite = False,
    _verbosity: Verbose = 0,
) -> None:
    """Compare trajectories, of any odometry, with ground truth and each other in one page of charts."""
    from hybridlio.datasets.protection import check_new_file
    from hybridlio.evaluation.metrics_table import metrics_table
    from hybridlio.evaluation.reference_check import reference_doubts
    from hybridlio.evaluation.report import write_report
    from hybridlio.evaluation.report_data import ReportData, analyse
    from hybridlio.runs.results.report_input import stored_map_points

    check_new_file(out, overwrite)
    pairs = [load_pair(path, reference) for path in estimates]
    first, true, steps = pairs[0]
    names = _names(estimates)
    others = {name: pair[0] for name, pair in zip(names[1:], pairs[1:], strict=True)}
    data = ReportData(
        name=" · ".join(names),
        estimate=first,
        reference=true,
        estimate_name=names[0],
        others=others,
        final_poses=None if steps is None else steps.poses,
        step_covariances=None if steps is None else steps.covariances,
        map_points=stored_map_points(estimates[0], first),
        reference_doubts=reference_doubts(true),
    )
    findings = analyse(data)
    write_report(out, data, findings)
    if findings.evaluations:
        print_table(metrics_table(findings.evaluations))
    for warning in findings.notes:
        print_warning(warning)
    print_result(f"report  {out}")


def _names(paths: list[Path]) -> list[str]:
    """Return a name for each path: its own, with that of the folder above where two are alike."""
    own = [path.resolve().name for path in paths]
    folders = [path.resolve().parent.name for path in paths]
    pairs = zip(folders, own, strict=True)
    names = [name if own.count(name) == 1 else f"{folder}/{name}" for folder, name in pairs]
    return [name if names.count(name) == 1 else f"{name} ({k + 1})" for k, name in enumerate(names)]
