"""The command ``sst-graph``: one module a command, imported when it is called."""

from __future__ import annotations

import importlib
import logging
import os
import sys
from collections.abc import Sequence

from sst_graph.cli.options import build_parser
from sst_graph.errors import SstGraphError

EXIT_OK = 0
EXIT_BAD_INPUT = 2
EXIT_NOT_TRUSTED = 3
EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``sst-graph`` with ``argv`` (default: the process's arguments) and return its exit code.

    0: done. 2: bad input or usage, one line on stderr. 3: finished, but the result is not to be trusted.
    """
    try:
        args = build_parser().parse_args(argv)
        _set_up_logging(args.verbose)
        command = importlib.import_module(f"sst_graph.cli.{args.command}")
        code: int = command.run(args)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of our output is gone: nothing can be said, and nothing should be at shutdown.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        return _complain("interrupted", EXIT_INTERRUPTED)
    except (SstGraphError, OSError) as error:
        return _complain(str(error), EXIT_BAD_INPUT)


def _complain(message: str, code: int) -> int:
    """One line on stderr, whatever the message holds."""
    print("sst-graph: error: " + " ".join(message.split()), file=sys.stderr)
    return code


def _set_up_logging(verbose: bool) -> None:
    level = logging.DEBUG if verbose else logging.WARNING
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", force=True)
    for name in ("sst_graph", "factors"):
        logging.getLogger(name).setLevel(level)
