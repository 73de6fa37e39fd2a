"""Labels and edges in one estimate: labels in a part of the frames, and edges in labelled frames too.

    OMP_NUM_THREADS=1 python -m studies.labels_and_edges part first own-504 third-900 ../shared/data/DRIVE
    OMP_NUM_THREADS=1 python -m studies.labels_and_edges part every4 ...
    OMP_NUM_THREADS=1 python -m studies.labels_and_edges same own-504 third-900 ../shared/data/DRIVE

Real drives are read with ``--image-shift 0`` for ``part``, so that a scan's own image is the one of its
instant, and with 1 for ``same``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import gtsam
import numpy as np

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.batch.by_edges.fusion import Fused
from sst_graph.batch.method_estimate import MethodEstimate
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.result import CalibrationResult
from sst_graph.types import Frame, GroundTruth, SemanticClass, Source
from studies.edges_streets import FloatArray, row, source_of, start_step

KEPT = {
    "first": lambda k, n: k < n // 2,
    "every4": lambda k, n: k % 4 == 0,
}


def bare(frame: Frame) -> Frame:
    """The frame without labels."""
    scan, image = frame.scan, frame.image
    if scan is not None:
        scan = replace(scan, classes=np.full_like(scan.classes, SemanticClass.IGNORE), instances=None)
    if image is not None:
        image = replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE), instances=None)
    return replace(frame, scan=scan, image=image)


def error_of(truth: GroundTruth, cTl: gtsam.Pose3, time_offset_s: float) -> FloatArray:
    """(7,) step from the truth."""
    return np.append(gtsam.Pose3.Logmap(truth.cTl.between(cTl)), time_offset_s - truth.time_offset_s)


def show(name: str, error: FloatArray, covariance: FloatArray, more: str = "") -> None:
    nees = float(error @ np.linalg.solve(covariance, error)) / 7.0
    degrees, shift = np.degrees(np.linalg.norm(error[:3])), 100.0 * np.abs(error[3:6]).mean()
    print(
        f"{name:28s} {degrees:.3f} deg {shift:5.2f} cm {1e3 * error[6]:+6.2f} ms  NEES/7 {nees:4.2f}  ",
        end="",
    )
    print(f"errors {row(error)}  sigmas {row(np.sqrt(np.diag(covariance)))}  {more}", flush=True)


def part(source: Source, start: gtsam.Pose3, kept: str) -> None:
    """Labels in a part of the frames: what labels say, what edges say, and both."""
    whole, truth = KeptDrive.of(source), source.truth
    assert truth is not None
    count = len(whole.frames)
    frames = tuple(f if KEPT[kept](k, count) else bare(f) for k, f in enumerate(whole.frames))
    began = time.process_time()
    result = calibrate(replace(whole, frames=frames), start, CalibrationConfig(method="both"))
    seconds = time.process_time() - began
    said = result.diagnostics.get("both", {})
    for kind in ("labels", "edges"):
        if kind in said:
            error = error_of(
                truth, gtsam.Pose3(np.array(said[kind]["T_camera_lidar"])), said[kind]["time_offset_s"]
            )
            show(
                f"  {kind}", error, np.diag(np.square(said[kind]["sigmas"])), f"{said[kind]['frames']} frames"
            )
    error = error_of(truth, result.T_camera_lidar, result.time_offset_s)
    show(f"  {result.method}", error, result.covariance, f"{result.status} {seconds:.0f} s")
    for reason in result.reasons:
        print(f"    {reason}")


def same(source: Source, start: gtsam.Pose3) -> None:
    """All frames by labels, all frames by edges, and the product as if the frames were different."""
    truth = source.truth
    assert truth is not None
    configs = {
        "joint": CalibrationConfig(method="joint"),
        "joint, no motion": CalibrationConfig(method="joint", use_motion="never"),
        "edges": CalibrationConfig(method="edges"),
    }
    results = {name: calibrate(source, start, config) for name, config in configs.items()}
    for name, result in results.items():
        error = error_of(truth, result.T_camera_lidar, result.time_offset_s)
        show(f"  {name}", error, result.covariance, result.status)
    fused = Fused.of(estimate_of(results["joint, no motion"]), estimate_of(results["edges"]))
    error = error_of(truth, fused.state.cTl, fused.state.time_offsets_s[0])
    show("  product", error, fused.covariance, f"chi-squared of 7: {fused.chi2:.1f}")


def estimate_of(result: CalibrationResult) -> MethodEstimate:
    return MethodEstimate(result.T_camera_lidar, result.time_offset_s, result.covariance, ())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("part", "same"))
    parser.add_argument("names", nargs="+", help="part: first one of first, every4")
    args = parser.parse_args()
    kept, names = (args.names[0], args.names[1:]) if args.what == "part" else ("", args.names)
    if args.what == "part" and kept not in KEPT:
        parser.error(f"part: found {kept}, expected one of {', '.join(KEPT)}")
    for name in names:
        print(name)
        simulated = name.startswith(("own-", "third-"))
        source = source_of(name) if simulated or args.what == "same" else open_source(name, image_shift=0)
        assert source.truth is not None
        start = source.truth.cTl.retract(start_step(name))
        if args.what == "part":
            part(source, start, kept)
        else:
            same(source, start)


if __name__ == "__main__":
    main()
