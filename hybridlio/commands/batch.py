"""``hybridlio batch``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.terminal import complain, progress, say, say_table
from hybridlio.runs.engines import LOCAL

if TYPE_CHECKING:
    from hybridlio.runs.batch_table import Batch


@guarded
def batch(
    data: Annotated[
        list[str],
        typer.Argument(
            metavar="DATA…",
            help="Recordings: paths, patterns in quotes, or .yaml or .txt files that list them.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="The folder of the run folders.", show_default=False)
    ],
    sequence: Annotated[
        str | None, typer.Option("--sequence", metavar="A,B,…", help="Which recordings, where DATA holds several.")
    ] = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    initial_pose: common.InitialPoseName = None,
    residual: common.ResidualName = None,
    backend: common.BackendName = None,
    config: common.ConfigFile = None,
    frames: common.Frames = None,
    vertical_angle: common.VerticalAngle = None,
    jobs: Annotated[
        int | None, typer.Option("-j", "--jobs", min=1, help="Recordings at a time; by default one for each core.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of each run; by default an equal share of the cores, on a cluster 1.")
    ] = None,
    engine: Annotated[
        str, typer.Option(metavar="NAME", help="loky: processes on this machine; dask or ray: a cluster's.")
    ] = LOCAL,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of the cluster, such as tcp://head:8786.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Run again what is there already.")] = False,
    _verbose: common.Verbose = 0,
) -> None:
    """Run the odometry over many recordings, several at a time, each into a run folder below -o.

    One that fails stops no other. The same command again runs only what is missing. DIR/batch.md sums up.
    """
    from hybridlio.runs.batch import run_batch
    from hybridlio.runs.recordings import find_recordings

    settings = common.settings(config, initial_pose=initial_pose, residual=residual, backend=backend)
    found = find_recordings(data, sequence, reader, raw_root, frames, vertical_angle)
    with progress("batch", "recordings") as tick:
        done = run_batch(
            found, out, settings, jobs=jobs, threads=threads, engine=engine, scheduler=scheduler, overwrite=overwrite,
            without_imu=initial_pose is None and config is None, progress=tick,
        )  # fmt: skip
    _finish(done)


def _finish(done: Batch) -> None:
    """Say what came of it, and end with the exit code that belongs to it."""
    from hybridlio.runs.batch_table import table

    say_table(table(done))
    say(f"written to {done.out / 'batch.md'} and {done.out / 'batch.json'}")
    if done.stopped is not None:
        complain("interrupted; the same command goes on with what is missing")
        raise typer.Exit(common.INTERRUPTED)
    if done.failed:
        complain(f"error: {len(done.failed)} of {len(done.rows)} recordings failed; the table says why")
        raise typer.Exit(common.FAILED)
