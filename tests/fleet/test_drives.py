"""Drives from folders, patterns and lists; vehicles and dates from expressions and tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from sst_graph.errors import ConfigError, DataError, SstGraphError
from sst_graph.fleet.drives import ListedDrive, file_name, find_drives, loose_files, with_vehicles
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


def test_loose_files_in_a_folder_are_no_drives(tree: Path) -> None:
    for name in ("README.md", "fleet.csv", "a.BAG", "b.mcap", "c.db3", ".hidden.txt"):
        (tree / "v1" / name).write_text("x")
    found = find_drives(str(tree / "v1"))
    assert [drive.place.name for drive in found] == ["20260301", "20260308", "a.BAG", "b.mcap", "c.db3"]
    assert loose_files(str(tree / "v1")) == ["README.md", "fleet.csv"]
    # Who names them wants them.
    assert len(find_drives(f"{tree}/v1/*.md")) == 1 and loose_files(f"{tree}/v1/*") == []
    (tree / "loose").mkdir()
    (tree / "loose" / "notes.txt").write_text("x")
    with pytest.raises(ConfigError, match=r"loose: found no drive, expected at least one folder or bag"):
        find_drives(str(tree / "loose"))


def test_drives_of_one_name_are_refused_and_told_apart_by_the_folder_above(tree: Path) -> None:
    with pytest.raises(ConfigError, match=r"two drives named 20260301.*--name-parts 2"):
        find_drives(f"{tree}/*/*")
    names = [drive.name for drive in find_drives(f"{tree}/*/*", name_parts=2)]
    assert names == ["v1_20260301", "v1_20260308", "v2_20260301", "v2_20260308"]


def test_a_drive_that_is_listed_twice_is_told(tree: Path, tmp_path: Path) -> None:
    """No number of parts would make two names of one place."""
    listed = tmp_path / "list.txt"
    listed.write_text(f"{tree}/v1/20260301\n{tree}/v2/../v1/20260301/\n")
    with pytest.raises(ConfigError, match=r"found the drive 20260301 twice, expected each drive once"):
        find_drives(str(listed))


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


def test_a_table_names_a_drive_by_its_folder(tmp_path: Path) -> None:
    """Also where the folder's name is no name of a result: with blanks and signs."""
    (tmp_path / "data" / "run 1 – rain").mkdir(parents=True)
    table = tmp_path / "vehicles.csv"
    table.write_text("drive,vehicle\nrun 1 – rain,car 7\n")
    (found,) = with_vehicles(find_drives(str(tmp_path / "data")), str(table))
    assert (found.name, found.vehicle) == ("run_1_rain", "car 7")


def test_a_table_is_of_one_vehicle_a_drive(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However the path is written; a row that is there twice alike says nothing new."""
    monkeypatch.chdir(tree)
    drives, table = find_drives("v1"), tmp_path / "vehicles.csv"
    table.write_text(f"drive,vehicle\n./v1/20260301,a\n{tree}/v1/20260308,a\n{tree}/v1/20260308,a\n")
    assert [drive.vehicle for drive in with_vehicles(drives, str(table))] == ["a", "a"]
    table.write_text(f"drive,vehicle\nv1/20260301,a\n{tree}/v1/20260301/,b\n")
    with pytest.raises(DataError, match=r"two rows of the drive .*v1/20260301/, expected one vehicle"):
        with_vehicles(drives, str(table))


def test_vehicles_of_one_file_name_are_refused_before_anything_is_run(tree: Path, tmp_path: Path) -> None:
    table = tmp_path / "list.csv"
    table.write_text("drive,vehicle\na,car 7\nb,car_7\nc,\nd,_\n")
    with pytest.raises(ConfigError, match=r"vehicles 'car 7' and 'car_7': found one file car_7.json"):
        find_drives(str(table))
    table.write_text("drive,vehicle\n20260301,car 7\n20260308,car/7\n")
    with pytest.raises(ConfigError, match=r"found one file car_7.json"):
        with_vehicles(find_drives(str(tree / "v1")), str(table))
    table.write_text("drive,vehicle\na,東京\nb,京都\n")
    assert [drive.vehicle for drive in find_drives(str(table))] == ["東京", "京都"]


def test_a_wrong_date_names_the_drive(tree: Path) -> None:
    with pytest.raises(DataError, match=r"v1/20260301: found the date .301."):
        with_vehicles(find_drives(str(tree / "v1")), r"(?P<vehicle>v1)/20260(?P<date>\d+)")


def test_a_number_sign_within_a_path_is_no_comment(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_bytes(b"\xef\xbb\xbf#1\r\n/data/run#1\r\n/data/run#2\t# rain\r\n")
    found = find_drives(str(tmp_path / "list.txt"))
    assert [drive.place.url for drive in found] == ["/data/run#1", "/data/run#2"]


@pytest.mark.parametrize(
    "text", ["2026-03-01", "20260301", "2026_03_01", "2026-03-01T00:00:00Z", "20260301_000000"]
)
def test_ways_to_write_a_day(text: str, tmp_path: Path) -> None:
    table = tmp_path / "list.csv"
    table.write_text(f"drive,date\nx,{text}\n")
    assert find_drives(str(table))[0].day == 20513.0  # 2026-03-01 after 1970-01-01


@pytest.mark.parametrize(
    "text",
    [
        "2026-03-01_10-15",
        "2026-03-01-10-15",
        "2026-03-01T10-15",
        "20260301_10-15",
        "2026_03_01-10_15_00",
        "2026-03-01_10-15-00",
        "20260301T1015",
        "20260301-1015",
        "2026-03-01T04:15-06:00",
        "2026-03-01T04:15-06",
    ],
)
def test_ways_to_write_an_hour_and_a_minute(text: str, tmp_path: Path) -> None:
    table = tmp_path / "list.csv"
    table.write_text(f"drive,date\nx,{text}\n")
    assert find_drives(str(table))[0].day == pytest.approx(20513.0 + 10.25 / 24.0, abs=1e-9)


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
    assert file_name("a/b c\n(é).mcap") == file_name("a/b c\n(e\u0301).mcap") == "a_b_c_é_.mcap"
    assert file_name("東京 7") == "東京_7" and len(file_name("東" * 999).encode()) == 150
    assert file_name("../../x") == "x" and file_name("..") == "_" and len(file_name("x" * 999)) == 150
    assert ListedDrive("x", Place.of("/a/b/")).place.url == "/a/b"
