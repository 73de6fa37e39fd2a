"""The commands of the fault matrix, their inputs, and what of their outputs is compared."""

from __future__ import annotations

import json
import os
import re
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sst_graph.files.staging import SUFFIX
from sst_graph.simulator import SimulationConfig, simulate, write_drive

ROOT = Path(__file__).resolve().parents[1]
STREET = SimulationConfig(
    seed=4,
    frames=12,
    width=276,
    height=84,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.5,
    vehicle_density=0.3,
    time_offset_s=0.0,
    rotation_error_deg=0.3,
    translation_error_m=0.02,
    motion="no_stop",
    speed_mps=6.0,
)
SMALL = ["--frames", "3", "--set", "width=160", "--set", "height=64", "--set", "azimuth_step_deg=2"]
QUICK = ["--set", "search.enabled=false", "--set", "find_causes=false", "--no-report"]
TRACK = ["--set", "start_scans=4", "--set", "calibration.search.enabled=false", "--checkpoint-every", "2"]
TABLE = [
    *("--set", "street.frames=3", "--set", "street.width=276", "--set", "street.height=84"),
    *("--set", "street.azimuth_step_deg=0.5", "--set", "calibration.search.enabled=false"),
]
BASIN = ["--streets", "2", "--set", "starts=[1]", "--set", "searches_deg=[5.0]", "--set", "searches_m=[0.1]"]

State = dict[str, bytes]

NOT_DONE = b"a drive to be run again"
"""Of a batch's record without a result, such as where the disk was full."""


@dataclass(frozen=True)
class Command:
    """A command as it is run here.

    Attributes:
        name: of the command, and what is told apart of it.
        arguments: for the folder with the inputs and the one to write into.
        output: what it writes there, None where it only prints.
        codes: exit codes of a run to its end.
        prints: its result is what it prints.
        older: arguments that make another output of the same kind, for overwriting.
        goes_on: what is done stays in its folder, and the same command does the rest.
        shared: two of it may fill one folder at a time.
    """

    name: str
    arguments: Callable[[Path, Path], list[str]]
    output: str | None
    codes: tuple[int, ...] = (0,)
    prints: bool = False
    older: tuple[str, ...] = ()
    goes_on: bool = False
    shared: bool = False


def calibrate_arguments(data: Path, desk: Path) -> list[str]:
    """``calibrate`` of the first frames."""
    return ["calibrate", str(data / "street"), "--frames", "0:3", "--out", str(desk / "out")]


def _rig(data: Path, desk: Path) -> list[str]:
    return [*calibrate_arguments(data, desk), "--camera", "image_2", "image_3", *QUICK]


def _with_video(data: Path, desk: Path) -> list[str]:
    return [*calibrate_arguments(data, desk), *QUICK, "--video", str(desk / "out.gif")]


def _track(data: Path, desk: Path) -> list[str]:
    files = ["--out", str(desk / "out.json"), "--checkpoint", str(desk / "checkpoint.npz")]
    return ["track", str(data / "street"), *TRACK, *files]


def _track_viewed(data: Path, desk: Path) -> list[str]:
    return [*_track(data, desk), "--view-save", str(desk / "out.rrd")]


def _overlay(data: Path, desk: Path) -> list[str]:
    return ["overlay", str(data / "result"), str(data / "street"), "--out", str(desk / "out.png")]


def _overlay_video(data: Path, desk: Path) -> list[str]:
    return ["overlay", str(data / "result"), str(data / "street"), "--video", str(desk / "out.gif")]


def _export(data: Path, desk: Path) -> list[str]:
    return ["export", str(data / "result"), "--force", "--to", "kalibr", "--out", str(desk / "out.yaml")]


def _export_marginal(data: Path, desk: Path) -> list[str]:
    return ["export", str(data / "result"), "--force", "--to", "gtsam", "--out", str(desk / "out.json")]


def _evaluate(data: Path, _: Path) -> list[str]:
    truth = data / "street/sequences/00/groundtruth.json"
    return ["evaluate", str(data / "result"), "--truth", str(truth)]


def _batch(data: Path, desk: Path) -> list[str]:
    drives, words = data / "drives.txt", ["--frames", "0:3", "--workers", "1", *QUICK]
    return ["batch", str(drives), "--out", str(desk / "out"), *words]


def _segment(data: Path, desk: Path) -> list[str]:
    networks = ["--image-model", str(data / "i.yaml"), "--lidar-model", str(data / "s.yaml")]
    return ["segment", str(data / "street"), "--frames", "0:6", *networks, "--out", str(desk / "out")]


def _view(data: Path, desk: Path) -> list[str]:
    words = ["--frames", "0:3", "--save", str(desk / "out.rrd")]
    return ["view", str(data / "result"), str(data / "street"), *words]


def _import(data: Path, desk: Path) -> list[str]:
    calibration = data / "street/sequences/00/calib.txt"
    return ["import", str(calibration), "--from", "kitti", "--out", str(desk / "out.json")]


def _table1(data: Path, desk: Path) -> list[str]:
    words = ["--data", str(data / "street"), "--methods", "joint"]
    words += ["--set", "calibration.search.enabled=false"]
    return ["experiment", "table1", *words, "--out", str(desk / "out.md")]


