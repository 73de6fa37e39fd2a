"""A tracker on disk: one npz file, written whole or not at all, arrays and JSON only."""

from __future__ import annotations

import io
import json
import zlib
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from sst_graph.errors import DataError
from sst_graph.estimators.incremental import Tracker
from sst_graph.estimators.resume import Setup, check_setup
from sst_graph.files import atomic_write_bytes
from sst_graph.storage import restored, stored

FORMAT = "sst-graph/tracker"
VERSION = 14
"""Goes up whenever what a tracker holds changes: a checkpoint is for the version that wrote it."""


def save_checkpoint(tracker: Tracker, path: str | Path) -> None:
    """Write a tracker; a file that exists is replaced in one step.

    The tracker is consolidated first (:meth:`Tracker.consolidate`), so that it and the one that is read back
    go on to the same estimates.

    Raises:
        OSError: it cannot be written; what stood there is untouched.
    """
    tracker.consolidate()
    node, data = stored(tracker)
    head = json.dumps({"format": FORMAT, "version": VERSION, "tracker": node})
    stream = io.BytesIO()
    np.savez(stream, head=np.frombuffer(head.encode(), np.uint8), data=np.frombuffer(data, np.uint8))
    atomic_write_bytes(path, stream.getvalue())


def load_checkpoint(path: str | Path, setup: Setup | None = None) -> Tracker:
    """The tracker in a checkpoint, at the estimate it was saved with.

    Whether it goes on with the drive that it was saved on, :func:`sst_graph.estimators.resume.frames_to_come`
    tells.

    Args:
        setup: camera, settings and guess that it must have been made with; None for any.

    Raises:
        DataError: no such file, not a checkpoint of this version, or of a tracker that was made with another
            camera, other settings or another guess.
    """
    try:
        with np.load(Path(path), allow_pickle=False) as file:
            head, data = json.loads(bytes(file["head"])), bytes(file["data"])
    except FileNotFoundError:
        raise DataError(path, "no such file", "a checkpoint of the tracker") from None
    except (OSError, ValueError, KeyError, EOFError, zlib.error, BadZipFile) as error:
        raise DataError(path, f"no readable checkpoint ({error})", "a checkpoint of the tracker") from error
    found = (head.get("format"), head.get("version")) if isinstance(head, dict) else (None, None)
    if found != (FORMAT, VERSION):
        raise DataError(path, f"{found[0]} version {found[1]}", f"{FORMAT} version {VERSION}")
    try:
        tracker = restored(head.get("tracker"), data)
    except (ValueError, RuntimeError) as error:
        raise DataError(path, f"an incomplete checkpoint ({error})", "all of a tracker") from error
    if not isinstance(tracker, Tracker):
        raise DataError(path, f"a checkpoint of a {type(tracker).__name__}", "all of a tracker")
    tracker.starting.catch_up()
    if setup is not None:
        check_setup(tracker, setup, path)
    return tracker
