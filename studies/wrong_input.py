"""Drives made wrong on purpose, calibrated as a user would: status, named cause, error. Prints a table.

    OMP_NUM_THREADS=1 python studies/wrong_input.py --seeds 201 202
    OMP_NUM_THREADS=1 python studies/wrong_input.py --drive DATA --faults "Tr inverted" clean
    OMP_NUM_THREADS=1 python studies/wrong_input.py --subtle --seeds 431 --frames 40
    OMP_NUM_THREADS=1 python studies/wrong_input.py --subtle --drive DATA --methods joint edges

Streets have 30 frames (--frames) of 621x188 px, and start from the pose that the data bring. --quick leaves
the solution out where something is certain before it: the status is then never ok. --subtle: faults that
leave a drive plausible, with a column for each drive and method: status, error, sigmas on the worst axis, and
in bold what is ok and more than 3 of them off, the truth of a real drive being known to 0.1 deg, 1 cm and
5 ms. Real drives are whole and start 1.5 deg and 5 cm off then. What is said first goes to stderr.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from subtle_faults import SUBTLE_FAULTS, SUBTLE_NAMED
from wrong_drives import INPUT_FAULTS, NAMED, right_camera

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch.calibrate import calibrate, calibrate_prepared, prepare_drives
from sst_graph.batch.config import Method
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.diagnosis import preflight
from sst_graph.errors import SstGraphError
from sst_graph.experiments.markdown import lines
from sst_graph.experiments.starts import errors_of
from sst_graph.metrics import TruthSigma, tangent_error
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Guess

CLEAN, RIGHT = "clean", "right camera"
HEAD = "| drive | mistake | as it should be | status | error of the answer | said first |"
SHORT = {"not_converged": "n.c.", "unobservable": "un."}
"""Statuses in the cells of subtle faults."""
MOST_SIGMAS = 3.0
REFERENCE = TruthSigma(0.1, 0.01, 0.005)
"""Of the published calibrations of real drives."""
START = np.array([*np.radians([0.9, -0.9, 0.8]), 0.03, -0.03, 0.03])
"""(6,) from the reference of a real drive to where its subtle faults start."""


def street(seed: int, frames: int, right: bool = False) -> KeptDrive:
    """A street of a seed, seen by its own camera or by one beside it."""
    made = simulate(SimulationConfig(seed=seed, frames=frames, width=621, height=188, azimuth_step_deg=0.3))
    return right_camera(made) if right else KeptDrive.of(made, sweep="auto")


def row(name: str, drive: KeptDrive, quick: bool) -> tuple[Sequence[str], bool]:
    """Cells of the table, and whether it is as it should be: a fault named and not ok, clean data silent."""
    config = CalibrationConfig()
    try:
        prepared = prepare_drives([drive], config)
        certain = preflight(prepared, Guess(drive.nominal, 0.0), config.classes) if quick else ()
        if certain:
            sentence = certain[0].sentence
            return ("before the solution", "", sentence), name in NAMED and NAMED[name] in sentence
        result = calibrate_prepared(prepared, drive.nominal, config)
    except SstGraphError as error:
        return ("refused", "", str(error)), NAMED.get(name, "") in str(error) and name in NAMED
    first = result.reasons[0] if result.reasons else ""
    error_text = ""
    if drive.truth is not None:
        errors = errors_of(result, drive.truth)
        error_text = f"{errors.qad_deg:.2f} deg, {100.0 * errors.atd_m:.1f} cm"
    named = not any(words in first for words in NAMED.values())
    if name in NAMED:
        named = NAMED[name] in first and result.status != "ok"
    return (result.status, error_text, first), named


def subtle_cell(name: str, drive: KeptDrive, method: Method, real: bool) -> tuple[str, bool]:
    """What a fault that leaves a drive plausible comes to, and whether the result can be believed.

    Args:
        real: its truth is a reference that is not exact.
    """
    try:
        result = calibrate(drive, drive.nominal, CalibrationConfig(method=method))
    except SstGraphError as error:
        print(f"{name}: {error}", file=sys.stderr, flush=True)
        return "refused", True
    first = result.reasons[0] if result.reasons else ""
    print(f"{name}: {first}", file=sys.stderr, flush=True)
    assert drive.truth is not None
    late_s = result.time_offset_s - (drive.truth.time_offset_s or 0.0)
    error = tangent_error(result.T_camera_lidar, drive.truth.cTl, late_s)
    covariance = result.covariance + real * REFERENCE.covariance
    sigmas = float((np.abs(error) / np.sqrt(np.diag(covariance))).max())
    sizes = (
        f"{np.degrees(np.linalg.norm(error[:3])):.2f}°, {100.0 * np.linalg.norm(error[3:6]):.1f} cm, "
        f"{1e3 * abs(late_s):.1f} ms, {sigmas:.1f} σ"
    )
    status = SHORT.get(result.status, result.status)
    if name in SUBTLE_NAMED and SUBTLE_NAMED[name] in first:
        status += ", named"
    believed = result.status != "ok" or sigmas <= MOST_SIGMAS
    believed = believed and SUBTLE_NAMED.get(name, "") in first
    return f"{status if believed else f'**{status}**'}, {sizes}", believed


def subtle_columns(args: argparse.Namespace) -> dict[str, tuple[KeptDrive, Method, bool]]:
    """Drive, method, and whether its truth is a reference, by the column's head."""
    found = {}
    for name, drive, _, _ in drives(args):
        real = name not in map(str, args.seeds)
        if real and drive.truth is not None:
            drive = replace(drive, nominal=drive.truth.cTl.retract(START))
        for method in args.methods:
            found[f"{method}, `{name}`" if real else f"{method}, street {name}"] = drive, method, real
    return found