COMMANDS = {
    command.name: command
    for command in (
        Command(
            "simulate", lambda _, desk: ["simulate", str(desk / "out"), *SMALL], "out", older=("--seed", "9")
        ),
        Command("calibrate", calibrate_arguments, "out", (0, 3), older=("--image-shift", "1")),
        Command("calibrate, two cameras", _rig, "out", (0, 3), older=("--image-shift", "1")),
        Command("calibrate --video", _with_video, "out", (0, 3), older=("--image-shift", "1")),
        Command("track", _track, "out.json", (0, 3)),
        Command("track --view-save", _track_viewed, "out.json", (0, 3)),
        Command("overlay", _overlay, "out.png", older=("--frame", "1")),
        Command("overlay --video", _overlay_video, "out.gif", older=("--frames", "0:3")),
        Command("export", _export, "out.yaml", older=("--to", "urdf")),
        Command("export --to gtsam", _export_marginal, "out.json", older=("--to", "urdf")),
        Command("evaluate", _evaluate, None, prints=True),
        Command(
            "inspect",
            lambda data, desk: ["inspect", str(data / "result"), "--plots", str(desk / "out")],
            "out",
            prints=True,
        ),
        Command("info", lambda data, _: ["info", str(data / "street")], None, prints=True),
        Command("settings", lambda *_: ["settings"], None, prints=True),
        Command("completion", lambda *_: ["completion", "bash"], None, prints=True),
        Command("import", _import, "out.json", older=("--camera", "image_2")),
        Command("view", _view, "out.rrd", older=("--frames", "0:1")),
        Command("segment", _segment, "out", goes_on=True, shared=True),
        Command("batch", _batch, "out", (0, 3), goes_on=True),
        Command(
            "experiment fit",
            lambda _, desk: [
                *("experiment", "fit", "--set", "seeds=[21]", "--set", "label_noises=[1.0]"),
                *(*TABLE, "--out", str(desk / "out.md")),
            ],
            "out.md",
            older=("--set", "turn_deg=0.1"),
        ),
        Command(
            "experiment basin",
            lambda _, desk: ["experiment", "basin", *BASIN, *TABLE, "--out", str(desk / "out.md")],
            "out.md",
            goes_on=True,
        ),
        Command("experiment table1", _table1, "out.md", goes_on=True),
        Command("demo", lambda _, desk: ["demo", "--out", str(desk / "out")], "out", older=("--seed", "2")),
    )
}


def write_inputs(data: Path) -> None:
    """A street, networks that label it, and a list of drives."""
    data.mkdir(parents=True)
    write_drive(simulate(STREET), data / "street", stereo=True)
    (data / "drives.txt").write_text(f"{data / 'street'}\n")
    if str(ROOT / "tests") not in sys.path:
        sys.path.append(str(ROOT / "tests"))
    from tiny_networks import colour_yaml, range_yaml, write_colour_network, write_range_network

    colour_yaml(write_colour_network(data / "i.onnx"))
    range_yaml(write_range_network(data / "s.onnx"), "neighbours: false\n")


def state(folder: Path) -> State:
    """All files below a folder with what is compared of them, staging folders by name alone."""
    found: State = {}
    for path, folders, files in os.walk(folder):
        for name in [one for one in (*folders, *files) if one.endswith(SUFFIX)]:
            found[os.path.relpath(os.path.join(path, name), folder)] = b""
        folders[:] = [one for one in folders if not one.endswith(SUFFIX)]
        for name in (one for one in files if not one.endswith(SUFFIX)):
            one = Path(path, name)
            found[str(one.relative_to(folder))] = compared(one)
    return found


def compared(path: Path) -> bytes:
    """The bytes of a file without times: how long something took, and when a viewer's file was written."""
    if path.suffix == ".rrd":
        return _entities(path)
    content = path.read_bytes()
    if path.name.endswith(".runs.jsonl"):
        return b"\n".join(re.sub(rb'"seconds": [\d.e-]+', b"", line) for line in content.splitlines())
    if path.parent.name == "records":
        record = json.loads(content)
        return json.dumps({**record, "cost": None}).encode() if record.get("numbers") else NOT_DONE
    if path.name.startswith("summary."):
        return b"holds how long each drive took"
    if path.suffix == ".md":  # of an experiment: the version of the code, and basin's last column, seconds
        return re.sub(rb"[\d.]+ \|\n\n", b"|\n\n", content.partition(b", sst-graph ")[0])
    return content


def _entities(path: Path) -> bytes:
    """What a viewer's file shows: rows by entity, which come in chunks as time goes by."""
    from rerun.chunk import RrdReader

    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] += chunk.num_rows
    return repr(sorted(rows.items())).encode()


def each_in(found: State, *states: State) -> bool:
    """Whether each output is as in one of some states; outputs take their names one after another."""
    names = {name.partition("/")[0] for one in (found, *states) for name in one}
    return all(_output(found, name) in [_output(one, name) for one in states] for name in names)


def _output(found: State, output: str) -> State:
    """What is below an output, a file or a folder."""
    return {name: data for name, data in found.items() if name.partition("/")[0] == output}


def is_part(found: State, whole: State) -> bool:
    """Whether each file is one of a whole output, or the beginning of its list of what is done."""
    return all(
        whole.get(name) == content
        or (content == NOT_DONE and name in whole)
        or (name.endswith(".runs.jsonl") and whole.get(name, b"").startswith(content.rpartition(b"\n")[0]))
        for name, content in found.items()
    )
