"""Files that others wrote: what is refused before it blocks, takes memory or reaches a terminal."""

from __future__ import annotations

import os
import pickle
import resource
import socket
import time
from pathlib import Path

import pytest

from sst_graph.errors import DataError, SstGraphError, printable
from sst_graph.factors.errors import FactorError
from sst_graph.files.reading import (
    MAX_DEPTH,
    SETTINGS,
    FileKind,
    parse_json,
    parse_toml,
    read_file,
    read_json,
    read_text,
)

NOTE = FileKind("a note", 1000)


def test_a_regular_file_is_read_whole_and_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(bytes(1000))
    (tmp_path / "link").symlink_to("a")
    assert read_file(tmp_path / "link", NOTE) == bytes(1000)


def test_a_small_file_takes_little_memory_whatever_is_allowed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert read_file(tmp_path / "a", FileKind("a note", 2**50)) == b"abc"


def test_a_file_that_says_nothing_of_its_size_is_read_whole_or_refused() -> None:
    assert b"MemTotal" in read_file("/proc/meminfo", FileKind("a note", 1_000_000))
    with pytest.raises(DataError, match="a note"):
        read_file("/proc/meminfo", FileKind("a note", 10))


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket may have 100 characters only
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "dangling").symlink_to("nothing")
    (tmp_path / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        began = time.monotonic()
        for name, found in [
            (tmp_path / "fifo", "a FIFO"),
            (tmp_path / "loop", "an unreadable file"),
            (tmp_path / "dangling", "no such file"),
            (tmp_path / "folder", "a folder"),
            (tmp_path / "socket", "a socket"),
            (Path("/dev/zero"), "a character device"),
            (tmp_path / ("x" * 300), "a name of [0-9]+ characters"),
            (Path("a\0b"), "no name of a file"),
        ]:
            with pytest.raises(DataError, match=f"found {found}.*, expected a note"):
                read_file(name, NOTE)
        assert time.monotonic() - began < 10.0  # not for ever; the machine may be busy


def test_a_sparse_giant_takes_no_memory(tmp_path: Path) -> None:
    with open(tmp_path / "big", "wb") as stream:
        stream.truncate(1 << 40)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match="expected a note of at most 1000 bytes"):
        read_file(tmp_path / "big", NOTE)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10_000  # kB


def test_text_is_strict_utf8_without_its_mark(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfT\xc3\xbcr")
    assert read_text(path, NOTE) == "Tür"
    path.write_bytes(b"Tr\xff")
    with pytest.raises(DataError, match="byte 2 is 0xff"):
        read_text(path, NOTE)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "nested too deeply"),
        ('{"a":' * 5000 + "1" + "}" * 5000, "nested too deeply"),
        ("1" * 5000, "a whole number of 5000 characters"),
        ("-" + "1" * 400, "a whole number of 401 characters"),
        ("0." + "1" * 400, "a number of 402 characters"),
        ("1e400", "not finite"),
        ("[NaN]", "NaN is no JSON number"),
        ("-Infinity", "-Infinity is no JSON number"),
        ('{"a": 1, "b": 2, "a": 3}', "the key 'a' twice"),
        ('["\\ud800"]', "a lone surrogate"),
        ('{"\\udfff": 1}', "a lone surrogate"),
        ("[" + "0," * 6_000_000 + "0]", "too many values"),
        ("", "no JSON"),
        ("{'a': 1}", "no JSON"),
    ],
)
def test_json_is_strict_and_bounded(text: str, found: str) -> None:
    with pytest.raises(DataError, match=f"x.json: found .*{found}"):
        parse_json(text, "x.json")


def test_json_that_is_read_as_usual(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    path.write_text('{"a": [1, -2.5e-3, true, null, "ü😀"], "key": 16645304222761353216}')
    assert read_json(path, SETTINGS) == {"a": [1, -2.5e-3, True, None, "ü😀"], "key": 16645304222761353216}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a = " + "[" * 20_000, "nested too deeply"),
        ("a = " + "[" * 100 + "]" * 100, "nested too deeply"),
        ("a = inf", "not finite"),
        ("a = 1e999", "not finite"),
        ("a = " + "9" * 5000, "no TOML"),
        ("a = " + "9" * 400, "more than 20 digits"),
        ("a = 1\na = 2", "no TOML"),
        ("a = {", "no TOML"),
        ("a." * 60_000 + "a = 1", "a line with more than 500 dots"),
    ],
)
def test_toml_is_strict_and_bounded(text: str, found: str) -> None:
    with pytest.raises(DataError, match=f"x.toml: found .*{found}"):
        parse_toml(text, "x.toml")


def test_messages_hold_no_control_character_and_stay_short() -> None:
    assert printable("a\x1b[31m\n\u202e\udc80ü") == r"a\x1b[31m\n\u202e\udc80ü"
    assert len(printable("\x1b" * 10**6)) <= 1200
    error = DataError("line\nbreak", "x" * 200_000_000, "y\x07")
    assert len(str(error)) < 1200 and str(error).isprintable()
    assert str(error).startswith(r"line\nbreak: found xxx") and str(error).endswith(r"expected y\x07")
    assert str(SstGraphError("two\n lines\x1b")) == r"two lines\x1b"


def test_all_errors_have_one_root_and_travel_between_processes() -> None:
    for error in (FactorError("E", "a", "b"), DataError("place\n", "a", "b"), SstGraphError("text")):
        assert isinstance(error, SstGraphError)
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again)) == (type(error), str(error))
    assert issubclass(FactorError, ValueError)
