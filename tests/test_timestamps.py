"""Stamps: exact nanoseconds, strictly rising."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.timestamps import check_rising, parse_seconds, read_times


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("0.000000e+00", 0),
        ("1.036000e-01", 103_600_000),
        (" 4.708e+02\n", 470_800_000_000),
        ("1317041272.123456789", 1_317_041_272_123_456_789),  # a double would lose 200 ns
        ("-0.5", -500_000_000),
    ],
)
def test_seconds_become_exact_nanoseconds(text: str, nanoseconds: int) -> None:
    assert parse_seconds(text, "times.txt") == nanoseconds


@pytest.mark.parametrize(
    "text",
    [
        "",
        "abc",
        "0.1 0.2",
        "nan",
        "inf",
        "1e30",
        "4611686018.5",  # 2**62 ns: what no estimator takes
        "-9e9",
        "0,5",
        "1e999999999",
        "-1e999999999",
        "1e99999999999",
        "1" * 400,
        "0." + "1" * 400,
        "1_0",
        "٣",
        "0x1p3",
    ],
)
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(DataError, match=r"^times\.txt:3: found .*, expected .*seconds"):
        parse_seconds(text, "times.txt:3")


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        ([0, 5, 5, 9], r"equal stamps 1 and 2 \(step 0 s\)"),
        ([0, 100_000_000, 50_000_000], r"falling stamps 1 and 2 \(step -0.05 s\)"),
    ],
)
def test_stamps_that_do_not_rise_are_named(stamps: list[int], message: str) -> None:
    with pytest.raises(DataError, match=message):
        check_rising(np.array(stamps, np.int64), "times.txt")


def test_one_stamp_and_none_rise() -> None:
    check_rising(np.array([3], np.int64), "x")
    check_rising(np.array([], np.int64), "x")


def test_times_file(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text("0.0\n1.036e-01\r\n2.072e-01\n\n")
    stamps = read_times(path)
    assert stamps.tolist() == [0, 103_600_000, 207_200_000]
    assert stamps.dtype == np.int64


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found no stamp"),
        (b"\n\n", "found no stamp"),
        (b"0.0\n\n0.2\n", "times.txt:2: found ''"),
        (b"0.0\n0.1x\n", "times.txt:2: found '0.1x'"),
        (b"0.0\n0.2\n0.1\n", "falling stamps 1 and 2"),
        (b"\xff\xfe0\x00", "no UTF-8 text"),
    ],
)
def test_bad_times_file_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "times.txt"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_times(path)


def test_missing_times_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"times\.txt: found no such file, expected"):
        read_times(tmp_path / "times.txt")
