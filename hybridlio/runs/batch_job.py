"""One run of a batch, in a process of its own: read the recording, estimate, write the run folder."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridlio.core.errors import HybridLioError
from hybridlio.core.files import write_atomically
from hybridlio.odometry.config import Config
from hybridlio.runs import engines
from hybridlio.runs.folder import JOB, LOG, METRICS, is_own_file
from hybridlio.runs.own_files import check_free
from hybridlio.runs.recordings import Recording
from hybridlio.runs.run_log import logged_to
from hybridlio.runs.whole_folder import discard_journal, replaced_folder

_log = logging.getLogger("hybridlio")


@dataclass(frozen=True)
class Job:
    """All that a process needs to run one recording.

    Attributes:
        recording: the recording to run.
        folder: its run folder.
        config: the settings.
        threads: maximum number of threads of the run.
        adapt_config, check: see :class:`BatchOptions`.
    """

    recording: Recording
    folder: Path
    config: Config
    threads: int
    adapt_config: bool
    check: bool = True

    @property
    def description(self) -> dict[str, Any]:
        """Recording and settings as plain values; equal for jobs with equal results."""
        return {"recording": self.recording.to_json_dict(), "settings": self.config.model_dump(mode="json")}


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
                discard_journal(part)
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
    from hybridlio.runs.recording_check import check_recording
    from hybridlio.runs.run import adapt_config, finish_run
    from hybridlio.runs.unfinished.keeper import Keeper
    from hybridlio.runs.unfinished.kept import resume_if_same
    from hybridlio.runs.write import write_run_files

    sequence = job.recording.open()
    if job.check:
        sequence = check_recording(sequence)
    config = adapt_config(sequence, job.config, is_explicit=not job.adapt_config)
    limited = engines.with_thread_limit(config, job.threads)
    run, length = resume_if_same(folder, sequence, config, lambda: Odometry(config=limited))
    with Keeper(folder, run, config, length) as keeper:
        finish_run(run, keeper=keeper)
    if isinstance(run.stopped, KeyboardInterrupt):
        raise run.stopped
    if run.stopped is not None and len(run.estimates) < 2:
        raise run.stopped
    write_run_files(folder, run, config)
    if run.stopped is not None:
        raise run.stopped
