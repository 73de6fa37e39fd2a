"""Whole or not at all: exceptions, kills, second writers, and what stood there before."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import pytest

from sst_graph.errors import ConfigError
from sst_graph.files import (
    MANIFEST,
    OutputFileKind,
    OutputKind,
    atomic_directory,
    atomic_write_bytes,
    atomic_write_in_steps,
    atomic_write_text,
    check_file_target,
    check_folder_target,
    output_file,
    sweep_folder,
)
from sst_graph.files.manifest import carry_over, give_back

KIND = OutputKind("thing")
CLOSED = OutputKind("thing", exclusive=("own",))

REPLACE = """
import os, signal, sys
from sst_graph.files import OutputKind, atomic_directory
from sst_graph.files import output, staging
%s
with atomic_directory(sys.argv[1], True, OutputKind("thing")) as folder:
    (folder / "own").mkdir()
    (folder / "own" / "a").write_text("new")
    (folder / "b").write_text("new")
"""
KILL = "os.kill(os.getpid(), signal.SIGKILL)"
KILLED_FILE = f"""
import os, signal, sys
from sst_graph.files import atomic_write_text
os.replace = lambda *_: {KILL}
atomic_write_text(sys.argv[1], "new" * 100000)
"""
CLAIM_OFTEN = """
import sys
from pathlib import Path
from sst_graph.errors import ConfigError
from sst_graph.files.staging import claim
for _ in range(int(sys.argv[2])):
    try:
        claim(Path(sys.argv[1])).release()
    except ConfigError as error:
        assert "is writing it" in str(error) or "keep writing it" in str(error), error
"""
KILLED_AT = {
    "while writing": f"output.write_manifest = lambda *_: {KILL}",
    "before it is flushed": f"output._sync_tree = lambda *_: {KILL}",
    "while notes are carried over": f"output.carry_over = lambda *_: {KILL}",
    "before the exchange": f"output._exchange = lambda *_: {KILL}",
    "after the exchange": f"real = output._exchange; output._exchange = lambda a, b: (real(a, b), {KILL})",
    "while notes are given back": f"output.give_back = lambda *_: {KILL}",
    "while the old one is removed": f"staging.remove = lambda *_: {KILL}",
}
NO_EXCHANGE = "output._exchange = lambda *_: False"
KILLED_BETWEEN_RENAMES = f"""
real = os.rename
def rename(a, b):
    if str(b) == os.path.realpath(sys.argv[1]) and str(a).endswith("/new") and not os.path.exists(b):
        {KILL}
    real(a, b)
