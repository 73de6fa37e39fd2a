"""A method from every start on one drive."""

from __future__ import annotations

import dataclasses
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import cast

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.batch.config import Method
from sst_graph.config import Settings, setting
from sst_graph.data.info.needed_labels import missing_labels
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.experiments.peers.frames import PeerProblem, peer_frames
from sst_graph.experiments.peers.methods import NAMES, PEERS
from sst_graph.experiments.starts import drive_of, start_near, truth_of
from sst_graph.metrics import calibration_errors
from sst_graph.odometry.sweep import with_sweep
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulationConfig
from sst_graph.types import GroundTruth, Source


@dataclass(frozen=True)
class PeersConfig(Settings):
    """Drives, starts and methods.

    Attributes:
        streets: number of simulated streets, beside the ``data``.
        seed: of the first street and of the starts.
        data: folders of drives that bring a reference calibration.
        image_shift: with which these are read.
        methods: that are compared.
        ranges_deg: half widths of the starts' rotation error, uniform by axis, one after the other [deg].
        metres_a_degree: half width of the translation error, in proportion to that of the rotation [m/deg].
        starts: of each drive and range.
        frames: that the peers are given, evenly over the drive; the package's methods choose their own.
        samples: poses of each round of CalibAnything's random search; the original leaves it to its user.
        failed_deg, failed_m: rotation (QAD) or translation (ATD) beyond which a run has failed.
        jobs: drives at a time, a process each.
        records: file that keeps finished tasks, from which a further call of the same code goes on; empty:
            one beside --out.
        figure: SVG to write, of error against start.
        street: the rest of the streets.
        calibration: settings of the package's methods.
    """

    streets: int = setting(3, at_least=0, at_most=10_000)
    seed: int = setting(800, at_least=0, at_most=10**15)
    data: tuple[str, ...] = setting((), length=(0, 1000))
    image_shift: int = setting(1, at_least=-1000, at_most=1000)
    methods: tuple[str, ...] = setting(NAMES, length=(1, 100), choices=NAMES)
    ranges_deg: tuple[float, ...] = setting(
        (1.0, 3.0, 10.0, 20.0), at_least=0.0, at_most=180.0, length=(1, 100)
    )
    metres_a_degree: float = setting(0.01, at_least=0.0, at_most=1.0)
    starts: int = setting(1, at_least=1, at_most=10_000)
    frames: int = setting(5, at_least=1, at_most=1000)
    samples: int = setting(1000, at_least=1, at_most=10**7)
    failed_deg: float = setting(1.0, at_least=0.0, at_most=180.0)
    failed_m: float = setting(0.2, at_least=0.0, at_most=100.0)
    jobs: int = setting(1, at_least=1, at_most=1000)
    records: str = ""
    figure: str = ""
    street: SimulationConfig = field(
        default_factory=lambda: SimulationConfig(frames=30, azimuth_limit_deg=60.0, time_offset_s=0.1)
    )
    calibration: CalibrationConfig = field(default_factory=lambda: CalibrationConfig(find_causes=False))

    def __post_init__(self) -> None:
        if self.streets == 0 and not self.data:
            raise ConfigError("streets, data: found neither, expected streets or drives")


START = "start"
"""What stands in the place of a method for the starts themselves."""


@dataclass(frozen=True)
class PeerTask:
    """A method on a drive.

    Attributes:
        place: folder of a drive, or "" for a simulated street.
        number: of the drive among the folders, or of the street among the streets.
        method: its name, or START.
        config: all settings that its runs depend on.
        traced: whether memory is measured too.
    """

    place: str
    number: int
    method: str
    config: PeersConfig
    traced: bool = False


@dataclass(frozen=True)
class PeerRun:
    """One method from one start.

    Attributes:
        drive: name of the drive.
        simulated: whether it is a street.
        method: its name, or "start" for the start itself.
        range_deg: half width of the start's error.
        qad_deg, atd_m: errors of the result; None where the method could not be run.
        status: what the result says of itself; "" of a peer, which says nothing.
        sigma_deg: claimed standard deviation of the rotation (root of the mean variance), or None.
        seconds: of processor time, without reading and preparing the drive; None where it could not be run.
        peak_mb: most memory of Python and NumPy at once beside the prepared drive (tracemalloc); only of the
            first start on the first street and the first drive.
        why_not: why it could not be run, or "".
    """

    drive: str
    simulated: bool
    method: str
    range_deg: float
    qad_deg: float | None
    atd_m: float | None
    status: str
    sigma_deg: float | None
    seconds: float | None
    peak_mb: float | None
    why_not: str = ""

    def failed(self, config: PeersConfig) -> bool:
        if self.qad_deg is None or self.atd_m is None:
            return True
        rotation_only = self.method in PEERS and PEERS[self.method].rotation_only
        return self.qad_deg > config.failed_deg or (not rotation_only and self.atd_m > config.failed_m)


@dataclass(frozen=True)
class _Answer:
    """Where a method ended."""

    cTl: gtsam.Pose3
    status: str = ""
    sigma_deg: float | None = None


_Solver = Callable[[gtsam.Pose3, float], _Answer]
"""From a start and the half width of its error [deg]."""


