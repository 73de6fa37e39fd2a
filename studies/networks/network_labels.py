"""What labels by networks cost against exact ones: small networks fitted to some streets, tried on others.

    python -m studies.networks.network_labels --out out/networks [--train 14 --streets 6] [--networks DIR]

Prints a table: intersection over union of the vehicles of both sides, and the errors of calibrations with
exact labels, with labels of the networks on one side, and on both.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.markdown import lines
from sst_graph.metrics import CalibrationErrors, calibration_errors
from sst_graph.segmentation import (
    ImageSegmenter,
    ScanSegmenter,
    open_image_segmenter,
    open_scan_segmenter,
    with_labels,
)
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass, Source
from studies.networks.small_networks import Fit, write_image_network, write_scan_network

HALF_SIZE = {
    "width": 621,
    "height": 188,
    "azimuth_step_deg": 0.3,
    "azimuth_limit_deg": 50.0,
    "vehicle_density": 0.3,
}
HEAD = "| street | labels | IoU masks | IoU points | rotation deg | ATD cm | time ms | status |"
FIRST_TRAINED, FIRST_TRIED = 700, 800
"""Seeds of the streets that the networks are fitted to, and of those that they are tried on."""


def main() -> None:
    """Fit the networks where they are not given, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/networks"))
    parser.add_argument(
        "--networks", type=Path, help="folder with image.yaml and scan.yaml of an earlier run"
    )
    parser.add_argument("--train", type=int, default=14)
    parser.add_argument("--streets", type=int, default=6)
    parser.add_argument("--frames", type=int, default=20)
    args = parser.parse_args()
    folder = args.networks or args.out
    if args.networks is None:
        folder.mkdir(parents=True, exist_ok=True)
        streets = [trained_street(FIRST_TRAINED + k) for k in range(args.train)]
        fit = Fit(pixels=4000, steps=3000)
        write_image_network(streets, folder, fit)
        write_scan_network(streets, folder, fit)
    images, scans = open_image_segmenter(folder / "image.yaml"), open_scan_segmenter(folder / "scan.yaml")
    seeds = range(FIRST_TRIED, FIRST_TRIED + args.streets)
    rows = (row for seed in seeds for row in tried(seed, args.frames, images, scans))
    for line in lines(HEAD, rows):
        print(line, flush=True)


def trained_street(seed: int) -> KeptDrive:
    """Six frames, half a second apart, with exact labels."""
    config = SimulationConfig(seed=seed, frames=6, frame_rate_hz=2.0, label_noise=0.0, **HALF_SIZE)
    return KeptDrive.of(simulate(config))


def tried(seed: int, frames: int, images: ImageSegmenter, scans: ScanSegmenter) -> list[list[str]]:
    """Rows of the table for a street."""
    config = SimulationConfig(seed=seed, frames=frames, label_noise=0.0, time_offset_s=0.1, **HALF_SIZE)
    street = KeptDrive.of(simulate(config))
    with tempfile.TemporaryDirectory() as folder:
        drives: dict[str, Source] = {
            "exact": street,
            "network for masks": with_labels(street, images, None, f"{folder}/masks"),
            "network for points": with_labels(street, None, scans, f"{folder}/points"),
            "networks for both": KeptDrive.of(with_labels(street, images, scans, f"{folder}/both")),
        }
        both = drives["networks for both"]
        masks = overlap([f.image.mask for f in both if f.image], [f.image.mask for f in street if f.image])
        points = overlap([f.scan.classes for f in both if f.scan], [f.scan.classes for f in street if f.scan])
        rows = []
        for name, drive in drives.items():
            of_masks = masks if "masks" in name or "both" in name else 1.0
            of_points = points if "points" in name or "both" in name else 1.0
            rows.append([str(seed), name, f"{of_masks:.2f}", f"{of_points:.2f}", *_calibrated(drive)])
        return rows


def overlap(found: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> float:
    """Intersection over union of the vehicles, over all frames."""
    a, b = (np.concatenate([one.ravel() for one in side]) == SemanticClass.VEHICLE for side in (found, exact))
    return float((a & b).sum() / max(1, (a | b).sum()))


def _calibrated(drive: Source) -> list[str]:
    result = calibrate(drive, drive.nominal, CalibrationConfig())
    assert drive.truth is not None
    errors: CalibrationErrors = calibration_errors(result.T_camera_lidar, result.time_offset_s, drive.truth)
    time_ms = 1e3 * (errors.time_offset_s or 0.0)
    return [f"{errors.qad_deg:.3f}", f"{100 * errors.atd_m:.2f}", f"{time_ms:+.1f}", result.status]


if __name__ == "__main__":
    main()
