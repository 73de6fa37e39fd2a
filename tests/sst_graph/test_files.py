"""Whole or not at all: exceptions, kills, and what stood there before."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from sst_graph.errors import ConfigError
from sst_graph.files import atomic_directory, atomic_write_bytes, atomic_write_text, check_writable_target

KILLED_FILE = """
import os, signal, sys
import sst_graph.files as files
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
files.atomic_write_text(sys.argv[1], "new" * 100000)
"""

KILLED_FOLDER = """
import os, signal, sys
from sst_graph.files import atomic_directory
with atomic_directory(sys.argv[1], overwrite=True) as folder:
    (folder / "half.txt").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def tree(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def run_killed(script: str, target: Path) -> None:
    result = subprocess.run([sys.executable, "-c", script, str(target)], capture_output=True, timeout=60)
    assert result.returncode == -signal.SIGKILL, result.stderr.decode()


def test_file_is_written_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.json"
    atomic_write_text(path, "eins ä")
    atomic_write_bytes(path, b"two\n")
    assert tree(tmp_path) == {"deep/er/a.json": "two\n"}


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    former = os.umask(0o027)
    try:
        atomic_write_text(tmp_path / "a", "x")
        with atomic_directory(tmp_path / "d"):
            pass
    finally:
        os.umask(former)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "d").stat().st_mode) == 0o750


def test_link_is_followed_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    atomic_write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_failed_replacement_leaves_old_file_and_no_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_text("old")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        atomic_write_text(tmp_path / "a", "new")
    assert tree(tmp_path) == {"a": "old"}


def test_killed_write_leaves_old_file(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    run_killed(KILLED_FILE, tmp_path / "a")
    assert (tmp_path / "a").read_text() == "old"


def test_killed_folder_leaves_old_folder(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "kept.txt").write_text("old")
    run_killed(KILLED_FOLDER, tmp_path / "out")
    assert tree(tmp_path / "out") == {"kept.txt": "old"}
    run_killed(KILLED_FOLDER, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_folder_appears_at_the_end_only(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out"
    with atomic_directory(target) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("1")
        assert not target.exists()
    assert tree(tmp_path) == {"deep/out/sub/a": "1"}


def test_exception_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), atomic_directory(tmp_path / "out") as folder:
        (folder / "a").write_text("1")
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_overwrite_replaces_the_whole_folder(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")
    with atomic_directory(tmp_path / "out", overwrite=True) as folder:
        (folder / "new").write_text("new")
    assert tree(tmp_path) == {"out/new": "new"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_exception_while_overwriting_keeps_the_old_folder(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_directory(tmp_path / "out", overwrite=True):
        raise KeyboardInterrupt
    assert tree(tmp_path) == {"out/old": "old"}


def test_folder_with_something_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    check_writable_target(tmp_path / "out", overwrite=False)
    (tmp_path / "out" / "thesis.tex").write_text("dear")
    with pytest.raises(ConfigError, match="not empty"), atomic_directory(tmp_path / "out"):
        pytest.fail("the block must not run")
    with pytest.raises(ConfigError, match=r"without calibration\.json"):
        check_writable_target(tmp_path / "out", overwrite=True, owned_by="calibration.json")
    with pytest.raises(ConfigError, match="found a file"):
        check_writable_target(tmp_path / "out" / "thesis.tex", overwrite=True)
    assert tree(tmp_path) == {"out/thesis.tex": "dear"}


def test_folder_filled_meanwhile_is_not_lost(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not empty"), atomic_directory(tmp_path / "out"):
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "other").write_text("theirs")
    assert tree(tmp_path) == {"out/other": "theirs"}