def tasks_of(config: PeersConfig) -> list[list[PeerTask]]:
    """All tasks of each drive: streets, then folders.

    Streets and folders are numbered apart: more of the one leave the records of the other as they are.
    """
    # What changes nothing of what one method finds on one drive.
    own = dataclasses.replace(config, streets=1, data=(), methods=NAMES, jobs=1, records="", figure="")
    places = [("", number) for number in range(config.streets)]
    places += [(place, number) for number, place in enumerate(config.data)]
    return [
        [PeerTask(place, number, method, own, number == 0) for method in (START, *config.methods)]
        for place, number in places
    ]


def runs_of(tasks: Sequence[PeerTask]) -> Iterator[list[PeerRun]]:
    """Each method from all starts on one drive, which is read and prepared once.

    Raises:
        DataError: the drive cannot be used.
        ConfigError: it brings no reference calibration.
    """
    read = _read(tasks[0])
    for task in tasks:
        yield _runs_of_task(task, read)


def _runs_of_task(task: PeerTask, read: _ReadDrive) -> list[PeerRun]:
    config = task.config
    solve = None if task.method == START else _solver(read, task.method, config)
    rng = np.random.default_rng([config.seed, task.number, 25])
    found = []
    for range_deg in config.ranges_deg:
        for number in range(config.starts):
            start = start_near(read.truth.cTl, range_deg, config.metres_a_degree * range_deg, rng)
            name, simulated = read.source.name, not task.place
            run = PeerRun(name, simulated, task.method, range_deg, 0.0, 0.0, "", None, None, None)
            if solve is None:
                found.append(_with_errors(run, start, read.truth))
                continue
            run = _run(run, solve, start, read.truth)
            if task.traced and number == 0 and range_deg == config.ranges_deg[0] and not run.why_not:
                # Once more, for tracing makes it slow.
                run = dataclasses.replace(run, peak_mb=_peak_mb(solve, start, range_deg))
            found.append(run)
    return found


@dataclass(frozen=True, eq=False)
class _ReadDrive:
    """A drive that is read and prepared once for all methods but edges, which prepares its own."""

    source: Source
    truth: GroundTruth
    drive: Drive
    problem: PeerProblem


def _read(task: PeerTask) -> _ReadDrive:
    config = task.config
    source = drive_of(task.place, task.number, config)
    truth = truth_of(source)
    swept = with_sweep(source, config.calibration.decide_sweep)
    drive = prepare_drive(swept, config.calibration.classes, config.calibration.prepare)
    offset_s = truth.time_offset_s or 0.0
    frames = peer_frames(swept, drive, offset_s, config.frames, source)
    problem = PeerProblem(frames, drive, offset_s, samples=config.samples, seed=config.seed)
    return _ReadDrive(swept, truth, drive, problem)


def _solver(read: _ReadDrive, method: str, config: PeersConfig) -> _Solver:
    if method in PEERS:
        return _by_peer(read.problem, method, config)
    if missing := missing_labels([read.source], method):
        return _without(f"the data hold no {' and no '.join(missing)}")
    own = dataclasses.replace(config.calibration, method=cast(Method, method))
    drive = prepare_drives([read.source], own)[0] if method == "edges" else read.drive
    return _by_package(drive, own, read.problem.time_offset_s)


def _by_peer(problem: PeerProblem, method: str, config: PeersConfig) -> _Solver:
    def solve(start: gtsam.Pose3, range_deg: float) -> _Answer:
        told = dataclasses.replace(problem, range_deg=range_deg, range_m=config.metres_a_degree * range_deg)
        return _Answer(PEERS[method].solve(told, start))

    return solve


def _by_package(drive: Drive, config: CalibrationConfig, offset_s: float) -> _Solver:
    def solve(start: gtsam.Pose3, range_deg: float) -> _Answer:
        result = calibrate_prepared([drive], start, config, initial_time_offset_s=offset_s)
        return _Answer(result.T_camera_lidar, result.status, _rotation_sigma_deg(result))

    return solve


def _without(why: str) -> _Solver:
    """What stands in the place of a method that lacks something, which is no failure of it."""

    def solve(start: gtsam.Pose3, range_deg: float) -> _Answer:
        raise EstimationError(why)

    return solve


def _rotation_sigma_deg(result: CalibrationResult) -> float:
    return float(np.degrees(np.sqrt(np.trace(np.asarray(result.covariance)[:3, :3]) / 3.0)))


def _run(run: PeerRun, solve: _Solver, start: gtsam.Pose3, truth: GroundTruth) -> PeerRun:
    began = time.process_time()
    try:
        answer = solve(start, run.range_deg)
    except EstimationError as error:
        return dataclasses.replace(run, qad_deg=None, atd_m=None, why_not=str(error))
    seconds = time.process_time() - began
    run = dataclasses.replace(run, status=answer.status, sigma_deg=answer.sigma_deg, seconds=seconds)
    return _with_errors(run, answer.cTl, truth)


def _peak_mb(solve: _Solver, start: gtsam.Pose3, range_deg: float) -> float:
    tracemalloc.start()
    try:
        solve(start, range_deg)
        return 1e-6 * tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _with_errors(run: PeerRun, cTl: gtsam.Pose3, truth: GroundTruth) -> PeerRun:
    errors = calibration_errors(cTl, 0.0, GroundTruth(truth.cTl, None))
    return dataclasses.replace(run, qad_deg=errors.qad_deg, atd_m=errors.atd_m)
