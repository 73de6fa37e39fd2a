"""A principal point that is off, under several prevalences: status, errors in sigmas, NEES. Prints a table.

    OMP_NUM_THREADS=1 python -m studies.principal_point own-547 own-551 third-901 third-903 STOP PARKED
    OMP_NUM_THREADS=1 python -m studies.principal_point own-547 --prevalence 0.1

The prevalence is the probability beforehand that the camera matrix's principal point is wrong
(:mod:`sst_graph.covariance.broken_assumptions`). Drives are those of :mod:`studies.edges_streets`, by labels
or with ``--method edges``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from unittest import mock

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.markdown import NONE, lines, table
from sst_graph.experiments.starts import error_of
from sst_graph.experiments.wrong_drives import with_principal_point
from sst_graph.metrics import nees
from studies.edges_streets import short, sigma_cells, source_of, start_step

HEAD = "| drive | cx, cy off by | prevalence | status | worst axis [sigma] | NEES / 7 | sigmas [deg] |"
Found = dict[tuple[str, str], list[tuple[str, float]]]
"""Status, and error over its sigma on the worst axis, by size and prevalence."""
OFF_PX = ((0.0, 0.0), (5.0, 0.0), (0.0, -6.0))
PREVALENCES = (0.02, 0.1, 0.25)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="+")
    parser.add_argument("--prevalence", nargs="+", type=float, default=PREVALENCES)
    parser.add_argument("--method", choices=["joint", "edges"], default="joint")
    options = parser.parse_args()
    found: Found = {}
    for line in lines(HEAD, rows(options, found)):
        print(line, flush=True)
    print("\n" + summary(found))


def rows(options: argparse.Namespace, found: Found) -> Iterator[list[str]]:
    """A row for each drive, size and prevalence, whose status and worst axis go to ``found``."""
    config = CalibrationConfig(method=options.method)
    for name in options.names:
        source = source_of(name)
        truth, kept = source.truth, KeptDrive.of(source)
        assert truth is not None
        start = truth.cTl.retract(start_step(name))
        for off in OFF_PX:
            drives = prepare_drives([with_principal_point(kept, *off)], config)
            for prevalence in options.prevalence:
                believed = {n: replace(ASSUMPTIONS[n], prevalence=prevalence) for n in ("cx", "cy")}
                with mock.patch.dict(ASSUMPTIONS, believed):
                    result = calibrate_prepared(drives, start, config)
                error = error_of(result.calibration, truth)
                worst = float(np.abs(error / np.sqrt(np.diag(result.covariance))).max())
                share, rotation = nees(error, result.covariance) / 7.0, sigma_cells(result.covariance)[0]
                case = f"{off[0]:g}, {off[1]:g} px", f"{prevalence:g}"
                found.setdefault(case, []).append((result.status, worst))
                yield [short(name), *case, result.status, f"{worst:.1f}", f"{share:.2f}", rotation]


def summary(found: Found) -> str:
    """How many are ok by size and prevalence, and the errors of these."""
    cells = []
    for case, outcomes in found.items():
        worst = [sigmas for status, sigmas in outcomes if status == "ok"]
        spread = f"{min(worst):.1f} to {max(worst):.1f}" if worst else NONE
        cells.append([*case, f"{len(worst)} of {len(outcomes)}", spread])
    return table("| cx, cy off by | prevalence | ok | worst axis of these [sigma] |", cells)


if __name__ == "__main__":
    main()
