"""Stamps of files, as their names and in CSV files: what is read, and what is refused for being unclear."""

from __future__ import annotations

from pathlib import Path

import pytest

from sst_graph.data.folder.stamps import stamped_files
from sst_graph.errors import DataError

S = 10**9
DATE = 1_700_000_000


def named(folder: Path, names: list[str]) -> list[int]:
    """Stamps of files that are called so [ns]."""
    for name in names:
        (folder / f"{name}.png").write_bytes(b"")
    return stamped_files(folder, (".png",)).stamps_ns.tolist()


def tabled(folder: Path, lines: list[str], count: int = 3) -> list[int]:
    """Stamps [ns] of img0.png, img1.png, ... by a CSV file."""
    images = folder / "images"
    images.mkdir()
    for k in range(count):
        (images / f"img{k}.png").write_bytes(b"")
    (folder / "images.csv").write_text("\n".join(lines) + "\n")
    return stamped_files(images, (".png",)).stamps_ns.tolist()


@pytest.mark.parametrize(
    "names",
    [
        [f"{k:06d}_10" for k in range(3)],  # KITTI flow
        [f"{k:010d}_10" for k in range(3)],
        [f"{k:010d}_{k:06d}" for k in range(3)],
        [f"{k:06d}_0" for k in range(3)],
        ["cam0_000001"],
    ],
)
def test_names_that_count_with_a_part_behind_are_no_stamps(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(DataError, match="expected a stamp"):
        named(tmp_path, names)


@pytest.mark.parametrize("digits", [1, 3, 5, 7, 8])
def test_a_part_of_a_second_in_another_unit_is_refused(tmp_path: Path, digits: int) -> None:
    """1700000000_037 is 37 ms, and not 37 us."""
    names = [f"{DATE}_{k:0{digits}d}" for k in (3, 4, 5)]
    with pytest.raises(DataError, match=rf"3\.png: found a part of a second in {digits} digit.*9 digits"):
        named(tmp_path, names)


def test_a_part_of_a_second_without_its_zeros(tmp_path: Path) -> None:
    names = [f"{DATE}_0", f"{DATE}_50000000", f"{DATE}_100000000"]
    assert named(tmp_path, names) == [DATE * S, DATE * S + 50_000_000, DATE * S + 100_000_000]


def test_seconds_since_a_start_with_nanoseconds(tmp_path: Path) -> None:
    assert named(tmp_path, ["12_000000000", "12_100000000"]) == [12 * S, 12 * S + 100_000_000]


@pytest.mark.parametrize(
    "line",
    [
        "img{k}.png,{k},{k}00",  # name, seq, ms
        "{k},img{k}.png,{k}00000000",  # seq, name, ns
        "img{k}.png,{k}00000005,9000",  # name, ns, exposure
        "img{k}.png,{k}00005,9000",
    ],
)
def test_two_numbers_are_not_taken_for_seconds_and_nanoseconds(tmp_path: Path, line: str) -> None:
    with pytest.raises(DataError, match=r"images.csv:1: found .*, expected name,stamp"):
        tabled(tmp_path, [line.format(k=k) for k in range(1, 4)], 4)


def test_a_count_behind_seconds_is_no_part_of_them(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"images.csv:1: found a part of a second in 1 digit"):
        tabled(tmp_path, [f"img{k}.png,{DATE + k},{k}" for k in range(3)])


@pytest.mark.parametrize(
    "heading",
    ["name,sec,nanosec", "#file,secs,nsecs", "image,header.stamp.sec,header.stamp.nanosec", "f,t [s],t [ns]"],
)
def test_columns_that_the_heading_names(tmp_path: Path, heading: str) -> None:
    """Of a simulation's clock, and without zeros before the nanoseconds."""
    found = tabled(tmp_path, [heading, "img0.png,12,900000000", "img1.png,13,0", "img2.png,13,50000000"])
    assert found == [12_900_000_000, 13_000_000_000, 13_050_000_000]


@pytest.mark.parametrize(
    ("heading", "nanoseconds"), [("name,width,height", "0"), ("name,sec,nsec", "1000000000")]
)
def test_columns_that_are_no_nanoseconds(tmp_path: Path, heading: str, nanoseconds: str) -> None:
    with pytest.raises(DataError, match=rf"images\.csv:2: found 'img0\.png,12,{nanoseconds}', expected name"):
        tabled(tmp_path, [heading, f"img0.png,12,{nanoseconds}", "img1.png,13,1", "img2.png,13,50"])


@pytest.mark.parametrize("rest", ["1", "640,480"])
def test_columns_behind_seconds_and_nanoseconds(tmp_path: Path, rest: str) -> None:
    found = tabled(tmp_path, [f"img{k}.png,{DATE},{k + 1}00000000,{rest}" for k in range(3)])
    assert found == [DATE * S + (k + 1) * 100_000_000 for k in range(3)]


@pytest.mark.parametrize("hz", [0.25, 0.5, 1.0, 10.0, 400.0])
@pytest.mark.parametrize("unit_ns", [1_000, 1_000_000])
def test_dates_in_other_units_at_any_rate(tmp_path: Path, hz: float, unit_ns: int) -> None:
    step = round(S / hz) // unit_ns * unit_ns
    stamps = [DATE * S + step * k for k in range(4)]
    assert named(tmp_path, [str(stamp // unit_ns) for stamp in stamps]) == stamps


@pytest.mark.parametrize("days", [0.02, 12.0, 30.0, 48.0])
@pytest.mark.parametrize("hz", [0.5, 10.0, 100.0])
def test_nanoseconds_since_a_start_stay_such(tmp_path: Path, days: float, hz: float) -> None:
    stamps = [round(days * 86_400) * S + round(S / hz) * k for k in range(4)]
    assert named(tmp_path, [str(stamp) for stamp in stamps]) == stamps


@pytest.mark.parametrize("comment", ["# 10 Hz", "#", "#exported", "  # by hand, 2", "# 0.000 img0.png"])
@pytest.mark.parametrize("place", [0, 2])
def test_comments(tmp_path: Path, comment: str, place: int) -> None:
    lines = [f"img{k}.png,0.{k}00" for k in range(3)]
    lines.insert(place, comment)
    assert tabled(tmp_path, lines) == [0, 100_000_000, 200_000_000]


def test_a_name_that_begins_as_a_comment(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for k in range(2):
        (images / f"#{k}.png").write_bytes(b"")
    (tmp_path / "images.csv").write_text("# 10 Hz\n#0.png,0.100\n#1.png,0.200\n")
    assert stamped_files(images, (".png",)).stamps_ns.tolist() == [100_000_000, 200_000_000]


def test_empty_fields_at_the_end(tmp_path: Path) -> None:
    lines = ["name,stamp,", *(f"img{k}.png,0.{k}00," for k in range(2)), "img2.png,0.200,,"]
    assert tabled(tmp_path, lines) == [0, 100_000_000, 200_000_000]


def test_the_error_names_every_form_of_a_stamp(tmp_path: Path) -> None:
    forms = "seconds with a decimal point, whole nanoseconds, .*microseconds or milliseconds.*sec_nsec"
    with pytest.raises(DataError, match=f"median step of 1 ns, expected stamps in {forms}"):
        named(tmp_path, [str(DATE + k) for k in range(3)])
