"""Groups of tasks in processes of their own, several at a time."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, TypeVar

from sst_graph.errors import EstimationError, SstGraphError, count_of

T = TypeVar("T")
R = TypeVar("R")

Run = Callable[[Sequence[T]], Iterator[R]]
"""What is done with a group: the result of each of its tasks in turn. A function of a module or a partial."""


def run_groups(run: Run[T, R], groups: Sequence[Sequence[T]], jobs: int) -> Iterator[tuple[T, R]]:
    """All results as they are done: in this process for one job, else each group in a process of its own.

    A process that ends before its time costs the rest of its group.

    Raises:
        SstGraphError: as ``run``.
        EstimationError: after all others are done, a process ended.
    """
    if jobs == 1:
        for group in groups:
            yield from zip(group, run(group), strict=True)
        return
    waiting, ended = list(groups), list[_Worker[T, R]]()
    working: dict[Connection, _Worker[T, R]] = {}
    try:
        while True:
            while waiting and len(working) < jobs:
                worker = _Worker(run, waiting.pop(0))
                working[worker.results] = worker
            if not working:
                break
            for ready in wait(list(working)):
                worker = working[ready]  # type: ignore[index]
                try:
                    message = worker.results.recv()
                except EOFError:
                    worker.wait()
                    del working[worker.results]
                    if worker.missing:
                        ended.append(worker)
                    continue
                if isinstance(message, SstGraphError):
                    raise message
                yield worker.next_task(), message
    finally:
        for worker in working.values():
            worker.end()
    if ended:
        first = ended[0]
        raise EstimationError(
            f"{first.group[0]!s:.100}: its process ended ({first.ending}) with {first.missing} of "
            f"{count_of(len(first.group), 'run')} left; with records kept, the same command does the rest"
        )


class _Worker(Generic[T, R]):
    """A process and the group that it works on.

    Attributes:
        results: where they come from.
        group: its tasks; the results come in their order.
    """

    def __init__(self, run: Run[T, R], group: Sequence[T]) -> None:
        context = get_context("spawn")
        self.group, self._done = group, 0
        self.results, sender = context.Pipe(duplex=False)
        arguments = (sender, run, group)
        self._process: BaseProcess = context.Process(target=_work, args=arguments, daemon=True)
        self._process.start()
        sender.close()

    def next_task(self) -> T:
        """The task of the result that came."""
        self._done += 1
        return self.group[self._done - 1]

    @property
    def missing(self) -> int:
        """Results that have not come."""
        return len(self.group) - self._done

    @property
    def ending(self) -> str:
        """How the process ended, in words."""
        code = self._process.exitcode or 0
        return f"signal {-code}" if code < 0 else f"exit code {code}"

    def wait(self) -> None:
        """Until the process has ended, which has closed its side."""
        self._process.join()
        self.results.close()

    def end(self) -> None:
        """End the process."""
        self._process.terminate()
        self.wait()


def _work(results: Connection, run: Run[T, R], group: Sequence[T]) -> None:
    """What a process does: send each result, or an error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is the parent's
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        for result in run(group):
            results.send(result)
    except SstGraphError as error:
        results.send(error)


def _end_with_parent() -> None:
    """End this process when its parent has ended, whatever ended it."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
