"""Drives on a cluster of dask.distributed (extra ``dask``): the same work on other machines.

A task runs one drive as the local pool does, in a process of its own below the Dask worker. Where a worker is
lost, the scheduler repeats its task elsewhere; a result that is whole by then is taken as it is. What the
scheduler gives up (by default after four lost workers) is given to it again, the last time by itself, when
all else is done: a lost worker counts against every task that waits on it.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any

from sst_graph.errors import ConfigError, count_of, one_line, optional_module
from sst_graph.fleet.attempt import Job
from sst_graph.fleet.record import Record

LOCAL = "local"
"""In the place of an address: a cluster on this machine, started for the batch."""
_PATIENCE_S, _FETCH_S, _CONNECT_S = 0.5, 2.0, 20.0
_WITHOUT_WORKERS_S = 10.0
"""A local cluster without any worker for this long gets new ones: a nanny gives up a worker that is killed
while it starts."""
_MOST_ROUNDS = 3
"""How often a drive is given to the scheduler, the last time with no other beside it; an end is needed where
all workers are killed for ever."""
_AHEAD = 4
"""Tasks at the scheduler for each that can run: enough that none waits, few enough for its memory."""


def run_on_dask(
    jobs: Iterable[Job], address: str, workers: int, run: Callable[[Job], Record]
) -> Iterator[Record | None]:
    """The records of all jobs, as they are done; None now and then while there is none.

    Args:
        address: of the cluster's scheduler, such as tcp://host:8786, or :data:`LOCAL`.
        workers: of a local cluster.

    Raises:
        ConfigError: no scheduler answers, or it is lost.
        MissingDependencyError: dask.distributed is not installed.
    """
    distributed = optional_module("distributed", "--dask needs dask.distributed", "dask")
    with _client(distributed, address, workers) as client:
        waiting = iter(jobs)
        running: dict[Any, Job] = {}
        alone: deque[Job] = deque()
        rounds: Counter[str] = Counter()
        renewal = _Renewal(client.cluster if address == LOCAL else None, workers)

        def submit(job: Job) -> None:
            name = job.drive.name
            rounds[name] += 1
            running[client.submit(run, job, pure=False, key=f"sst-graph-{name}-{rounds[name]}")] = job

        while True:
            there = client.scheduler_info(n_workers=-1)["workers"].values()
            renewal.look(len(there))
            threads = sum(one["nthreads"] for one in there)
            for job in islice(waiting, max(_AHEAD * max(threads, 1) - len(running), 0)):
                submit(job)
            if not running and alone:
                submit(alone.popleft())
            if not running:
                return
            try:
                done = distributed.wait(
                    list(running), timeout=_PATIENCE_S, return_when="FIRST_COMPLETED"
                ).done
                outcomes = {future: _outcome(future) for future in done}
            except (TimeoutError, distributed.TimeoutError):
                yield None
                continue
            except CancelledError:
                raise ConfigError(
                    f"--dask {address}: lost the scheduler with "
                    f"{count_of(len(running), 'drive')} at it; "
                    "the same command goes on from here, on this one or another"
                ) from None
            for future, found in outcomes.items():
                if found is None:
                    continue
                job = running.pop(future)
                is_lost = isinstance(found, distributed.KilledWorker)
                if is_lost and rounds[job.drive.name] + 1 < _MOST_ROUNDS:
                    submit(job)
                elif is_lost and rounds[job.drive.name] < _MOST_ROUNDS:
                    alone.append(job)
                else:
                    del rounds[job.drive.name]
                    yield found if isinstance(found, Record) else _failure(job, found, is_lost)
                future.release()


def _outcome(future: Any) -> Record | BaseException | None:
    """What a task gave, or its error.

    None where there is nothing after all: a result is lost with the worker that holds it, and the scheduler
    makes it again, if need be on a worker that has yet to be started.

    Raises:
        CancelledError: the scheduler is lost.
    """
    try:
        record = future.result(timeout=_FETCH_S)
    except CancelledError:
        raise
    except TimeoutError as error:  # the task's own, or nothing has come
        return error if future.status == "error" else None
    except Exception as error:
        return error
    assert isinstance(record, Record)
    return record


def _failure(job: Job, error: BaseException, is_lost: bool) -> Record:
    """Why a task gave nothing: its workers were lost, or one could not run it."""
    name, place = job.drive.name, job.place
    if is_lost:
        return Record(
            name, place, "killed", f"its Dask workers were lost, all that it had: {one_line(error):.500}"
        )
    return Record(name, place, "crash", f"could not be run on its Dask worker: {one_line(error):.500}")


@contextmanager
def _client(distributed: Any, address: str, workers: int) -> Iterator[Any]:
    """A client of the scheduler; a local cluster is closed with it."""
    with ExitStack() as stack:
        try:
            place, patience = address, {"timeout": _CONNECT_S}
            if address == LOCAL:
                # Its scheduler and nannies run in this process: what they do every minute is no news here.
                logging.getLogger("distributed").setLevel(logging.WARNING)
                place, patience = (
                    distributed.LocalCluster(
                        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
                    ),
                    {},
                )
                stack.callback(place.close)
            client = stack.enter_context(distributed.Client(place, **patience))
        except (OSError, ValueError, TimeoutError) as error:
            raise ConfigError(f"--dask {address}: found no scheduler ({error})") from error
        yield client


class _Renewal:
    """New workers for a local cluster that has lost all of them."""

    def __init__(self, cluster: Any, workers: int) -> None:
        """cluster: None for one of others, which see to their workers themselves."""
        self._cluster, self._workers = cluster, workers
        self._last_seen = time.monotonic()

    def look(self, workers: int) -> None:
        """Tell how many workers there are now."""
        now = time.monotonic()
        if workers or self._cluster is None:
            self._last_seen = now
        elif now - self._last_seen > _WITHOUT_WORKERS_S:
            self._cluster.scale(0)
            self._cluster.scale(self._workers)
            self._last_seen = now
