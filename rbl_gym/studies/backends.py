"""Run a function on many tasks: in this process, in several ones, or on a cluster, by joblib."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from typing import Any, NamedTuple

from rbl_gym.extras import require

__all__ = ["HERE", "Workers", "each"]

BACKENDS = ("loky", "dask", "ray")
# Maximum number of successive worker deaths without a completed task.
_PATIENCE = 3


class Workers(NamedTuple):
    """Where to run tasks.

    Attributes
    ----------
    jobs
        Processes of this machine.
    backend
        None: this process if `jobs` is 1, else ``"loky"``. ``"dask"`` or ``"ray"``: the
        cluster at `address`, or one of `jobs` local workers.
    address
        Address of the scheduler of the cluster.
    """

    jobs: int = 1
    backend: str | None = None
    address: str | None = None


# Tasks run sequentially, in this process.
HERE = Workers()


def each(
    function: Callable[[Any], Any], tasks: Sequence[Any], workers: Workers = HERE
) -> Iterator[tuple[int, Any]]:
    """Yield ``function(task)`` of every task, as (index, result), in the order of completion.

    Parameters
    ----------
    function, tasks
        Picklable; the function must be importable where the workers run.
    workers
        Where to run them.

    Raises
    ------
    MissingExtraError
        If joblib or the backend is not installed.
    ChildProcessError
        If workers die repeatedly on the same tasks. Otherwise the tasks of a dead worker are run
        again.
    """
    check(workers)
    jobs, backend, address = workers
    if backend is None and jobs == 1:
        yield from ((index, function(task)) for index, task in enumerate(tasks))
    elif backend in (None, "loky"):
        yield from _surviving(function, tasks, jobs)
    elif backend == "dask":
        yield from _dask(function, tasks, jobs, address)
    else:
        yield from _ray(function, tasks, jobs, address)


def check(workers: Workers) -> None:
    """Raise MissingExtraError if a library for `each` is not installed."""
    jobs, backend, _ = workers
    if backend is None and jobs == 1:
        return
    what = f"the backend {backend}" if backend else "running in several processes"
    require("joblib", "parallel", what, instead="leave out --jobs" if backend is None else "")
    if backend == "dask":
        require("distributed", "parallel", what)
    elif backend == "ray":
        require("ray", "parallel", what, also="ray")


def _surviving(
    function: Callable[[Any], Any], tasks: Sequence[Any], jobs: int
) -> Iterator[tuple[int, Any]]:
    """Run on processes of this machine; after a death, new processes run the remaining tasks."""
    from joblib.externals.loky import BrokenProcessPool

    open_ = set(range(len(tasks)))
    patience = _PATIENCE
    while open_:
        try:
            for index, result in _finished(function, tasks, sorted(open_), n_jobs=jobs):
                open_.discard(index)
                patience = _PATIENCE
                yield index, result
        except BrokenProcessPool as error:
            patience -= 1
            if not patience:
                left = ", ".join(str(tasks[index]) for index in sorted(open_)[:jobs])
                raise ChildProcessError(
                    f"workers died {_PATIENCE} times in a row with {len(open_)} tasks left, "
                    f"among them {left:.300}: if memory ran out, use fewer processes"
                ) from error


def _finished(
    function: Callable[[Any], Any], tasks: Sequence[Any], indices: list[int], **options: Any
) -> Iterator[tuple[int, Any]]:
    joblib: Any = import_module("joblib")
    # One task at a time, so that finished results are returned at once.
    parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, **options)
    found = parallel(joblib.delayed(_indexed)(function, index, tasks[index]) for index in indices)
    with contextlib.closing(found):
        yield from found


def _indexed(function: Callable[[Any], Any], index: int, task: Any) -> tuple[int, Any]:
    return index, function(task)


def _dask(
    function: Callable[[Any], Any], tasks: Sequence[Any], jobs: int, address: str | None
) -> Iterator[tuple[int, Any]]:
    """Run on a dask cluster, which itself reassigns the tasks of a dead worker."""
    joblib: Any = import_module("joblib")
    distributed: Any = import_module("distributed")
    with contextlib.ExitStack() as stack:
        if address is None:
            address = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=jobs, threads_per_worker=1, dashboard_address=None
                )
            )
        client = stack.enter_context(distributed.Client(address))
        stack.enter_context(joblib.parallel_config(backend="dask", client=client))
        try:
            yield from _finished(function, tasks, list(range(len(tasks))), n_jobs=-1)
        except distributed.KilledWorker as error:
            raise ChildProcessError(
                f"workers died repeatedly: if memory ran out, use fewer workers ({error})"
            ) from error


def _ray(
    function: Callable[[Any], Any], tasks: Sequence[Any], jobs: int, address: str | None
) -> Iterator[tuple[int, Any]]:
    """Run on a ray cluster; its joblib backend returns lists, so tasks are sent in batches."""
    joblib: Any = import_module("joblib")
    ray: Any = import_module("ray")
    ray_joblib: Any = import_module("ray.util.joblib")
    options: dict[str, Any] = {"num_cpus": jobs} if address is None else {"address": address}
    with ray.init(ignore_reinit_error=True, log_to_driver=False, **options):
        ray_joblib.register_ray()
        workers = max(1, int(ray.cluster_resources().get("CPU", jobs)))
        with joblib.parallel_config(backend="ray", n_jobs=workers):
            for start in range(0, len(tasks), 2 * workers):
                part = range(start, min(start + 2 * workers, len(tasks)))
                yield from joblib.Parallel(batch_size=1)(
                    joblib.delayed(_indexed)(function, index, tasks[index]) for index in part
                )
