"""From where the joint method finds the calibration: starts over the whole sphere of rotations.

Each start is searched around with half widths that reach the truth or do not. A run has failed where its
result is far from the truth; it has failed silently where its status is ``ok`` all the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError, count_of
from sst_graph.experiments.markdown import NONE, median, median_worst, status_counts, table
from sst_graph.experiments.starts import drive_of, expect_labels, truth_of
from sst_graph.experiments.tasks.resumable import Work, rows_of
from sst_graph.metrics import calibration_errors
from sst_graph.simulator import SimulationConfig

NEAR_DEG = 30.0
"""Starts closer than this stand in a row of their own [deg]: the default half width of the search."""
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class BasinConfig(Settings):
    """Streets or drives, starts and searches.

    Attributes:
        streets: number of simulated streets; none where ``data`` are given.
        seed: of the first street and of the starts.
        data: folders of drives that bring a reference calibration, in place of streets.
        image_shift: with which these are read.
        searches_deg: half widths of the rotations that are searched [deg]; 180 is the whole sphere.
        searches_m: half widths of the translations that are searched [m], one for each of these.
        starts: on each street or drive, one number for each of these.
        start_deg: largest angle between a start and the truth; the rotations are uniform within [deg].
        start_m: half width of the starts' translation error, uniform by axis [m].
        failed_deg, failed_m: rotation (QAD) or translation (ATD) beyond which a run has failed.
        jobs: processes at a time.
        records: file that keeps finished streets, from which a further call of the same code goes on; empty:
            one beside --out.
        street: the rest of the streets.
        calibration: settings of the method.
    """

    streets: int = setting(50, at_least=1, at_most=10_000)
    seed: int = setting(700, at_least=0, at_most=10**15)
    data: tuple[str, ...] = setting((), length=(0, 1000))
    image_shift: int = setting(1, at_least=-1000, at_most=1000)
    searches_deg: tuple[float, ...] = setting((30.0, 180.0), at_least=0.0, at_most=180.0, length=(1, 10))
    searches_m: tuple[float, ...] = setting((0.6, 1.0), at_least=0.001, at_most=20.0, length=(1, 10))
    starts: tuple[int, ...] = setting((18, 2), at_least=1, at_most=10_000, length=(1, 10))
    start_deg: float = setting(180.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(1.0, at_least=0.0, at_most=100.0)
    failed_deg: float = setting(1.0, at_least=0.0, at_most=180.0)
    failed_m: float = setting(0.2, at_least=0.0, at_most=100.0)
    jobs: int = setting(1, at_least=1, at_most=1000)
    records: str = ""
    street: SimulationConfig = field(
        default_factory=lambda: SimulationConfig(
            frames=6, frame_rate_hz=3.0, width=621, height=187, azimuth_limit_deg=60.0, time_offset_s=0.1
        )
    )
    calibration: CalibrationConfig = field(
        default_factory=lambda: CalibrationConfig(method="joint", find_causes=False)
    )

    def __post_init__(self) -> None:
        if not len(self.searches_deg) == len(self.searches_m) == len(self.starts):
            raise ConfigError(
                f"searches_deg, searches_m, starts: found {len(self.searches_deg)}, {len(self.searches_m)} "
                f"and {count_of(len(self.starts), 'value')}, expected as many of each"
            )


@dataclass(frozen=True)
class Task:
    """One street or drive with all its starts, prepared once.

    Attributes:
        place: folder of the drive, or "" for a simulated street.
        number: of the street or drive.
        config: all settings that its runs depend on.
    """

    place: str
    number: int
    config: BasinConfig


@dataclass(frozen=True)
class BasinRun:
    """One start.

    Attributes:
        drive: name of the drive.
        search_deg, search_m: half widths of the searched rotations [deg] and translations [m].
        start_deg: angle between the start and the truth [deg].
        qad_deg, atd_m: errors of the result.
        status: of the result.
        seconds: that it took, on one core [s].
    """

    drive: str
    search_deg: float
    search_m: float
    start_deg: float
    qad_deg: float
    atd_m: float
    status: str
    seconds: float

    def failed(self, config: BasinConfig) -> bool:
        return self.qad_deg > config.failed_deg or self.atd_m > config.failed_m


def run(config: BasinConfig, progress: Progress | None = None) -> str:
    """The table as Markdown.

    Raises:
        ConfigError: the records are of another kind.
        DataError: a drive cannot be used.
    """
    # Neither how many streets nor how many processes there are changes what is found on one of them.
    own = dataclasses.replace(config, streets=1, data=(), jobs=1, records="")
    places = config.data or ("",) * config.streets
    drives = [[Task(place, number, own)] for number, place in enumerate(places)]
    return markdown(config, rows_of(Work(runs_of, BasinRun, config.jobs, config.records), drives, progress))


def runs_of(tasks: Sequence[Task]) -> Iterator[list[BasinRun]]:
    """Every start of every search on each street or drive."""
    yield from map(_runs_of_drive, tasks)


def _runs_of_drive(task: Task) -> list[BasinRun]:
    """Every start of every search on one.

    Raises:
        DataError: the drive cannot be used, or has no labels.
        ConfigError: it brings no reference calibration.
    """
    config = task.config
    source = drive_of(task.place, task.number, config)
    truth = truth_of(source)
    expect_labels(source, (config.calibration.method,))
    drives = prepare_drives([source], config.calibration)
    found = []
    for search_deg, search_m, starts in zip(
        config.searches_deg, config.searches_m, config.starts, strict=True
    ):
        rng = np.random.default_rng([config.seed, task.number, 24])
        search = dataclasses.replace(
            config.calibration.search, rotation_deg=search_deg, translation_m=search_m
        )
        calibration = dataclasses.replace(config.calibration, search=search)
        for _ in range(starts):
            start = start_anywhere(truth.cTl, config.start_deg, config.start_m, rng)
            result = calibrate_prepared(drives, start, calibration)
            errors = calibration_errors(result.T_camera_lidar, result.time_offset_s, truth)
            away = np.linalg.norm(gtsam.Rot3.Logmap(start.rotation().between(truth.cTl.rotation())))
            found.append(
                BasinRun(
                    source.name,
                    search_deg,
                    search_m,
                    float(np.degrees(away)),
                    errors.qad_deg,
                    errors.atd_m,
                    result.status,
                    float(result.diagnostics["seconds"]["estimate"]),
                )
            )
    return found


def start_anywhere(
    cTl: gtsam.Pose3, largest_deg: float, half_m: float, rng: np.random.Generator
) -> gtsam.Pose3:
    """A pose whose rotation is uniform over those within an angle of the extrinsic's (Haar measure).

    The translation (of T_camera_lidar) has an error uniform by axis within a half width [m].
    """
    axis = rng.normal(size=3)
    turn = gtsam.Rot3.Expmap(axis / np.linalg.norm(axis) * _angle_within(np.radians(largest_deg), rng))
    shift = rng.uniform(-half_m, half_m, 3)
    return gtsam.Pose3(turn * cTl.rotation(), np.asarray(cTl.translation()) + shift)


def _angle_within(largest: float, rng: np.random.Generator) -> float:
    """Angle of a rotation that is uniform over those within ``largest`` [rad]: its density is 1 - cos."""
    while True:
        angle = largest * float(rng.uniform())
        if rng.uniform() * (1.0 - np.cos(largest)) <= 1.0 - np.cos(angle):
            return angle


def binomial_bounds(count: int, of: int) -> tuple[float, float]:
    """Exact bounds of a probability that showed ``count`` times in ``of`` (Clopper and Pearson, 1934)."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - _CONFIDENCE)
    low = 0.0 if count == 0 else float(beta.ppf(tail, count, of - count + 1))
    high = 1.0 if count == of else float(beta.ppf(1.0 - tail, count + 1, of - count))
    return low, high


