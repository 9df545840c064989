"""``hybridlio batch``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_message, print_result, print_table, progress
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics
from hybridlio.runs.engines import LOCAL

if TYPE_CHECKING:
    from hybridlio.runs.batch_table import Batch


Recordings = Annotated[
    list[str],
    typer.Argument(
        metavar="DATA…",
        help="Recordings: paths, quoted patterns, or .yaml or .txt files that list them.",
        show_default=False,
    ),
]
Out = Annotated[
    Path,
    typer.Option(
        "-o",
        "--out",
        metavar="DIR",
        help="The folder for the run folders and the results, batch.md.",
        show_default=False,
    ),
]
Jobs = Annotated[
    int | None, typer.Option("-j", "--jobs", min=1, help="Number of parallel runs; default: one per core.")
]
Threads = Annotated[
    int | None,
    typer.Option(min=1, help="Threads per run; default: the cores divided by --jobs, or 1 on a cluster."),
]
EngineName = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.engine,
        help="loky: processes on this machine; dask or ray: a cluster.",
    ),
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Address of the cluster, such as tcp://head:8786.")
]


@guarded
@common.with_topic_options
def batch(
    data: Recordings,
    out: Out,
    sequence: common.SequenceNames = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    initial_pose: common.InitialPoseName = None,
    residual: common.ResidualName = None,
    backend: common.BackendName = None,
    config: common.ConfigFile = None,
    frames: common.Frames = None,
    vertical_angle: common.VerticalAngle = None,
    check: common.Check = True,
    jobs: Jobs = None,
    threads: Threads = None,
    engine: EngineName = LOCAL,
    scheduler: Scheduler = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Run recordings again that have a run in -o.")] = False,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Run the odometry on many recordings in parallel, each into a run folder below -o.

    A recording that fails does not stop the others. The same command runs only what is missing.
    """
    from hybridlio.runs.batch import BatchOptions, run_batch
    from hybridlio.runs.recordings import find_recordings

    settings = common.load_settings(config, initial_pose=initial_pose, residual=residual, backend=backend)
    found = find_recordings(data, sequence, reader, raw_root, frames, vertical_angle, topics)
    options = BatchOptions(
        jobs=jobs, threads=threads, engine=engine, scheduler=scheduler, overwrite=overwrite,
        adapt_config=initial_pose is None and config is None, check=check,
    )  # fmt: skip
    with progress("batch", "recordings") as report:
        done = run_batch(found, out, settings, options, report)
    _finish(done)


def _finish(done: Batch) -> None:
    """Print the results, and exit with an error code if any recording failed."""
    from hybridlio.runs.batch_table import table

    print_table(table(done))
    print_result(f"wrote {done.out / 'batch.md'} and {done.out / 'batch.json'}")
    if done.stopped is not None:
        print_message("interrupted; the same command runs what is missing")
        raise typer.Exit(common.INTERRUPTED)
    if done.failed:
        print_message(f"error: {len(done.failed)} of {len(done.rows)} recordings failed; the table has the reasons")
        raise typer.Exit(common.FAILED)
