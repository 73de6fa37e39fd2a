"""What each heuristic is worth: the method without one of them, on simulated streets and real drives.

    OMP_NUM_THREADS=1 python benchmarks/ablation.py run --out RUNS.jsonl --drive stop=DATA --drive parked=DATA
    OMP_NUM_THREADS=1 python benchmarks/ablation.py run --out RUNS.jsonl --cases none --kinds near,free
    python benchmarks/ablation.py table RUNS.jsonl

A case (ablation_cases.py) leaves one heuristic out: by its setting, or else by replacing a constant or a
function in its module, which is done nowhere but here. Every run is one line of the file, and runs that are
in it are not made again. Streets are small: 24 frames of 621 x 188 pixels. ``NAME@2=DATA`` shifts the images
of a drive by two frames instead of one.

Kinds of run: ``local`` starts 1 degree, 5 cm and 20 ms from the truth without the search for a start;
``near`` searches from 12 degrees and 10 cm by axis; ``free`` from nothing; ``track`` is the tracker with a
window of 24 scans, from the start of ``local``, over 60 frames of streets; in ``knock`` the camera turns by
a degree about its y axis after 60 % of them, in ``clock`` its stamps move by 30 ms.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import gc
import importlib
import json
import pickle
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
from ablation_cases import CASES, Case
from ablation_table import write_table
from numpy.typing import NDArray
from second_street import SecondStreet, StreetConfig
from third_street import ThirdConfig, ThirdStreet
from tracker_steps import Step

from sst_graph import CalibrationConfig, Tracker, TrackerConfig, open_source
from sst_graph.batch import calibrate_prepared, prepare_drives
from sst_graph.batch.motion_factor import _UNLIKELY_CHI2
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.metrics import tangent_error
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import CameraImage, GroundTruth

FloatArray = NDArray[np.float64]

calibrate_module = importlib.import_module("sst_graph.batch.calibrate")

SIZE = {"width": 621, "height": 188}
OFFSET_S = 0.05
FIRST_SEED = 8200
TRACKER_KINDS = {"track", "knock", "clock"}
WINDOW = 24
"""Scans of the tracker's window: most of a drive leaves it."""
STEPS = {"knock": Step("knock", (0.0, 1.0, 0.0)), "clock": Step("clock", late_ms=30.0)}


def street(simulator: str, seed: int, frames: int) -> KeptDrive:
    """A small street; even seeds stop, odd ones do not. Half of the vehicles move in a ``first-moving``."""
    simulator, _, variant = simulator.partition("-")
    stops = seed % 2 == 0
    common: dict[str, Any] = {"seed": seed, "frames": frames, "time_offset_s": OFFSET_S, **SIZE}
    common["moving_fraction"] = 0.5 if variant == "moving" else 0.2
    if simulator == "first":
        sparse = {"azimuth_step_deg": 0.3, "azimuth_limit_deg": 60.0, "vehicle_density": 0.25}
        motion = "stop_and_go" if stops else "mixed"
        return KeptDrive.of(simulate(SimulationConfig(motion=motion, **common, **sparse)))
    common |= {"focal_px": 360.0, "motion": "stop" if stops else "vary", "density": 0.2}
    if simulator == "second":
        return KeptDrive.of(SecondStreet(StreetConfig(**common)))
    return KeptDrive.of(ThirdStreet(ThirdConfig(**common)))


