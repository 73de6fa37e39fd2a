"""A tracker on disk: one npz file, written whole or not at all, arrays and JSON only.

On reading, the checksum and the classes of the objects are checked, and the tracker must give its estimate; a
file that fails any check is refused as a whole.
"""

from __future__ import annotations

import dataclasses
import gc
import hashlib
import importlib
import io
import json
import pkgutil
import re
import warnings
import zipfile
import zlib
from collections.abc import Container, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np

from sst_graph.errors import CheckpointError, DataError
from sst_graph.files import atomic_write_in_steps
from sst_graph.files.checked_values import checked_camera
from sst_graph.files.object_store import (
    Block,
    Blocks,
    Node,
    attribute_node,
    class_name,
    lay_out,
    restored,
    stored,
)
from sst_graph.files.reading import FileKind, parse_json, path_of, read_file
from sst_graph.odometry.sweep import SweepDecision
from sst_graph.tracker.storage.resume import Setup, check_inputs, check_setup
from sst_graph.tracker.track_update import current_update
from sst_graph.types import NO_PICTURE, CameraImage

if TYPE_CHECKING:
    from sst_graph.tracker.tracker import Tracker

FORMAT = "sst-graph/tracker"
VERSION = 36
"""Goes up whenever what a tracker holds changes: a checkpoint is for the version that wrote it."""

CHECKPOINT = FileKind("a checkpoint of the tracker", 512 * 1024 * 1024)

_NPY_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '\|u1', 'fortran_order': False, 'shape': \((\d{1,15}),\), \} *\n",
    re.DOTALL,
)
"""How NumPy begins the file of an array of bytes; its own reader evaluates more than that."""

_MEMBERS = ("head", "data", "sha256")
_STEP_BYTES = 8 * 1024 * 1024
"""Are summed up, or written, in a step: some milliseconds."""
_MAX_DEPTH = 200
"""Levels of a checkpoint's JSON; a tracker's has about forty."""

_PACKAGES = (
    "sst_graph.association",
    "sst_graph.assumptions",
    "sst_graph.baselines",
    "sst_graph.batch",
    "sst_graph.covariance",
    "sst_graph.drive",
    "sst_graph.factors",
    "sst_graph.features",
    "sst_graph.graph",
    "sst_graph.hand_eye",
    "sst_graph.initialization",
    "sst_graph.inspect",
    "sst_graph.objects",
    "sst_graph.odometry",
    "sst_graph.result",
    "sst_graph.sweep_timing",
    "sst_graph.tracker",
    "sst_graph.types",
)
"""Where the classes are defined that a tracker is made of."""
_TRACKER = "sst_graph.tracker.tracker:Tracker"


class Saver:
    """Saves one tracker under one name, so that no frame takes long for it.

    ``saver.follow(tracker)`` goes before each frame, ``saver.save(tracker)`` behind one that is to be saved.
    What a tracker keeps of a scan, an image or a pair never changes: it is stored once, with the frame after
    the one that brought it. A save consolidates the tracker; before the next frame the rest of it is stored,
    and then the file is written, some with each frame. It takes its name in one step, so that a kill at any
    moment leaves the former one whole, or the new one.

    As a context it finishes where the block ends well, and leaves the former file where it does not.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = path_of(path, "a checkpoint")
        self._blocks = Blocks(checkpoint_classes())
        self._saved: Tracker | None = None
        self._writing: Generator[None] | None = None

    def __enter__(self) -> Saver:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.finish()
        elif self._writing is not None:
            self._writing.close()

    def follow(self, tracker: Tracker) -> None:
        """Store what the last frame brought, and the rest of a tracker that was saved, or write some of it.

        Raises:
            OSError: it cannot be written; what stood there is untouched.
        """
        for value in _immutable_parts(tracker):
            self._blocks.number(value)
        if self._saved is not None:
            self._store()
        elif self._writing is not None:
            next(self._writing, None)

    def save(self, tracker: Tracker) -> None:
        """Save a tracker as it is; the file is there after :meth:`finish`, or some frames later.

        The tracker is consolidated (:func:`consolidate`), so that it and the one that is read back go
        on to the same estimates. It may change after the next :meth:`follow`, not before.

        Raises:
            OSError: an earlier one cannot be written; what stood there is untouched.
        """
        self.finish()
        consolidate(tracker, self._blocks)
        self._saved = tracker

    def _store(self) -> None:
        """Store the tracker that was saved; a large file is still to be written."""
        with _without_gc():
            node, rest, blocks = self._blocks.stored(self._saved)
        self._saved = None
        self._writing = atomic_write_in_steps(self._path, partial(_write_in_steps, node, rest, blocks))
        if len(rest) + sum(len(block.data) for block in blocks) < _STEP_BYTES:
            self.finish()

    def finish(self) -> None:
        """Write all that is left to write.

        Raises:
            OSError: it cannot be written; what stood there is untouched.
        """
        if self._saved is not None:
            self._store()
        for _ in self._writing or ():
            pass


def consolidate(tracker: Tracker, laid_out: Container[int] = ()) -> None:
    """Build iSAM2 and the odometry's map again from what a checkpoint holds.

    The estimate stays; from here on this tracker and one loaded from a checkpoint of it go on alike.

    Args:
        laid_out: ids of values that have their memory layout already.
    """
    lay_out(tracker, laid_out)
    tracker.inputs.odometry.rebuild_map()
    if tracker.estimate.smoother is not None:
        tracker.estimate.smoother.relinearize()


def _immutable_parts(tracker: Tracker) -> Iterator[object]:
    """The immutable parts of a tracker, which are most of it."""
    yield from (features for _, features in tracker.inputs.window.scans)
    yield from tracker.inputs.window.images
    if tracker.estimate.smoother is not None:
        yield from tracker.estimate.smoother.entries.values()


@contextmanager
def _without_gc() -> Iterator[None]:
    """Without Python's search for circular garbage: so many lists at once would set it off for nothing."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _write_in_steps(node: Node, rest: bytes, blocks: Sequence[Block], stream: BinaryIO) -> Iterator[None]:
    """Write a tracker as :func:`numpy.savez` does, with its checksum, some with each step."""
    # 1. JSON, the blocks' as it is there already, and all bytes.
    yield
    head, parts = _head(node, len(rest), blocks), [rest, *(block.data for block in blocks)]
    yield
    # 2. The checksum of both.
    digest = hashlib.sha256(len(head).to_bytes(8, "little"))
    for portion in _portions([head, *parts]):
        for part in portion:
            digest.update(part)
        yield
    # 3. The file.
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in zip(_MEMBERS, ([head], parts, [digest.digest()]), strict=True):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                array = {"descr": "|u1", "fortran_order": False, "shape": (sum(map(len, content)),)}
                np.lib.format.write_array_header_1_0(member, array)
                for portion in _portions(content):
                    member.writelines(portion)
                    yield


