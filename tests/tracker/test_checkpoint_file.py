"""The file of a checkpoint: what is damaged, forged or a bomb is refused as a whole."""

from __future__ import annotations

import hashlib
import io
import json
import os
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sst_graph import Tracker
from sst_graph.errors import CheckpointError
from sst_graph.files.object_store import stored
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.tracker.storage import checkpoint
from sst_graph.tracker.storage.checkpoint import Saver

SMALL = SimulationConfig(seed=5, frames=3, width=160, height=48, azimuth_step_deg=1.0, motion="no_stop")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    street = simulate(SMALL)
    tracker = Tracker(street.camera, None, street.nominal)
    for k in range(len(street)):
        tracker.add(street[k])
    path = tmp_path_factory.mktemp("checkpoint") / "tracker.npz"
    tracker.save(path)
    return path.read_bytes()


def parts_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    with np.load(io.BytesIO(data)) as file:
        return json.loads(bytes(file["head"])), bytes(file["data"])


def forged(document: Any, data: bytes, save: Callable[..., None] = np.savez) -> bytes:
    """An npz file of a checkpoint with the right checksum."""
    head = (document if isinstance(document, str) else json.dumps(document)).encode()
    digest = hashlib.sha256(len(head).to_bytes(8, "little") + head + data).digest()
    stream = io.BytesIO()
    parts = {"head": head, "data": data, "sha256": digest}
    save(stream, **{name: np.frombuffer(part, np.uint8) for name, part in parts.items()})
    return stream.getvalue()


def refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "tracker.npz"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=message) as caught:
        Tracker.load(path)
    assert str(caught.value).isprintable() and "tracker.npz" in str(caught.value)


def test_what_was_saved_is_read(tmp_path: Path, good: bytes) -> None:
    path = tmp_path / "tracker.npz"
    path.write_bytes(good)
    tracker = Tracker.load(path)
    assert tracker.inputs.window.next_scan == 3 and not tracker.estimate.exists
    path.write_bytes(forged(*parts_of(good)))
    assert Tracker.load(path).inputs.window.next_scan == 3


def test_a_save_is_written_with_the_frames_that_follow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The former file stands until the new one is whole; what is broken off leaves it, and nothing else."""
    street, path = simulate(SMALL), tmp_path / "tracker.npz"
    tracker = Tracker(street.camera, None, street.nominal)
    tracker.add(street[0])
    tracker.save(path)
    monkeypatch.setattr(checkpoint, "_STEP_BYTES", 100_000)  # such a small file is written at once
    former = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), Saver(path) as saver:
        tracker.add(street[1])
        saver.save(tracker)
        for _ in range(3):
            saver.follow(tracker)
        raise KeyboardInterrupt
    assert path.read_bytes() == former and list(tmp_path.iterdir()) == [path]
    with Saver(path) as saver:
        saver.save(tracker)
        saver.follow(tracker)
        tracker.add(street[2])
        saver.follow(tracker)
        assert path.read_bytes() == former
        saver.finish()
        assert Tracker.load(path).inputs.window.next_scan == 2
        saver.save(tracker)
    assert Tracker.load(path).inputs.window.next_scan == 3 and list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_what_is_saved_does_not_depend_on_when_it_was_stored(tmp_path: Path) -> None:
    """The same tracker, whether much or nothing was stored with earlier frames."""
    street, paths = simulate(SMALL), [tmp_path / name for name in ("followed", "at_once")]
    for path in paths:
        tracker = Tracker(street.camera, None, street.nominal)
        with Saver(path) as saver:
            for k in range(len(street)):
                if path.name == "followed":
                    saver.follow(tracker)
                tracker.add(street[k])
            saver.save(tracker)
    documents = [parts_of(path.read_bytes())[0] for path in paths]
    trackers = [Tracker.load(path) for path in paths]
    assert [len(document["blocks"]) for document in documents] == [len(documents[0]["blocks"])] * 2
    assert stored(trackers[0]) == stored(trackers[1])


@pytest.mark.parametrize("at", [0.01, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_one_bit_is_enough_to_refuse(tmp_path: Path, good: bytes, at: float) -> None:
    damaged = bytearray(good)
    damaged[int(at * len(good))] ^= 4
    refused(tmp_path, bytes(damaged), "no readable checkpoint")


def _npy(header: str) -> bytes:
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def _archive(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return stream.getvalue()


EMPTY = _npy("{'descr': '|u1', 'fortran_order': False, 'shape': (0,), }")
NAMES = ("head.npy", "data.npy", "sha256.npy")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x05\x06" + bytes(18),
        EMPTY,
        _archive({}),
        _archive(dict.fromkeys(NAMES, b"")),
        _archive(dict.fromkeys(NAMES, EMPTY)),
        _archive(dict.fromkeys(NAMES, EMPTY), zipfile.ZIP_DEFLATED),
        _archive(dict.fromkeys((*NAMES, "more.npy"), EMPTY)),
        _archive(
            dict.fromkeys(NAMES, _npy("{'descr': '|u1', 'fortran_order': False, 'shape': (10**13,), }"))
        ),
        _archive(
            dict.fromkeys(
                NAMES, _npy("{'descr': '|u1', 'fortran_order': False, 'shape': (10000000000000,), }")
            )
        ),
        _archive(
            dict.fromkeys(NAMES, _npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }") + bytes(8))
        ),
        _archive(dict.fromkeys(NAMES, _npy("__import__('os').system('true')"))),
        _archive(dict.fromkeys(NAMES, _npy("(" * 100))),
        # Stored members whose flags say that they are encrypted.
        _archive(dict.fromkeys(NAMES, EMPTY)).replace(
            b"PK\x01\x02\x14\x03\x14\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01"
        ),
    ],
)
def test_what_is_no_such_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    refused(tmp_path, content, "no readable checkpoint")


def test_an_archive_that_unpacks_to_more_takes_no_memory(tmp_path: Path) -> None:
    bomb = _npy("{'descr': '|u1', 'fortran_order': False, 'shape': (64000000,), }") + bytes(64_000_000)
    content = _archive(dict.fromkeys(NAMES[:1], bomb) | dict.fromkeys(NAMES[1:], EMPTY), zipfile.ZIP_DEFLATED)
    del bomb
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(tmp_path, content, "no readable checkpoint")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


def _nodes(node: Any, tag: str) -> list[Any]:
    """Nodes of a tag in a document, in order."""
    found = [node] if isinstance(node, list) and node and node[0] == tag else []
    return found + [one for part in (node if isinstance(node, list) else []) for one in _nodes(part, tag)]


def _attribute(node: Any, name: str) -> Any:
    """The [name, value] of an object's node."""
    return next(pair for pair in node[2][1] if pair[0] == name)


