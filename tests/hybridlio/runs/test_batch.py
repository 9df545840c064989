from __future__ import annotations

import json
import os
import sys

import cloudpickle
import pytest
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.core.errors import ConfigError, DataError, MissingDependencyError
from hybridlio.odometry.config import Config
from hybridlio.runs import batch, engines
from hybridlio.runs.batch import BatchOptions, Job, run_batch, run_job
from hybridlio.runs.batch_table import DONE, DONE_BEFORE, FAILED, NOT_RUN
from hybridlio.runs.recordings import Recording, find_recordings
from hybridlio.runs.whole_folder import partial_folder

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import tests

QUICK = Config(residual="none")


@pytest.fixture
def two(tiny_drive) -> tuple[Recording, ...]:
    return find_recordings([Recording(str(tiny_drive), frames=part) for part in (":4", "4:9")])


@pytest.fixture(autouse=True)
def without_pages(monkeypatch) -> None:
    """Skip the reports, which are slow, in runs within this process."""
    monkeypatch.setattr("hybridlio.runs.write.write_pages", lambda *_: None)


def statuses(done) -> list[str]:
    return [row.status for row in done.rows]


def test_a_failed_recording_does_not_stop_the_others_and_a_second_batch_runs_only_what_is_missing(two, tmp_path):
    recordings = (two[0], Recording(str(tmp_path / "gone"), name="gone"), two[1])
    first = run_batch(recordings, tmp_path / "out", QUICK, BatchOptions(jobs=2))
    assert statuses(first) == [DONE, FAILED, DONE]
    assert "no such folder" in first.rows[1].reason
    assert [row.metrics["frames_done"] for row in (first.rows[0], first.rows[2])] == [4, 5]
    written = {row.folder: (row.folder / "metrics.json").stat().st_mtime_ns for row in (first.rows[0], first.rows[2])}
    again = run_batch(recordings, tmp_path / "out", QUICK, BatchOptions(jobs=2))
    assert statuses(again) == [DONE_BEFORE, FAILED, DONE_BEFORE]
    assert {folder: (folder / "metrics.json").stat().st_mtime_ns for folder in written} == written


def test_batch_json_and_batch_md_contain_every_recording_with_metrics_or_reason(two, tmp_path):
    run_batch((two[0], Recording("/gone", name="gone")), tmp_path, QUICK, BatchOptions(engine="threading"))
    first, gone = json.loads((tmp_path / "batch.json").read_text())["recordings"]
    assert first["frames"] == 4
    assert first["ate_m"] > 0
    assert first["folder"] == two[0].name
    assert gone["status"] == "failed"
    text = (tmp_path / "batch.md").read_text()
    assert text.startswith("2 recordings: 1 done, 1 failed")
    assert "/gone: no such folder" in text


def test_a_run_with_other_settings_is_an_error_unless_overwrite_is_set(two, tmp_path):
    run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="threading"))
    other = QUICK.model_copy(update={"initial_pose": "identity"})
    with pytest.raises(ConfigError, match="other settings"):
        run_batch(two[:1], tmp_path, other, BatchOptions(engine="threading"))
    assert statuses(run_batch(two[:1], tmp_path, other, BatchOptions(engine="threading", overwrite=True))) == [DONE]


def test_an_interrupted_run_is_run_again(two, tmp_path):
    (row,) = run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="threading")).rows
    metrics = row.folder / "metrics.json"
    metrics.write_text(json.dumps({**json.loads(metrics.read_text()), "interrupted": True}))
    assert statuses(run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="threading"))) == [DONE]


def run_or_die(job: Job) -> tuple[Recording, str | None]:
    if job.recording.name == "deadly":
        partial = partial_folder(job.folder)
        partial.mkdir(parents=True)
        (partial / batch.JOB).write_text("{}")
        os._exit(9)
    return run_job(job)


def test_a_process_that_dies_fails_only_its_own_recording(two, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "run_job", run_or_die)
    done = run_batch((Recording("/gone", name="deadly"), two[0]), tmp_path, QUICK, BatchOptions(jobs=2))
    assert statuses(done) == [FAILED, DONE]
    assert "the process died" in done.rows[0].reason


def interrupt_the_second(job: Job) -> tuple[Recording, str | None]:
    if (job.folder.parent / "seen").exists():
        raise KeyboardInterrupt
    (job.folder.parent / "seen").touch()
    return run_job(job)


def test_an_interrupt_keeps_complete_runs(two, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "run_job", interrupt_the_second)
    stopped = run_batch(two, tmp_path, QUICK, BatchOptions(jobs=1, engine="sequential"))
    assert isinstance(stopped.stopped, KeyboardInterrupt)
    assert statuses(stopped) == [DONE, NOT_RUN]
    monkeypatch.undo()
    assert statuses(run_batch(two, tmp_path, QUICK, BatchOptions(engine="threading"))) == [DONE_BEFORE, DONE]


