"""One thread that runs the tasks of the page in order, and long work while it is idle."""

from __future__ import annotations

import functools
import threading
import traceback
from collections.abc import Callable, Iterator
from typing import Any, Concatenate, ParamSpec

P = ParamSpec("P")
Method = Callable[Concatenate[Any, P], None]
# Interval at which waiting threads check whether to stop, seconds.
_WAIT_S = 0.2


def in_order(key: object = None) -> Callable[[Method[P]], Method[P]]:
    """Make a method a task of the page's `_worker`: a call queues it and returns at once.

    `key` is that of `Worker.post`.
    """

    def decorate(method: Method[P]) -> Method[P]:
        @functools.wraps(method)
        def post(page: Any, *args: P.args, **kwargs: P.kwargs) -> None:
            page._worker.post(lambda: method(page, *args, **kwargs), key)

        return post

    return decorate


class Worker:
    """Runs tasks one after the other, and steps of long work in between.

    The callbacks of the page run in their own threads. They pass all tasks to one worker. The state
    then has a single writer and needs no lock. `failed` is called with the exception of a failed
    task; the worker continues.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._tasks: dict[object, Callable[[], object]] = {}
        self._idle: Iterator[Any] | None = None
        self._busy = False
        self._stopped = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)
        self._thread.start()

    def post(self, task: Callable[[], object], key: object = None) -> None:
        """Queue a task.

        A waiting task with the same key is dropped, so that only the last one runs.
        """
        with self._changed:
            self._tasks.pop(key, None)
            self._tasks[object() if key is None else key] = task
            self._changed.notify_all()

    def when_idle(self, steps: Iterator[Any] | None) -> None:
        """Replace the long work; its steps run while no task waits."""
        with self._changed:
            self._idle = steps
            self._changed.notify_all()

    def settle(self, timeout: float = 60.0) -> bool:
        """Wait until all work is done; return whether this was within the time limit."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._tasks and self._idle is None and not self._busy, timeout
            )

    def stop(self) -> None:
        """Finish the waiting tasks, drop long work, and stop."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not (self._tasks or self._idle is not None or self._stopped):
                    self._changed.wait(_WAIT_S)
                if self._tasks:
                    task, steps = self._tasks.pop(next(iter(self._tasks))), None
                elif self._stopped:
                    return
                else:
                    task, steps = None, self._idle
                self._busy = True
            try:
                if task is not None:
                    task()
                elif steps is not None:
                    self._step(steps)
            except Exception as error:
                if steps is not None:
                    self._leave(steps)
                self._tell(error)
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _step(self, steps: Iterator[Any]) -> None:
        try:
            next(steps)
        except StopIteration:
            self._leave(steps)

    def _leave(self, steps: Iterator[Any]) -> None:
        with self._changed:
            if self._idle is steps:
                self._idle = None

    def _tell(self, error: Exception) -> None:
        try:
            self._failed(error)
        except Exception:  # the page may be gone
            traceback.print_exc()
