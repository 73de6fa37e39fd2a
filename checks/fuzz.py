"""A seeded fuzzer of all that is read: drives, calibrations, marginals, settings, checkpoints, commands.

    OMP_NUM_THREADS=1 python -m checks.fuzz --seed 1 --count 20000

Valid tiny files of every kind are mutated (checks/fuzz_mutations.py) and read in a worker process whose
memory is limited. Right ends are a value, an error of the package (one printable line), and for a command
exit 0, 2 (one line on stderr) or 3. Wrong are any other exception, more than 5 s (of the processor), more
than 1 GB, a process that dies, and lines of libraries. ``--kind calibrate`` runs whole calibrations
of mutated drives. A case is made again from its number: ``--seed 1 --only 4711``.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import logging
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from checks import fuzz_layouts, fuzz_results
from checks import fuzz_mutations as m
from sst_graph import CalibrationConfig, Tracker, TrackerConfig, calibrate, open_source
from sst_graph.cli import main as command
from sst_graph.cli.options import EXPORTS
from sst_graph.config import read_config, with_overrides
from sst_graph.config import to_dict as config_to_dict
from sst_graph.drive.preparation import prepare_drive
from sst_graph.errors import SstGraphError
from sst_graph.experiments import markdown
from sst_graph.export import ExportOptions, export_text
from sst_graph.export.marginal import fuse_marginals, marginal_of_result, read_marginal
from sst_graph.imports import ImportOptions, import_calibration, read_tree
from sst_graph.reference import read_reference
from sst_graph.simulator import SimulationConfig, simulate, write_drive
from sst_graph.types import Frame, SemanticClass

MAX_SECONDS = 5.0
PATIENCE = 8.0
"""How many times as long a case may take by the clock on the wall."""
MAX_BYTES = 1 << 30
CALIBRATE_SECONDS = 120.0

STREET = SimulationConfig(
    seed=5,
    frames=4,
    width=310,
    height=94,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.5,
    vehicle_density=0.3,
    motion="standing",
    time_offset_s=0.0,
)
"""The drive of whole calibrations and of the tracker."""

Rng = np.random.Generator


class TooLong(BaseException):
    """A case took more than its time; no handler of the package's own errors may catch it."""


@dataclass(frozen=True)
class Case:
    """One mutated input.

    Attributes:
        number: its number; with the seed it makes it again.
        kind: key of :data:`KINDS`.
        verdict: "value", "error", "exit 0", ..., or "FAILURE".
        why: of a failure, or the error's line.
        seconds: it took.
    """

    number: int
    kind: str
    verdict: str
    why: str
    seconds: float


@dataclass
class Ground:
    """Valid inputs in a folder of one worker, each put back after it was mutated."""

    folder: Path

    @property
    def drive(self) -> Path:
        return self.folder / "tiny" / "sequences" / "00"

    @property
    def street(self) -> Path:
        return self.folder / "street" / "sequences" / "00"

    @contextlib.contextmanager
    def mutated(self, rng: Rng, path: Path, mutation: m.Mutation, special: float = 0.04) -> Iterator[Path]:
        """A file with mutated content, or with no regular file in its place; what stood there comes back."""
        valid = path.read_bytes()
        try:
            if rng.random() < special:
                m.make_special(rng, path)
            else:
                path.write_bytes(mutation(rng, valid))
            yield path
        finally:
            m.remove(path)
            path.write_bytes(valid)


# --- valid inputs -----------------------------------------------------------------------------------------


