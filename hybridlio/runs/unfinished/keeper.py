"""Keeps a run on the disk while it goes, so that a kill, a power loss or a full disk costs about a second of it.

The run's hidden folder (:func:`hybridlio.runs.whole_folder.partial_folder`) gets two files. ``journal.bin`` grows: a
header, then blocks of estimates with their inertial samples, fixes and loop keyframes. ``state.bin`` is replaced from
time to time: the state of the front end, from which a resumed run goes on.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Frame, GpsFix, ImuSamples
from hybridlio.odometry.config import Config
from hybridlio.record import journal
from hybridlio.record.plain_values import encode
from hybridlio.runs.run import Run
from hybridlio.runs.unfinished.identity import header_of, points_digest
from hybridlio.runs.whole_folder import JOURNAL, STATE

_BLOCK_SCANS, _BLOCK_S = 50, 1.0  # what a kill may cost, whichever comes first
# Share of the time that storing the state may take; storing estimates takes 0.3 % (benchmarks/keeping.py).
_STATE_SHARE = 0.004
_STATE_AFTER_S = 10.0  # at the latest: a resumed run estimates these seconds again


class Keeper:
    """Writes a run's journal and state. Used as a context; at its end all estimates are on the disk.

    Args:
        folder: the hidden folder to write to.
        run: the run, new or resumed.
        config: the settings.
        length: of the part of the journal that holds the run already, in bytes, for a run that is resumed.

    Raises:
        DataError: the folder cannot be written to.
    """

    def __init__(self, folder: Path, run: Run, config: Config, length: int = 0) -> None:
        self._folder, self._run = folder, run
        self._rows = len(run.estimates)  # that are written, or being written
        self._inputs: dict[int, tuple[ImuSamples, tuple[GpsFix, ...]]] = {}
        self._writer = ThreadPoolExecutor(1, "journal")
        self._writing: Future[None] | None = None
        self._written_s = self._state_due_s = time.perf_counter()
        self._state_write_s = 0.0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = (folder / JOURNAL).open("ab")
            self._file.truncate(length)
            if not length:
                journal.append_block(self._file, encode(header_of(run.sequence, config)))
        except OSError as error:
            raise _disk_error(folder, error) from error

    def __enter__(self) -> Keeper:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            with suppress(DataError):  # the disk is full; the run has stopped for that already, or the results show it
                self._write(with_state=False)  # an interrupt may have left the odometry ahead of the estimates
                self._wait()
        finally:
            self._writer.shutdown()
            self._file.close()

    def see(self, frame: Frame) -> None:
        """Take the inertial samples and fixes of the frame that is estimated next."""
        self._inputs[frame.index] = frame.imu, frame.gps

    def after_scan(self) -> None:
        """Write what is due.

        Raises:
            DataError: the disk is full, or cannot be written to.
        """
        is_whole_block = len(self._run.estimates) - self._rows >= _BLOCK_SCANS
        is_writing = self._writing is not None and not self._writing.done()
        if is_whole_block or (time.perf_counter() - self._written_s >= _BLOCK_S and not is_writing):
            self._write(with_state=True)

    def _write(self, with_state: bool) -> None:
        """Give all estimates that are not written to the writing thread, and the odometry's state where that is due."""
        self._wait()
        rows = len(self._run.estimates)
        if rows == self._rows:
            return
        start_s, start_cpu_s = time.perf_counter(), time.thread_time()
        block = self._block()
        is_due = with_state and start_s >= self._state_due_s
        state = self._state() if is_due else None
        self._inputs = {k: seen for k, seen in self._inputs.items() if k > self._run.estimates[-1].index}
        self._rows, self._written_s = rows, start_s
        self._writing = self._writer.submit(self._put, block, state)
        if is_due:
            spent_s = time.thread_time() - start_cpu_s + self._state_write_s  # a busy machine makes neither longer
            self._state_due_s = start_s + min(spent_s / _STATE_SHARE, _STATE_AFTER_S)

    def _wait(self) -> None:
        """Wait until everything that was given to the thread is on the disk."""
        writing, self._writing = self._writing, None
        if writing is not None:
            try:
                writing.result()
            except OSError as error:
                raise _disk_error(self._folder, error) from error

    def _block(self) -> bytes:
        run = self._run
        rows = range(self._rows, len(run.estimates))
        estimates, state = [run.estimates[row] for row in rows], run.odometry.state(rows.start)
        return encode(
            {
                "estimates": estimates,
                "inputs": [self._inputs[estimate.index] for estimate in estimates],
                "reading_s": run.reading_s[rows.start : rows.stop],
                "keyframes": [] if state is None else [kept for kept in state["keyframes"] if kept[0] < rows.stop],
                "start": None if state is None else state["start"],
                "imu_noise": None if state is None else state["imu_noise"],
                "unreadable": run.unreadable,
                "skipped": run.skipped,
                "seconds": run.seconds,
            }
        )

    def _state(self) -> bytes | None:
        rows = len(self._run.estimates)
        state = self._run.odometry.state(rows)
        return (
            None if state is None else encode({"rows": rows, "points": points_digest(self._run.last_points), **state})
        )

    def _put(self, block: bytes, state: bytes | None) -> None:
        journal.append_block(self._file, block)
        if state is not None:
            start_s = time.thread_time()  # not while the disk works
            new = self._folder / f".{STATE}.new"
            with new.open("wb") as file:
                journal.append_block(file, state)
            os.replace(new, self._folder / STATE)
            self._state_write_s = time.thread_time() - start_s


def _disk_error(folder: Path, error: OSError) -> DataError:
    return DataError(
        f"cannot write to {folder}: {error.strerror}; make room there, then --resume goes on from the estimates on disk"
    )
