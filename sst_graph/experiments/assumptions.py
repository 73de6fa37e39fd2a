"""Assumptions broken on purpose: which are found, and what the others do to the result and its covariance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import Settings, setting
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError, count_of
from sst_graph.experiments import markdown
from sst_graph.experiments.starts import error_of
from sst_graph.experiments.wrong_drives import WRONG, with_line_delay
from sst_graph.metrics import nees
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.types import FloatArray

SIZES: dict[str, tuple[float, ...]] = {
    "focal": (0.003, 0.01, 0.02, 0.04, 0.08),
    "cx": (1.0, 5.0, 15.0, 30.0, 60.0),
    "cy": (1.0, 5.0, 15.0, 30.0, 60.0),
    "k1": (0.01, 0.03, 0.06, 0.1, 0.3),
    "k2": (0.01, 0.03, 0.06, 0.1, 0.3),
    "skew": (0.003, 0.01, 0.02, 0.04, 0.08),
    "line_delay": (2e-5, 1e-4, 4e-4),
    "range_bias": (0.03, 0.1, 0.3, 1.0, 2.0),
    "range_scale": (0.003, 0.01, 0.03, 0.1, 0.3),
    "elevation": (0.001, 0.003, 0.01, 0.02, 0.04),
}
"""Sizes by which each assumption is broken, in its unit, in either sense."""

CLEAN, DRAWN = "clean", "drawn"
"""A street as it is, and with all parameters drawn from their prior deviations at once."""
CASES = (CLEAN, DRAWN, *SIZES)
_LARGE_SIGMAS = 5.0
"""A size above this many of the deviations that its parameter would have as a variable is to be found."""
_PRIOR_SPANS = 0.5
"""A deviation above this share of its parameter's span, the prior of the test, is the prior's."""
_SILENT_SIGMAS = 3.0
"""A result that is ``ok`` is to be off by no more than this on any of its seven axes."""


@dataclass(frozen=True)
class AssumptionTableConfig(Settings):
    """Streets, and how their data are broken.

    Attributes:
        streets: simulated streets.
        seed: of the first one; the next ones follow.
        street: what they are like; its own seed does not matter.
        cases: ``clean``, ``drawn`` (all parameters from their prior deviations at once), and names of
            assumptions that are broken; none: all of them.
        sizes: by which assumptions are broken; none: :data:`SIZES` of each.
        in_sigmas: ``sizes`` count the deviation that the parameter has on the clean street, which is then
            calibrated first; what a clean street says nothing of is left out.
        calibration: settings of the method.
    """

    streets: int = setting(5, at_least=1, at_most=10_000)
    seed: int = setting(700, at_least=0, at_most=2**31)
    street: SimulationConfig = field(default_factory=lambda: SimulationConfig(frames=30, time_offset_s=0.1))
    cases: tuple[str, ...] = ()
    sizes: tuple[float, ...] = setting((), at_least=0.0, at_most=1000.0, length=(0, 100))
    in_sigmas: bool = False
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)

    def __post_init__(self) -> None:
        if unknown := [name for name in self.cases if name not in CASES]:
            raise ConfigError(f"cases: found {', '.join(unknown)}, expected some of {', '.join(CASES)}")
        if self.in_sigmas and not self.sizes:
            raise ConfigError("in_sigmas: found no sizes, expected some, as in sizes=[2,5,10]")
        if self.in_sigmas and CLEAN not in (self.cases or CASES):
            raise ConfigError("in_sigmas: cases leave out clean, expected it: it gives the deviations")


@dataclass(frozen=True)
class AssumptionRun:
    """One calibration of one street.

    Attributes:
        seed: of the street.
        case: what was done to it.
        size: by how much, with its sign; 0 where nothing was, or all.
        status: of the result.
        error: (7,) how far the result is off [rad, m, s].
        covariance: (7, 7) that it claims.
        estimates: what the data say of each parameter: estimate and deviation, by name.
        contradicted: assumptions that the data contradict, the most contradicted first.
    """

    seed: int
    case: str
    size: float
    status: str
    error: FloatArray
    covariance: FloatArray
    estimates: Mapping[str, tuple[float, float]]
    contradicted: tuple[str, ...]

    @property
    def nees(self) -> float:
        """Normalised error squared over its dimension."""
        return nees(self.error, self.covariance) / len(self.error)

    @property
    def worst_sigmas(self) -> float:
        """Error over its sigma on the worst axis."""
        return float((np.abs(self.error) / np.sqrt(np.diag(self.covariance))).max())

    @property
    def silent(self) -> bool:
        """``ok`` and more than three sigmas off on an axis."""
        return self.status == "ok" and self.worst_sigmas > _SILENT_SIGMAS


def run(config: AssumptionTableConfig, progress: Progress | None = None) -> str:
    """A Markdown table: a row for each case and size, both senses together, and what they come to."""
    return table(list(runs_of(config, progress)), config.in_sigmas)


def runs_of(config: AssumptionTableConfig, progress: Progress | None) -> Iterator[AssumptionRun]:
    """All calibrations of the table: street by street, each simulated once."""
    cases = [
        (name, sign * size)
        for name in sorted(config.cases or CASES, key=lambda name: name != CLEAN)
        for size in ((config.sizes or SIZES[name]) if name in SIZES else (0.0,))
        for sign in ((1.0, -1.0) if size else (1.0,))
    ]
    for number in range(config.streets):
        street = simulate(replace(config.street, seed=config.seed + number))
        kept = KeptDrive.of(street)
        units = dict.fromkeys(SIZES, 1.0)
        for done, (name, size) in enumerate(cases):
            if name not in SIZES or name in units:
                by = size * units.get(name, 1.0)
                one = _calibrated(_broken(street, kept, name, by), (street.config.seed, name, by), config)
                if name == CLEAN and config.in_sigmas:
                    units = _deviations(one)
                yield one
            if progress is not None:
                progress("assumptions", number * len(cases) + done + 1, config.streets * len(cases))


def _deviations(clean: AssumptionRun) -> dict[str, float]:
    """Deviations of the parameters that a clean street determines, by name."""
    return {
        name: sigma
        for name, (_, sigma) in clean.estimates.items()
        if sigma < _PRIOR_SPANS * ASSUMPTIONS[name].span
    }


def _broken(street: SimulatedDrive, kept: KeptDrive, case: str, size: float) -> KeptDrive:
    if case == CLEAN:
        return kept
    if case == DRAWN:
        rng = np.random.default_rng([street.config.seed, 71])
        for name, wrong in WRONG.items():
            kept = wrong(kept, ASSUMPTIONS[name].sigma * float(rng.standard_normal()))
        return kept
    return with_line_delay(street, kept, size) if case == "line_delay" else WRONG[case](kept, size)


def _calibrated(
    drive: KeptDrive, case: tuple[int, str, float], config: AssumptionTableConfig
) -> AssumptionRun:
    settings = config.calibration
    result = calibrate_prepared(prepare_drives([drive], settings), drive.nominal, settings)
    assert drive.truth is not None
    error = error_of(result.calibration, drive.truth)
    report = result.diagnostics.get("assumptions", {})
    estimates = {
        name: (entry["estimate"], entry["estimate_sigma"])
        for name, entry in report.items()
        if "estimate" in entry
    }
    against = [name for name in estimates if report[name]["contradicted"]]
    against.sort(key=lambda name: -abs(estimates[name][0]) / estimates[name][1])
    return AssumptionRun(*case, result.status, error, result.covariance, estimates, tuple(against))


def table(runs: Sequence[AssumptionRun], in_sigmas: bool = False) -> str:
    """The table of some runs, with a summary below.

    A row holds the runs of one size; with ``in_sigmas`` those of one assumption, in a column for each size
    over its deviation.

    A size in sigmas is in units of the deviation that its parameter would have as a variable on that street.
    "Silent" runs are ``ok`` and more than three sigmas off on an axis.
    """
    sigmas = {
        (one.seed, name): sigma
        for one in runs
        if one.case == CLEAN
        for name, (_, sigma) in one.estimates.items()
    }
    if in_sigmas:
        return "\n".join([_by_size(runs, sigmas), *_summary(runs, sigmas)]) + "\n"
    rows: dict[tuple[str, float], list[AssumptionRun]] = {}
    for one in runs:
        rows.setdefault((one.case, abs(one.size)), []).append(one)
    cells = (_row(case, some, sigmas) for (case, _), some in rows.items())
    return "\n".join([markdown.table(_HEADER, cells), *_summary(runs, sigmas)]) + "\n"


def _by_size(runs: Sequence[AssumptionRun], sigmas: Mapping[tuple[int, str], float]) -> str:
    """A row for each assumption, with its deviations, and a column for each size."""
    broken = [one for one in runs if one.size]
    sizes = sorted({round(_in_sigmas(one, sigmas), 6) for one in broken})
    rows = []
    for case in dict.fromkeys(one.case for one in broken):
        own = [one for one in broken if one.case == case]
        deviations = (sigmas[seed, case] for seed in dict.fromkeys(one.seed for one in own))
        cells = ([one for one in own if round(_in_sigmas(one, sigmas), 6) == size] for size in sizes)
        rows.append([f"`{case}`", ", ".join(f"{one:.2g}" for one in deviations), *map(_counts, cells)])
    return markdown.table(f"| broken | σ | {' | '.join(f'± {size:g} σ' for size in sizes)} |", rows)


def _counts(runs: Sequence[AssumptionRun]) -> str:
    """Contradicted, named first, not ok and silent, of all; median and mean NEES over its dimension."""
    if not runs:
        return markdown.NONE
    counts = (
        sum(bool(one.contradicted) for one in runs),
        sum(one.contradicted[:1] == (one.case,) for one in runs),
        sum(one.status != "ok" for one in runs),
        sum(one.silent for one in runs),
    )
    normalised = [one.nees for one in runs]
    figures = f"{np.median(normalised):.2g}, {np.mean(normalised):.2g}"
    return f"{', '.join(map(str, counts))} of {len(runs)}; {figures}"


_HEADER = (
    "| broken | by ± | size [σ] | runs | contradicted | named first | not ok | silent "
    "| error [deg, cm, ms], median | NEES / dimension: median, mean |"
)


def _in_sigmas(one: AssumptionRun, sigmas: Mapping[tuple[int, str], float]) -> float:
    """Size over the deviation of its parameter on the clean street; NaN where that was not calibrated."""
    return abs(one.size) / sigmas.get((one.seed, one.case), np.nan)


def _row(case: str, runs: Sequence[AssumptionRun], sigmas: Mapping[tuple[int, str], float]) -> list[str]:
    size = float(np.median([abs(one.size) for one in runs]))
    sizes = np.array([_in_sigmas(one, sigmas) for one in runs])
    errors = np.array([one.error for one in runs])
    turn = np.degrees(np.median(np.linalg.norm(errors[:, :3], axis=1)))
    shift = 100.0 * np.median(np.linalg.norm(errors[:, 3:6], axis=1))
    offset = 1e3 * np.median(np.abs(errors[:, 6]))
    normalised = [one.nees for one in runs]
    return [
        case,
        f"{size:.3g}" if size else "–",
        f"{np.median(sizes):.1f}" if size and np.isfinite(sizes).all() else "–",
        str(len(runs)),
        str(sum(bool(one.contradicted) for one in runs)),
        str(sum(one.contradicted[:1] == (case,) for one in runs)) if size else "–",
        str(sum(one.status != "ok" for one in runs)),
        str(sum(one.silent for one in runs)),
        f"{turn:.3f}, {shift:.2f}, {offset:.2f}",
        f"{np.median(normalised):.2f}, {np.mean(normalised):.2f}",
    ]


def _summary(runs: Sequence[AssumptionRun], sigmas: Mapping[tuple[int, str], float]) -> list[str]:
    broken = [one for one in runs if one.size]
    large = [one for one in broken if _in_sigmas(one, sigmas) > _LARGE_SIGMAS]
    groups = {f"sizes above {_LARGE_SIGMAS:g} σ": large, "all sizes": broken}
    groups |= {case: [one for one in runs if one.case == case] for case in (CLEAN, DRAWN)}
    return [
        f"- {name}: {count_of(len(some), 'run')}, {sum(bool(one.contradicted) for one in some)} "
        "contradicted, "
        f"{sum(one.status != 'ok' for one in some)} not ok, {sum(one.silent for one in some)} silent"
        for name, some in groups.items()
        if some
    ]