def _head(node: Node, start: int, blocks: Sequence[Block]) -> bytes:
    """All JSON of a checkpoint; the blocks' bytes begin at ``start``."""
    records = []
    for block in blocks:
        records.append(f"[{block.number}, {start}, {len(block.data)}, {block.text}]")
        start += len(block.data)
    text = json.dumps({"format": FORMAT, "version": VERSION, "tracker": node}, allow_nan=False)
    return f'{text[:-1]}, "blocks": [{", ".join(records)}]}}'.encode("ascii")


def _portions(parts: Sequence[bytes]) -> Iterator[list[bytes]]:
    """The parts, in order, some megabytes at a time."""
    portion: list[bytes] = []
    for part in parts:
        portion.append(part)
        if sum(map(len, portion)) >= _STEP_BYTES:
            yield portion
            portion = []
    yield portion


def load_checkpoint(
    path: str | Path, setup: Setup | None = None, sweep: SweepDecision | None = None
) -> Tracker:
    """The tracker in a checkpoint, at the estimate it was saved with.

    :func:`sst_graph.tracker.storage.resume.frames_to_come` checks that it goes on with its own drive.

    Args:
        setup: camera, settings and guess that it must have been made with; None for any.
        sweep: what was decided of the sweep of the scans to come; None: what the checkpoint says.

    Raises:
        CheckpointError: no such file, not a checkpoint of this version, or one that was changed or damaged.
        DataError: one of a tracker that was made with another camera, other settings or another guess.
    """
    document, data = _read(path)
    # Numbers of a forged file overflow where those of a tracker do not: no warning of NumPy's is ours.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _check_tracker(_tracker(document, data, path), path)
        tracker = _tracker(document, data, path)
        _catch_up(tracker)
    if setup is not None:
        check_setup(tracker, setup, path)
    if sweep is not None:
        tracker.estimate.sweep = sweep
    return tracker


def checkpoint_setup(path: str | Path) -> Setup:
    """Camera, settings and guess of the tracker in a checkpoint; nothing else of it is restored.

    Raises:
        CheckpointError: as :func:`load_checkpoint`.
    """
    document, data = _read(path)
    try:
        setup = restored(attribute_node(document.get("tracker"), "setup"), data, checkpoint_classes())
    except ValueError as error:
        raise CheckpointError(path, f"an incomplete checkpoint ({error})", "all of a tracker") from error
    if not isinstance(setup, Setup):
        raise CheckpointError(
            path, f"a checkpoint with a setup of {type(setup).__name__}", "all of a tracker"
        )
    return setup


def _read(path: str | Path) -> tuple[dict[str, Any], memoryview]:
    """Document and bytes of a checkpoint of this version.

    Raises:
        CheckpointError: no such file, or another one.
    """
    try:
        path = path_of(path, CHECKPOINT.name)
        head, data = _members(read_file(path, CHECKPOINT), path)
        document = parse_json(head, path, CHECKPOINT.name, max_depth=_MAX_DEPTH)
    except CheckpointError:
        raise
    except DataError as error:
        raise CheckpointError(error.place, error.found, error.expected) from None
    found = (document.get("format"), document.get("version")) if isinstance(document, dict) else (None, None)
    if found != (FORMAT, VERSION):
        raise CheckpointError(
            path, f"{found[0]!r:.60} version {found[1]!r:.60}", f"{FORMAT} version {VERSION}"
        )
    assert isinstance(document, dict)
    return document, data


