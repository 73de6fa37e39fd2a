"""The processes of a batch's drives end with the batch itself."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sst_graph.cli.messages import complain
from sst_graph.fleet import Place
from sst_graph.fleet.attempt import remove_unfinished
from sst_graph.fleet.isolated import end_all


@contextmanager
def children_ended(out: Place) -> Iterator[None]:
    """What ends this process ends those of its drives first, and removes what they left unfinished in the
    batch's folder; so does an error."""
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}

    def end(number: int, frame: FrameType | None) -> None:
        for one in former:
            signal.signal(one, signal.SIG_IGN)
        complain("ending the drives that run; the same command goes on from here")
        end_all()
        remove_unfinished(out)
        before = former[signal.Signals(number)]
        if callable(before):
            before(number, frame)
        raise KeyboardInterrupt

    in_main = threading.current_thread() is threading.main_thread()
    for number, before in former.items():
        if in_main and before is not signal.SIG_IGN:
            signal.signal(number, end)
    try:
        yield
    except BaseException:
        end_all()
        remove_unfinished(out)
        raise
    finally:
        for number, before in former.items():
            if in_main and before is not None:
                signal.signal(number, before)