def _forget(node: Any, name: str) -> None:
    """Without an attribute of an object's node."""
    node[2][1].remove(_attribute(node, name))


def _inputs(tracker: Any) -> Any:
    """The node of a tracker's inputs."""
    return _attribute(tracker, "inputs")[1]


@pytest.mark.parametrize(
    "change",
    [
        lambda tracker: tracker.__setitem__(1, "sst_graph.tracker.storage.checkpoint:Tracker"),
        lambda tracker: tracker.__setitem__(1, "os:system"),
        lambda tracker: tracker.__setitem__(0, "enum"),
        lambda tracker: tracker.__setitem__(0, "__class__"),
        lambda tracker: tracker.__setitem__(2, ["dict", [], 9999]),
        lambda tracker: tracker.__setitem__(2, ["same", 0]),
        lambda tracker: tracker[2][1].append(["__class__", 1]),
        lambda tracker: tracker[2][1].append(["add", None]),
        lambda tracker: tracker[2][1].pop(),
        lambda tracker: _nodes(tracker, "array")[0].__setitem__(2, [10**13]),
        lambda tracker: _nodes(tracker, "array")[0].__setitem__(1, "|O"),
        lambda tracker: _nodes(tracker, "enum")[0].__setitem__(1, "sst_graph.tracker.tracker:Tracker"),
        lambda tracker: _nodes(tracker, "enum")[0].__setitem__(2, 999),
        lambda tracker: _nodes(tracker, "pose")[0].__setitem__(1, ["list", [], 9999]),
        lambda tracker: _nodes(tracker, "object")[1].__setitem__(1, "sst_graph.types:Scan"),
        lambda tracker: tracker.clear(),
        lambda tracker: _attribute(tracker, "setup").__setitem__(1, None),
        lambda tracker: _attribute(_inputs(tracker), "seen").__setitem__(1, None),
        lambda tracker: _attribute(_attribute(_inputs(tracker), "seen")[1], "scans").__setitem__(1, 7),
        lambda tracker: _attribute(_attribute(_inputs(tracker), "seen")[1], "images")[1].__setitem__(
            2, [6, 1]
        ),
        lambda tracker: _attribute(_attribute(_inputs(tracker), "scan_order")[1], "newest_ns").__setitem__(
            1, "late"
        ),
        lambda tracker: _attribute(_attribute(tracker, "setup")[1], "camera").__setitem__(1, None),
        lambda tracker: _forget(_attribute(_inputs(tracker), "window")[1], "next_scan"),
    ],
)
def test_a_forged_tracker_is_refused(tmp_path: Path, good: bytes, change: Callable[[Any], Any]) -> None:
    document, data = parts_of(good)
    change(document["tracker"])
    refused(tmp_path, forged(document, data), "an incomplete checkpoint|a tracker that gives no estimate")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("[]", "None version None"),
        ('{"format": "sst-graph/tracker", "version": 1}', "'sst-graph/tracker' version 1, expected"),
        ('{"format": NaN}', "NaN is no JSON number"),
        ("{", "no JSON"),
    ],
)
def test_another_head_is_refused(tmp_path: Path, head: str, message: str) -> None:
    refused(tmp_path, forged(head, b""), message)


@pytest.mark.parametrize(
    "change",
    [
        lambda blocks: blocks.clear(),
        lambda blocks: blocks.append(blocks[0]),
        lambda blocks: blocks[0].__setitem__(1, 2**40),
        lambda blocks: blocks[0].__setitem__(2, -1),
        lambda blocks: blocks[-1].__setitem__(3, ["block", blocks[-1][0]]),
        lambda blocks: blocks[0].__setitem__(3, blocks[-1][3]),
        lambda blocks: blocks[0].pop(),
    ],
)
def test_forged_blocks_are_refused(tmp_path: Path, good: bytes, change: Callable[[Any], Any]) -> None:
    document, data = parts_of(good)
    change(document["blocks"])
    refused(tmp_path, forged(document, data), "an incomplete checkpoint|a tracker that gives no estimate")


def test_another_thing_than_a_tracker_is_refused(tmp_path: Path, good: bytes) -> None:
    document, data = parts_of(good)
    document["tracker"] = ["list", [], 0]
    refused(tmp_path, forged(document, data), "a checkpoint of a list")


def test_no_file_and_no_regular_file(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such file"):
        Tracker.load(tmp_path / "nothing.npz")
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(CheckpointError, match="a FIFO"):
        Tracker.load(tmp_path / "fifo")
