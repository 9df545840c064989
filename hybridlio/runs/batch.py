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

from hybridlio.core.errors import ConfigError, HybridLioError
from hybridlio.core.files import make_folder, write_atomically
from hybridlio.core.progress import Progress
from hybridlio.datasets.protection import check_output
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import check_implementations, check_names
from hybridlio.runs import engines
from hybridlio.runs.batch_table import DONE, DONE_BEFORE, FAILED, NOT_RUN, Batch, BatchRow, summary_metrics, write_batch
from hybridlio.runs.folder import JOB, LOG, METRICS, is_own_file
from hybridlio.runs.new_folder import check_free
from hybridlio.runs.own_files import BATCH
from hybridlio.runs.recordings import Recording
from hybridlio.runs.run_log import logged_to
from hybridlio.runs.whole_folder import held, partial_folder, replaced_folder

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
    """

    jobs: int | None = None
    threads: int | None = None
    engine: str = engines.LOCAL
    scheduler: str | None = None
    overwrite: bool = False
    adapt_config: bool = True


@dataclass(frozen=True)
class Job:
    """All that a process needs to run one recording.

    Attributes:
        recording: the recording to run.
        folder: its run folder.
        config: the settings.
        threads: maximum number of threads of the run.
        adapt_config: see :class:`BatchOptions`.
    """

    recording: Recording
    folder: Path
    config: Config
    threads: int
    adapt_config: bool

    @property
    def description(self) -> dict[str, Any]:
        """Recording and settings as plain values; equal for jobs with equal results."""
        return {"recording": self.recording.to_json_dict(), "settings": self.config.model_dump(mode="json")}


def run_batch(
    recordings: Items[Recording],
    out: Path,
    config: Config | None = None,
    options: BatchOptions | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Run recordings in parallel; write each to ``out/<name>``, and ``batch.json`` and ``batch.md`` to ``out``.

    Complete runs are kept. An interrupt (Ctrl-C) ends the batch and is returned in :attr:`Batch.stopped`. With
    ``overwrite``, an older run stays until the new one is complete.

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
    BATCH.check(out)
    parallel, threads = _workers(options, len(recordings))
    jobs = [Job(r, out / r.name, config, threads, options.adapt_config) for r in recordings]
    complete = {job.recording for job in jobs if _is_complete(job, options.overwrite)}
    missing = [job for job in jobs if job.recording not in complete]
    for job in missing:
        check_free(job.folder, overwrite=True)
    with engines.engine(options.engine, parallel, threads, options.scheduler):
        make_folder(out)
        with held(out):
            rows = {job.recording: _row(job, DONE_BEFORE if job.recording in complete else NOT_RUN) for job in jobs}
            stopped = _run_missing(missing, rows, out, progress)
            batch = Batch(out, tuple(rows.values()), stopped)
            write_batch(batch)
    return batch


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


def run_job(job: Job) -> tuple[Recording, str | None]:
    """Run one recording and write its run folder; return the recording, and the reason if it failed.

    The library's log of the run is written to the folder's ``run.log``, with the traceback of an unexpected error. If
    the run fails without a result, an older run in the folder stays, with the new log.
    """
    try:
        check_free(job.folder, overwrite=True)
        with replaced_folder(job.folder, is_own_file) as part:
            write_atomically(part / JOB, json.dumps(job.description, indent=2) + "\n")
            with logged_to(part / LOG):
                reason = _run_in(part, job)
            if reason is not None and not (part / METRICS).exists() and (job.folder / METRICS).exists():
                write_atomically(job.folder / LOG, (part / LOG).read_bytes())
                raise _NoResultError(reason)
    except _NoResultError as error:
        return job.recording, str(error)
    except (OSError, HybridLioError) as error:
        return job.recording, f"{job.folder}: cannot be written: {error}"
    return job.recording, reason


class _NoResultError(Exception):
    """Keeps an older run from being replaced by one without a result."""


def _run_in(folder: Path, job: Job) -> str | None:
    """Run a job and write the files to a folder; return the reason if it failed."""
    try:
        _run(job, folder)
    except HybridLioError as error:
        _log.error("%s", error)
        return str(error)
    except Exception as error:
        _log.exception("a bug in hybridlio")
        return f"{type(error).__name__}: {error} (a bug in hybridlio; {LOG} has the traceback)"
    return None


def _run(job: Job, folder: Path) -> None:
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.runs.run import adapt_config, run_odometry
    from hybridlio.runs.write import write_run_files

    sequence = job.recording.open()
    config = adapt_config(sequence, job.config, is_explicit=not job.adapt_config)
    run = run_odometry(sequence, Odometry(config=engines.with_thread_limit(config, job.threads)))
    if isinstance(run.stopped, KeyboardInterrupt):
        raise run.stopped
    if run.stopped is not None and len(run.estimates) < 2:
        raise run.stopped
    write_run_files(folder, run, config)
    if run.stopped is not None:
        raise run.stopped
