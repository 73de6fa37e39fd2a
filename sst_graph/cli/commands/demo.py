"""``sst-graph demo``: simulate a street, calibrate it from disk, compare with the truth."""

from __future__ import annotations

import argparse

from sst_graph.batch import CalibrationConfig
from sst_graph.cli.commands.calibrate import calibrate_drives
from sst_graph.cli.messages import complain, mention
from sst_graph.cli.outputs import exit_code, write_calibration
from sst_graph.cli.progress import ProgressBar
from sst_graph.data import open_source
from sst_graph.files import OutputKind, atomic_directory
from sst_graph.inspect.report import verdict_and_summary
from sst_graph.metrics import CalibrationErrors
from sst_graph.simulator import SimulationConfig, fill_drive, simulate

CAMERA = "image_2"
DRIVE = "drive"
CALIBRATION = "calibration"
DEMO = OutputKind("demo", exclusive=(DRIVE,))

MAX_ROTATION_DEG = 0.3
MAX_TRANSLATION_M = 0.03
MAX_TIME_OFFSET_S = 0.010
"""Errors beyond which the demo has failed: QAD, ATD and time offset."""


def street(seed: int) -> SimulationConfig:
    """The embedded street: a stop, an acceleration and a turn, seen by a camera 100 ms late."""
    return SimulationConfig(seed=seed, frames=36, time_offset_s=0.1, azimuth_limit_deg=60.0)


def run(args: argparse.Namespace) -> int:
    """Simulate, calibrate, compare, write ``args.out``."""
    config = street(args.seed)
    with atomic_directory(args.out, args.overwrite, DEMO) as folder:
        with ProgressBar() as progress:
            fill_drive(simulate(config), folder / DRIVE, progress=progress.stage("simulate"))
        source = open_source(folder / DRIVE, camera=CAMERA)
        result, against = calibrate_drives([source], source.nominal, 0.0, CalibrationConfig(), CAMERA)
        (folder / CALIBRATION).mkdir()
        mention(verdict_and_summary(result, against))
        names = write_calibration(folder / CALIBRATION, result, [source], against)
    mention(f"{'wrote':<15} {args.out}/{DRIVE}, {args.out}/{CALIBRATION}: {', '.join(names)}")
    if against is None:
        raise AssertionError("a simulated drive brings its truth")
    faults = over_bounds(against.errors)
    if faults:
        complain(f"demo failed: {', '.join(faults)}")
    return exit_code(result) or (3 if faults else 0)


def over_bounds(errors: CalibrationErrors) -> list[str]:
    """What is farther from the truth than the demo allows, in words."""
    faults = []
    if errors.qad_deg > MAX_ROTATION_DEG:
        faults.append(f"rotation off by {errors.qad_deg:.2f} deg (allowed {MAX_ROTATION_DEG})")
    if errors.atd_m > MAX_TRANSLATION_M:
        faults.append(f"translation off by {100 * errors.atd_m:.1f} cm (allowed {100 * MAX_TRANSLATION_M:g})")
    if errors.time_offset_s is not None and abs(errors.time_offset_s) > MAX_TIME_OFFSET_S:
        found_ms, allowed_ms = 1e3 * errors.time_offset_s, 1e3 * MAX_TIME_OFFSET_S
        faults.append(f"time offset off by {found_ms:+.1f} ms (allowed {allowed_ms:g})")
    return faults
