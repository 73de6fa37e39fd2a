"""Where boundary points lie beside exact contours, at the true extrinsic, by side and range. Prints a table.

    OMP_NUM_THREADS=1 python studies/simulators/edge_bias.py --simulator third --streets 40
    OMP_NUM_THREADS=1 python studies/simulators/edge_bias.py --simulator third --streets 40 --option rays=1

One standing frame a street, vehicles only. Distances are robust means (Geman-McClure, 3 px) in pixels,
positive outside of the contour, and their deviations by object. What sides have in common is taken up by the
mask bias of each object; a top that differs from the sides by 1 px tilts the camera by 1/f.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

# Streets are built here, as the directory of a script is on its path.
from second_street import SecondStreet, StreetConfig
from third_street import ThirdConfig, ThirdStreet

from sst_graph.association.edge_matching import SIDE_OF
from sst_graph.features.lidar_edges import find_boundaries
from sst_graph.features.mask_contour import ContourMap
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass, Source

FloatArray = NDArray[np.float64]

SIMULATORS: dict[str, Callable[..., Source]] = {
    "first": lambda **options: simulate(SimulationConfig(**options)),
    "second": lambda **options: SecondStreet(StreetConfig(**{"density": 0.2, **options})),
    "third": lambda **options: ThirdStreet(ThirdConfig(**options)),
}
STANDING = {
    "frames": 1,
    "motion": "standing",
    "time_offset_s": 0.0,
    "label_noise": 0.0,
    "moving_fraction": 0.0,
}
SIDES = ("left", "right", "top", "bottom")
RANGES_M = (0.0, 8.0, 14.0, 24.0, 60.0)
_KERNEL_PX, _FARTHEST_PX, _LEAST_COSINE = 3.0, 9.0, 0.5


def edges(source: Source) -> FloatArray:
    """(n, 4) object, side, range [m], signed distance [px] of the vehicles' boundary points."""
    frame, truth = source[0], source.truth
    assert frame.scan is not None and frame.image is not None and truth is not None
    found = find_boundaries(frame.scan, [SemanticClass.VEHICLE])
    contour = ContourMap.of(frame.image.mask, SemanticClass.VEHICLE)
    if not found or contour is None:
        return np.zeros((0, 4))
    points = found[SemanticClass.VEHICLE]
    R, t = truth.cTl.rotation().matrix(), truth.cTl.translation()
    uvs, outs = (source.camera.project(lPs @ R.T + t) for lPs in (points.lPs, points.outward))
    feet = contour.look_up(uvs)
    way = outs - uvs
    cosine = (way * feet.normals).sum(axis=1) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    ok = feet.valid & (cosine > _LEAST_COSINE) & (np.abs(feet.distances) < _FARTHEST_PX)
    sides = SIDE_OF[points.edges, (way[:, 0] > 0).astype(np.intp)]
    ranges = np.linalg.norm(points.lPs, axis=1)
    return np.asarray(np.stack([points.objects, sides, ranges, feet.distances], axis=1)[ok])


def robust_mean(distances: FloatArray, objects: FloatArray) -> str:
    """Mean and its deviation over objects."""
    if len(distances) < 30:
        return "–"
    mean = float(np.median(distances))
    for _ in range(20):
        weights = 1.0 / (1.0 + ((distances - mean) / _KERNEL_PX) ** 2) ** 2
        mean = float(weights @ distances / weights.sum())
    groups = np.unique(objects, return_inverse=True)[1].reshape(-1)
    sums = np.bincount(groups, weights * (distances - mean))
    return f"{mean:+.2f} ± {np.sqrt(sums @ sums) / weights.sum():.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--simulator", choices=sorted(SIMULATORS), default="third")
    parser.add_argument("--streets", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--option", action="append", default=[], help="NAME=NUMBER of the simulator")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    options = {}
    for name, number in (each.split("=") for each in args.option):
        options[name] = float(number) if "." in number else int(number)
    rows = []
    for seed in range(args.seed, args.seed + args.streets):
        found = edges(SIMULATORS[args.simulator](seed=seed, **STANDING, **options))
        rows.append(found + np.array([1000.0 * seed, 0.0, 0.0, 0.0]))
    table = np.concatenate(rows)
    spans = list(pairwise(RANGES_M))
    print("| side | points | all [px] | " + " | ".join(f"{a:.0f} to {b:.0f} m" for a, b in spans) + " |")
    print("|---" * (3 + len(spans)) + "|")
    for side, name in enumerate(SIDES):
        own = table[table[:, 1] == side]
        parts = [own[(own[:, 2] >= a) & (own[:, 2] < b)] for a, b in spans]
        cells = [robust_mean(part[:, 3], part[:, 0]) for part in (own, *parts)]
        print(f"| {name} | {len(own)} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