os.rename = rename
"""


def tree(folder: Path) -> dict[str, str]:
    """Content of all files below a folder but manifests."""
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MANIFEST
    }


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def write(target: Path, files: dict[str, str], overwrite: bool = False, kind: OutputKind = KIND) -> None:
    with atomic_directory(target, overwrite, kind) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)


def run_killed(script: str, target: Path) -> None:
    result = subprocess.run([sys.executable, "-c", script, str(target)], capture_output=True, timeout=60)
    assert result.returncode == -signal.SIGKILL, result.stderr.decode()


def test_file_is_written_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.json"
    atomic_write_text(path, "eins ä")
    atomic_write_bytes(path, b"two\n")
    assert tree(tmp_path) == {"deep/er/a.json": "two\n"}


def _in_two(stream: BinaryIO) -> Iterator[None]:
    for part in (b"ne", b"w"):
        stream.write(part)
        yield


def test_a_file_written_in_steps_appears_with_the_last(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("old")
    steps = atomic_write_in_steps(path, _in_two)
    for _ in range(3):
        next(steps)
        assert path.read_text() == "old"
    assert sum(1 for _ in steps) <= 50
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_a_file_whose_steps_are_broken_off_leaves_the_old_one(tmp_path: Path) -> None:
    def failing(stream: BinaryIO) -> Iterator[None]:
        yield from _in_two(stream)
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "a"
    path.write_text("old")
    for done in range(4):
        steps = atomic_write_in_steps(path, _in_two)
        for _ in range(done):
            next(steps)
        steps.close()
        assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="No space left on device") as caught:
        list(atomic_write_in_steps(path, failing))
    assert caught.value.filename == str(path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    former = os.umask(0o027)
    try:
        atomic_write_text(tmp_path / "a", "x")
        write(tmp_path / "d", {})
        with output_file(tmp_path / "b", False) as out:
            out.write_text("x")
    finally:
        os.umask(former)
    assert [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in "adb"] == [0o640, 0o750, 0o640]


def test_link_is_followed_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    atomic_write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    with output_file(tmp_path / "link.txt", True) as out:
        out.write_text("newer")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "newer"


def test_failed_replacement_leaves_old_file_and_no_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_text("old")

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left") as caught:
        atomic_write_text(tmp_path / "a", "new")
    assert caught.value.filename == str(tmp_path / "a")
    with pytest.raises(OSError, match="No space left") as caught, output_file(tmp_path / "a", True) as out:
        out.write_text("new")
    assert caught.value.filename == str(tmp_path / "a")
    with pytest.raises(OSError, match="No space left") as caught:
        write(tmp_path / "d", {"x": "new"})
    assert caught.value.filename == str(tmp_path / "d")
    assert tree(tmp_path) == {"a": "old"} and names(tmp_path) == {"a"}


def test_an_error_inside_names_the_output(tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match="No such file") as caught,
        atomic_directory(tmp_path / "d", False, KIND) as d,
    ):
        (d / "missing" / "a").write_text("x")
    assert caught.value.filename == str(tmp_path / "d" / "missing" / "a")


def test_killed_write_leaves_old_file_and_is_cleaned_up(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    run_killed(KILLED_FILE, tmp_path / "a")
    assert (tmp_path / "a").read_text() == "old" and len(names(tmp_path)) == 2
    with output_file(tmp_path / "a", True) as out:
        out.write_text("new")
    assert tree(tmp_path) == {"a": "new"}


@pytest.mark.parametrize("moment", KILLED_AT)
def test_killed_replacement_leaves_the_old_or_the_new(tmp_path: Path, moment: str) -> None:
    out = tmp_path / "out"
    write(out, {"own/a": "old", "b": "old"})
    (out / "notes.txt").write_text("dear")
    run_killed(REPLACE % KILLED_AT[moment], out)
    old = {"own/a": "old", "b": "old", "notes.txt": "dear"}
    new = {"own/a": "new", "b": "new", "notes.txt": "dear"}
    done = moment in ("after the exchange", "while notes are given back", "while the old one is removed")
    assert tree(out) == (new if done else old)
    write(out, {"b": "third"}, overwrite=True)
    assert tree(out) == {"b": "third", "notes.txt": "dear"} and names(tmp_path) == {"out"}


def test_without_an_exchange_the_next_run_puts_the_old_folder_back(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, {"b": "old"})
    (out / "notes.txt").write_text("dear")
    run_killed(REPLACE % (NO_EXCHANGE + KILLED_BETWEEN_RENAMES), out)
    assert not out.exists()
    with pytest.raises(RuntimeError, match="stop"), atomic_directory(out, False, KIND):
        raise RuntimeError("stop")
    assert tree(out) == {"b": "old", "notes.txt": "dear"} and names(tmp_path) == {"out"}


def test_without_an_exchange_a_folder_is_replaced_as_well(tmp_path: Path) -> None:
    write(tmp_path / "out", {"b": "old"})
    script = REPLACE % NO_EXCHANGE
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "out")], check=True, timeout=60)
    assert tree(tmp_path) == {"out/own/a": "new", "out/b": "new"} and names(tmp_path) == {"out"}


def test_folder_appears_at_the_end_only(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out"
    with atomic_directory(target, False, KIND) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("1")
        assert not target.exists()
    assert tree(tmp_path) == {"deep/out/sub/a": "1"} and names(target.parent) == {"out"}


def test_exception_leaves_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(RuntimeError, match="stop"),
        atomic_directory(tmp_path / "deep/out", False, KIND) as new,
    ):
        (new / "a").write_text("1")
        raise RuntimeError("stop")
    with pytest.raises(RuntimeError, match="stop"), output_file(tmp_path / "deep/a", False):
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_exception_while_overwriting_keeps_the_old_folder(tmp_path: Path) -> None:
    write(tmp_path / "out", {"old": "old"})
    with pytest.raises(KeyboardInterrupt), atomic_directory(tmp_path / "out", True, KIND):
        raise KeyboardInterrupt
    assert tree(tmp_path) == {"out/old": "old"}


def test_what_others_keep_in_a_folder_survives(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, {"report.md": "old", "own/a": "old", "gone": "old"})
    (out / "report.md").write_text("old, and my remarks")
    (out / "own" / "photo").write_text("mine")
    (out / "link").symlink_to("report.md")
    (out / "empty").mkdir()
    write(out, {"report.md": "new", "own": "now a file"}, overwrite=True)
    assert tree(out) == {
        "report.md": "new",
        "report.md.kept": "old, and my remarks",
        "own": "now a file",
        "own_photo": "mine",
        "link": "new",
    }
    assert (out / "link").is_symlink() and (out / "empty").is_dir() and names(tmp_path) == {"out"}


def test_notes_saved_while_the_folder_is_replaced_survive(tmp_path: Path) -> None:
    """They are written to the former folder, after what others keep there has been carried over."""
    out, new, former = tmp_path / "out", tmp_path / "new", tmp_path / "former"
    write(out, {"a": "old"})
    (out / "notes.txt").write_text("first")
    write(new, {"a": "new"})
    carry_over(out, new)
    (out / "late.txt").write_text("late")
    (out / "saved").write_text("second")
    os.replace(out / "saved", out / "notes.txt")
    os.utime(out / "notes.txt", ns=(1 << 62, 1 << 62))
    out.rename(former)
    new.rename(out)
    give_back(former, out)
    assert tree(out) == {"a": "new", "late.txt": "late", "notes.txt": "second"}


def test_a_folder_that_is_not_ours_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    check_folder_target(out, False, KIND)
    (out / "thesis.tex").write_text("dear")
    with pytest.raises(ConfigError, match="not empty"), atomic_directory(out, False, KIND):
        pytest.fail("the block must not run")
    with pytest.raises(ConfigError, match="not from sst-graph"):
        check_folder_target(out, True, KIND)
    with pytest.raises(ConfigError, match="found a file"):
        check_folder_target(out / "thesis.tex", True, KIND)
    assert tree(tmp_path) == {"out/thesis.tex": "dear"}


def test_a_folder_of_another_kind_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "out", {"a": "1"})
    with pytest.raises(ConfigError, match="found a thing, expected a drive to overwrite"):
        check_folder_target(tmp_path / "out", True, OutputKind("drive"))


@pytest.mark.parametrize("stranger", ["own/b", "own/a"])
def test_a_folder_with_strangers_among_ours_is_refused(tmp_path: Path, stranger: str) -> None:
    write(tmp_path / "out", {"own/a": "1"}, kind=CLOSED)
    (tmp_path / "out" / "notes.txt").write_text("mine")
    check_folder_target(tmp_path / "out", True, CLOSED)
    (tmp_path / "out" / stranger).write_text("2")
    with pytest.raises(ConfigError, match=f"found {stranger}, which is not as sst-graph wrote it"):
        check_folder_target(tmp_path / "out", True, CLOSED)


def test_what_appears_meanwhile_is_not_replaced_and_the_work_not_lost(tmp_path: Path) -> None:
    beside = pytest.raises(ConfigError, match=r"the output stands in .*/out-2")
    with beside, atomic_directory(tmp_path / "out", False, KIND) as folder:
        (folder / "a").write_text("ours")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "other").write_text("theirs")
    beside = pytest.raises(ConfigError, match=r"the output stands in .*/a-2\.json")
    with beside, output_file(tmp_path / "a.json", False) as out:
        (tmp_path / "a.json").write_text("theirs")
        out.write_text("ours")
    assert tree(tmp_path) == {
        "out/other": "theirs",
        "out-2/a": "ours",
        "a.json": "theirs",
        "a-2.json": "ours",
    }


def test_a_second_writer_is_refused_before_its_work(tmp_path: Path) -> None:
    script = (
        "import sys\nfrom sst_graph.files import OutputKind, atomic_directory\n"
        "with atomic_directory(sys.argv[1], True, OutputKind('thing')):\n    sys.exit('ran')"
    )
    with atomic_directory(tmp_path / "out", False, KIND) as folder:
        (folder / "a").write_text("first")
        second = subprocess.run(
            [sys.executable, "-c", script, str(tmp_path / "out")], capture_output=True, text=True, timeout=60
        )
        assert second.returncode == 1 and f"(process {os.getpid()})" in second.stderr, second.stderr
        with pytest.raises(ConfigError, match="another run"), output_file(tmp_path / "out", False):
            pass
    assert tree(tmp_path) == {"out/a": "first"}


@pytest.mark.parametrize("rounds", [1000, pytest.param(4000, marks=pytest.mark.slow)])
def test_of_many_writers_each_has_the_name_or_is_told_who_has_it(tmp_path: Path, rounds: int) -> None:
    command = [sys.executable, "-c", CLAIM_OFTEN, str(tmp_path / "a"), str(rounds)]
    runs = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    assert [run.communicate(timeout=60)[1] for run in runs] == ["", "", ""]
    assert list(tmp_path.iterdir()) == []


def test_a_living_temporary_is_left_alone(tmp_path: Path) -> None:
    living = tmp_path / f".a.{'0' * 16}.sst-graph-partial"
    named_alike = tmp_path / ".a.notes.sst-graph-partial"
    named_alike.write_text("mine")
    with open(living, "wb") as stream:
        fcntl.flock(stream.fileno(), fcntl.LOCK_EX)
        with output_file(tmp_path / "a", False) as out:
            out.write_text("x")
        assert living.exists()
    with output_file(tmp_path / "a", True) as out:
        out.write_text("y")
    assert names(tmp_path) == {"a", named_alike.name}


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    kind = OutputFileKind("a song", lambda head: head.startswith(b"la"))
    (tmp_path / "a").write_text("thesis")
    with pytest.raises(ConfigError, match="found a file, expected none"):
        check_file_target(tmp_path / "a", False, kind)
    with pytest.raises(ConfigError, match="expected a song to overwrite"):
        check_file_target(tmp_path / "a", True, kind)
    (tmp_path / "a").write_text("la la")
    check_file_target(tmp_path / "a", True, kind)
    with pytest.raises(ConfigError, match="found a folder"):
        check_file_target(tmp_path, True, kind)
    with pytest.raises(ConfigError, match="found a device"):
        check_file_target("/dev/null", True, kind)


@pytest.mark.parametrize("name", ["/proc/x", "/proc/1/deep/x", "/dev/null/x", "x" * 300])
def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="x: "), atomic_directory(tmp_path / name, False, KIND):
        pytest.fail("the block must not run")
    with pytest.raises(ConfigError, match="x: "), output_file(tmp_path / name, False):
        pytest.fail("the block must not run")
    assert list(tmp_path.iterdir()) == []


def test_a_link_that_leads_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(ConfigError, match="a loop of symbolic links"):
        check_folder_target(tmp_path / "a", True, KIND)
    with pytest.raises(ConfigError, match="a loop of symbolic links"), output_file(tmp_path / "a", False):
        pytest.fail("the block must not run")
    assert (tmp_path / "a").is_symlink()


def test_long_and_strange_names_are_fine(tmp_path: Path) -> None:
    for name in ("n" * 255, os.fsdecode(b"stra\xdfe"), "a b\nc", ".hidden", "*[a]?"):
        for text in ("old", "new"):
            write(tmp_path / name, {"a": text}, overwrite=True)
        assert tree(tmp_path / name) == {"a": "new"}
    assert len(names(tmp_path)) == 5


def test_a_folder_of_many_files_is_swept(tmp_path: Path) -> None:
    """What a living process writes there stays, and what only looks like it."""
    left, living = (tmp_path / f".{name}.png.{16 * name}.sst-graph-partial" for name in "ab")
    others = [
        tmp_path / name for name in ("a.png", ".a.png.sst-graph-partial", ".a.png.zz.sst-graph-partial")
    ]
    for path in (left, living, *others):
        path.write_bytes(b"half")
    with open(living, "rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        sweep_folder(tmp_path)
        assert sorted(tmp_path.iterdir()) == sorted([living, *others])
    sweep_folder(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(others)


@pytest.mark.parametrize("rounds", [250, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_sweep_leaves_what_another_is_writing(tmp_path: Path, rounds: int) -> None:
    """Also in the instants before a file is locked, and before it has its name."""
    over = threading.Event()

    def sweep() -> None:
        while not over.is_set():
            sweep_folder(tmp_path)

    sweeping = threading.Thread(target=sweep)
    sweeping.start()
    try:
        for number in range(rounds):
            atomic_write_bytes(tmp_path / "a", str(number).encode())
            for _ in atomic_write_in_steps(tmp_path / "b", lambda stream: iter([stream.write(b"b")])):
                pass
    finally:
        over.set()
        sweeping.join()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": str(rounds - 1), "b": "b"}


@pytest.mark.parametrize("size", ["1e999", "Infinity", "1" + "0" * 5000, "null", "[" * 200_000, "fifo"])
def test_a_manifest_that_cannot_be_used_is_none(tmp_path: Path, size: str) -> None:
    """No error of another kind, and nothing that blocks."""
    with atomic_directory(tmp_path / "out", False, KIND) as folder:
        (folder / "a").write_text("one")
    path = tmp_path / "out" / MANIFEST
    text = path.read_text()
    path.unlink()
    if size == "fifo":
        os.mkfifo(path)
    else:
        path.write_text(text.replace("3,", f"{size},", 1))
    with (
        pytest.raises(ConfigError, match="found a folder without"),
        atomic_directory(tmp_path / "out", True, KIND),
    ):
        pass
    assert (tmp_path / "out" / "a").read_text() == "one"
