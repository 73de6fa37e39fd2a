"""Where boundary points lie beside exact contours, at the true extrinsic, by simulator and side: a table.

    OMP_NUM_THREADS=1 python studies/simulators/edge_bias.py --streets 40

One standing frame a street, vehicles only. Distances are robust means (Geman-McClure, 3 px) in pixels,
positive outside of the contour, and their deviations by object. What sides have in common is taken up by the
mask bias of each object; a top that differs from the sides by 1 px tilts the camera by 1/f.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

# Streets are built here, as the directory of a script is on its path.
from second_street import SecondStreet, StreetConfig
from third_street import ThirdConfig, ThirdStreet

from sst_graph.association.edge_matching import SIDE_OF
from sst_graph.experiments.markdown import NONE, lines
from sst_graph.features.lidar_edges import find_boundaries
from sst_graph.features.mask_contour import ContourMap
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass, Source

FloatArray = NDArray[np.float64]

SIMULATORS: dict[str, Callable[..., Source]] = {
    "first": lambda **options: simulate(SimulationConfig(**options)),
    "second": lambda **options: SecondStreet(StreetConfig(density=0.2, **options)),
    "third, ideal rays": lambda **options: ThirdStreet(ThirdConfig(rays=1, **options)),
    "third, beams of 2 mrad": lambda **options: ThirdStreet(ThirdConfig(**options)),
}
STANDING = {
    "frames": 1,
    "motion": "standing",
    "time_offset_s": 0.0,
    "label_noise": 0.0,
    "moving_fraction": 0.0,
}
SIDES = ("left", "right", "top", "bottom")
_KERNEL_PX, _FARTHEST_PX, _LEAST_COSINE = 3.0, 9.0, 0.5


def edges(source: Source) -> FloatArray:
    """(n, 3) object, side, signed distance [px] of the vehicles' boundary points."""
    frame, truth = source[0], source.truth
    assert frame.scan is not None and frame.image is not None and truth is not None
    found = find_boundaries(frame.scan, [SemanticClass.VEHICLE])
    contour = ContourMap.of(frame.image.mask, SemanticClass.VEHICLE)
    if not found or contour is None:
        return np.zeros((0, 3))
    points = found[SemanticClass.VEHICLE]
    R, t = truth.cTl.rotation().matrix(), truth.cTl.translation()
    uvs, outs = (source.camera.project(lPs @ R.T + t) for lPs in (points.lPs, points.outward))
    feet = contour.look_up(uvs)
    way = outs - uvs
    cosine = (way * feet.normals).sum(axis=1) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    ok = feet.valid & (cosine > _LEAST_COSINE) & (np.abs(feet.distances) < _FARTHEST_PX)
    sides = SIDE_OF[points.edges, (way[:, 0] > 0).astype(np.intp)]
    return np.asarray(np.stack([points.objects, sides, feet.distances], axis=1)[ok])


def robust_mean(distances: FloatArray, objects: FloatArray) -> str:
    """Mean and its deviation over objects."""
    if len(distances) < 30:
        return NONE
    mean = float(np.median(distances))
    for _ in range(20):
        weights = 1.0 / (1.0 + ((distances - mean) / _KERNEL_PX) ** 2) ** 2
        mean = float(weights @ distances / weights.sum())
    groups = np.unique(objects, return_inverse=True)[1].reshape(-1)
    sums = np.bincount(groups, weights * (distances - mean))
    return f"{mean:+.2f} ± {np.sqrt(sums @ sums) / weights.sum():.2f}"


def row(simulator: str, seeds: Sequence[int]) -> list[str]:
    """A simulator's means by side."""
    rows = []
    for seed in seeds:
        found = edges(SIMULATORS[simulator](seed=seed, **STANDING))
        rows.append(found + np.array([1000.0 * seed, 0.0, 0.0]))
    points = np.concatenate(rows)
    own = (points[points[:, 1] == side] for side in range(len(SIDES)))
    return [simulator, *(robust_mean(some[:, 2], some[:, 0]) for some in own)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--streets", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    seeds = range(args.seed, args.seed + args.streets)
    for line in lines(f"| | {' | '.join(SIDES)} |", (row(simulator, seeds) for simulator in SIMULATORS)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
