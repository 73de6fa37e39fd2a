"""Groups of cases in processes of their own, several at a time."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from sst_graph.errors import SstGraphError, count_of
from sst_graph.experiments.paper.config import PaperTableConfig
from sst_graph.experiments.paper.runs import Case, Run, runs_of


def run_groups(groups: Sequence[Sequence[Case]], config: PaperTableConfig) -> Iterator[tuple[Case, Run]]:
    """All runs as they are done: in this process for one job, else each group in a process of its own.

    A process that ends before its time costs the rest of its group.

    Raises:
        SstGraphError: a drive cannot be used; or, after all others are done, a process ended.
    """
    if config.jobs == 1:
        for group in groups:
            yield from zip(group, runs_of(group, config), strict=True)
        return
    waiting, ended = list(groups), list[_Worker]()
    working: dict[Connection, _Worker] = {}
    try:
        while True:
            while waiting and len(working) < config.jobs:
                worker = _Worker(waiting.pop(0), config)
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
                if isinstance(message, str):
                    raise SstGraphError(message)
                yield worker.next_case(), message
    finally:
        for worker in working.values():
            worker.end()
    if ended:
        first = ended[0]
        raise SstGraphError(
            f"{first.group[0].drive.name}: its process ended ({first.ending}) with {first.missing} of "
            f"{count_of(len(first.group), 'run')} left; what is done is kept with --out, the same "
            "command does the rest"
        )


class _Worker:
    """A process and the group that it works on.

    Attributes:
        results: where its runs come from.
        group: its cases; the runs come in their order.
    """

    def __init__(self, group: Sequence[Case], config: PaperTableConfig) -> None:
        context = get_context("spawn")
        self.group, self._done = group, 0
        self.results, sender = context.Pipe(duplex=False)
        arguments = (sender, group, config)
        self._process: BaseProcess = context.Process(target=_work, args=arguments, daemon=True)
        self._process.start()
        sender.close()

    def next_case(self) -> Case:
        """The case of the run that came."""
        self._done += 1
        return self.group[self._done - 1]

    @property
    def missing(self) -> int:
        """Runs that have not come."""
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


def _work(results: Connection, group: Sequence[Case], config: PaperTableConfig) -> None:
    """What a process does: send each run, or the sentence of an error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is the parent's
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        for run in runs_of(group, config):
            results.send(run)
    except SstGraphError as error:
        results.send(str(error))


def _end_with_parent() -> None:
    """End this process when its parent has ended, whatever ended it."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
