"""Engines that run the jobs of a batch: joblib's backends, from processes on this machine to a cluster."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from hybridlio.core.errors import ConfigError, MissingDependencyError

if TYPE_CHECKING:  # the command line imports this module for the name of an engine
    from hybridlio.odometry.config import Config

Task = tuple[Callable[..., Any], tuple[Any, ...]]

LOCAL = "loky"
_WATCH_S = 0.5  # how often a worker looks whether its parent lives


def is_remote(name: str) -> bool:
    """Return whether an engine may run jobs on other machines, which have other devices and files."""
    return name in _CONNECT


def cores() -> int:
    """Return the number of cores that this process may use, by its affinity and its container's quota."""
    import joblib

    return int(joblib.cpu_count())


@contextmanager
def engine(name: str, jobs: int | None, threads: int, scheduler: str | None = None) -> Iterator[None]:
    """Make :func:`run_tasks` use an engine within the block.

    Args:
        name: ``loky`` (processes on this machine), ``dask``, ``ray``, or another backend known to joblib.
        jobs: maximum number of parallel jobs; None for all that the engine has.
        threads: threads of numerical libraries per process of ``loky``; other engines have their own setting.
        scheduler: a cluster's address. Without one, Dask and Ray use the cluster that this process is connected to or
            that their own settings name; otherwise they start one on this machine.

    Raises:
        MissingDependencyError: the engine is not installed.
        ConfigError: the engine is unknown, or there is no scheduler at the address.
    """
    import joblib

    if scheduler is not None and name not in _CONNECT:
        raise ConfigError(f"the engine {name} has no scheduler; use {' or '.join(_CONNECT)}, or omit --scheduler")
    options: dict[str, Any] = {}
    if name == LOCAL:
        options = {"inner_max_num_threads": threads, "initializer": _end_with_parent, "initargs": (os.getpid(),)}
    with _CONNECT.get(name, _without_cluster)(scheduler, jobs):
        try:
            config = joblib.parallel_config(backend=name, n_jobs=jobs or -1, **options)
        except (ValueError, KeyError) as error:
            known = ", ".join((LOCAL, *_CONNECT))
            raise ConfigError(f"unknown engine {name!r}; choose one of {known}, or a backend of joblib") from error
        with config:
            yield


def run_tasks(tasks: Iterable[Task]) -> Generator[Any]:
    """Yield the result of each task: as it ends where the engine supports that, otherwise all together at the end.

    Every task runs in another process than this one, even a single task, so that a crash does not end this process.
    Closing the generator cancels tasks that are still running. Processes on this machine end when this one does.
    """
    import joblib
    from joblib.parallel import get_active_backend

    backend, jobs = get_active_backend()
    has_generator = getattr(backend, "supports_return_generator", False)
    parallel = joblib.Parallel(
        n_jobs=max(jobs, 2) if jobs > 0 else jobs,  # with one job, joblib would run the task in this process
        batch_size=1,
        pre_dispatch=jobs if jobs > 0 else "all",
        return_as="generator_unordered" if has_generator else "list",
    )
    yield from parallel(joblib.delayed(call)(*arguments) for call, arguments in tasks)


def _end_with_parent(parent: int) -> None:
    """Let this process end when its parent does, even where that is killed; called as a worker starts.

    Linux can do so by a signal (PR_SET_PDEATHSIG), but sends it when the parent's thread ends that had started the
    process, and joblib starts processes from several threads.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    """End this process, without writing anything more, when another process has become its parent."""
    while os.getppid() == parent:
        time.sleep(_WATCH_S)
    os.kill(os.getpid(), signal.SIGKILL)


@contextmanager
def _without_cluster(_scheduler: str | None, _jobs: int | None) -> Iterator[None]:
    yield


@contextmanager
def _dask(scheduler: str | None, jobs: int | None) -> Iterator[None]:
    try:
        import dask
        from distributed import Client, get_client
    except ImportError as error:
        raise MissingDependencyError("the engine dask is not installed: pip install distributed") from error
    address = scheduler or dask.config.get("scheduler-address", None)
    if address is None and (connected := _or_none(get_client)) is not None:
        with connected.as_current():
            yield
        return
    try:
        client = Client(address) if address else Client(n_workers=jobs or cores(), threads_per_worker=1)
    except OSError as error:
        raise ConfigError(f"no Dask scheduler at {address}: {error}") from error
    with client:
        yield


@contextmanager
def _ray(scheduler: str | None, _jobs: int | None) -> Iterator[None]:
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise MissingDependencyError("the engine ray is not installed: pip install 'ray[default]'") from error
    if not ray.is_initialized():
        try:
            ray.init(address=scheduler)
        except (ConnectionError, ValueError) as error:
            raise ConfigError(f"no Ray cluster at {scheduler}: {error}") from error
    register_ray()
    yield


def _or_none(get_client: Callable[[], Any]) -> Any:
    """Return the client that this process is connected by, or None."""
    try:
        return get_client()
    except ValueError:
        return None


_CONNECT: dict[str, Callable[[str | None, int | None], Any]] = {"dask": _dask, "ray": _ray}


def with_thread_limit(config: Config, threads: int) -> Config:
    """Return the settings with every ``threads`` reduced to the limit."""

    def limit(tree: dict[str, Any]) -> dict[str, Any]:
        return {
            key: limit(value)
            if isinstance(value, dict)
            else min(value, threads)
            if key == "threads" and value is not None
            else value
            for key, value in tree.items()
        }

    return type(config).model_validate(limit(config.model_dump()))
