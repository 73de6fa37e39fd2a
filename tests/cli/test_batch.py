"""``sst-graph batch`` as a user calls it: drives that fail alone, kills, resuming, S3, Dask."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

import sst_graph
from sst_graph.cli import main
from sst_graph.fleet import Place, Record

PROGRAM = [sys.executable, "-m", "sst_graph"]
FAST = ["--no-report"]


@pytest.fixture
def drives(kitti_drive: Path, tmp_path: Path) -> Path:
    """Three drives of a few pixels (no vehicle, so unobservable), and one whose calib.txt is cut off."""
    folder = tmp_path / "drives"
    for name in ("v1_2026-03-01", "v1_2026-03-08", "v2_2026-03-01", "v2_2026-03-08"):
        shutil.copytree(kitti_drive.parents[1], folder / name)
    (folder / "v2_2026-03-08/sequences/00/calib.txt").write_text("P0: 1")
    return folder


def test_a_drive_in_the_place_of_a_folder_of_drives_is_told(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What stands in it is no drive; without the note its errors name folders that were never given."""
    drive = drives / "v1_2026-03-01"
    command = ["batch", str(drive), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(command) == 3
    told = capsys.readouterr().err
    assert f"note: {drive} looks like one drive (kitti); what stands in it (sequences) is taken for" in told
    assert main(["batch", str(drives), "--out", str(tmp_path / "other"), "--vehicle-from", "x(y)"]) == 2
    assert "looks like one drive" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_folder_of_bags_is_a_folder_of_drives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without metadata.yaml; with it, the folder is one bag, and that is said."""
    folder = tmp_path / "day"
    folder.mkdir()
    for name in ("a.mcap", "b.mcap"):
        (folder / name).write_bytes(b"no bag")
    main(["batch", str(folder), "--out", str(tmp_path / "out")])
    assert "looks like one drive" not in capsys.readouterr().err
    (folder / "metadata.yaml").touch()
    main(["batch", str(folder), "--out", str(tmp_path / "again")])
    assert f"note: {folder} looks like one drive (ros)" in capsys.readouterr().err


def test_loose_files_are_named_once_and_a_long_reason_is_short_on_the_terminal(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("v1_2026-03-01", "v1_2026-03-08", "v2_2026-03-01", "v2_2026-03-08"):
        shutil.rmtree(drives / name)
    (drives / "empty").mkdir()
    (drives / "README.md").write_text("x")
    (drives / "fleet.csv").write_text("drive\n")
    out = tmp_path / "out"
    assert main(["batch", str(drives), "--out", str(out), "--workers", "1"]) == 3
    said = capsys.readouterr()
    assert f"note: {drives}: 2 files left out: README.md, fleet.csv (" in said.err
    for text in (said.out, said.err):
        (line,) = [one for one in text.splitlines() if "found no layout that is known" in one]
        assert len(line) < 250 and line.endswith(" (more in records/empty.json)")
    record = Record.from_json((out / "records/empty.json").read_bytes(), "record")
    assert "expected KITTI odometry" in record.reason and len(record.reason) > 300


@pytest.mark.slow
def test_a_batch_in_the_folder_of_its_drives_goes_on(
    drives: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its own folder is no drive, when the same command is given again."""
    for name in ("v1_2026-03-01", "v1_2026-03-08", "v2_2026-03-01"):
        shutil.rmtree(drives / name)
    command = ["batch", str(drives), "--out", str(drives / "out"), "--workers", "1"]
    for _ in range(2):
        assert main(command) == 3
        assert "1: 1 bad_input" in capsys.readouterr().out
    shutil.rmtree(drives / "v2_2026-03-08")
    assert main(command) == 2
    assert "found no drive beside this folder of the batch" in capsys.readouterr().err


def rows_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open(newline="") as stream:
        return {row["drive"]: row for row in csv.DictReader(stream)}


def results(out: Path) -> dict[str, bytes]:
    return {str(one.relative_to(out)): one.read_bytes() for one in out.rglob("*") if one.is_file()}


@pytest.mark.slow
def test_a_bad_file_costs_that_drive_alone(
    drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    vehicle = ["--vehicle-from", r"(?P<vehicle>v\d)_(?P<date>[\d-]+)$"]
    command = ["batch", str(drives), "--out", str(out), "--workers", "2", *vehicle, *FAST]
    assert main(command) == 3
    said = capfd.readouterr()
    assert "4: 3 unobservable, 1 bad_input" in said.out and "calib.txt" in said.out
    rows = rows_of(out)
    assert [rows[f"{v}_2026-03-{d}"]["status"] for v, d in (("v1", "01"), ("v1", "08"), ("v2", "01"))] == [
        "unobservable"
    ] * 3
    assert rows["v2_2026-03-08"]["status"] == "bad_input" and not (out / "drives/v2_2026-03-08").exists()
    # each as the command itself makes it
    alone = tmp_path / "alone"
    assert main(["calibrate", str(drives / "v1_2026-03-08"), "--out", str(alone), *FAST]) == 3
    assert results(alone) == results(out / "drives/v1_2026-03-08")
    # again: nothing is run but what failed, which is mended by then
    shutil.copy(
        drives / "v2_2026-03-01/sequences/00/calib.txt", drives / "v2_2026-03-08/sequences/00/calib.txt"
    )
    before = {
        name: one.stat().st_mtime_ns for name in rows for one in (out / "drives").glob(f"{name}/*.json")
    }
    assert main(command) == 3
    assert {row["status"] for row in rows_of(out).values()} == {"unobservable"}
    after = {
        name: one.stat().st_mtime_ns for name in before for one in (out / "drives").glob(f"{name}/*.json")
    }
    assert before.items() <= after.items()
    assert json.loads((out / "vehicles/v1.json").read_text())["dated"] is True


def test_limits_are_recorded_with_what_was_taken(drives: Path, tmp_path: Path) -> None:
    one = [str(drives / "v1_*-01"), "--retries", "0", *FAST]
    assert main(["batch", *one, "--out", str(tmp_path / "a"), "--memory-limit", "0.04"]) == 3
    assert main(["batch", *one, "--out", str(tmp_path / "b"), "--time-limit", "0.2"]) == 3
    memory, wall = (rows_of(tmp_path / name)["v1_2026-03-01"] for name in "ab")
    assert memory["status"] == "memory_limit" and "GB of memory, more than 0.04 GB" in memory["reason"]
    assert float(memory["peak_mb"]) > 40.0
    assert (wall["status"], wall["reason"]) == ("time_limit", "took more than 0.2 s")
    for name in "ab":
        assert list((tmp_path / name).glob("drives/*")) == []  # nothing unfinished either


def wait_for(condition: object, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def running(pid: int) -> list[int]:
    """Processes that another one started."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(one) for one in task.read_text().split()]
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes by /proc")
@pytest.mark.slow
def test_killed_drives_are_tried_again_and_a_killed_batch_goes_on(drives: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.rmtree(drives / "v2_2026-03-08")
    command = [*PROGRAM, "batch", str(drives), "--out", str(out), "--workers", "1", *FAST]
    # 1. the process of a drive is killed: it is tried again
    batch = subprocess.Popen(command, stderr=subprocess.PIPE)
    wait_for(lambda: running(batch.pid))
    os.kill(running(batch.pid)[0], signal.SIGKILL)
    wait_for(lambda: len(list(out.glob("records/*"))) >= 1)
    # 2. the batch itself is killed: its drives end with it
    wait_for(lambda: running(batch.pid))
    orphans = running(batch.pid)
    batch.kill()
    batch.wait()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() and _is_alive(pid) for pid in orphans))
    assert not (out / "summary.csv").exists()
    # 3. Ctrl-C: it ends with a line, and no process stays
    batch = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    wait_for(lambda: running(batch.pid))
    orphans = running(batch.pid)
    batch.send_signal(signal.SIGINT)
    _, said = batch.communicate(timeout=60)
    assert batch.returncode == 130 and "interrupted" in said and "Traceback" not in said
    wait_for(lambda: not any(_is_alive(pid) for pid in orphans))
    assert not list(out.glob("drives/.*"))
    # 4. the same command finishes
    assert subprocess.run(command, check=False).returncode == 3
    rows = rows_of(out)
    assert len(rows) == 3 and {row["status"] for row in rows.values()} == {"unobservable"}
    assert max(int(row["attempts"]) for row in rows.values()) == 2
    assert main(["calibrate", str(drives / "v1_2026-03-01"), "--out", str(tmp_path / "alone"), *FAST]) == 3
    assert results(tmp_path / "alone") == results(out / "drives/v1_2026-03-01")


LEFT = (".v1_2026-03-01.sst-graph-partial", ".v1_2026-03-08.0123456789abcdef.sst-graph-partial")
"""Unfinished results of processes that are gone."""


def leave(out: Path) -> list[Path]:
    left = [out / "drives" / name for name in LEFT]
    for folder in left:
        (folder / "new").mkdir(parents=True)
    return left


def test_what_a_killed_batch_left_is_removed_when_the_next_one_begins(tmp_path: Path) -> None:
    """Not only when its drive is run: the next one may end before. What a living process writes stays."""
    from sst_graph.files.staging import claim
    from sst_graph.fleet import open_batch

    out = tmp_path / "out"
    with open_batch(Place(str(out)), ()):
        pass
    left, stage = leave(out), claim(out / "drives" / "v2_2026-03-01")
    for name in ("", "records", "vehicles"):
        (out / name).mkdir(exist_ok=True)
        left.append(out / name / ".v1.json.0123456789abcdef.sst-graph-partial")
        left[-1].write_text("{")
    (out / "drives" / "v1_2026-03-01").mkdir()
    with open_batch(Place(str(out)), ()):
        assert not any(one.exists() for one in left)
        assert stage.path.exists() and (out / "drives" / "v1_2026-03-01").exists()
    stage.release()


def test_another_version_that_goes_on_with_a_batch_is_told(tmp_path: Path) -> None:
    from sst_graph.fleet import open_batch

    out = tmp_path / "out"
    with open_batch(Place(str(out)), ()) as note:
        assert note == ""
    begun = out / "batch.json"
    begun.write_text(begun.read_text().replace(f'"{sst_graph.__version__}"', '"0.0.7"'))
    with open_batch(Place(str(out)), ()) as note:
        assert "begun by sst-graph 0.0.7" in note and sst_graph.__version__ in note


def test_what_ends_a_batch_leaves_nothing_unfinished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its drives are killed where they do not heed; who waits for them may not come to clean up."""
    from sst_graph.cli.commands.batch.ending import children_ended

    monkeypatch.setattr("sst_graph.fleet.isolated._ended", threading.Event())
    with pytest.raises(KeyError), children_ended(Place(str(tmp_path))):
        left = leave(tmp_path)
        raise KeyError
    assert not any(one.exists() for one in left)


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.slow
def test_from_s3_to_s3(drives: Path, tmp_path: Path, s3: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives are copied, results uploaded whole, and nothing stays on this machine."""
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    for name in ("v1_2026-03-01", "v2_2026-03-08"):
        Place.of(f"{s3}/in/{name}").upload(drives / name)
    command = ["batch", f"{s3}/in", "--out", f"{s3}/out", *FAST]
    assert main(command) == 3
    out = Place.of(f"{s3}/out")
    text = (out / "summary.csv").read().decode()
    assert "v1_2026-03-01,,,unobservable" in text and "v2_2026-03-08,,,bad_input" in text
    found = (out / "drives/v1_2026-03-01").fetch(tmp_path)
    assert main(["calibrate", str(drives / "v1_2026-03-01"), "--out", str(tmp_path / "alone"), *FAST]) == 3
    assert results(tmp_path / "alone") == results(found)
    assert list((tmp_path / "scratch").iterdir()) == []
    record = Record.from_json((out / "records/v1_2026-03-01.json").read(), "record")
    assert record.cost.attempts == 1 and record.cost.input_bytes > 1000
    (out / "drives/v2_2026-03-08").remove()
    assert main(command) == 3
    again = Record.from_json((out / "records/v1_2026-03-01.json").read(), "record")
    assert again == record  # not run again: it would have taken another time


@pytest.mark.slow
def test_a_drive_whose_files_have_changed_is_run_again(
    drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Where that fails, nothing is left of the old result. Data that are gone change nothing."""
    out, one = tmp_path / "out", drives / "v1_2026-03-01"
    command = ["batch", str(drives / "v1_*"), "--out", str(out), "--workers", "1", *FAST]
    assert main(command) == 3
    before = results(out / "drives")
    calib = next(one.rglob("calib.txt"))
    stored = out / "records" / f"{one.name}.json"
    record = Record.from_json(stored.read_bytes(), "record")
    stored.unlink()  # as where the batch is killed before it is written
    assert main(command) == 3
    assert replace(Record.from_json(stored.read_bytes(), "record"), cost=record.cost) == record
    *others, last = calib.read_text().rstrip().split(" ")
    calib.write_text(" ".join([*others, f"{float(last) + 0.01:.6f}\n"]))
    capfd.readouterr()
    assert main(command) == 3
    said = capfd.readouterr().err
    assert "2 drives, 1 of them done by an earlier run, 1 run again, for their files have changed" in said
    after = results(out / "drives")
    changed = {Path(name).parts[0] for name in before if before[name] != after[name]}
    assert changed == {one.name}
    whole = calib.read_text()
    calib.write_text("P0: 1")
    for _ in range(2):
        assert main(command) == 3
        assert rows_of(out)[one.name]["status"] == "bad_input" and not (out / "drives" / one.name).exists()
    calib.write_text(whole)
    assert main(command) == 3
    assert results(out / "drives") == after
    capfd.readouterr()
    shutil.rmtree(one)
    assert main(["batch", str(drives / "v1_*"), "--out", str(out), "--workers", "1", *FAST]) == 3
    assert "files have changed" not in capfd.readouterr().err
    assert results(out / "drives") == after


@pytest.mark.slow
def test_on_dask(drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    out = tmp_path / "out"
    one = str(drives / "v?_*-08")
    assert main(["batch", one, "--out", str(out), "--dask", "local", "--workers", "1", *FAST]) == 3
    assert {name: row["status"] for name, row in rows_of(out).items()} == {
        "v1_2026-03-08": "unobservable",
        "v2_2026-03-08": "bad_input",
    }
    assert "INFO" not in capfd.readouterr().err  # Dask's own business


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], "--workers 0"),
        (["--retries", "-1"], "--retries -1"),
        (["--time-limit", "nan"], "--time-limit nan"),
        (["--memory-limit", "0"], "--memory-limit 0"),
        (["--name-parts", "0"], "--name-parts 0"),
        (["--drift", "1,2"], "--drift 1,2"),
        (["--drift", "1,2,x"], "--drift 1,2,x"),
        (["--drift", "0,1,1"], "--drift 0,1,1: rotation_deg: found 0.0, expected at least 0.0001"),
        (["--false-alarm-rate", "2"], "--false-alarm-rate 2: false_alarm_rate: found 2.0"),
        (["--vehicle-from", "("], "no regular expression"),
        (["--set", "nothing=1"], "nothing"),
        (["--init", "nowhere.json"], "nowhere.json"),
        (["--classes", "cow"], "cow"),
        (["--frames", "x"], "frames 'x'"),
        (["--frames", "7:3"], "frames 7:3"),
        (["--loader", "rosbagg"], "rosbagg"),
        (["--sweep-start-deg", "1e9"], "sweep start"),
        (["--labels", "nowhere"], "--labels nowhere: found no file or folder"),
        (["--image-model", "nowhere.onnx"], "--image-model nowhere.onnx: found no file or folder"),
        (["--method", "none"], "--method"),
    ],
)
def test_usage(
    drives: Path, tmp_path: Path, options: list[str], words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["batch", str(drives), "--out", str(tmp_path / "out"), *options]) == 2
    said = capfd.readouterr().err
    assert words in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_places_that_are_taken(drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("x")
    (tmp_path / "file").write_text("x")
    for out, words in (
        (drives, "found the drive"),
        (drives / "v1_2026-03-01" / "out", "found the drive"),
        (tmp_path / "other", "without batch.json"),
        (tmp_path / "file", "found a file"),
    ):
        assert main(["batch", str(drives), "--out", str(out)]) == 2
        assert words in capfd.readouterr().err
    assert main(["batch", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2


def test_other_options_do_not_mix(drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    bad = str(drives / "v2_*-08")
    assert main(["batch", bad, "--out", str(out), "--retries", "0"]) == 3
    assert main(["batch", bad, "--out", str(out), "--set", "seed=1"]) == 2
    said = capfd.readouterr().err
    assert "was begun with the options (none), found --set=seed=1" in said
    (out / "batch.json").write_text("{")
    assert main(["batch", bad, "--out", str(out)]) == 2


@pytest.mark.slow
def test_drives_of_no_known_vehicle_are_named(
    drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("v1_2026-03-01", "v1_2026-03-08", "v2_2026-03-01"):
        (drives / name / "sequences/00/calib.txt").write_text("P0: 1")
    command = ["batch", str(drives), "--out", str(tmp_path / "out"), "--vehicle-from", r"(?P<vehicle>v1)_"]
    assert main(command) == 3
    said = capfd.readouterr().err
    assert "note: no vehicle is known of 2 drives: v2_2026-03-01, v2_2026-03-08" in said


@pytest.mark.slow
def test_vehicles_of_which_some_drives_have_no_date_are_named(
    drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Then none of their dates counts."""
    for scan in drives.glob("v1_2026-03-08/*/*/velodyne/*.bin"):  # no copy of the other drive
        scan.write_bytes(scan.read_bytes()[16:] + scan.read_bytes()[:16])
    listed = tmp_path / "list.csv"
    rows = [
        f"{drives}/v1_2026-03-01,a,2026-03-01",
        f"{drives}/v1_2026-03-08,a,",
        f"{drives}/v2_2026-03-01,b,",
    ]
    listed.write_text("\n".join(["drive,vehicle,date", *rows]))
    assert main(["batch", str(listed), "--out", str(tmp_path / "out"), *FAST]) == 3
    said = capfd.readouterr().err
    assert "note: some drives have no date, so their order counts, of the vehicles a\n" in said


@pytest.mark.slow
def test_a_file_of_the_options_is_the_same_to_the_end(
    drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """An edited --config would give half of the drives other settings."""
    (tmp_path / "settings.json").write_text('{"seed": 1}')
    command = ["batch", str(drives / "v2_*-08"), "--out", str(tmp_path / "out"), "--retries", "0"]
    command += ["--config", str(tmp_path / "settings.json")]
    assert main(command) == 3 == main(command)
    (tmp_path / "settings.json").write_text('{"seed": 2}')
    capfd.readouterr()
    assert main(command) == 2
    said = capfd.readouterr().err
    assert f"was begun with other contents of --config={tmp_path}/settings.json" in said


@pytest.mark.parametrize(
    ("option", "named", "changed"),
    [
        ("--camera-file", "camera.yaml", "camera.yaml"),
        ("--image-model", "net.yaml", "net.onnx"),
        ("--image-model", "net.onnx", "net.onnx.data"),
        ("--lidar-model", ".", "data_cfg.yaml"),
    ],
)
@pytest.mark.slow
def test_a_network_of_the_options_is_the_same_to_the_end(
    drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], option: str, named: str, changed: str
) -> None:
    """Its weights, beside what describes it, or a file of its folder: labels would be of two networks. A
    camera's file, too."""
    nets = tmp_path / "nets"
    nets.mkdir()
    (nets / "camera.yaml").write_text("1")
    (nets / "net.yaml").write_text("network: net.onnx\nclasses: coco\n")
    for name in ("net.onnx", "net.onnx.data", "data_cfg.yaml"):
        (nets / name).write_text("1")
    command = ["batch", str(drives / "v2_*-08"), "--out", str(tmp_path / "out"), "--retries", "0"]
    command += [option, str(nets / named)]
    assert main(command) == 3 == main(command)
    (nets / changed).write_text("2")
    capfd.readouterr()
    assert main(command) == 2
    assert f"was begun with other contents of {option}={nets / named}" in capfd.readouterr().err


def test_two_batches_do_not_meet(drives: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from sst_graph.fleet import open_batch

    with open_batch(Place(str(tmp_path / "out")), ()):
        assert main(["batch", str(drives), "--out", str(tmp_path / "out")]) == 2
    assert "another run" in capfd.readouterr().err
