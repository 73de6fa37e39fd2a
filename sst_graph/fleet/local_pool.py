"""Several drives at a time on this machine: a thread each, and below it a process (:mod:`isolated`)."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator

from sst_graph.fleet.attempt import Job
from sst_graph.fleet.record import Record


def run_locally(jobs: Iterable[Job], workers: int, run: Callable[[Job], Record]) -> Iterator[Record | None]:
    """The records of all jobs, as they are done.

    Yields None now and then while there is none, so that progress can be shown. The caller's thread does no
    work of its own: a signal finds it within half a second.

    Args:
        workers: how many at a time.
        run: what is done for a job; it does not raise.
    """
    waiting, done = iter(jobs), queue.SimpleQueue[Record | BaseException | None]()
    lock, stopped = threading.Lock(), threading.Event()

    def work() -> None:
        try:
            while not stopped.is_set():
                with lock:
                    job = next(waiting, None)
                if job is None:
                    return
                done.put(run(job))
        except BaseException as error:  # raised again where the records are read
            done.put(error)
        finally:
            done.put(None)

    threads = [threading.Thread(target=work, daemon=True) for _ in range(max(1, workers))]
    for thread in threads:
        thread.start()
    alive = len(threads)
    try:
        while alive:
            try:
                record = done.get(timeout=_PATIENCE_S)
            except queue.Empty:
                yield None
                continue
            if isinstance(record, BaseException):
                raise record
            if record is None:
                alive -= 1
            else:
                yield record
    finally:
        stopped.set()


_PATIENCE_S = 0.5
