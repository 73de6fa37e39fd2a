"""Lenses broken on purpose, or estimated: what is said of the lens, and how far the calibration is off.

    OMP_NUM_THREADS=1 python -m studies.broken_lens STOP --estimate k1 --broken none k1=-0.03 k1=-0.1
    OMP_NUM_THREADS=1 python -m studies.broken_lens own-547 --method edges --broken none cx=10 focal=0.02

Drives are those of :mod:`studies.edges_streets`, from the start that they bring; what breaks them is
:data:`sst_graph.experiments.wrong_drives.WRONG`. Prints a table: the distance from the reference and from the
answer to the first case of the drive, and the parameters that are estimated or, without ``--estimate``,
contradicted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, calibrate
from sst_graph.config import with_overrides
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.markdown import NONE, lines
from sst_graph.experiments.starts import error_of
from sst_graph.experiments.wrong_drives import WRONG
from sst_graph.result import CalibrationResult
from studies.edges_streets import short, source_of

FloatArray = NDArray[np.float64]
AS_IT_IS = "none"
HEAD = "| drive | broken by | status | off by | worst axis [σ] | moved by | estimated or contradicted |"


def broken(drive: KeptDrive, case: str) -> KeptDrive:
    """A drive with one parameter broken, "NAME=SIZE", or as it is."""
    name, _, size = case.partition("=")
    return drive if case == AS_IT_IS else WRONG[name](drive, float(size))


def size_of(error: FloatArray) -> str:
    """Rotation, translation and time offset of seven errors."""
    degrees, centimetres = np.degrees(np.linalg.norm(error[:3])), 100.0 * np.linalg.norm(error[3:6])
    return f"{degrees:.3f}°, {centimetres:.2f} cm, {1e3 * abs(error[6]):.1f} ms"


def lens_of(result: CalibrationResult, estimate: Sequence[str]) -> str:
    """Value and deviation of the parameters that are estimated, else of those that are contradicted."""
    if estimate:
        found = {n: (e["value"], e["sigma"]) for n, e in result.diagnostics["estimated"].items()}
        found = {name: found[name] for name in estimate}
    else:
        tested = result.diagnostics.get("assumptions", {})
        found = {n: (e["estimate"], e["estimate_sigma"]) for n, e in tested.items() if e.get("contradicted")}
    return "; ".join(f"{name} {value:.3g} ± {sigma:.2g}" for name, (value, sigma) in found.items()) or NONE


def rows(args: argparse.Namespace) -> Iterator[list[str]]:
    """A row for each drive and case."""
    config = CalibrationConfig(method=args.method)
    if args.estimate:
        names = ",".join(f'"{name}"' for name in args.estimate)
        config = with_overrides(config, [f"assumptions.estimate=[{names}]"])
    for name in args.names:
        drive, first = KeptDrive.of(source_of(name)), None
        assert drive.truth is not None
        for case in args.broken:
            result = calibrate(broken(drive, case), drive.nominal, config)
            first = first or result
            error = error_of(result.calibration, drive.truth)
            worst = float(np.abs(error / np.sqrt(np.diag(result.covariance))).max())
            moved = first.calibration.local_coordinates(result.calibration)
            yield [
                short(name),
                NONE if case == AS_IT_IS else case,
                result.status,
                size_of(error),
                f"{worst:.1f}",
                NONE if first is result else size_of(moved),
                lens_of(result, args.estimate),
            ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="+")
    parser.add_argument("--method", choices=["joint", "edges"], default="joint")
    parser.add_argument("--estimate", nargs="+", default=[], choices=list(WRONG), metavar="NAME")
    parser.add_argument("--broken", nargs="+", default=[AS_IT_IS], metavar="NAME=SIZE")
    for line in lines(HEAD, rows(parser.parse_args())):
        print(line, flush=True)


if __name__ == "__main__":
    main()
