"""When the files of a drive count as changed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sst_graph.fleet.drive_files import changed_at, fingerprint, size_of


def drive(folder: Path) -> Path:
    (folder / "scans").mkdir(parents=True)
    (folder / "scans" / "0.bin").write_bytes(bytes(160))
    (folder / "calib.txt").write_text("Tr: 1.25")
    return folder


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: (folder / "calib.txt").write_text("Tr: 1.35"),
        lambda folder: (folder / "scans" / "0.bin").write_bytes(bytes(176)),
        lambda folder: (folder / "scans" / "1.bin").write_bytes(b""),
        lambda folder: (folder / "scans" / "0.bin").rename(folder / "scans" / "1.bin"),
    ],
    ids=["a number", "a size", "one more", "a name"],
)
def test_a_change_shows(tmp_path: Path, change: Callable[[Path], object]) -> None:
    folder = drive(tmp_path / "a")
    before = fingerprint(folder)
    assert before == fingerprint(drive(tmp_path / "b")) != ""
    change(folder)
    assert fingerprint(folder) != before


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: (folder / "calib.txt").write_text("Tr: 1.35"),
        lambda folder: (folder / "scans" / "1.bin").unlink(),
        lambda folder: (folder / "scans" / "0.bin").rename(folder / "scans" / "2.bin"),
    ],
    ids=["a number", "one less", "a name"],
)
def test_when_it_changed(tmp_path: Path, change: Callable[[Path], object]) -> None:
    folder = drive(tmp_path / "a")
    (folder / "scans" / "1.bin").write_bytes(b"1")
    before = changed_at(folder)
    for file in folder.rglob("*"):
        os.utime(file, (0, 0))  # of no use, for copies keep this time
    assert changed_at(folder) >= before > 0.0
    before = changed_at(folder)
    time.sleep(0.05)  # the clock of a file system has a step
    change(folder)
    assert changed_at(folder) > before


def test_what_is_no_change(tmp_path: Path) -> None:
    folder = drive(tmp_path / "a")
    before = fingerprint(folder)
    os.utime(folder / "calib.txt", (0, 0))
    (folder / ".cache").mkdir()
    (folder / ".cache" / "x.txt").write_text("x")
    (folder / "gone").symlink_to(folder / "nowhere")
    assert fingerprint(folder) == before
    assert size_of(folder) == 160 + 8 + 1


def test_links_are_followed_and_pipes_are_none(tmp_path: Path) -> None:
    """As where clouds stand on another disk; a loop of links ends."""
    folder, elsewhere = tmp_path / "a", drive(tmp_path / "b")
    folder.mkdir()
    (folder / "velodyne").symlink_to(elsewhere, target_is_directory=True)
    (elsewhere / "loop").symlink_to(elsewhere, target_is_directory=True)
    os.mkfifo(folder / "pipe.txt")
    before = fingerprint(folder)
    assert before != "" and size_of(folder) == 168
    (elsewhere / "calib.txt").write_text("Tr: 1.35")
    assert fingerprint(folder) != before


def test_one_file_and_none(tmp_path: Path) -> None:
    bag = tmp_path / "drive.mcap"
    assert fingerprint(bag) == "" and size_of(bag) == 0 and changed_at(bag) == 0.0
    bag.write_bytes(b"123")
    before = fingerprint(bag)
    assert before != "" and size_of(bag) == 3 and changed_at(bag) == bag.stat().st_ctime
    bag.write_bytes(b"1234")
    assert fingerprint(bag) != before
