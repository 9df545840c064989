"""Run many recordings, each in its own process on this machine or a cluster, and into its own run folder.

A recording that fails does not stop the others; complete runs are kept.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Generator, Iterator
from collections.abc import Sequence as Items
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridlio.core.errors import ConfigError
from hybridlio.core.files import make_folder
from hybridlio.core.progress import Progress
from hybridlio.datasets.protection import check_output
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import check_implementations, check_names
from hybridlio.runs import engines
from hybridlio.runs.batch_job import Job, run_job
from hybridlio.runs.batch_table import DONE, DONE_BEFORE, FAILED, NOT_RUN, Batch, BatchRow, summary_metrics, write_batch
from hybridlio.runs.folder import JOB, METRICS
from hybridlio.runs.own_files import BATCH, check_free
from hybridlio.runs.recordings import Recording
from hybridlio.runs.whole_folder import discard_journal, held, partial_folder

_log = logging.getLogger("hybridlio")


@dataclass(frozen=True)
class BatchOptions:
    """How a batch runs.

    Attributes:
        jobs: number of parallel runs; None for one per core, or for all that the cluster has.
        threads: threads of each run; None for the cores divided by ``jobs``, or for one on a cluster.
        engine, scheduler: see :func:`hybridlio.runs.engines.engine`.
        overwrite: run recordings again that have a run already.
        adapt_config: run recordings without IMU data with initial poses by constant velocity.
        check: compare the IMU with the scans first (:func:`hybridlio.runs.recording_check.check_recording`).
    """

    jobs: int | None = None
    threads: int | None = None
    engine: str = engines.LOCAL
    scheduler: str | None = None
    overwrite: bool = False
    adapt_config: bool = True
    check: bool = True


def run_batch(
    recordings: Items[Recording],
    out: Path,
    config: Config | None = None,
    options: BatchOptions | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Run recordings in parallel; write each to ``out/<name>``, and ``batch.json`` and ``batch.md`` to ``out``.

    Complete runs are kept, and those that were killed go on from their last estimates. An interrupt (Ctrl-C) ends the
    batch and is returned in :attr:`Batch.stopped`. With ``overwrite``, an older run stays until the new one is
    complete.

    Args:
        recordings: the recordings, from :func:`hybridlio.runs.recordings.find_recordings`.
        out: the folder of the run folders; for a cluster, one that all machines see under this path.
        config: the settings of all runs.
        options: parallelism, engine and what to do with existing runs.
        progress: called after each recording with its name, recordings done and recordings in all.

    Raises:
        ConfigError: ``out`` touches a recording, holds runs of other recordings or with other settings or files of
            somebody else, or is being written by another batch; the engine is unknown, or the settings are invalid.
            Nothing is run or removed then.
        DataError: the folder cannot be created.
        MissingDependencyError: the engine is not installed.
    """
    config, options, out = config or Config(), options or BatchOptions(), Path(out).absolute()
    if engines.is_remote(options.engine):
        check_names(config.initial_pose, config.residual, config.backend)
    else:
        check_implementations(config)
    check_output(out, *(recording.path for recording in recordings))
    BATCH.check(out)  # before an engine is started
    parallel, threads = _workers(options, len(recordings))
    jobs = [Job(r, out / r.name, config, threads, options.adapt_config, options.check) for r in recordings]
    complete = {job.recording for job in jobs if _is_complete(job, options.overwrite)}
    missing = [job for job in jobs if job.recording not in complete]
    for job in missing:
        check_free(job.folder, overwrite=True)
    with engines.engine(options.engine, parallel, threads, options.scheduler):
        make_folder(out)
        with held(out):
            BATCH.remove_leftovers(out)
            for job in missing:
                _prepare_folder(job, options.overwrite)
            rows = {job.recording: _row(job, DONE_BEFORE if job.recording in complete else NOT_RUN) for job in jobs}
            stopped = _run_missing(missing, rows, out, progress)
            batch = Batch(out, tuple(rows.values()), stopped)
            write_batch(batch)
    return batch


