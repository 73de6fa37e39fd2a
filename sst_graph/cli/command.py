"""One command from its arguments to its exit code."""

from __future__ import annotations

import errno
import importlib
import keyword
import logging
import os
import sys
import time
import traceback
from collections.abc import Sequence

from sst_graph.cli import (
    EXIT_BAD_INPUT,
    EXIT_DEFECT,
    EXIT_INTERRUPTED,
    EXIT_NOT_WRITTEN,
    EXIT_READER_GONE,
)
from sst_graph.cli.messages import StreamError, complain, flush, loading, loudness
from sst_graph.cli.options import build_parser
from sst_graph.errors import ConfigError, SstGraphError, printable

_LOG = logging.getLogger(__name__)
_LONGEST = 390
"""Characters of what was said elsewhere, or of a place that the system names."""


def run(argv: Sequence[str], own_process: bool = False, tells_apart: bool = False) -> int:
    """Run the command that ``argv`` names; its exit code (:func:`sst_graph.cli.main`).

    Args:
        own_process: its process runs nothing else, so that progress is shown in lines, too.
        tells_apart: what is no fault of the input has exit codes of its own (:mod:`sst_graph.cli.one_drive`).
    """
    not_written = EXIT_NOT_WRITTEN if tells_apart else EXIT_BAD_INPUT
    defect = EXIT_DEFECT if tells_apart else EXIT_BAD_INPUT
    try:
        code = _run(argv, own_process)
        flush()
        return code
    except StreamError as error:
        if error.reader_gone:
            # Whoever read the output has stopped: a message would reach nobody.
            return EXIT_READER_GONE
        return _failed(str(error), EXIT_BAD_INPUT)
    except BrokenPipeError:
        return EXIT_READER_GONE
    except KeyboardInterrupt:
        return _failed("interrupted", EXIT_INTERRUPTED)
    except OSError as error:
        return _failed(printable(_sentence(error), _LONGEST), not_written)
    except SstGraphError as error:
        # A setting that the system refuses is a place for the output.
        by_system = isinstance(error, ConfigError) and isinstance(error.__cause__, OSError)
        return _failed(str(error), not_written if by_system else EXIT_BAD_INPUT)
    except MemoryError as error:
        needed = f" ({' '.join(str(error).split())})" if str(error) else ""
        advice = "raise the limit of this process, or take fewer --frames"
        return _failed(printable(f"not enough memory{needed}: {advice}", _LONGEST), defect)
    except Exception as error:
        if not own_process:
            raise
        from sst_graph.data.source import loader_behind  # help and usage do without the readers

        _LOG.debug("where it was", exc_info=error)
        of_loader = loader_behind(error)
        if of_loader is not None:
            name, place = of_loader
            words = f"in the loader {name}: {_named(error)} ({place}; --verbose shows all)"
            return _failed(words, EXIT_BAD_INPUT)
        package = _imported_package(error)
        if package is not None:
            advice = "is it installed whole, and are the variables of the environment right?"
            return _failed(f"{package} does not load: {_named(error)}{_where(error)}: {advice}", defect)
        return _failed(_unexpected(error), defect)


def _named(error: Exception) -> str:
    """An exception by its type and text, on one line."""
    return printable(" ".join(f"{type(error).__name__}: {error}".split()), _LONGEST)


def _unexpected(error: Exception) -> str:
    """What nobody foresaw, on one line: a defect of this program."""
    return f"unexpected {_named(error)}{_where(error)} (a defect, please report it with what --verbose says)"


def _where(error: Exception) -> str:
    """The line that raised an exception, with ``at`` before it."""
    steps = traceback.extract_tb(error.__traceback__)
    return f" at {os.path.basename(steps[-1].filename)}:{steps[-1].lineno}" if steps else ""


def _imported_package(error: Exception) -> str | None:
    """The package of others whose import raised an exception; None where no such import was under way."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if frame.f_code.co_name == "<module>" and package not in ("sst_graph", "factors"):
            return package
    return None


def _run(argv: Sequence[str], own_process: bool) -> int:
    for argument in argv:
        if "\0" in argument:
            raise ConfigError(f"argument {argument!r:.60}: found a NUL character, expected none")
    args = build_parser().parse_args(argv)
    loudness.quiet, loudness.lines = args.quiet, own_process
    loudness.began_s = time.monotonic() if own_process else None
    _set_up_logging(args.verbose)
    name = f"{args.command}_" if keyword.iskeyword(args.command) else args.command
    with loading(args.command):
        command = importlib.import_module(f"sst_graph.cli.commands.{name}")
    code: int = command.run(args)
    return code


def _failed(message: str, code: int) -> int:
    complain(f"error: {message}")
    return code


def _sentence(error: OSError) -> str:
    """Where it happened, and what."""
    if error.errno is None:
        return str(error)
    what = error.strerror or os.strerror(error.errno)
    place = error.filename if error.filename is not None else _place_without_name(error)
    if isinstance(place, bytes):
        place = os.fsdecode(place)
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    advice = " (free some space, or name another place)" if full else ""
    return f"{place}: {what}{advice}"


def _place_without_name(error: OSError) -> str:
    """What an error without a file's name may be about."""
    if error.errno == errno.ENOENT:
        try:
            os.getcwd()
        except FileNotFoundError:
            return "the working directory (was it removed?)"
    return "the operating system"


def _set_up_logging(verbose: bool) -> None:
    level = logging.DEBUG if verbose else logging.WARNING
    # A message that cannot be logged is no reason for a traceback.
    logging.raiseExceptions = False
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", force=True)
    logging.getLogger("sst_graph").setLevel(level)
    if sys.stderr is not None:
        logging.captureWarnings(True)
