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
from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.assumptions.model import Scene
from sst_graph.data.frame_parts import image_at, image_positions
from sst_graph.experiments.markdown import table
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import Tracks
from sst_graph.odometry.relative import (
    _line_distance,
    _refine,
    _softened,
    huber_weights,
    rays,
    skew,
)
from sst_graph.odometry.visual import ImagePair, image_pairs
from sst_graph.types import Source

FloatArray = NDArray[np.float64]
LENS = ("focal", "cx", "cy", "k1", "k2")
_STRETCHES, _ITERATIONS = 10, 4
_STEP = 1e-3
"""Of the numerical derivative, as a share of a parameter's span; an iteration that moves less is the last."""


def tracked(source: Source) -> list[ImagePair]:
    """Tracks between images of a drive, where they have a direction of motion."""
    images = (image_at(source, position) for position in image_positions(source))
    pairs = image_pairs((image for image in images if image is not None), source.camera)
    return [pair for pair in pairs if pair.direction.ok]


def pixel_shift(name: str, uvs: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(n, 2) what one unit of a lens parameter does to pixels."""
    n = len(uvs)
    view = Scene(camera, np.zeros(6), 0.0, 0.1).view(np.ones((n, 3)), np.zeros(n), uvs)
    shift = ASSUMPTIONS[name].effect(view).pixel_shift
    assert shift is not None
    return shift


def lens_rays(
    tracks: Tracks, name: str, value: float, camera: PinholeCamera
) -> tuple[FloatArray, FloatArray]:
    """(n, 3) rays through both pixels of tracks, by a lens with this parameter."""
    fa, fb = (rays(uv - value * pixel_shift(name, uv, camera), camera) for uv in (tracks.uv_a, tracks.uv_b))
    return fa, fb


def distances(
    motion: tuple[FloatArray, FloatArray], tracks: Tracks, name: str, value: float, camera: PinholeCamera
) -> FloatArray:
    """(n,) distance from the epipolar line, in pixels as they were seen: a lens that draws them together
    does not make it smaller."""
    aRb, direction = motion
    fa, fb = lens_rays(tracks, name, value, camera)
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


def estimate(pairs: Sequence[ImagePair], camera: PinholeCamera, name: str) -> tuple[float, float, float]:
    """A parameter, its deviation by stretches, and by the noise of the tracks alone."""
    step = _STEP * ASSUMPTIONS[name].span
    value, scores, information = 0.0, np.zeros(len(pairs)), np.zeros(len(pairs))
    motions = [(pair.direction.rotation.matrix(), pair.direction.direction) for pair in pairs]
    for _ in range(_ITERATIONS):
        for k, tracks in enumerate(pair.tracks for pair in pairs):
            fa, fb = lens_rays(tracks, name, value, camera)
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
    rows = []
    for drive in parser.parse_args().drives:
        source = open_source(drive)
        pairs = tracked(source)
        for name in LENS:
            value, sigma, least = estimate(pairs, source.camera, name)
            rows.append([source.name, name, f"{value:.3g}", f"{sigma:.2g}", f"{least:.2g}"])
    print(table("| drive | parameter | estimate | deviation by stretches | by the tracks' noise |", rows))


if __name__ == "__main__":
    main()