class Data:
    """One drive of known calibration, kept in a file between invocations, and what was prepared of it.

    Attributes:
        name: ``first/8200``, or that of a real drive.
    """

    def __init__(self, name: str, path: str | None, cache: Path, frames: int) -> None:
        self.name, self._path, self._frames = name, path, frames
        self._file = cache / f"{name.replace('/', '-')}-{frames}.pickle"
        self._kept: KeptDrive | None = None
        self._prepared: tuple[list[Drive], float] | None = None

    @property
    def kept(self) -> KeptDrive:
        """All frames."""
        if self._kept is None:
            if not self._file.exists():
                if self._path is not None:
                    shift = int(self.name.partition("@")[2] or 1)
                    made = KeptDrive.of(open_source(self._path, image_shift=shift))
                else:
                    simulator, seed = self.name.split("/")
                    made = street(simulator, int(seed), self._frames)
                self._file.parent.mkdir(parents=True, exist_ok=True)
                temporary = self._file.with_suffix(f".{time.monotonic_ns()}")
                temporary.write_bytes(pickle.dumps(made))
                temporary.rename(self._file)
            self._kept = pickle.loads(self._file.read_bytes())
        return self._kept

    def prepared(self, config: CalibrationConfig, anew: bool) -> tuple[list[Drive], float]:
        """What calibration needs of it, and the CPU seconds that took; with ``anew`` under these settings."""
        if anew or self._prepared is None:
            kept, began = self.kept, _cpu_s()
            found = prepare_drives([kept], config), _cpu_s() - began
            if anew:
                return found
            self._prepared = found
        return self._prepared

    def wrong_start(self, kind: str) -> tuple[gtsam.Pose3 | None, float]:
        """Where a kind of run starts: extrinsic and time offset [s]."""
        truth = self.truth
        rng = np.random.default_rng([*self.name.encode(), 99])
        if kind == "free":
            return None, 0.0
        if kind == "near":
            away = np.concatenate([np.radians(rng.uniform(-12.0, 12.0, 3)), rng.uniform(-0.1, 0.1, 3)])
            return truth.cTl.retract(away), 0.0
        turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        away = np.concatenate([np.radians(1.0) * turn, 0.05 * shift])
        return truth.cTl.retract(away), self.offset_s + 0.02 * float(rng.choice([-1.0, 1.0]))

    @property
    def truth(self) -> GroundTruth:
        assert self.kept.truth is not None
        return self.kept.truth

    @property
    def offset_s(self) -> float:
        """True time offset [s]."""
        assert self.truth.time_offset_s is not None
        return self.truth.time_offset_s

    def drop(self) -> None:
        self._kept = self._prepared = None
        gc.collect()


def _cpu_s() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime


def calibrated(case: Case, data: Data, kind: str) -> Iterator[dict[str, Any]]:
    """One calibration; of the full method also what its covariance is without parts of it."""
    config = CalibrationConfig(find_causes=False)
    if kind == "local":
        config = dataclasses.replace(config, search=dataclasses.replace(config.search, enabled=False))
    probe = Probe()
    with case.left_out(), probe.listening():
        config = case.configured(config)
        drives, preparation_s = data.prepared(config, anew=case.preparation)
        guess, offset_s = data.wrong_start(kind)
        began = _cpu_s()
        result = calibrate_prepared(drives, guess, config, initial_offset_s=offset_s)
        seconds = _cpu_s() - began
    numbers = result.diagnostics
    row = {
        "case": case.name,
        **judged(data.truth, result.T_camera_lidar, result.time_offset_s, result.covariance),
        **{name: numbers.get(name) for name in ("outer_iterations", "matches")},
        "status": result.status,
        "reasons": [reason[:120] for reason in result.reasons],
        "prepare_s": preparation_s,
        "estimate_s": seconds,
    }
    yield row
    if case.name == "none" and kind == "local" and probe.robust is not None:
        for other in CASES:
            if other.covariance:
                covariance = probe.without(other, np.asarray(result.covariance), numbers["motion"])
                yield {**row, "case": other.name, "covariance": covariance.tolist()}


class Probe:
    """What a calibration's covariance was made of.

    Attributes:
        robust: that of the matches, and what it was made from.
        considered: what assumptions add, with their prior deviations and with those that the data leave open.
    """

    def __init__(self) -> None:
        self.robust: tuple[Any, tuple[Any, ...]] | None = None
        self.considered: tuple[Any, Any] | None = None

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        robust_covariance, told_by = calibrate_module.robust_covariance, calibrate_module.told_by

        def robust(*args: Any) -> Any:
            found = robust_covariance(*args)
            self.robust = found, args
            return found

        def told(considered: Any, findings: Any) -> Any:
            found = told_by(considered, findings)
            self.considered = considered, found
            return found

        calibrate_module.robust_covariance, calibrate_module.told_by = robust, told  # type: ignore
        try:
            yield
        finally:
            calibrate_module.robust_covariance, calibrate_module.told_by = robust_covariance, told_by  # type: ignore

    def without(self, case: Case, whole: FloatArray, motion: Mapping[str, Any]) -> FloatArray:
        """(7, 7) covariance without what a case leaves out, from the whole one."""
        assert self.robust is not None
        assert self.considered is not None
        prior, told = (each.covariance(7) for each in self.considered)
        if case.covariance == "assumptions":
            return whole - told + (np.zeros((7, 7)) if case.name == "considered" else prior)
        apart = motion.get("chi2_of_7", 0.0) if motion.get("fused") else 0.0
        inflation = apart / 7.0 if apart > _UNLIKELY_CHI2 else 1.0
        found, args = self.robust
        with case.left_out():
            other = calibrate_module.robust_covariance(*args)
        return np.asarray(whole + inflation * (other.matrix - found.matrix)[:7, :7])


