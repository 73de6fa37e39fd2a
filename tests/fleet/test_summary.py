"""Records, tables and the page: nothing is hidden, what needs attention comes first."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import gtsam
import numpy as np
import pytest
from fleet.vehicle_drives import RIG, SIGMAS

from sst_graph import report
from sst_graph.errors import DataError
from sst_graph.export import fuse_marginals, marginal_of_result
from sst_graph.factors import FactorError, PinholeCamera
from sst_graph.fleet import BatchConfig, ListedDrive, Place, Record, write_summary
from sst_graph.fleet.record import Cost, Numbers, Status
from sst_graph.fleet.summary import page as summary_page
from sst_graph.fleet.summary.tables import own_reason
from sst_graph.fleet.vehicles.fused import vehicle_of
from sst_graph.fleet.vehicles.walk import WalkConfig
from sst_graph.reference import read_reference
from sst_graph.result import CalibrationResult


def test_every_status_has_a_colour_and_a_rank() -> None:
    style = (Path(summary_page.__file__).parent / "page.css").read_text()
    ranks = [Record("d", "/d", status).attention for status in get_args(Status)]
    assert sorted(ranks) == list(range(len(ranks)))
    for status in get_args(Status):
        assert re.search(rf"\.s-{status}\b", style), status


def _luminance(colour: str) -> float:
    """Of #rrggbb, as WCAG 2 has it."""
    values = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_a_status_can_be_read_on_its_colour_in_light_and_dark() -> None:
    own = (Path(summary_page.__file__).parent / "page.css").read_text()
    shared = (Path(report.__file__).parent / "page.css").read_text()
    (text,) = re.findall(r"\.tag \{[^}]*[ ;]color: var\(--(\w+)\)", own)
    grounds = set(re.findall(r"background: var\(--(\w+)\); \}", own)) - {"panel"}
    light = dict(re.findall(r"--(\w+): (#\w{6})", shared.split("@media")[0]))
    dark = light | dict(re.findall(r"--(\w+): (#\w{6})", shared.split("@media")[1]))
    assert len(grounds) == 4 and light["back"] != dark["back"]
    for colours in (light, dark):
        for ground in grounds:
            high, low = sorted((_luminance(colours[text]), _luminance(colours[ground])), reverse=True)
            assert (high + 0.05) / (low + 0.05) > 4.3, ground


CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1242, 375)
SHIFT = np.array([0.0, 0.002, 0.0, 0.01, 0.0, 0.0, 0.0])
"""Of the estimate by a principal point that is off by one sigma."""


def result(seed: int, status: str = "ok", knock: float = 0.0) -> CalibrationResult:
    """With errors as its covariance says, part of which is that of an assumption."""
    rng = np.random.default_rng(seed)
    error = rng.normal(size=7) * SIGMAS
    error[2] += knock
    return CalibrationResult(
        RIG.retract(error[:6]),
        0.02 + error[6],
        np.diag(SIGMAS**2) + np.outer(SHIFT, SHIFT),
        status,  # type: ignore[arg-type]
        CAMERA,
        reasons=() if status == "ok" else ("because",),
        diagnostics={"assumptions": {"cx": {"sigma": 0.5, "sensitivity": (SHIFT / 0.5).tolist()}}},
    )


def done(name: str, found: CalibrationResult) -> Record:
    reason = "; ".join(found.reasons)
    return Record(
        name, f"/data/{name}", found.status, reason, Cost(1, 9.0, 8.0, 10**8, 10**6), Numbers.of(found)
    )


def drive(name: str, vehicle: str = "", date: str = "") -> ListedDrive:
    return ListedDrive(name, Place(f"/data/{name}"), vehicle, date)


@pytest.fixture
def batch() -> tuple[list[ListedDrive], dict[str, Record]]:
    """Six drives of a vehicle that is knocked before the fourth, and one of each kind of failure."""
    drives = [drive(f"a{k}", "car 1", f"2026-03-{k + 1:02d}T00:00:00+00:00") for k in range(6)]
    records = [done(f"a{k}", result(k, knock=0.03 * (k >= 3))) for k in range(6)]
    drives += [drive("b0", "car 2"), drive("c0", "<b>car</b> 3"), drive("d0"), drive("e0")]
    records += [
        done("b0", result(9, "not_converged")),
        Record("c0", "/data/c0", "bad_input", "=cmd|x: <script>alert(1)</script>", log=("a", "b")),
        Record("d0", "/data/d0", "crash", "ended by SIGSEGV after 1.0 s", Cost(3, 1.0, 1.0, 10**9, 10**6)),
    ]
    return drives, {one.drive: one for one in records}