def _prepare_folder(job: Job, overwrite: bool) -> None:
    """Forget that a killed batch had started the job; its estimates stay, unless all is to be run again."""
    part = partial_folder(job.folder)
    (part / JOB).unlink(missing_ok=True)
    if overwrite:
        discard_journal(part)


def _workers(options: BatchOptions, recordings: int) -> tuple[int | None, int]:
    """Return the number of parallel runs, None for all that the engine has, and the threads of each."""
    if options.engine != engines.LOCAL:
        return options.jobs, options.threads or 1
    cores = engines.cores()
    jobs = max(1, min(options.jobs or cores, recordings))
    return jobs, options.threads or max(1, cores // jobs)


def _run_missing(
    missing: list[Job], rows: dict[Recording, BatchRow], out: Path, progress: Progress | None
) -> BaseException | None:
    """Run jobs and update the row of each as it ends; return the interrupt that stopped them, if any."""
    before = {job.recording: _version(job.folder) for job in missing}
    try:
        for job, reason in _run_all(missing):
            rows[job.recording] = _row(job, DONE if reason is None else FAILED, reason)
            write_batch(Batch(out, tuple(rows.values())))
            if progress is not None:
                ended = sum(row.status != NOT_RUN for row in rows.values())
                progress(job.recording.name, ended, len(rows))
    except KeyboardInterrupt as error:
        new = (job for job in missing if _version(job.folder) != before[job.recording])
        rows |= {job.recording: _row(job, DONE) for job in new if _is_whole(_metrics(job.folder))}
        return error
    return None


def _is_complete(job: Job, overwrite: bool) -> bool:
    """Return whether the run folder holds this job's run.

    Raises:
        ConfigError: it holds another run.
    """
    metrics = _metrics(job.folder)
    if metrics and not overwrite:
        if _description(job.folder) != job.description:
            raise ConfigError(
                f"{job.folder} holds a run of another recording or with other settings; choose another folder with -o, "
                "or give --overwrite to run all recordings again"
            )
        return _is_whole(metrics)
    return False


def _version(folder: Path) -> tuple[int, int] | None:
    """Return what changes when the folder gets a new run."""
    path = folder / METRICS
    return (path.stat().st_ino, path.stat().st_mtime_ns) if path.is_file() else None


def _is_whole(metrics: dict[str, Any]) -> bool:
    return bool(metrics) and not metrics.get("interrupted")


def _description(folder: Path) -> Any:
    try:
        return json.loads((folder / JOB).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _metrics(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / METRICS).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _row(job: Job, status: str, reason: str | None = None) -> BatchRow:
    metrics = _metrics(job.folder)
    if status in (FAILED, NOT_RUN) and _is_whole(metrics):  # an older run, which the new one would have replaced
        metrics = {}
    return BatchRow(job.recording, job.folder, status, reason, summary_metrics(metrics) if metrics else {})


def _run_all(jobs: list[Job]) -> Iterator[tuple[Job, str | None]]:
    """Yield every job as it ends, with the reason if it failed.

    When a process dies (out of memory, a crash in a library), the engine loses all jobs that run beside it. The jobs
    that had started are then run one by one, so that only the one that crashes fails; then the rest continues.
    """
    waiting = {job.recording: job for job in jobs}
    while waiting:
        broken: Exception | None = None
        with closing(_results(list(waiting.values()))) as results:
            try:
                for recording, reason in results:
                    yield waiting.pop(recording), reason
            except Exception as error:  # raised by the engine; errors of a job are returned as its reason
                broken = error
        if broken is None:
            return
        suspects = [job for job in waiting.values() if (partial_folder(job.folder) / JOB).exists()]
        if not suspects:
            raise broken
        for job in suspects:
            yield waiting.pop(job.recording), _run_alone(job)


def _results(jobs: list[Job]) -> Generator[tuple[Recording, str | None]]:
    return engines.run_tasks((run_job, (job,)) for job in jobs)


def _run_alone(job: Job) -> str | None:
    """Run one job and return the reason if it failed or its process died."""
    try:
        with closing(_results([job])) as results:
            return next(results)[1]
    except Exception as error:
        return f"the process died: {str(error).splitlines()[0]}"