def tracked(case: Case, data: Data, kind: str) -> Iterator[dict[str, Any]]:
    """One drive through the tracker; ``knock`` turns the camera half way, ``clock`` moves its stamps."""
    config = TrackerConfig(window=WINDOW)
    calibration = config.calibration
    search = dataclasses.replace(calibration.search, enabled=False)
    config = dataclasses.replace(config, calibration=dataclasses.replace(calibration, search=search))
    truth = data.truth
    half, step = round(0.6 * len(data.kept)), STEPS.get(kind, Step(""))
    with case.left_out():
        config = dataclasses.replace(config, calibration=case.configured(config.calibration))
        config = case.tracking(config)
        guess, offset_s = data.wrong_start("track")
        tracker = Tracker(data.kept.camera, config, guess, offset_s)
        costs, alarms, adopted, started = [], [], 0, None
        for number, frame in enumerate(data.kept):
            if number >= half and frame.image is not None:
                frame = dataclasses.replace(frame, image=stepped(frame.image, step, data.kept.camera.matrix))
            began = _cpu_s()
            update = tracker.add(frame)
            costs.append(_cpu_s() - began)
            alarms += [number] if update.alarm else []
            adopted += update.adopted
            started = number if started is None and tracker.started else started
    after = GroundTruth(
        gtsam.Pose3(step.rotation, np.zeros(3)) * truth.cTl, data.offset_s - 1e-3 * step.late_ms
    )
    yield {
        "case": case.name,
        **judged(after, update.T_camera_lidar, update.time_offset_s, update.covariance),
        "status": update.status,
        "estimate_s": float(np.sum(costs)),
        "prepare_s": 0.0,
        "worst_frame_s": float(np.max(costs)),
        "alarms": alarms,
        "stepped_at": half if step.name else None,
        "adopted": adopted,
        "started": started,
    }


def stepped(image: CameraImage, step: Step, K: FloatArray) -> CameraImage:
    """An image after a step of the calibration; what the camera did not see before is unknown."""
    mask, pixels = image.mask, image.pixels
    if any(step.turn_deg):
        H = K @ step.rotation.matrix() @ np.linalg.inv(K)
        size = mask.shape[::-1]
        mask = cv2.warpPerspective(mask, H, size, flags=cv2.INTER_NEAREST, borderValue=255)
        if image.has_picture:
            pixels = cv2.warpPerspective(pixels, H, size, flags=cv2.INTER_LINEAR)
    stamp_ns = image.stamp_ns + round(1e6 * step.late_ms)
    return dataclasses.replace(
        image, mask=np.asarray(mask, np.uint8), pixels=np.asarray(pixels, np.uint8), stamp_ns=stamp_ns
    )


def judged(
    truth: GroundTruth, cTl: gtsam.Pose3, offset_s: float, covariance: FloatArray | None
) -> dict[str, list[Any] | None]:
    """Error (7) against the truth, its covariance (7, 7), and the translation's in the camera's axes (3)."""
    assert truth.time_offset_s is not None
    error = tangent_error(cTl, truth.cTl, offset_s - truth.time_offset_s)
    c_shift = np.asarray(cTl.translation() - truth.cTl.translation())
    return {
        "error": error.tolist(),
        "c_shift": c_shift.tolist(),
        "covariance": None if covariance is None else np.asarray(covariance).tolist(),
    }


