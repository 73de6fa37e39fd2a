"""Labels and edges in one estimate: labels in a part of the frames, and edges in labelled frames too.

    OMP_NUM_THREADS=1 python -m studies.labels_and_edges part first own-504 third-900 ../shared/data/DRIVE
    OMP_NUM_THREADS=1 python -m studies.labels_and_edges part every4 ...
    OMP_NUM_THREADS=1 python -m studies.labels_and_edges same own-504 third-900 ../shared/data/DRIVE

Real drives are read with ``--image-shift 0`` for ``part``, so that a scan's own image is the one of its
instant, and with 1 for ``same``. Prints a table; reasons go to stderr.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.batch.by_edges.fusion import Fused
from sst_graph.batch.method_estimate import MethodEstimate
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.markdown import lines
from sst_graph.experiments.starts import error_of
from sst_graph.metrics import nees
from sst_graph.result import CalibrationResult
from sst_graph.types import Calibration, Frame, SemanticClass
from studies.edges_streets import (
    FloatArray,
    cells,
    short,
    sigma_cells,
    source_of,
    start_step,
)

KEPT = {
    "first": lambda k, n: k < n // 2,
    "every4": lambda k, n: k % 4 == 0,
}
HEAD = "| drive | by | rotation, ATD, time offset | each [deg; cm; ms] | their sigmas | NEES / 7 | |"


def bare(frame: Frame) -> Frame:
    """The frame without labels."""
    scan, image = frame.scan, frame.image
    if scan is not None:
        scan = replace(scan, classes=np.full_like(scan.classes, SemanticClass.IGNORE), instances=None)
    if image is not None:
        image = replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE), instances=None)
    return replace(frame, scan=scan, image=image)


def row(name: str, by: str, error: FloatArray, covariance: FloatArray, more: str = "") -> Sequence[str]:
    """A row of a drive: the size of the errors, all seven, their sigmas and NEES."""
    degrees, shift = np.degrees(np.linalg.norm(error[:3])), 100.0 * np.abs(error[3:6]).mean()
    sizes = f"{degrees:.2f} deg, {shift:.1f} cm, {1e3 * error[6]:+.1f} ms"
    every, sigmas = "; ".join(cells(error)), "; ".join(sigma_cells(covariance))
    return short(name), by, sizes, every, sigmas, f"{nees(error, covariance) / 7.0:.1f}", more


def part(name: str, kept: str) -> Iterator[Sequence[str]]:
    """Labels in a part of the frames: what labels say, what edges say, and both."""
    simulated = name.startswith(("own-", "third-"))
    source = source_of(name) if simulated else open_source(name, image_shift=0)
    whole, truth = KeptDrive.of(source), source.truth
    assert truth is not None
    count = len(whole.frames)
    frames = tuple(f if KEPT[kept](k, count) else bare(f) for k, f in enumerate(whole.frames))
    start = truth.cTl.retract(start_step(name))
    result = calibrate(replace(whole, frames=frames), start, CalibrationConfig(method="both"))
    said = result.diagnostics.get("both", {})
    for kind in ("labels", "edges"):
        if kind in said:
            pose = gtsam.Pose3(np.array(said[kind]["T_camera_lidar"]))
            error = error_of(Calibration(pose, said[kind]["time_offset_s"]), truth)
            yield row(name, kind, error, np.diag(np.square(said[kind]["sigmas"])))
    error = error_of(result.calibration, truth)
    yield row(name, result.method, error, result.covariance, result.status)
    for reason in result.reasons:
        print(f"{name}: {reason}", file=sys.stderr, flush=True)


def same(name: str) -> Iterator[Sequence[str]]:
    """All frames by labels, all frames by edges, and the product as if the frames were different."""
    source = source_of(name)
    truth = source.truth
    assert truth is not None
    configs = {
        "joint": CalibrationConfig(method="joint"),
        "joint, no motion": CalibrationConfig(method="joint", use_motion="never"),
        "edges": CalibrationConfig(method="edges"),
    }
    start = truth.cTl.retract(start_step(name))
    results = {by: calibrate(source, start, config) for by, config in configs.items()}
    for by, result in results.items():
        error = error_of(result.calibration, truth)
        yield row(name, by, error, result.covariance, result.status)
    fused = Fused.of(estimate_of(results["joint, no motion"]), estimate_of(results["edges"]))
    error = error_of(fused.state.calibration(), truth)
    yield row(name, "product", error, fused.covariance, f"chi-squared of 7: {fused.chi2:.1f}")


def estimate_of(result: CalibrationResult) -> MethodEstimate:
    return MethodEstimate(*result.calibration, result.covariance, ())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("part", "same"))
    parser.add_argument("names", nargs="+", help="part: first one of first, every4")
    args = parser.parse_args()
    kept, names = (args.names[0], args.names[1:]) if args.what == "part" else ("", args.names)
    if args.what == "part" and kept not in KEPT:
        parser.error(f"part: found {kept}, expected one of {', '.join(KEPT)}")
    found = (each for name in names for each in (part(name, kept) if kept else same(name)))
    for line in lines(HEAD, found):
        print(line, flush=True)


if __name__ == "__main__":
    main()
