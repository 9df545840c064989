"""Many recordings: each run in a process of its own, on one machine or a cluster, into a run folder of its own.

A recording that fails leaves its reason and stops no other; what is complete is not done again.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Generator, Iterator
from collections.abc import Sequence as Items
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridlio.core.errors import ConfigError, DataError, HybridLioError
from hybridlio.core.files import make_folder, write_whole
from hybridlio.odometry.config import Config
from hybridlio.odometry.registry import check_implementations, check_names
from hybridlio.runs import engines
from hybridlio.runs import folder as run_folder
from hybridlio.runs.batch_table import DONE, DONE_BEFORE, FAILED, NOT_RUN, Batch, BatchRow, figures_of, write_batch
from hybridlio.runs.recordings import Recording

Progress = Callable[[int, int, str], None]

JOB, LOG = "batch_job.json", "run.log"
_log = logging.getLogger("hybridlio")


@dataclass(frozen=True)
class Job:
    """One recording's run, for a process that knows nothing else.

    Attributes:
        recording: what to run.
        folder: the run folder.
        config: the settings.
        threads: at most so many for the run.
        without_imu: run a recording without inertial data from another initial pose.
    """

    recording: Recording
    folder: Path
    config: Config
    threads: int
    without_imu: bool

    @property
    def description(self) -> dict[str, Any]:
        """What makes two jobs the same: recording and settings."""
        return {"recording": self.recording.to_json_dict(), "settings": self.config.model_dump(mode="json")}


def run_batch(
    recordings: Items[Recording],
    out: Path,
    config: Config | None = None,
    *,
    jobs: int | None = None,
    threads: int | None = None,
    engine: str = engines.LOCAL,
    scheduler: str | None = None,
    overwrite: bool = False,
    without_imu: bool = True,
    progress: Progress | None = None,
) -> Batch:
    """Run recordings, several at a time, and write each to ``out/<name>``, and ``batch.json`` and ``batch.md`` beside.

    Runs that are complete are left as they are. What stops the batch, such as Ctrl-C, is kept in
    :attr:`Batch.stopped`; the runs that were complete by then stay.

    Args:
        recordings: as :func:`hybridlio.runs.recordings.find_recordings` finds them.
        out: a folder, on a cluster one that all machines see under this path.
        config: the settings of all runs.
        jobs: how many at a time; None for one for each core.
        threads: of each run; None for an equal share of the cores, or one on a cluster.
        engine, scheduler: see :func:`hybridlio.runs.engines.engine`.
        overwrite: run again what is there already.
        without_imu: run recordings without inertial data from initial poses of constant velocity.
        progress: called with recordings done, recordings in all, and the one that is done.

    Raises:
        ConfigError: ``out`` holds runs of other recordings or with other settings, an unknown engine, or settings that
            no recording can be run with. Nothing has been run or removed then.
        DataError: the folder cannot be made.
        MissingDependencyError: the engine is not installed.
    """
    config, out = config or Config(), Path(out).absolute()
    if engines.is_remote(engine):
        check_names(config.initial_pose, config.residual, config.backend)
    else:
        check_implementations(config)
    local = engine == engines.LOCAL
    jobs = max(1, min(jobs or engines.cores(), len(recordings))) if local else jobs
    threads = threads or (max(1, engines.cores() // jobs) if local and jobs else 1)
    todo = [Job(r, out / r.name, config, threads, without_imu) for r in recordings]
    done = {job.recording for job in todo if _is_complete(job, overwrite)}
    missing = [job for job in todo if job.recording not in done]
    with engines.engine(engine, jobs, threads, scheduler):
        make_folder(out)
        for job in missing:
            _clear(job)
        rows = {job.recording: _row(job, DONE_BEFORE if job.recording in done else NOT_RUN) for job in todo}
        stopped = _run_missing(missing, rows, out, progress)
    batch = Batch(out, tuple(rows.values()), stopped)
    write_batch(batch)
    return batch


def _run_missing(
    missing: list[Job], rows: dict[Recording, BatchRow], out: Path, progress: Progress | None
) -> BaseException | None:
    """Run jobs, and put in each one's row as it ends; what stopped them, if anything."""
    try:
        for job, reason in _run_all(missing):
            rows[job.recording] = _row(job, DONE if reason is None else FAILED, reason)
            write_batch(Batch(out, tuple(rows.values())))
            if progress is not None:
                counted = sum(row.status != NOT_RUN for row in rows.values())
                progress(counted, len(rows), job.recording.name)
    except KeyboardInterrupt as error:
        rows |= {job.recording: _row(job, DONE) for job in missing if _reached_its_end(_metrics(job.folder))}
        return error
    return None