def test_the_summary_says_it_all(batch: tuple[list[ListedDrive], dict[str, Record]], tmp_path: Path) -> None:
    drives, records = batch
    outcome = write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    assert not outcome.all_fine
    rows = list(csv.DictReader(io.StringIO((tmp_path / "summary.csv").read_text())))
    assert [row["drive"] for row in rows][:4] == ["d0", "c0", "e0", "b0"] and len(rows) == 10
    status = {row["drive"]: row["status"] for row in rows}
    assert (status["e0"], status["d0"], status["b0"]) == ("not_run", "crash", "not_converged")
    by_name = {row["drive"]: row for row in rows}
    assert by_name["c0"]["reason"].startswith("'=cmd") and by_name["c0"]["sigma_rot_x_deg"] == ""
    assert float(by_name["a0"]["sigma_trans_x_cm"]) == pytest.approx(100.0 * np.hypot(SIGMAS[3], SHIFT[3]))
    assert by_name["a0"]["report"] == "drives/a0/report.html" and by_name["d0"]["report"] == ""
    vehicles = {one["vehicle"]: one for one in csv.DictReader((tmp_path / "vehicles.csv").open())}
    assert vehicles["car 1"]["status"] == "changed" and "between a2 and a3" in vehicles["car 1"]["reason"]
    assert "2026-03-03 to 2026-03-04" in vehicles["car 1"]["reason"]
    assert vehicles["car 2"]["status"] == "no_result" and vehicles["car 2"]["without"] == "1"
    stored = json.loads((tmp_path / "vehicles/car_1.json").read_text())
    assert [(one["after"], one["before"]) for one in stored["changes"]] == [("a2", "a3")]
    assert len(stored["drift"]) == 6 and stored["calibration"]["drive"] == "a5"