def prepare(folder: Path, started: bool = False) -> None:
    """Write valid inputs of every kind.

    Args:
        started: the tracker of the checkpoint has started, which takes half a minute to make.
    """
    _write_tiny_drive(folder / "tiny" / "sequences" / "00")
    fuzz_layouts.write_layouts(folder / "tiny" / "sequences" / "00", folder / "layouts")
    street = simulate(STREET)
    write_drive(street, folder / "street")
    result = calibrate(street, street.nominal, CalibrationConfig())
    result = dataclasses.replace(result, status="ok", camera_name="image_2")
    (folder / "calibration.json").write_text(result.to_json())
    (folder / "marginal.json").write_text(marginal_of_result(result).to_json())
    (folder / "exports").mkdir()
    for target in EXPORTS:
        # Formats with named frames, with the camera's link and its optical frame below it.
        options = ExportOptions(child="camera_link") if target in ROBOTS else ExportOptions()
        (folder / "exports" / target).write_text(export_text(result, target, options))
    results = folder / "results"
    fuzz_results.write_results(folder / "tiny" / "sequences" / "00", folder / "calibration.json", results)
    truth = street.truth
    document = {"T_camera_lidar": truth.cTl.matrix().tolist(), "time_offset_s": 0.0, "camera": "image_2"}
    (folder / "truth.json").write_text(json.dumps(document))
    (folder / "calib.txt").write_text((folder / "street/sequences/00/calib.txt").read_text())
    (folder / "settings.json").write_text(json.dumps(config_to_dict(CalibrationConfig())))
    (folder / "settings.toml").write_text(_toml(config_to_dict(CalibrationConfig())))
    _tracker(started).save(folder / "tracker.npz")


def _tracker(started: bool) -> Tracker:
    """A tracker after some frames, and before its start unless that is asked for."""
    motion = dataclasses.replace(STREET, frames=14, motion="no_stop") if started else STREET
    street = simulate(motion)
    config = TrackerConfig(start_scans=8)
    search = dataclasses.replace(config.calibration.search, enabled=False)
    config = dataclasses.replace(config, calibration=dataclasses.replace(config.calibration, search=search))
    tracker = Tracker(street.camera, config, street.truth.cTl, 0.0)
    for k in range(len(street)):
        tracker.add(street[k])
    if started and not tracker.estimate.exists:
        raise RuntimeError("the tracker of the checkpoint has not started")
    return tracker