def threads_of(_: int) -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")


def test_each_job_runs_in_its_own_process_with_the_given_threads():
    with engines.engine("loky", 1, 1):
        ((process, threads),) = engines.run_tasks([(threads_of, (0,))])
    assert process != os.getpid()
    assert threads == "1"


def test_the_thread_limit_applies_to_all_parts_of_the_settings():
    matching = engines.with_thread_limit(Config(), 1).scan_matching
    assert (matching.registration.threads, matching.local_map.threads) == (1, 1)
    assert engines.with_thread_limit(Config(), 99) == Config()


def test_a_batch_runs_on_a_dask_cluster(two, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        done = run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="dask", scheduler=cluster.scheduler_address))
    assert statuses(done) == [DONE]


def test_the_error_for_a_folder_that_cannot_be_created_names_it_with_every_engine(two, tmp_path):
    distributed = pytest.importorskip("distributed")
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cannot make the folder .*file/runs"):
        run_batch(two, tmp_path / "file/runs", QUICK)
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster),
        pytest.raises(DataError, match=r"cannot make the folder .*file/runs"),
    ):
        run_batch(two, tmp_path / "file/runs", QUICK, BatchOptions(engine="dask"))


@pytest.mark.parametrize(("engine", "module"), [("dask", "distributed"), ("ray", "ray")])
def test_the_error_for_a_missing_engine_says_what_to_install(two, tmp_path, monkeypatch, engine, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        run_batch(two, tmp_path, QUICK, BatchOptions(engine=engine))


def test_an_unknown_engine_or_a_scheduler_for_a_local_engine_is_an_error(two, tmp_path):
    with pytest.raises(ConfigError, match="unknown engine 'steam'"):
        run_batch(two, tmp_path, QUICK, BatchOptions(engine="steam"))
    with pytest.raises(ConfigError, match="no scheduler"):
        run_batch(two, tmp_path, QUICK, BatchOptions(scheduler="tcp://head:8786"))


def command(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["batch", *map(str, words)], env={"COLUMNS": "200", "TERM": "dumb"})
    return result.exit_code, result.output


def test_the_exit_code_shows_whether_any_recording_failed(tiny_drive, tmp_path):
    options = ("-o", tmp_path / "out", "--residual", "none", "--frames", ":4", "--engine", "threading")
    code, output = command(tiny_drive, *options)
    assert code == 0, output
    assert "1 recording: 1 done" in output
    code, output = command(tiny_drive, "/gone", *options)
    assert code == 1
    assert "1 done before, 1 failed" in output
    assert command(tiny_drive, *options, "--residual", "nonsense")[0] == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--frames", "x"), "frames 'x': give a range"),
        (("--frames", "9:5"), "frames '9:5': the range is empty"),
        (("--reader", "x"), "unknown reader 'x'"),
        (("--raw-root", "/gone"), "raw root /gone: no such folder"),
        (("--initial-pose", "x"), "unknown initial pose 'x'"),
        (("--engine", "steam"), "unknown engine 'steam'"),
        (("--scheduler", "tcp://head:8786"), "no scheduler"),
        (("--config", "/gone.yaml"), "/gone.yaml: cannot be read"),
    ],
)
def test_an_invalid_option_fails_once_before_any_run(options, words, tmp_path):
    code, output = command("/one", "/two", "-o", tmp_path / "out", *options)
    assert code == 2
    assert output.count(words) == 1, output
    assert not (tmp_path / "out").exists()


def test_invalid_settings_do_not_remove_existing_runs(two, tmp_path):
    run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="threading"))
    without_weights = Config.model_validate({"residual": "network", "network": {"weights": "/gone.safetensors"}})
    for settings, engine in ((without_weights, "threading"), (QUICK, "steam")):
        with pytest.raises(ConfigError, match=r"gone\.safetensors|steam"):
            run_batch(two[:1], tmp_path, settings, BatchOptions(engine=engine, overwrite=True))
    assert statuses(run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="threading"))) == [DONE_BEFORE]


def test_a_range_outside_one_recording_fails_for_that_recording_only(two, tmp_path):
    beyond = Recording(two[0].path, frames="900:", name="beyond")
    done = run_batch((beyond, two[0]), tmp_path, QUICK, BatchOptions(engine="threading"))
    assert statuses(done) == [FAILED, DONE]
    assert "no scans in 900:" in done.rows[0].reason


def test_an_unexpected_error_is_the_recordings_reason_with_a_traceback_in_its_log(two, tmp_path, monkeypatch):
    monkeypatch.setattr("hybridlio.runs.write.write_run_files", lambda *_: 1 // 0)
    done = run_batch(two[:1], tmp_path, QUICK, BatchOptions(engine="sequential"))
    assert "ZeroDivisionError" in done.rows[0].reason
    assert "Traceback" in (done.rows[0].folder / "run.log").read_text()