def test_parquet_has_the_rows_of_the_csv(
    batch: tuple[list[ListedDrive], dict[str, Record]], tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    drives, records = batch
    outcome = write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    for name, rows in (("summary", outcome.rows), ("vehicles", None)):
        read = parquet.read_table(tmp_path / f"{name}.parquet").to_pylist()
        texts = list(csv.DictReader((tmp_path / f"{name}.csv").open()))
        assert len(read) == len(texts) and list(read[0]) == list(texts[0])
        assert rows is None or read == rows


def test_the_page_shows_failures_and_runs_nothing_of_the_data(
    batch: tuple[list[ListedDrive], dict[str, Record]], tmp_path: Path
) -> None:
    drives, records = batch
    write_summary(drives, records, Place.of(tmp_path), BatchConfig(options=("--no-report",)))
    page = (tmp_path / "summary.html").read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert(1)" in page and "<b>car</b>" not in page
    assert "6 of 10 drives are ok; 3 have no result; 3 of 3 vehicles need attention" in page
    assert "1 × crash: ended by SIGSEGV after 1.0 s" in page
    assert 'href="drives/a0/report.md"' in page and "http" not in page.replace("http://www.w3.org", "")
    assert 'href="records/d0.json">d0</a>' in page and "records/e0" not in page
    # seven drives of 8 s and one of 1 s
    assert "Took 1.0 minutes of processor time" in page and "1.0 GB of memory at most" in page
    assert page.index(">d0</a>") < page.index('row">c0<') < page.index(">b0</a>") < page.index(">a0</a>")


def test_reasons_that_drives_share_are_counted_together(tmp_path: Path) -> None:
    drives = [drive(f"x{k}") for k in range(4)]
    records = {one.name: done(one.name, result(k, "not_converged")) for k, one in enumerate(drives)}
    more = (
        "2 more",
        "3 more reasons, mostly consequences of it;",
        "1 more and 1 more reason, a consequence of them;",
    )
    for k, name in enumerate(("x0", "x1", "x2")):
        words = f"{name}/00: the scans move by {0.5 * k} cm: say how ({more[k]} in its report)"
        records[name] = replace(records[name], reason=words)
    write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    page = (tmp_path / "summary.html").read_text()
    assert "<li>3 × not_converged: the scans move by … cm: say how</li>" in page
    assert "0 of 4 drives are ok; 0 have no result" in page


def test_a_contradiction_is_no_other_reason(tmp_path: Path) -> None:
    """What a drive says of itself is counted with others that say the same; that it contradicts, apart."""
    drives = [drive(f"x{k}", "v") for k in range(6)]
    records = {
        one.name: done(one.name, result(k, "unobservable", 0.03 * (k == 2))) for k, one in enumerate(drives)
    }
    long = (
        "the time offset is known to 340.2 ms only: record motion, several frames at some speed, with a " * 2
    )
    records |= {name: replace(record, reason=long + "turn") for name, record in records.items()}
    write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    page = (tmp_path / "summary.html").read_text()
    assert "<li>1 × contradicts the other drives of its vehicle</li>" in page
    (kind,) = re.findall(r"<li>6 × unobservable: ([^<]*)</li>", page)
    assert kind.endswith(" motion…") and long.replace("340.2", "…").startswith(kind[:-1])
    # The drives that count and those that do not are all there are.
    assert re.search(r'<td class="num">5</td><td class="num">1</td>', page)


def test_a_vehicle_whose_drives_all_leave_a_direction_open_is_unobservable(tmp_path: Path) -> None:
    """Each drive is, too; where they see different directions, the vehicle is ok."""
    drives = [drive("x", "v"), drive("y", "v")]

    def outcome(*wide: int) -> tuple[str, str]:
        records = {}
        for one, axis in zip(drives, wide, strict=True):
            found = result(1, "unobservable")
            covariance = np.array(found.covariance)
            covariance[axis, axis] = 0.3**2
            records[one.name] = done(one.name, replace(found, covariance=covariance))
        (vehicle,) = write_summary(drives, records, Place.of(tmp_path), BatchConfig()).vehicles
        return vehicle.status, vehicle.reason

    status, reason = outcome(6, 6)
    assert status == "unobservable" and reason.startswith("by all drives, the time offset is known to 2")
    assert "1 of 1 vehicle needs attention" in (tmp_path / "summary.html").read_text()
    assert outcome(6, 3) == ("ok", "")


def test_charts_of_many_drives_stay_small_and_show_their_change(tmp_path: Path) -> None:
    """60 vehicles with charts of 130 kB and 5,000 drives in the table are a page of 10 MB."""
    drives = [drive(f"a{k:03d}", "v", f"2026-01-01T{k // 4:02d}:{k % 4}0:00+00:00") for k in range(80)]
    records = {one.name: done(one.name, result(k, knock=0.06 * (k >= 33))) for k, one in enumerate(drives)}
    write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    page = (tmp_path / "summary.html").read_text()
    charts = page[page.index('id="drift"') : page.index('id="drives"')]
    assert len(charts) < 130_000
    titles = re.findall(r"<title>(a\d+)</title>", charts)
    assert {"a000", "a032", "a033", "a079"} <= set(titles)
    assert len(set(titles)) <= summary_page.MOST_IN_A_CHART + 2 and len(titles) == 7 * len(set(titles))


def test_drives_of_earlier_runs_that_are_not_given_are_told(tmp_path: Path) -> None:
    for name in ("x", "y", "z"):
        (tmp_path / "drives" / name).mkdir(parents=True)
    records = {"x": done("x", result(0))}
    outcome = write_summary([drive("x")], records, Place.of(tmp_path), BatchConfig())
    assert outcome.others == 2
    page = (tmp_path / "summary.html").read_text()
    assert "2 drives of earlier runs were not given this time: they are in no table and in no vehicle" in page


def test_a_drift_is_not_drawn_across_a_change(
    batch: tuple[list[ListedDrive], dict[str, Record]], tmp_path: Path
) -> None:
    drives, records = batch
    write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    page = (tmp_path / "summary.html").read_text()
    rotation = page[page.index("Rotation") :].split("</svg></figure>")[0].split("Translation")[0]
    # Three axes, each drawn before the change and after it.
    assert len(re.findall('class="line [abc]"', rotation)) == 6
    assert len(re.findall('class="band [abc]"', rotation)) == 6


def test_all_fine(tmp_path: Path) -> None:
    drives = [drive("x", "v"), drive("y", "v")]
    records = {name: done(name, result(k)) for k, name in enumerate("xy")}
    assert write_summary(drives, records, Place.of(tmp_path), BatchConfig()).all_fine


def test_a_summary_leaves_nothing_of_an_earlier_one(tmp_path: Path) -> None:
    """Vehicles that have another name, or none, when the command is given again."""
    records = {"x": done("x", result(0))}
    for vehicle, files in (("old", ["old.json"]), ("new", ["new.json"]), ("", [])):
        write_summary([drive("x", vehicle)], records, Place.of(tmp_path), BatchConfig())
        assert sorted(path.name for path in tmp_path.glob("vehicles/*")) == files
        assert (tmp_path / "vehicles.csv").exists() == bool(vehicle)


def test_a_contradicting_drive_stands_before_those_that_are_ok(tmp_path: Path) -> None:
    drives = [drive(f"x{k}", "v") for k in range(6)]
    records = {one.name: done(one.name, result(k, knock=0.03 * (k == 2))) for k, one in enumerate(drives)}
    outcome = write_summary(drives, records, Place.of(tmp_path), BatchConfig())
    assert outcome.rows[0]["drive"] == "x2" and outcome.rows[0]["contradicts"] is True
    assert "contradicts the other drives of v" in str(outcome.rows[0]["reason"]) and not outcome.all_fine


def test_a_vehicle_is_a_start_and_a_truth(tmp_path: Path) -> None:
    """``--init`` and ``--truth`` read the calibration of its file."""
    drives = [drive("x", "v"), drive("y", "v"), drive("z", "w")]
    named = [replace(result(k), camera_name="image_2") for k in range(2)]
    records = {name: done(name, found) for name, found in zip("xy", named, strict=True)}
    (known, _) = write_summary(drives, records, Place.of(tmp_path), BatchConfig()).vehicles
    found = read_reference(tmp_path / "vehicles/v.json", "image_2")
    assert known.calibration is not None and found.cTl.equals(known.calibration.cTl, 1e-12)
    assert found.time_offset_s == pytest.approx(known.calibration.time_offset_s)
    with pytest.raises(DataError, match=r"a calibration of camera image_2, expected one of image_3"):
        read_reference(tmp_path / "vehicles/v.json", "image_3")
    with pytest.raises(DataError, match="a vehicle without a calibration"):
        read_reference(tmp_path / "vehicles/w.json")


def test_what_drives_have_in_common_does_not_average_out() -> None:
    """Sixteen drives: their own errors fall to a quarter, that of the assumption stays."""
    drives = [drive(f"x{k:02d}", "v") for k in range(16)]
    results = [result(k) for k in range(16)]
    records = {one.name: done(one.name, found) for one, found in zip(drives, results, strict=True)}
    still = WalkConfig(rotation_deg=1e-4, translation_m=1e-5, time_offset_s=1e-6)
    now = vehicle_of("v", drives, records, still).calibration
    assert now is not None
    expected = np.sqrt(SIGMAS**2 / 16.0 + SHIFT**2)
    np.testing.assert_allclose(np.sqrt(np.diag(now.covariance)), expected, rtol=0.02)
    fused = fuse_marginals([marginal_of_result(one) for one in results])
    assert np.linalg.norm(fused.cTl.localCoordinates(now.cTl)) < 1e-5


def test_a_drive_that_is_there_twice_counts_once() -> None:
    drives, scans = [drive(name, "v") for name in ("a", "copy", "b")], ("0" * 16, "1" * 16, "2" * 16)
    records = {
        name: done(name, replace(result(k), diagnostics={**result(k).diagnostics, "scan_hashes": scans[k:]}))
        for name, k in (("a", 1), ("copy", 1))
    }
    records["b"] = done("b", result(2))
    found = vehicle_of("v", drives, records, WalkConfig())
    assert found.drives == ("a", "b")
    assert found.without == {"copy": "it holds scans of a, which count once"}
    assert Record.from_json(records["copy"].to_json().encode(), "record.json") == records["copy"]
    alone = vehicle_of("v", [drives[0], drives[2]], records, WalkConfig()).calibration
    assert found.calibration is not None and alone is not None
    np.testing.assert_array_equal(found.calibration.covariance, alone.covariance)


def test_a_drive_that_is_left_out_of_its_vehicle_says_why(tmp_path: Path) -> None:
    """Its own result is right, so the status does not tell."""
    drives = [drive("a", "v"), drive("copy", "v")]
    twice = replace(result(1), diagnostics={**result(1).diagnostics, "scan_hashes": ("0" * 16,)})
    records = {one.name: done(one.name, twice) for one in drives}
    rows = write_summary(drives, records, Place(str(tmp_path)), BatchConfig()).rows
    assert [(row["drive"], row["status"], row["reason"]) for row in rows] == [
        ("copy", "ok", "not counted for v: it holds scans of a, which count once"),
        ("a", "ok", ""),
    ]
    assert own_reason(rows[0]) == ""


def test_drives_of_two_cameras_are_told() -> None:
    drives = [drive("a", "v"), drive("b", "v")]
    results = [replace(result(k), camera_name=name) for k, name in enumerate(("front", "left"))]
    records = {one.name: done(one.name, found) for one, found in zip(drives, results, strict=True)}
    found = vehicle_of("v", drives, records, WalkConfig())
    assert found.reason.startswith("its drives name 2 cameras (front, left), which are fused as one")
    records["b"] = done("b", replace(results[1], camera_name="front"))
    assert vehicle_of("v", drives, records, WalkConfig()).reason == ""


def test_drives_without_dates_count_in_their_order() -> None:
    drives = [drive("z", "v"), drive("a", "v"), drive("m", "v", "2026-03-01T00:00:00+00:00")]
    records = {one.name: done(one.name, result(k)) for k, one in enumerate(drives)}
    found = vehicle_of("v", drives, records, WalkConfig())
    assert (found.drives, found.days, found.dated) == (("z", "a", "m"), (0.0, 1.0, 2.0), False)
    dated = [replace(one, date=f"2026-03-0{9 - k}T00:00:00+00:00") for k, one in enumerate(drives)]
    assert vehicle_of("v", dated, records, WalkConfig()).drives == ("m", "a", "z")


def test_one_drive_without_a_date_leaves_no_date_to_a_change() -> None:
    """The list begins with the later drives: by their dates the step is from v to u, by the list the other
    way."""
    listed = {"t": "2026-03-01", "u": "2026-03-08", "v": "2026-01-01", "w": "2026-01-08", "x": ""}
    drives = [drive(name, "car", date) for name, date in listed.items()]
    later = result(0).T_camera_lidar.retract(np.radians([0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    records = {
        name: done(name, replace(result(k), **({"T_camera_lidar": later} if name in "tu" else {})))
        for k, name in enumerate(listed)
    }
    found = vehicle_of("car", drives, records, WalkConfig())
    assert not found.dated and found.undated == ("x",)
    (change,) = found.changes
    assert change.words.startswith("between u and v: rotation by") and "2026" not in change.words
    assert "no date of x: its drives count in the order of the list" in found.reason
    dated = vehicle_of("car", drives[:4], records, WalkConfig())
    assert dated.undated == () and "between w and t (2026-01-08 to 2026-03-01)" in dated.reason
    in_order = [drives[2], drives[3], drives[0], drives[1], drives[4]]
    assert vehicle_of("car", in_order, records, WalkConfig()).undated == ()


def test_a_record_reads_back() -> None:
    for record in (done("x", result(1)), Record("y", "s3://b/y", "crash", "died", log=("one", "two"))):
        assert Record.from_json(record.to_json().encode(), "record.json") == record


@pytest.mark.parametrize(
    "changed", [{"status": "fine"}, {"cost": 3}, {"numbers": {}}, {"log": [1]}, {"version": 1}, {"drive": 7}]
)
def test_a_record_that_is_none(changed: dict[str, object]) -> None:
    document = json.loads(done("x", result(1)).to_json()) | changed
    with pytest.raises(DataError, match=r"record\.json"):
        Record.from_json(json.dumps(document).encode(), "record.json")


def test_a_record_with_a_number_beyond_64_bits() -> None:
    document = json.loads(done("x", result(1)).to_json())
    document["cost"]["peak_bytes"] = 2**63
    with pytest.raises(DataError, match=r"cost: peak_bytes: found 9.22e\+18, expected a whole number of 64"):
        Record.from_json(json.dumps(document).encode(), "record.json")


@pytest.mark.parametrize(
    ("i", "j", "value", "found"),
    [(0, 0, -1e-6, "a variance of -1e-06"), (0, 1, 1.0, "a correlation of"), (2, 5, 1e-3, "symmetric")],
)
def test_a_record_of_another_matrix_than_a_covariance(i: int, j: int, value: float, found: str) -> None:
    document = json.loads(done("x", result(1)).to_json())
    document["numbers"]["covariance"][i][j] = value
    if found != "symmetric":
        document["numbers"]["covariance"][j][i] = value
    with pytest.raises(DataError, match=f"covariance: .*{found}"):
        Record.from_json(json.dumps(document).encode(), "record.json")


def test_a_record_with_common_errors_beyond_all_bounds() -> None:
    document = json.loads(done("x", result(1)).to_json())
    document["numbers"]["common_errors"] = {"cx": [1e200] * 7}
    record = Record.from_json(json.dumps(document).encode(), "record.json")
    assert record.numbers is not None
    with pytest.raises(FactorError, match="more than its covariance"):
        record.numbers.marginal()


def test_the_pose_in_the_table_is_that_of_the_result(tmp_path: Path) -> None:
    found = result(5)
    outcome = write_summary([drive("x")], {"x": done("x", found)}, Place.of(tmp_path), BatchConfig())
    row = outcome.rows[0]
    w, x, y, z = (float(row[f"quat_{name}"]) for name in "wxyz")  # type: ignore[arg-type]
    rotation = gtsam.Rot3.Quaternion(w, x, y, z)
    assert rotation.equals(found.T_camera_lidar.rotation(), 1e-9) and row["vehicle"] == ""