def markdown(config: BasinConfig, runs: Sequence[BasinRun]) -> str:
    """The table of runs, a row for every search and distance of the start."""
    names = dict.fromkeys(row.drive for row in runs)
    over = (
        ", ".join(names)
        if config.data
        else f"{count_of(len(names), 'simulated street')} (seeds from {config.seed})"
    )
    conditions = (
        f"{over}; starts uniform over rotations within {config.start_deg:g}° of the truth and within "
        f"±{config.start_m:g} m by axis. Failed: QAD above {config.failed_deg:g}° or ATD above "
        f"{100.0 * config.failed_m:g} cm. Silent: failed and `ok`. In brackets: exact "
        f"{100.0 * _CONFIDENCE:g} % bounds (Clopper–Pearson)."
    )
    rows = []
    for search_deg, search_m in zip(config.searches_deg, config.searches_m, strict=True):
        own = [row for row in runs if (row.search_deg, row.search_m) == (search_deg, search_m)]
        near = [row for row in own if row.start_deg <= NEAR_DEG]
        label = f"±{search_deg:g}°, ±{search_m:g} m"
        rows.append(_row(label, "all", own, config))
        if 0 < len(near) < len(own):
            rows.append(_row(label, f"within {NEAR_DEG:g}°", near, config))
    if len(config.searches_deg) > 1:
        rows.append(_row("all", "all", runs, config))
    return f"{conditions}\n\n{table(_HEADER, rows)}"


_HEADER = (
    "| searched | starts | runs | failed | silent | ok / unobservable / not converged "
    "| QAD of those not failed, median / worst [deg] | ATD [cm] | seconds, median |"
)


def _row(searched: str, starts: str, runs: Sequence[BasinRun], config: BasinConfig) -> list[str]:
    failed = [row for row in runs if row.failed(config)]
    good = [row for row in runs if not row.failed(config)]
    silent = sum(row.status == "ok" for row in failed)
    return [
        searched,
        starts,
        str(len(runs)),
        _share(len(failed), len(runs)),
        _share(silent, len(runs)),
        status_counts([row.status for row in runs]),
        median_worst([row.qad_deg for row in good], 3),
        median_worst([100.0 * row.atd_m for row in good], 1),
        median([row.seconds for row in runs], 1),
    ]


def _share(count: int, of: int) -> str:
    if of == 0:
        return NONE
    low, high = binomial_bounds(count, of)
    return f"{count} ({100.0 * low:.2f}–{100.0 * high:.2f} %)"