def _write_tiny_drive(folder: Path) -> None:
    """Five frames of 12 points and 8x6 px, every optional file there; one picture is a JPEG file."""
    for name in ("velodyne", "labels", "velodyne_times", "image_2", "semantic_2", "instance_2"):
        (folder / name).mkdir(parents=True)
    P, Tr = "700 0 4 35 0 700 3 0 0 0 1 0", "0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27"
    (folder / "calib.txt").write_text(f"P0: {P}\nP2: {P}\nTr: {Tr}\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(5)))
    pose = [[0, -1, 0, 0.05], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]
    truth = {"T_camera_lidar": pose, "time_offset_s": 0.0, "camera": "image_2"}
    (folder / "groundtruth.json").write_text(json.dumps(truth))
    for k in range(5):
        rng = np.random.default_rng(k)
        rng.uniform(1.0, 20.0, (12, 4)).astype("<f4").tofile(folder / f"velodyne/{k:06d}.bin")
        np.linspace(-0.05, 0.05, 12).astype("<f4").tofile(folder / f"velodyne_times/{k:06d}.bin")
        labels = np.full(12, 40, "<u4")
        labels[: k + 1] = 10 | 3 << 16
        labels.tofile(folder / f"labels/{k:06d}.label")
        picture = rng.integers(0, 255, (6, 8, 3), np.uint8)
        cv2.imwrite(str(folder / f"image_2/{k:06d}{'.jpg' if k == 1 else '.png'}"), picture)
        mask = np.zeros((6, 8), np.uint8)
        mask[0, : k + 1] = 26
        cv2.imwrite(str(folder / f"semantic_2/{k:06d}.png"), mask)
        cv2.imwrite(str(folder / f"instance_2/{k:06d}.png"), mask.astype(np.uint16) * 256)


def _toml(table: dict[str, Any], prefix: str = "") -> str:
    """A nested table as TOML."""
    plain = {k: v for k, v in table.items() if not isinstance(v, dict) and v is not None}
    lines = [f"{key} = {json.dumps(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += [f"[{prefix}{key}]", _toml(value, f"{prefix}{key}.")]
    return "\n".join(lines)


# --- what is tried ----------------------------------------------------------------------------------------


def _read_drive(ground: Ground, rng: Rng) -> None:
    source = open_source(ground.drive, sweep=m.pick(rng, ("auto", "auto", "instant", "azimuth")))
    if rng.random() < 0.15:
        prepare_drive(source, (SemanticClass.VEHICLE,))
    else:
        list(source)


def _of_drive(pattern: str, mutation: m.Mutation) -> Callable[[Ground, Rng], None]:
    def attempt(ground: Ground, rng: Rng) -> None:
        path = m.pick(rng, sorted(ground.drive.glob(pattern)))
        with ground.mutated(rng, path, mutation):
            _read_drive(ground, rng)

    return attempt


def _layout(ground: Ground, rng: Rng) -> None:
    """Files of a drive gone, renamed, exchanged, or in folders of other names."""
    copy = ground.folder / "layout"
    shutil.rmtree(copy, ignore_errors=True)
    folder = shutil.copytree(ground.drive, copy / "sequences" / m.pick(rng, ("00", "a\nb", "\x1b[31m", "é")))
    for _ in range(int(rng.integers(1, 5))):
        paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size < 1 << 20)
        if not paths:
            break
        path, other = m.pick(rng, paths), m.pick(rng, paths)
        action = int(rng.integers(5))
        if action == 0:
            path.unlink()
        elif action == 1:
            names = ("1", "99999999999999999999", "-1", "000002", "x", "9" * 200, "٣", "1.5")
            path.rename(path.with_name(m.pick(rng, names) + path.suffix))
        elif action == 2:
            path.write_bytes(other.read_bytes())
        elif action == 3:
            m.make_special(rng, path)
        else:
            home = path.parent if path.parent != folder else path
            home.rename(home.with_name(f"elsewhere{int(rng.integers(1 << 30))}"))
    root = m.pick(rng, (copy, folder))
    list(open_source(root, frames=m.pick(rng, (None, "1:3", "0:99999999999", "2:"))))


def _calibration(ground: Ground, rng: Rng) -> None:
    with ground.mutated(rng, ground.folder / "calibration.json", m.json_text) as path:
        _command(ground, rng, _words_about(ground, rng, str(path)))


def _words_about(ground: Ground, rng: Rng, result: str) -> list[str]:
    """A command on a result."""
    frame, ahead = (m.pick(rng, words) for words in (("0", "2", "99"), ("1", "10", "1000000000000000000")))
    picture = str(ground.folder / "o.png")
    return list(
        m.pick(
            rng,
            (
                ["inspect", result],
                ["inspect", result, "--json"],
                ["inspect", result, "--all-frames", "--next", ahead],
                ["export", result, "--to", m.pick(rng, EXPORTS), "--force"],
                ["export", result, "--to", "kitti", "--calib", str(ground.folder / "calib.txt"), "--force"],
                ["evaluate", result, "--truth", str(ground.folder / "truth.json")],
                ["evaluate", result, "--json", "--truth", result],
                ["overlay", result, str(ground.drive), "--frame", frame, "--out", picture],
            ),
        )
    )


def _reference(ground: Ground, rng: Rng) -> None:
    name, mutation = m.pick(
        rng, (("truth.json", m.json_text), ("calibration.json", m.json_text), ("calib.txt", m.text))
    )
    with ground.mutated(rng, ground.folder / name, mutation) as path:
        if rng.random() < 0.7:
            read_reference(path)
        else:
            _command(ground, rng, ["evaluate", str(ground.folder / "calibration.json"), "--truth", str(path)])


def _marginal(ground: Ground, rng: Rng) -> None:
    good = read_marginal(ground.folder / "marginal.json")
    with ground.mutated(rng, ground.folder / "marginal.json", m.json_text) as path:
        marginal = read_marginal(path)
    marginal.factor().error(marginal.point())
    fuse_marginals([good, marginal]).best()


def _imports(target: str) -> Callable[[Ground, Rng], None]:
    """A file that an export wrote, as a start, as a vehicle, and by the command."""

    def attempt(ground: Ground, rng: Rng) -> None:
        mutation = m.json_text if target in ("nuscenes", "gtsam") and rng.random() < 0.6 else m.text
        with ground.mutated(rng, ground.folder / "exports" / target, mutation) as path:
            draw = rng.random()
            if draw < 0.5:
                import_calibration(path, ImportOptions(camera=m.pick(rng, (None, "image_2", "\x1b"))))
            elif draw < 0.6:
                import_calibration(path, form=target)
            elif draw < 0.7:
                read_tree(path)
            elif draw < 0.85:
                _command(ground, rng, ["import", str(path), *m.pick(rng, IMPORT_OPTIONS)])
            else:
                result = str(ground.folder / "calibration.json")
                _command(ground, rng, ["export", result, "--to", m.pick(rng, ROBOTS), "--tree", str(path)])

    return attempt


def _settings(ground: Ground, rng: Rng) -> None:
    name, mutation = m.pick(rng, (("settings.json", m.json_text), ("settings.toml", m.toml_text)))
    with ground.mutated(rng, ground.folder / name, mutation) as path:
        read_config(CalibrationConfig, path)


def _overrides(ground: Ground, rng: Rng) -> None:
    config = CalibrationConfig()
    names = [".".join(path) for path in _setting_names(config_to_dict(config))]
    values = (*m.NUMBERS, *m.TEXTS[:10], "[" * 100_000, "[]", '["a"]', "{}", "[1, [2]]")
    name = m.pick(rng, (*names, *names, "bogus", "a.b.c", "", ".", "\x1b", "joint." * 500))
    with_overrides(config, [f"{name}{m.pick(rng, ('=', '=', '=', '==', ''))}{m.pick(rng, values)}"])


def _setting_names(table: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in table.items():
        yield (*above, key)
        if isinstance(value, dict):
            yield from _setting_names(value, (*above, key))


def _checkpoint(ground: Ground, rng: Rng) -> None:
    with ground.mutated(rng, ground.folder / "tracker.npz", m.checkpoint, special=0.02) as path:
        tracker = Tracker.load(path)
    # What was taken goes on: no frame may bring it down.
    frames: list[Frame] = list(open_source(ground.street))
    for frame in frames[-1:]:
        scan, image = frame.scan, frame.image
        assert scan is not None and image is not None
        later = 60_000_000_000
        tracker.add_image(dataclasses.replace(image, stamp_ns=image.stamp_ns + later))
        tracker.add_scan(dataclasses.replace(scan, stamp_ns=scan.stamp_ns + later))
    tracker.result().to_json()


def _calibrate(ground: Ground, rng: Rng) -> None:
    """A whole calibration of a drive with several mutated files."""
    copy = ground.folder / "mutated"
    shutil.rmtree(copy, ignore_errors=True)
    folder = shutil.copytree(ground.street, copy / "sequences" / "00")
    mutated: set[Path] = set()
    for _ in range(int(rng.integers(1, 4))):
        pattern, mutation = m.pick(rng, DRIVE_FILES[:-1])
        paths = [path for path in sorted(folder.glob(pattern)) if path not in mutated]
        if not paths:
            continue
        path = m.pick(rng, paths)
        mutated.add(path)
        action = rng.random()
        if action < 0.15:
            path.unlink()
        elif action < 0.2:
            m.make_special(rng, path)
        else:
            path.write_bytes(mutation(rng, path.read_bytes()))
    method = m.pick(rng, ("joint", "joint", "joint", "static", "motion", "paper", "semalign"))
    init = m.pick(rng, ("dataset", "dataset", "none"))
    out = str(ground.folder / "out")
    words = ["calibrate", str(copy), "--method", method, "--init", init, "--out", out, "--overwrite"]
    _command(ground, rng, words)


def _other_layout(kind: str) -> Callable[[Ground, Rng], None]:
    """A mutated file of a drive in another layout than KITTI odometry."""

    def attempt(ground: Ground, rng: Rng) -> None:
        path, mutation, drive = fuzz_layouts.target(ground.folder / "layouts", kind, rng)
        with ground.mutated(rng, path, mutation):
            if rng.random() < 0.1:
                _command(ground, rng, ["info", str(drive)])
            fuzz_layouts.read_all(drive, rng)

    return attempt


def _of_results(kind: str) -> Callable[[Ground, Rng], None]:
    """A mutated file of a network, of labels, of a rig or of a batch."""

    def attempt(ground: Ground, rng: Rng) -> None:
        folder = ground.folder / "results"
        path, mutation = fuzz_results.target(folder, kind, rng)
        with ground.mutated(rng, path, mutation):
            fuzz_results.KINDS[kind][0](folder, ground.drive, path)

    return attempt


def _messages(ground: Ground, rng: Rng) -> None:
    fuzz_layouts.messages(ground.folder / "layouts", rng)


DRIVE_FILES: tuple[tuple[str, m.Mutation], ...] = (
    ("calib.txt", m.text),
    ("times.txt", m.text),
    ("velodyne/*.bin", m.array("<f4", m.FLOATS)),
    ("labels/*.label", m.array("<u4", m.LABELS)),
    ("image_2/*", m.image),
    ("semantic_2/*.png", m.image),
    ("groundtruth.json", m.json_text),
    ("velodyne_times/*.bin", m.array("<f4", m.FLOATS)),
)

ROBOTS = ("ros-tf", "ros1-launch", "ros2-launch", "ros2-launch-xml", "urdf", "xacro")
IMPORT_OPTIONS = (
    [],
    ["--camera-frame", "camera_optical_frame", "--lidar-frame", "lidar"],
    ["--camera-link", "camera_link"],
    ["--from", "kalibr"],
    ["--from", "opencv", "--camera", "a\nb"],
    ["--lidar-frame", "\x1b[2J"],
    ["--parent", "\u2028"],
)

Kinds = Mapping[str, tuple[Callable[[Ground, Rng], None], float]]

KINDS: Kinds = {
    "calib": (_of_drive("calib.txt", m.text), 1.0),
    "times": (_of_drive("times.txt", m.text), 1.0),
    "velodyne": (_of_drive("velodyne/*.bin", m.array("<f4", m.FLOATS)), 1.0),
    "labels": (_of_drive("labels/*.label", m.array("<u4", m.LABELS)), 0.7),
    "point_times": (_of_drive("velodyne_times/*.bin", m.array("<f4", m.FLOATS)), 0.5),
    "images": (_of_drive("image_2/*", m.image), 1.5),
    "masks": (_of_drive("semantic_2/*.png", m.image), 1.0),
    "instances": (_of_drive("instance_2/*.png", m.image), 0.5),
    "groundtruth": (_of_drive("groundtruth.json", m.json_text), 1.0),
    "layout": (_layout, 0.5),
    "calibration": (_calibration, 2.0),
    "reference": (_reference, 0.7),
    "marginal": (_marginal, 1.0),
    **{f"import {target}": (_imports(target), 0.15) for target in EXPORTS},
    "settings": (_settings, 1.0),
    "overrides": (_overrides, 1.0),
    "checkpoint": (_checkpoint, 0.5),
    "kitti-raw": (_other_layout("kitti-raw"), 0.8),
    "folder": (_other_layout("folder"), 0.8),
    "clouds": (_other_layout("clouds"), 0.8),
    "nuscenes": (_other_layout("nuscenes"), 0.8),
    "bags": (_other_layout("bags"), 0.8),
    "messages": (_messages, 0.8),
    **{kind: (_of_results(kind), 0.5) for kind in fuzz_results.KINDS},
    "calibrate": (_calibrate, 0.0),
}
"""What is tried, and how often; a weight of 0: only where it is asked for."""


# --- verdicts ---------------------------------------------------------------------------------------------


class WrongEnd(Exception):
    """A command that ended otherwise than it may."""


class Ended(Exception):
    """A command that ended as it may, with an exit code."""


def _command(ground: Ground, rng: Rng, words: list[str]) -> None:
    """Run a command of ``sst-graph`` in this process.

    Raises:
        Ended: with exit 0, 3, or 2 and one line on stderr.
        WrongEnd: otherwise.
    """
    (ground.folder / "o.png").unlink(missing_ok=True)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = command(words)
    logging.getLogger().handlers.clear()
    lines = err.getvalue().splitlines()
    ours = [line for line in lines if line.startswith("sst-graph: ")]
    if code not in (0, 2, 3):
        raise WrongEnd(f"exit {code}: {' | '.join(lines)[:300]}")
    if code == 2 and not (
        len(ours) == 1 and lines[-1] == ours[0] and ours[0].isprintable() and len(ours[0]) < 1300
    ):
        raise WrongEnd(f"exit 2 with {len(lines)} lines: {' | '.join(lines)[:300]!r}")
    if any(not line.isprintable() for line in out.getvalue().replace("\t", " ").split("\n")):
        raise WrongEnd("control characters on stdout")
    others = [line for line in lines if line not in ours and not line.startswith("WARNING sst_graph")]
    if others:
        raise WrongEnd(f"exit {code} with lines of others: {' | '.join(others)[:300]!r}")
    raise Ended(f"exit {code}")


@dataclass(frozen=True)
class Trials:
    """What is tried, and for how long at most.

    Attributes:
        seed: of all cases.
        kinds: as :data:`KINDS`.
        max_seconds: of a case that calibrates nothing.
    """

    seed: int
    kinds: Kinds = field(default_factory=lambda: KINDS)
    max_seconds: float = MAX_SECONDS

    def limit_s(self, kind: str) -> float:
        return CALIBRATE_SECONDS if kind == "calibrate" else self.max_seconds


def tried(number: int, kind: str, trials: Trials, ground: Ground, noise: int) -> Case:
    """Make one case, try it, and judge how it ended."""
    rng = np.random.default_rng([trials.seed, number])
    attempt, _ = trials.kinds[kind]
    limit = trials.limit_s(kind)
    os.ftruncate(noise, 0)
    os.lseek(noise, 0, os.SEEK_SET)
    # Of the process's own time, so that a busy machine does not count; and what blocks is ended, too.
    signal.setitimer(signal.ITIMER_PROF, limit)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE * limit)
    began = time.perf_counter()
    verdict, why = "value", ""
    try:
        attempt(ground, rng)
    except Ended as end:
        verdict = str(end)
    except SstGraphError as error:
        verdict, why = "error", str(error)
        if not (why.isprintable() and len(why) <= 1300):
            verdict, why = "FAILURE", f"a message that is no printable line: {why!r:.200}"
    except TooLong:
        verdict, why = "FAILURE", f"more than {limit:g} s: {''.join(traceback.format_exc()[-400:])}"
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-4:]
        steps = " < ".join(f"{Path(step.filename).name}:{step.lineno}" for step in reversed(place))
        verdict, why = "FAILURE", f"{type(error).__name__}: {str(error)[:300]} at {steps}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    seconds = time.perf_counter() - began
    written = os.pread(noise, 400, 0)
    if written and verdict != "FAILURE":
        verdict, why = "FAILURE", f"lines of a library: {written!r}"
    return Case(number, kind, verdict, why, seconds)


