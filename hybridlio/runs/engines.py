"""Who runs the recordings of a batch: joblib's backends, from processes on one machine to a cluster's scheduler."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from hybridlio.core.errors import ConfigError, MissingDependencyError

Task = tuple[Callable[..., Any], tuple[Any, ...]]

LOCAL = "loky"


def is_remote(name: str) -> bool:
    """Whether an engine's workers may be on other machines, with other devices and files than this one."""
    return name in _CONNECT


def cores() -> int:
    """Cores that this process may use, by affinity and by a container's quota."""
    import joblib

    return int(joblib.cpu_count())


@contextmanager
def engine(name: str, jobs: int | None, threads: int, scheduler: str | None = None) -> Iterator[None]:
    """Have :func:`run_tasks` within the block run by an engine.

    Args:
        name: ``loky`` (processes on this machine), ``dask``, ``ray``, or another backend that joblib knows.
        jobs: at most so many at a time; None for all that the engine has.
        threads: of numerical libraries in each of ``loky``'s processes; other engines set it for their workers.
        scheduler: a cluster's address. Without one, Dask and Ray use the cluster that the process is connected to
            already or that their own settings name, and otherwise make one of this machine.

    Raises:
        MissingDependencyError: the engine is not installed.
        ConfigError: there is no such engine, or no scheduler at that address.
    """
    import joblib

    if scheduler is not None and name not in _CONNECT:
        raise ConfigError(f"the engine {name} has no scheduler to connect to; choose {' or '.join(_CONNECT)}")
    options: dict[str, Any] = {"inner_max_num_threads": threads} if name == LOCAL else {}
    with _CONNECT.get(name, _alone)(scheduler, jobs):
        try:
            config = joblib.parallel_config(backend=name, n_jobs=jobs or -1, **options)
        except (ValueError, KeyError) as error:
            known = ", ".join((LOCAL, *_CONNECT))
            raise ConfigError(f"unknown engine {name!r}; choose one of {known}, or a backend of joblib") from error
        with config:
            yield


def run_tasks(tasks: Iterable[Task]) -> Generator[Any]:
    """What the tasks return, each as soon as it is known where the engine can tell, else all at the end.

    A process of its own runs each, also where there is a single one, so that one that ends by force does not take this
    process with it. Closing the generator gives up what is still running.
    """
    import joblib
    from joblib.parallel import get_active_backend

    backend, jobs = get_active_backend()
    as_known = getattr(backend, "supports_return_generator", False)
    parallel = joblib.Parallel(
        n_jobs=max(jobs, 2) if jobs > 0 else jobs,  # of one job joblib makes none of its own
        batch_size=1,
        pre_dispatch=jobs if jobs > 0 else "all",
        return_as="generator_unordered" if as_known else "list",
    )
    yield from parallel(joblib.delayed(call)(*arguments) for call, arguments in tasks)


@contextmanager
def _alone(_scheduler: str | None, _jobs: int | None) -> Iterator[None]:
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


def _or_none(connected: Callable[[], Any]) -> Any:
    try:
        return connected()
    except ValueError:
        return None


_CONNECT: dict[str, Callable[[str | None, int | None], Any]] = {"dask": _dask, "ray": _ray}
