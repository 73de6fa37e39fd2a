"""Drives from folders, patterns and lists; vehicles and dates from expressions and tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from sst_graph.errors import ConfigError, DataError, SstGraphError
from sst_graph.fleet.drives import Drive, file_name, find_drives, with_vehicles
from sst_graph.fleet.places import Place


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for vehicle in ("v1", "v2"):
        for day in ("20260301", "20260308"):
            (tmp_path / "data" / vehicle / day).mkdir(parents=True)
    (tmp_path / "data" / "v1" / ".hidden").mkdir()
    return tmp_path / "data"


def test_a_folder_a_pattern_and_a_list_name_the_same_drives(tree: Path, tmp_path: Path) -> None:
    lines = tmp_path / "list.txt"
    lines.write_text(f"# of the first vehicle\n\n{tree}/v1/20260301\n{tree}/v1/20260308  # snow\n")
    table = tmp_path / "list.csv"
    table.write_text(f"Drive, Name ,vehicle\n{tree}/v1/20260301,,v1\n{tree}/v1/20260308/,,v1\n")
    expected = ["20260301", "20260308"]
    for what in (tree / "v1", tree / "v1" / "*", lines, table):
        found = find_drives(str(what))
        assert [drive.name for drive in found] == expected
        assert [drive.place.url for drive in found] == [f"{tree}/v1/{name}" for name in expected]
    assert find_drives(str(table))[0].vehicle == "v1"


def test_drives_of_one_name_are_refused_and_told_apart_by_the_folder_above(tree: Path) -> None:
    with pytest.raises(ConfigError, match=r"two drives named 20260301.*--name-parts 2"):
        find_drives(f"{tree}/*/*")
    names = [drive.name for drive in find_drives(f"{tree}/*/*", name_parts=2)]
    assert names == ["v1_20260301", "v1_20260308", "v2_20260301", "v2_20260308"]


def test_vehicle_and_date_by_an_expression(tree: Path) -> None:
    drives = find_drives(f"{tree}/*/*", name_parts=2)
    found = with_vehicles(drives, r"(?P<vehicle>v\d)/(?P<date>\d{8})$")
    assert [drive.vehicle for drive in found] == ["v1", "v1", "v2", "v2"]
    assert found[1].day - found[0].day == 7.0  # type: ignore[operator]
    assert with_vehicles(drives, r"/(v\d)/")[3].vehicle == "v2"
    # A group that takes no part in the match says nothing; the date is no vehicle.
    found = with_vehicles(drives, r"(?P<date>\d{8})$|(?P<vehicle>v2)")
    assert [drive.vehicle for drive in found] == ["", "", "v2", "v2"]
    assert with_vehicles(drives, r"(v\d)/(?P<date>\d{8})$")[0].vehicle == "v1"


def test_vehicle_and_date_by_a_table(tree: Path, tmp_path: Path) -> None:
    table = tmp_path / "vehicles.csv"
    table.write_text(f"drive,vehicle,date\n20260301,car 7,2026-03-01T12:00:00\n{tree}/v1/20260308,car 7,\n")
    first, second = with_vehicles(find_drives(str(tree / "v1")), str(table))
    assert (first.vehicle, first.date) == ("car 7", "2026-03-01T12:00:00+00:00")
    assert (second.vehicle, second.date, second.day) == ("car 7", "", None)


@pytest.mark.parametrize(
    "text", ["2026-03-01", "20260301", "2026_03_01", "2026-03-01T00:00:00Z", "20260301_000000"]
)
def test_ways_to_write_a_day(text: str, tmp_path: Path) -> None:
    table = tmp_path / "list.csv"
    table.write_text(f"drive,date\nx,{text}\n")
    assert find_drives(str(table))[0].day == 20513.0  # 2026-03-01 after 1970-01-01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no drive|columns"),
        ("name\nx\n", "a column drive"),
        ("drive,date\nx,yesterday\n", "date 'yesterday'"),
        ("drive,date\n,2026-01-01\n", "empty cell"),
        ("drive\nx,y,z\n", "too many cells"),
        ('drive\n"x\n', "unexpected end of data"),
        ("drive\nx\0y\n", "zero byte"),
        ("drive,name\na,same\nb,same\n", "two drives named same"),
    ],
)
def test_a_table_that_is_none(tmp_path: Path, text: str, words: str) -> None:
    table = tmp_path / "list.csv"
    table.write_text(text)
    with pytest.raises(SstGraphError, match=words):
        find_drives(str(table))


def test_a_list_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "list").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="UTF-8"):
        find_drives(str(tmp_path / "list"))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("(", "no regular expression"),
        ("(" * 5000, "no regular expression"),
        ("a{99999999999}", "no regular expression"),
        ("v1", "no group"),
        (r"(?P<date>\d{8})", "no group"),
        ("(nothing)", "no vehicle"),
    ],
)
def test_an_expression_that_is_none(tree: Path, given: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        with_vehicles(find_drives(str(tree / "v1")), given)


def test_a_folder_whose_name_looks_like_a_pattern(tmp_path: Path) -> None:
    (tmp_path / "runs [1]" / "a").mkdir(parents=True)
    assert [drive.name for drive in find_drives(str(tmp_path / "runs [1]"))] == ["a"]


@pytest.mark.parametrize("what", ["", " "])
def test_an_empty_name_is_not_the_root(what: str) -> None:
    with pytest.raises(ConfigError, match="an empty name"):
        find_drives(what)


@pytest.mark.parametrize("what", ["nowhere", "nowhere/*"])
def test_nothing_there(tmp_path: Path, what: str) -> None:
    with pytest.raises(ConfigError, match="found n"):
        find_drives(str(tmp_path / what))


def test_names_fit_into_file_names() -> None:
    assert file_name("a/b c\n(é).mcap") == "a_b_c_.mcap"
    assert file_name("../../x") == "x" and file_name("..") == "_" and len(file_name("x" * 999)) == 150
    assert Drive("x", Place.of("/a/b/")).place.url == "/a/b"