def _tracker(document: dict[str, Any], data: memoryview, path: str | Path) -> Tracker:
    try:
        blocks = document.get("blocks", [])
        tracker = restored(document.get("tracker"), data, checkpoint_classes(), blocks)
    except ValueError as error:
        raise CheckpointError(path, f"an incomplete checkpoint ({error})", "all of a tracker") from error
    if not isinstance(tracker, checkpoint_classes()[_TRACKER]):
        raise CheckpointError(path, f"a checkpoint of a {type(tracker).__name__}", "all of a tracker")
    return cast("Tracker", tracker)


def _check_tracker(tracker: Tracker, path: str | Path) -> None:
    """Require a tracker that gives its estimate and its result, and accepts its last frame once more: its
    parts are consistent.

    Raises:
        CheckpointError: it does not, whatever it raises; a file may hold any contradiction.
    """
    try:
        checked_camera(tracker.inputs.camera, "camera")
        check_inputs(tracker)
        _catch_up(tracker)
        current_update(tracker, tracker.last_update).to_dict()
        consolidate(tracker)
        _repeat_last_frame(tracker)
        current_update(tracker).to_dict()
        tracker.result().to_json()
        stored(tracker)
    except Exception as error:
        found = f"a tracker that gives no estimate ({type(error).__name__}: {error})"
        raise CheckpointError(path, found, "all of a tracker") from error


def _catch_up(tracker: Tracker) -> None:
    """Repeat the work that a stored search, or a stored review, had done."""
    edges = tracker.estimate.edges
    for under_way in (tracker.initializer.search, None if edges is None else edges.review):
        if under_way is not None:
            under_way.catch_up()


def _repeat_last_frame(tracker: Tracker) -> None:
    """The last frame once more, a second later."""
    scan, images = tracker.inputs.last_scan, tracker.inputs.window.images
    stamps = [one.stamp_ns for one in (scan, *images) if one is not None]
    if not stamps:
        return
    later = max(stamps) + 1_000_000_000
    if images:
        tracker.add_image(CameraImage(later, images[-1].mask, NO_PICTURE))
    if scan is not None:
        tracker.add_scan(dataclasses.replace(scan, stamp_ns=later))


@cache
def checkpoint_classes() -> dict[str, type]:
    """Classes and enumerations that a checkpoint may name."""
    modules = []
    for package in map(importlib.import_module, _PACKAGES):
        modules.append(package)
        found = pkgutil.walk_packages(getattr(package, "__path__", ()), f"{package.__name__}.")
        modules += [importlib.import_module(info.name) for info in found]
    return {
        class_name(cls): cls
        for module in modules
        for cls in vars(module).values()
        if isinstance(cls, type) and cls.__module__ == module.__name__ and not issubclass(cls, Exception)
    }


def _members(archive: bytes, path: str | Path) -> tuple[str, memoryview]:
    """JSON and bytes of an npz file whose members are stored as they are, and have their checksum.

    Nothing is unpacked: a member's declared shape is compared with the bytes that are there.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as file:
            names = [f"{name}.npy" for name in _MEMBERS]
            if file.namelist() != names:
                raise ValueError(f"members {file.namelist()!r:.100}")
            head, data, digest = (_bytes_of(file, name, len(archive)) for name in names)
            text = bytes(head).decode("ascii")
    except (zipfile.BadZipFile, zlib.error, ArithmeticError, LookupError, OSError, RuntimeError) as error:
        raise _unreadable(path, error) from error
    except (EOFError, MemoryError, ValueError) as error:
        raise _unreadable(path, error) from error
    if _digest(head, data) != bytes(digest):
        raise CheckpointError(path, "no readable checkpoint (another checksum)", "one as it was written")
    return text, data


def _bytes_of(file: zipfile.ZipFile, name: str, most: int) -> memoryview:
    info = file.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1 or info.file_size > most:
        raise ValueError(f"{name} compressed, encrypted or larger than the file")
    content = file.read(info)
    header = _NPY_HEADER.match(content)
    if header is None or int(header[1]) != len(content) - header.end():
        raise ValueError(f"{name} that is no array of as many bytes as it says")
    return memoryview(content)[header.end() :]


def _digest(head: bytes | memoryview, data: bytes | memoryview) -> bytes:
    """SHA-256 of both: a damaged or edited checkpoint has another."""
    sum_ = hashlib.sha256(len(head).to_bytes(8, "little"))
    sum_.update(head)
    sum_.update(data)
    return sum_.digest()


def _unreadable(path: str | Path, error: Exception) -> CheckpointError:
    found = f"no readable checkpoint ({type(error).__name__}: {error})"
    return CheckpointError(path, found, CHECKPOINT.name)
