"""The command ``sst-graph``: one module a command, imported when it is called.

This module imports next to nothing, so that a signal finds its handler from the first milliseconds on.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

EXIT_BAD_INPUT = 2
EXIT_NOT_TRUSTED = 3
EXIT_INTERRUPTED = 130
EXIT_READER_GONE = 141
EXIT_DEFECT = 70
EXIT_NOT_WRITTEN = 74
"""Of :mod:`sst_graph.cli.one_drive` alone, which tells data that are refused from what is no fault of theirs;
for people both are EXIT_BAD_INPUT."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``sst-graph`` with ``argv`` and return its exit code.

    Without ``argv`` it is the process's own command: the arguments are the process's, signals end it without
    a trace, its streams are made safe, and its arithmetic is that of one thread. With ``argv`` nothing of
    the process is touched.

    0: done. 2: bad input or usage, or an output that could not be written, one line on stderr. 3: finished,
    but the result is not to be trusted. 130, 143, 129: ended by Ctrl-C, SIGTERM, SIGHUP. 141: the
    reader of stdout has gone.
    """
    if argv is not None:
        from sst_graph.cli.command import run

        return run(argv)
    from sst_graph.cli.process import own_process

    with own_process() as arguments:
        from sst_graph.cli.command import run

        return run(arguments, own_process=True)
