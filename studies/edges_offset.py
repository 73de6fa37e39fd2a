"""What a real drive's edges say of the time offset where the pose is the published one. Prints a table.

    OMP_NUM_THREADS=1 python -m studies.edges_offset DRIVE [...]

The score of ``--method edges`` at the reference pose, at time offsets around the reference's; a parabola
through it has its vertex where this part of the edges wants the time offset. A clock that is off says the
same in every stretch of frames; a shift of the edges says less the faster the vehicle is, for offset times
speed is what it shows. Offsets within 5 ms are left out: objects of unknown speed count only there, which
lifts the score. Real drives are read with ``--image-shift 1``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.drive.preparation import Drive
from sst_graph.edges.agreement import score
from sst_graph.experiments.markdown import lines
from sst_graph.features.lidar_edges import Edge
from sst_graph.graph.matching import edges_of
from sst_graph.graph.state import State
from sst_graph.types import Guess
from studies.edges_streets import short

FloatArray = NDArray[np.float64]
OFFSETS_MS = np.array([-30.0, -22.0, -15.0, -10.0, -6.0, 6.0, 10.0, 15.0, 20.0, 25.0, 32.0, 40.0])
BLUR_PX = 2.5
POINTS_A_SCAN = 400
HEAD = "| drive | part | speed [m/s] | time offset [ms] | times speed [cm] |"
STRETCHES = ((0, 10), (10, 20), (20, 30), (30, 45), (45, 60))


def of_kind(drive: Drive, kind: Edge) -> Drive:
    """The drive with the boundary points of one kind."""
    scans = []
    for scan in drive.scans:
        kept = {c: points.take(np.flatnonzero(points.edges == kind)) for c, points in scan.boundaries.items()}
        scans.append(replace(scan, boundaries={c: points for c, points in kept.items() if len(points)}))
    return replace(drive, scans=tuple(scans))


def row(name: str, part: str, scores: FloatArray, speed_mps: float) -> Sequence[str]:
    """Vertex of the parabola, and how far that is at the vehicle's speed."""
    a, b, _ = np.polyfit(OFFSETS_MS, scores / scores.max(), 2)
    vertex_ms = -b / (2.0 * a)
    way = f"{0.1 * vertex_ms * speed_mps:+.1f}"
    return short(name), part, f"{speed_mps:.1f}", f"{vertex_ms:+.1f}", way


def rows(name: str) -> Iterator[Sequence[str]]:
    """The whole drive, its stretches of frames, its kinds of edges."""
    config = CalibrationConfig(method="edges")
    source = open_source(name, image_shift=1)
    truth = source.truth
    assert truth is not None
    problem = CalibrationProblem.of(prepare_drives([source], config), Guess(truth.cTl, 0.0), config)
    drive, motion = thinned(problem.drives[0], POINTS_A_SCAN), problem.motions[0]
    speeds = np.array([np.linalg.norm(each.mean_twist[3:]) for each in drive.lidar_motions])

    def scores(part: Drive, scans: list[int]) -> FloatArray:
        edges = edges_of([part.part(scans)], [motion.part(scans)], config.joint.graph)
        states = [State(truth.cTl, (truth.time_offset_s + 1e-3 * ms,)) for ms in OFFSETS_MS]
        return np.array([score(edges, state, BLUR_PX) for state in states])

    every = list(range(len(drive.scans)))
    yield row(name, "all", scores(drive, every), float(speeds.mean()))
    for first, last in STRETCHES:
        scans = every[first:last]
        if scans:
            part = f"frames {first} to {first + len(scans) - 1}"
            yield row(name, part, scores(drive, scans), float(speeds[first:last].mean()))
    for kind in (Edge.SIDE, Edge.TOP, Edge.SHALLOW_TOP):
        part = f"{kind.name.lower().replace('_', ' ')} edges"
        yield row(name, part, scores(of_kind(drive, kind), every), float(speeds.mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("drives", nargs="+")
    found = (each for name in parser.parse_args().drives for each in rows(name))
    for line in lines(HEAD, found):
        print(line, flush=True)


if __name__ == "__main__":
    main()