def _is_complete(job: Job, overwrite: bool) -> bool:
    """Whether the run is there.

    Raises:
        ConfigError: another run is there.
    """
    metrics = _metrics(job.folder)
    if metrics and not overwrite:
        if _description(job.folder) != job.description:
            raise ConfigError(
                f"{job.folder} holds a run of another recording or with other settings; choose another folder, or "
                "--overwrite all that is there"
            )
        return _reached_its_end(metrics)
    return False


def _clear(job: Job) -> None:
    run_folder.clear(job.folder)
    (job.folder / JOB).unlink(missing_ok=True)


def _reached_its_end(metrics: dict[str, Any]) -> bool:
    return bool(metrics) and not metrics.get("interrupted")


def _description(folder: Path) -> Any:
    try:
        return json.loads((folder / JOB).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _metrics(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / run_folder.METRICS).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _row(job: Job, status: str, reason: str | None = None) -> BatchRow:
    metrics = _metrics(job.folder)
    return BatchRow(job.recording, job.folder, status, reason, figures_of(metrics) if metrics else {})


def _run_all(jobs: list[Job]) -> Iterator[tuple[Job, str | None]]:
    """Every job as it ends, with the reason where it failed.

    Where a process ends by force (out of memory, a crash in a library), all that ran beside it are lost too. Those
    that had been started are then run one by one, so that only the one whose fault it is fails; the rest goes on.
    """
    waiting = {job.recording: job for job in jobs}
    while waiting:
        broken: Exception | None = None
        with closing(_results(list(waiting.values()))) as results:
            try:
                for recording, reason in results:
                    yield waiting.pop(recording), reason
            except Exception as error:  # of the engine: what a job raises comes back as its reason
                broken = error
        if broken is None:
            return
        suspects = [job for job in waiting.values() if (job.folder / JOB).exists()]
        if not suspects:
            raise broken
        for job in suspects:
            yield waiting.pop(job.recording), _reason_alone(job)


def _results(jobs: list[Job]) -> Generator[tuple[Recording, str | None]]:
    return engines.run_tasks((run_job, (job,)) for job in jobs)


def _reason_alone(job: Job) -> str | None:
    try:
        with closing(_results([job])) as results:
            return next(results)[1]
    except Exception as error:
        return f"its process ended by force: {str(error).splitlines()[0]}"


def run_job(job: Job) -> tuple[Recording, str | None]:
    """Run one recording and write its run folder; why that failed is returned, not raised.

    The library's log of it is in the folder's ``run.log``, with the traceback of an error that is a fault.
    """
    try:
        job.folder.mkdir(parents=True, exist_ok=True)
        write_whole(job.folder / JOB, json.dumps(job.description, indent=2) + "\n")
        with _logged_to(job.folder / LOG):
            try:
                _run(job)
            except HybridLioError as error:
                _log.error("%s", error)
                return job.recording, str(error)
            except Exception as error:
                _log.exception("a fault in hybridlio")
                return job.recording, f"{type(error).__name__}: {error} (a fault in hybridlio; {LOG} shows where)"
    except (OSError, DataError) as error:
        return job.recording, f"{job.folder}: cannot be written to: {error}"
    return job.recording, None


def _run(job: Job) -> None:
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.runs.run import run_odometry, suited_to
    from hybridlio.runs.write import write_run

    sequence = job.recording.open()
    config = suited_to(sequence, job.config, as_asked=not job.without_imu)
    run = run_odometry(sequence, Odometry(config=_limited(config, job.threads)))
    if isinstance(run.stopped, KeyboardInterrupt):
        raise run.stopped
    if run.stopped is not None and len(run.estimates) < 2:
        raise run.stopped
    write_run(job.folder, run, config)
    if run.stopped is not None:
        raise run.stopped


def _limited(config: Config, threads: int) -> Config:
    """The settings with no part of them using more threads."""

    def limited(tree: dict[str, Any]) -> dict[str, Any]:
        return {
            key: limited(value)
            if isinstance(value, dict)
            else min(value, threads)
            if key == "threads" and value is not None
            else value
            for key, value in tree.items()
        }

    return Config.model_validate(limited(config.model_dump()))


@contextmanager
def _logged_to(file: Path) -> Iterator[None]:
    """Write what the library, and what draws its pictures, logs in this thread to a file."""
    mine = threading.get_ident()
    handler = logging.FileHandler(file, mode="w", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.addFilter(lambda record: record.thread == mine)
    loggers, level = (_log, logging.getLogger("matplotlib")), _log.level
    for logger in loggers:
        logger.addHandler(handler)
    _log.setLevel(min(logging.INFO, level) if level else logging.INFO)
    try:
        yield
    finally:
        _log.setLevel(level)
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()