def _too_long(signum: int, frame: object) -> None:
    raise TooLong


def _work(inputs: Path, trials: Trials, numbers: list[tuple[int, str]], answers: Connection) -> None:
    """A worker: its own copy of the valid inputs, its own limits."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as noise:
        ground = Ground(Path(shutil.copytree(inputs, Path(folder) / "inputs")))
        for stream in (1, 2):  # LAPACK writes to stdout; the package's own lines are captured above it
            os.dup2(noise.fileno(), stream)
        logging.getLogger("sst_graph").addHandler(logging.NullHandler())
        signal.signal(signal.SIGALRM, _too_long)
        signal.signal(signal.SIGPROF, _too_long)
        with open("/proc/self/statm", encoding="ascii") as stream:
            present = int(stream.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (present + MAX_BYTES, present + MAX_BYTES))
        for number, kind in numbers:
            answers.send(tried(number, kind, trials, ground, noise.fileno()))
        answers.send(None)


def cases(inputs: Path, trials: Trials, numbers: list[tuple[int, str]]) -> Iterator[Case]:
    """Verdicts of the cases, in order, from a worker that is replaced when it dies."""
    todo = list(numbers)
    context = multiprocessing.get_context("fork")
    while todo:
        ours, theirs = context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(inputs, trials, todo, theirs))
        worker.start()
        theirs.close()
        try:
            while todo:
                if not ours.poll(1.5 * PATIENCE * trials.limit_s(todo[0][1]) + 20.0):
                    worker.kill()
                    raise EOFError
                case = ours.recv()
                todo.pop(0)
                yield case
        except GeneratorExit:  # no more cases are asked for; else the worker would wait for a reader for ever
            worker.kill()
            worker.join()
            raise
        except EOFError:
            worker.join()
            number, kind = todo.pop(0)
            yield Case(number, kind, "FAILURE", f"the process died (exit code {worker.exitcode})", 0.0)
        worker.join(5.0)
        ours.close()


def plan(seed: int, count: int, kinds: list[str]) -> list[tuple[int, str]]:
    """Numbers and kinds of the cases."""
    weights = np.array([KINDS[kind][1] or float(len(kinds) == 1) for kind in kinds])
    chosen = np.random.default_rng(seed).choice(len(kinds), size=count, p=weights / weights.sum())
    return [(number, kinds[int(k)]) for number, k in enumerate(chosen)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=1000)
    usual = [kind for kind, (_, weight) in KINDS.items() if weight]
    parser.add_argument("--kind", action="append", choices=list(KINDS), help="only these (repeatable)")
    parser.add_argument("--only", type=int, metavar="NUMBER", help="one case, with its error")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no case after so long")
    parser.add_argument("--started", action="store_true", help="the checkpoint's tracker has started")
    args = parser.parse_args()
    tried_cases: list[Case] = []
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder), args.started)
        numbers = plan(args.seed, args.count, args.kind or usual)
        if args.only is not None:
            numbers = [numbers[args.only]]
        for case in cases(Path(folder), Trials(args.seed), numbers):
            tried_cases.append(case)
            if case.verdict == "FAILURE" or args.only is not None:
                print(f"{case.number} {case.kind}: {case.verdict} {case.why}", flush=True)
            if time.monotonic() - began > 60.0 * args.minutes:
                break
    print(table_of(tried_cases))
    return int(any(case.verdict == "FAILURE" for case in tried_cases))


def table_of(tried_cases: Sequence[Case]) -> str:
    """Inputs, verdicts and the slowest of each kind, and of all."""
    kinds = dict.fromkeys(case.kind for case in tried_cases)
    groups = {kind: [case for case in tried_cases if case.kind == kind] for kind in sorted(kinds)}
    rows = []
    for name, some in (*groups.items(), ("all", tried_cases)):
        ends = Counter(case.verdict for case in some)
        failures = ends.pop("FAILURE", 0)
        said = ", ".join(f"{count} {verdict}" for verdict, count in sorted(ends.items()))
        slowest = max((case.seconds for case in some), default=0.0)
        rows.append([name, str(len(some)), said, str(failures), f"{slowest:.2f}"])
    return markdown.table("| kind of input | inputs | ended with | failures | slowest [s] |", rows)


if __name__ == "__main__":
    sys.exit(main())
