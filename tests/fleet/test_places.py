"""The same files on a disk, in memory and at an S3 server."""

from __future__ import annotations

import os
import uuid
from pathlib import Path

import pytest

from sst_graph.errors import DataError, MissingDependencyError
from sst_graph.files import MANIFEST
from sst_graph.fleet.places import Place, read_many
from sst_graph.fleet.scratch import scratch_folder, sweep_scratch


@pytest.fixture(params=["disk", "memory", "s3"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """An empty place."""
    name = uuid.uuid4().hex
    if request.param == "disk":
        return Place.of(tmp_path / name)
    if request.param == "memory":
        return Place.of(f"memory://{name}")
    return Place.of(f"{request.getfixturevalue('s3')}/{name}")


def test_files_are_written_read_listed_and_removed(root: Place) -> None:
    assert not root.exists() and not root.is_folder()
    (root / "a/x.json").write(b"1")
    (root / "a/y.json").write(b"22")
    (root / "b.txt").write(b"")
    assert root.is_folder() and not (root / "b.txt").is_folder()
    assert (root / "a/x.json").exists() and not (root / "a/z.json").exists()
    assert (root / "a/y.json").read() == b"22"
    assert [one.name for one in root.below()] == ["a", "b.txt"]
    assert root.entries() == {root / "a": True, root / "b.txt": False}
    assert [(one.name, one.read()) for one in (root / "a/*.json").matches()] == [
        ("x.json", b"1"),
        ("y.json", b"22"),
    ]
    many = read_many(root / f"a/{name}.json" for name in "xyz")
    assert {place.name: data for place, data in many.items()} == {"x.json": b"1", "y.json": b"22"}
    (root / "a/x.json").write(b"new")
    assert (root / "a/x.json").read() == b"new"
    (root / "a").remove()
    assert [one.name for one in root.below()] == ["b.txt"]


def test_folders_go_there_and_come_back(root: Place, tmp_path: Path) -> None:
    if root.is_local:
        pytest.skip("drives on this machine are not copied")
    source = tmp_path / "drive"
    (source / "sequences/00/velodyne").mkdir(parents=True)
    (source / "sequences/00/velodyne/0.bin").write_bytes(b"\x00" * 100)
    (source / "sequences/00/calib.txt").write_text("P0")
    (source / MANIFEST).write_text("{}")
    (root / "drive").upload(source)
    (tmp_path / "scratch").mkdir()
    copy = (root / "drive").fetch(tmp_path / "scratch")
    assert copy.name == "drive"
    names = sorted(str(one.relative_to(source)) for one in source.rglob("*") if one.is_file())
    assert sorted(str(one.relative_to(copy)) for one in copy.rglob("*") if one.is_file()) == names
    assert (copy / "sequences/00/velodyne/0.bin").read_bytes() == b"\x00" * 100
    single = (root / "drive/sequences/00/calib.txt").fetch(tmp_path / "scratch")
    assert single.read_text() == "P0"


def test_what_is_not_there_is_said(root: Place, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="found"):
        (root / "nothing").read()
    if not root.is_local:
        with pytest.raises(DataError, match="found"):
            (root / "nothing").fetch(tmp_path)


def test_a_url_that_nobody_knows() -> None:
    with pytest.raises((DataError, MissingDependencyError), match="nowhere://x"):
        Place.of("nowhere://x").exists()


def test_scratch_folders_of_ended_processes_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "sst-graph-batch-0123").mkdir()
    (tmp_path / "sst-graph-batch-0123" / "frame.png").write_bytes(b"x")
    (tmp_path / "of-others").mkdir()
    with scratch_folder() as own:
        assert sweep_scratch() == 1
        assert sorted(one.name for one in tmp_path.iterdir()) == sorted(["of-others", own.name])
    assert [one.name for one in tmp_path.iterdir()] == ["of-others"]


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for name, found in {"fifo": "a FIFO", ".": "a folder"}.items():
        place = Place.of(tmp_path / name)
        with pytest.raises(DataError, match=found):
            place.read()
        with pytest.raises(DataError, match=found):
            read_many([place])
    assert read_many([Place.of(tmp_path / "nothing")]) == {}
