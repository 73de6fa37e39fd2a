"""What the camera's own tracks say of its lens: epipolar residuals with one lens parameter for a whole drive.

    OMP_NUM_THREADS=1 python -m studies.lens_by_tracks ../shared/data/DRIVE [...]

Each pair of images has a rotation and a direction of its own, which are eliminated; a parameter is estimated
by Gauss-Newton while the others hold, as the test of the assumptions does by matches. Printed are the
estimate, its deviation from ten stretches of the drive (tracks of neighbouring pairs err alike), and the
deviation that the tracks' noise alone would leave.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph import open_source
from sst_graph.assumptions import ASSUMPTIONS, View
from sst_graph.data.frame_parts import image_at, image_positions
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import FeatureTracker, Tracks
from sst_graph.odometry.relative import (
    DirectionMotion,
    _line_distance,
    _refine,
    _softened,
    huber_weights,
    rays,
    relative_pose,
    skew,
)
from sst_graph.types import Source

FloatArray = NDArray[np.float64]
LENS = ("focal", "cx", "cy", "k1", "k2")
_INTERVAL_S, _STRETCHES, _ITERATIONS = 0.07, 10, 4
_STEP = 1e-3
"""Of the numerical derivative, as a share of a parameter's span; an iteration that moves less is the last."""


def image_pairs(source: Source) -> list[tuple[Tracks, DirectionMotion]]:
    """Tracks between images of a drive, where they have a direction of motion."""
    tracker, found = FeatureTracker(), []
    for position in image_positions(source):
        image = image_at(source, position)
        if image is None or tracker.seconds_to(image) < _INTERVAL_S:
            continue
        tracks = tracker.add(image)
        if tracks is not None:
            found.append((tracks, relative_pose(tracks, source.camera)))
    return [pair for pair in found if pair[1].ok]


def pixel_shift(name: str, uvs: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(n, 2) what one unit of a lens parameter does to pixels."""
    n = len(uvs)
    view = View(np.ones((n, 3)), np.zeros(n), uvs, camera, np.zeros(6), 0.0, 0.1)
    shift = ASSUMPTIONS[name].effect(view).pixel_shift
    assert shift is not None
    return shift


def distances(
    motion: tuple[FloatArray, FloatArray], tracks: Tracks, name: str, value: float, camera: PinholeCamera
) -> FloatArray:
    """(n,) distance from the epipolar line, in pixels as they were seen: a lens that draws them together
    does not make it smaller."""
    aRb, direction = motion
    fa, fb = (rays(uv - value * pixel_shift(name, uv, camera), camera) for uv in (tracks.uv_a, tracks.uv_b))
    line_a = fa @ skew(-direction[None])[0].T
    gradient = (line_a @ aRb)[:, :2] / [camera.fx, camera.fy]
    steps = np.eye(2)
    slopes = [pixel_shift(name, tracks.uv_b + 0.5 * step, camera) for step in steps]
    slopes = [
        high - pixel_shift(name, tracks.uv_b - 0.5 * step, camera)
        for high, step in zip(slopes, steps, strict=True)
    ]
    gradient = gradient - value * np.einsum("kni,ni->nk", np.stack(slopes), gradient)
    return np.asarray(np.einsum("ij,ij->i", line_a, fb @ aRb.T) / _softened(np.hypot(*gradient.T), camera))


def estimate(
    pairs: Sequence[tuple[Tracks, DirectionMotion]], camera: PinholeCamera, name: str
) -> tuple[float, float, float]:
    """A parameter, its deviation by stretches, and by the noise of the tracks alone."""
    step = _STEP * ASSUMPTIONS[name].span
    value, scores, information = 0.0, np.zeros(len(pairs)), np.zeros(len(pairs))
    motions = [(motion.rotation.matrix(), motion.direction) for _, motion in pairs]
    for _ in range(_ITERATIONS):
        for k, (tracks, _) in enumerate(pairs):
            fa, fb = (
                rays(uv - value * pixel_shift(name, uv, camera), camera) for uv in (tracks.uv_a, tracks.uv_b)
            )
            refined = _refine(*motions[k], fa, fb, camera)
            motions[k] = refined.rotation, refined.direction
            r = distances(motions[k], tracks, name, value, camera)
            high, low = (
                distances(motions[k], tracks, name, value + way * step, camera) for way in (1.0, -1.0)
            )
            column, (_, J) = (high - low) / (2.0 * step), _line_distance(*motions[k], fa, fb, camera)
            weights = huber_weights(r / refined.noise_px) / refined.noise_px**2
            own = (J * weights[:, None]).T
            column = column - J @ np.linalg.lstsq(own @ J, own @ column, rcond=None)[0]
            scores[k], information[k] = column @ (weights * r), column @ (weights * column)
        change = -float(scores.sum() / information.sum())
        value += change
        if abs(change) < step:
            break
    left = scores + information * change
    stretches = [part.sum() for part in np.array_split(left, min(_STRETCHES, len(left)))]
    n = len(stretches)
    sigma = float(np.sqrt(np.square(stretches).sum() * n / max(n - 1, 1)) / information.sum())
    return value, sigma, float(information.sum() ** -0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("drives", nargs="+")
    print(
        "| drive | parameter | estimate | deviation by stretches | by the tracks' noise |\n"
        + "|---" * 5
        + "|"
    )
    for drive in parser.parse_args().drives:
        source = open_source(drive)
        pairs = image_pairs(source)
        for name in LENS:
            value, sigma, least = estimate(pairs, source.camera, name)
            print(f"| {source.name} | {name} | {value:.3g} | {sigma:.2g} | {least:.2g} |", flush=True)


if __name__ == "__main__":
    main()