def subtle_rows(
    args: argparse.Namespace, columns: Mapping[str, tuple[KeptDrive, Method, bool]], right: list[bool]
) -> Iterator[Sequence[str]]:
    """A row for each fault that leaves a drive plausible; whether each can be believed goes to ``right``."""
    for fault in args.faults or (CLEAN, *SUBTLE_FAULTS):
        cells = []
        for drive, method, real in columns.values():
            wrong = drive if fault == CLEAN else SUBTLE_FAULTS[fault](drive)
            cell, believed = subtle_cell(fault, wrong, method, real)
            right.append(believed)
            cells.append(cell)
        yield fault, *cells


def rows(args: argparse.Namespace, right: list[bool]) -> Iterator[Sequence[str]]:
    """Rows of mistakes; whether each is as it should be goes to ``right``."""
    for name, drive, other, beside in drives(args):
        for fault in args.faults:
            if fault == RIGHT and beside is None:
                continue
            wrong = (
                drive if fault == CLEAN else beside if fault == RIGHT else INPUT_FAULTS[fault](drive, other)
            )
            assert wrong is not None
            cells, as_it_should = row(fault, wrong, args.quick)
            right.append(as_it_should)
            yield name, fault, "yes" if as_it_should else "**no**", *cells


def drives(args: argparse.Namespace) -> Iterator[tuple[str, KeptDrive, KeptDrive, KeptDrive | None]]:
    """Name, drive, another drive of the same size, and the drive by the right camera where it can be had."""
    some = None if args.subtle else f":{args.frames}"
    other = KeptDrive.of(open_source(args.other, frames=some), sweep="auto") if args.other else None
    for path in args.drive:
        source = open_source(path, image_shift=args.image_shift, frames=some)
        drive = KeptDrive.of(source, sweep="auto")
        yield path.name, drive, other or drive, None
    for seed in args.seeds:
        beside = street(seed, args.frames, right=True) if RIGHT in args.faults else None
        made = street(seed, args.frames)
        yield str(seed), made, made if args.subtle else street(seed + 1000, args.frames), beside


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--drive", type=Path, nargs="*", default=[])
    parser.add_argument("--other", type=Path, help="another drive, for masks and images of another drive")
    parser.add_argument("--image-shift", type=int, default=0)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--subtle", action="store_true", help="faults that leave a drive plausible")
    parser.add_argument(
        "--methods", nargs="+", default=["joint"], choices=["joint", "edges"], help="of --subtle"
    )
    parser.add_argument("--faults", nargs="*", default=[])
    args = parser.parse_args()
    known = (CLEAN, *SUBTLE_FAULTS) if args.subtle else (CLEAN, *INPUT_FAULTS, RIGHT)
    if unknown := set(args.faults) - set(known):
        parser.error(f"--faults: found {', '.join(sorted(unknown))}, expected some of {', '.join(known)}")
    if not args.subtle and not args.faults:
        args.faults = list(known)
    right: list[bool] = []
    if args.subtle:
        columns = subtle_columns(args)
        found = lines(f"| fault | {' | '.join(columns)} |", subtle_rows(args, columns, right))
    else:
        found = lines(HEAD, rows(args, right))
    for line in found:
        print(line, flush=True)
    print(f"\n{sum(right)} of {len(right)} are as they should be.")


if __name__ == "__main__":
    main()