def _known(path: Path) -> set[tuple[str, str, str]]:
    if not path.exists():
        return set()
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {(row["case"], row["kind"], row["data"]) for row in rows}


def runs(args: argparse.Namespace) -> Iterator[tuple[Case, str, Data]]:
    """What is to be run, the drives one after the other within each tier of cases."""
    chosen = set(args.cases.split(",")) if args.cases else None
    if chosen is not None and (unknown := chosen - {case.name for case in CASES}):
        raise SystemExit(f"found cases {sorted(unknown)}, expected some of {[case.name for case in CASES]}")
    kinds = args.kinds.split(",")
    drives = [_named(given) for given in args.drive]
    names: list[tuple[str, str | None]] = list(drives)
    counts = {name: int(count) for name, count in (each.split(":") for each in args.streets.split(","))}
    for k in range(max(counts.values())):
        names += [(f"{name}/{FIRST_SEED + k}", None) for name, count in counts.items() if k < count]
    part, parts = (int(number) for number in args.part.split("/"))
    names = names[part::parts]
    for tier in args.tiers.split(","):
        for name, path in names:
            frames = 60 if TRACKER_KINDS & set(kinds) else 24
            data = Data(name, path, Path(args.cache), frames)
            for case in CASES:
                if chosen is None and case.tier != int(tier) and case.name != "none":
                    continue
                if (chosen is not None and case.name not in chosen) or case.covariance:
                    continue
                for kind in kinds:
                    if kind in case.kinds:
                        yield case, kind, data
            data.drop()
        if chosen is not None:
            break


def _named(given: str) -> tuple[str, str]:
    name, _, path = given.partition("=")
    return name, path


def run(args: argparse.Namespace) -> bool:
    """Runs that are not in the file yet, as long as there is time; whether all are done."""
    out, began = Path(args.out), time.monotonic()
    known = _known(out)
    for case, kind, data in runs(args):
        if (case.name, kind, data.name) in known:
            continue
        if time.monotonic() - began > args.seconds:
            return False
        made = tracked(case, data, kind) if kind in TRACKER_KINDS else calibrated(case, data, kind)
        try:
            rows = list(made)
        except Exception as error:  # a case may well break the method: that is a finding, too
            rows = [{"case": case.name, "failed": f"{type(error).__name__}: {error}"[:300]}]
        with out.open("a") as file:
            for row in rows:
                file.write(json.dumps({"kind": kind, "data": data.name, **row}) + "\n")
        print(case.name, kind, data.name, rows[0].get("status", rows[0].get("failed")), flush=True)
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    runner = commands.add_parser("run")
    runner.add_argument("--out", required=True, help="JSON lines; runs that it has are not made again")
    runner.add_argument("--cache", default="/tmp/ablation", help="folder of streets, to be used again")
    runner.add_argument("--cases", default="", help="names, by commas; all of the tiers without")
    runner.add_argument("--tiers", default="1,2,3")
    runner.add_argument("--kinds", default="local")
    runner.add_argument("--streets", default="first:8,second:8,third:6")
    runner.add_argument("--drive", action="append", default=[], metavar="NAME=DATA")
    runner.add_argument("--part", default="0/1", help="which part of the drives, of how many")
    runner.add_argument("--seconds", type=float, default=1e9, help="begin no run after so many")
    writer = commands.add_parser("table")
    writer.add_argument("runs", nargs="+")
    writer.add_argument("--kind", default="local")
    writer.add_argument("--full", action="store_true", help="of the full method only")
    writer.add_argument(
        "--into", help="Markdown file in which it stands between <!-- KIND --> and <!-- end -->"
    )
    args = parser.parse_args(arguments)
    if args.command == "table":
        text = write_table([Path(path) for path in args.runs], args.kind, args.full)
        if args.into is None:
            print(text)
        else:
            page, mark = Path(args.into), f"<!-- {args.kind} -->\n"
            before, _, rest = page.read_text().partition(mark)
            page.write_text(f"{before}{mark}\n{text}\n<!-- end -->{rest.partition('<!-- end -->')[2]}")
        return
    cv2.setNumThreads(1)
    raise SystemExit(0 if run(args) else 3)


if __name__ == "__main__":
    main()
