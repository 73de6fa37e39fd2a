"""Whether labels are of these clouds and these pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.diagnosis.finding import Finding
from sst_graph.diagnosis.units import FLAT, usual_ground
from sst_graph.drive.input_statistics import InputStatistics
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of
from sst_graph.features.mask_shift import MaskShift, mask_shift
from sst_graph.features.up import LEVEL
from sst_graph.odometry.lidar import MOVABLE_CLASSES
from sst_graph.points import transformed_points
from sst_graph.sampling import step_for
from sst_graph.types import FloatArray, Guess, SemanticClass

_THINGS = (*MOVABLE_CLASSES, SemanticClass.POLE, SemanticClass.SIGN)
"""Classes of which no scene consists, as a forest does of vegetation."""
_NOTHING_ELSE = 0.95
"""Share of all points or pixels in one of them: the ground alone takes more than the rest."""
_LEAST_SHIFT_PX = 1.0
"""Contours follow the picture's edges over a pixel by themselves [px]. With 1.5 here, masks 2 px to the right
pass on two drives of three of an independent simulator, whose results are ok and 4.7 and 5.3 sigmas off."""
_SIGMAS = 4.0
_LEAST_CONTRAST = 1.3
"""Of masks over their own pictures: 1.6 and more on streets and real drives; over others 0.3 to 1.1 ..."""
_MOST_RIVAL = 0.75
"""... and there the second best shift has this share of the best one or more; over their own up to 0.7."""
_SMOOTH = 0.95
"""Share of the points labelled ground on slopes: 0.99 and more of ground, 0.9 and less of other things."""
_ABOVE = 0.1
"""Ground whose mean row is higher than the vehicles' or the sky's by this share of the image is no ground."""
_UPRIGHT = 0.7
"""Cosine between up and the pictures' own from which rows tell what lies above the ground."""
_COPIED_PAIRS, _COPIED_PX = 12, 4
"""Pairs of scan and image in which copied labels are looked for, and how far from a border [px]."""
_LEAST_COPIED = 300
"""Fewest points inside of borders, and outside of them ..."""
_MOST_DIFFER = 0.02
"""... and the share of these, labelled otherwise than their pixel, up to which labels are copies: copies have
0.000. Of labels made apart the side that differs more has 0.37 and 0.57 on the KITTI drives, and 0.06 to 0.27
if they are exact, on streets of three simulators at the true pose."""


def searched_classes(drives: Sequence[Drive], classes: Sequence[SemanticClass]) -> Finding | None:
    """None of the classes to align in any scan, or in any mask; or hardly anything but one of them."""
    statistics_of_drives = [drive.statistics for drive in drives if drive.statistics is not None]
    names = " or ".join(c.name.lower() for c in classes)
    for what, labelled in (
        ("point", [scan.labelled for statistics in statistics_of_drives for scan in statistics.scans]),
        (
            "mask's pixel",
            [image.labelled for statistics in statistics_of_drives for image in statistics.images],
        ),
    ):
        present = {c for counts in labelled for c in counts}
        if labelled and present <= {int(SemanticClass.IGNORE)}:
            return Finding(
                f"no {what} has a label",
                f"{names} cannot be aligned",
                "say where the labels are, make them by networks, or take --method edges, which needs none",
            )
        if labelled and not present & {int(c) for c in classes}:
            return Finding(
                f"no {what} is labelled {names}",
                f"labels found: {_names(present)}",
                "compare the class numbers of the labels with their table, or name other --classes",
            )
        total = sum(sum(counts.values()) for counts in labelled)
        for c in (c for c in classes if c in _THINGS):
            share = sum(counts.get(int(c), 0) for counts in labelled) / max(total, 1)
            if share > _NOTHING_ELSE:
                ground = sum(counts.get(int(SemanticClass.GROUND), 0) for counts in labelled) / total
                return Finding(
                    f"nearly every {what} is labelled {c.name.lower()}",
                    f"{100.0 * share:.0f} % of all, {100.0 * ground:.0f} % ground",
                    "compare the class numbers of the labels with their table, and look at an overlay",
                )
    return None


def few_labelled(drives: Sequence[Drive], time_offset_s: float, least: float) -> Finding | None:
    """Frames with pictures that a method by labels leaves out: less than a share has labels of both sensors.

    Args:
        time_offset_s: under which scans and images are paired [s].
        least: the share.
    """
    both, frames = 0, 0
    for drive in drives:
        if drive.statistics is None:
            continue
        scans, images = drive.statistics.scans, drive.statistics.images
        of_scans, of_images = [scan.stamp_ns for scan in scans], [image.stamp_ns for image in images]
        for pair in pair_by_time(of_scans, of_images, time_offset_s, drive.image_period_s):
            scan, image = scans[pair.scan], images[pair.image]
            labelled = all(one.labelled.keys() - {int(SemanticClass.IGNORE)} for one in (scan, image))
            both += labelled
            frames += labelled or image.brightest is not None
    if not both or both >= least * frames:
        return None
    return Finding(
        f"only {both} of {count_of(frames, 'frame')} have labels of both sensors",
        f"the other {frames - both} are not used",
        "--method both uses the others by edges",
    )


def ground_points(drive: Drive) -> Finding | None:
    """Points labelled ground that lie on no plane, nor on slopes as of hills."""
    ground = usual_ground(drive)
    if ground is None or ground.share >= FLAT or ground.smooth >= _SMOOTH:
        return None
    return Finding(
        "the class numbers of the points are mixed up",
        f"only {100.0 * ground.share:.0f} % of the points labelled ground lie on one plane",
        "compare the numbers in the label files with their table, and their order with the points'",
    )


def mask_rows(drive: Drive, guess: Guess) -> Finding | None:
    """Masks whose ground is above their sky or their vehicles; below them, in a camera that is mounted upside
    down by the start. Nothing where the start has up to the side of the pictures, or out of them."""
    upward = _upward(drive, guess)
    if drive.statistics is None or abs(upward) < _UPRIGHT:
        return None
    rows = {c: _mean_row(drive.statistics, c) for c in (SemanticClass.GROUND, *_OVER_GROUND)}
    ground, where = rows[SemanticClass.GROUND], "above" if upward > 0.0 else "below"
    for c in _OVER_GROUND:
        over = rows[c]
        if ground is None or over is None:
            continue
        beyond = float(np.sign(upward)) * (over - ground)
        if beyond > _ABOVE:
            return Finding(
                "the class numbers of the masks are mixed up, or the pictures are upside down",
                f"ground lies {100.0 * beyond:.0f} % of the image's height {where} {c.name.lower()}",
                "compare the numbers in the masks with their table, and look at an overlay",
            )
    return None


def _upward(drive: Drive, guess: Guess) -> float:
    """Cosine between up, by the ground in the clouds, and up in the pictures, by the start; 1 without one."""
    if guess.cTl is None:
        return 1.0
    ground = usual_ground(drive)
    up = LEVEL if ground is None else ground.up
    return float(-guess.cTl.rotation().matrix()[1] @ up)


def copied(drive: Drive, guess: Guess, classes: Sequence[SemanticClass]) -> Finding | None:
    """Points whose classes were read from the masks under the start, or masks that were drawn from the
    points: they agree where they were made so, and nothing in them tells a better calibration.

    Labels that were made apart differ at the borders of objects, because each sensor sees past them in its
    own way. Larger masks leave differences on one side only, so both sides have to agree.
    """
    if guess.cTl is None:
        return None
    stamps = drive.scan_stamps_ns, drive.image_stamps_ns
    pairs = pair_by_time(*stamps, guess.time_offset_s, drive.image_period_s)
    # Of both ways to make a pixel's number of a place, nearest and rounded down: points and those that
    # differ, outside of the borders and inside.
    counts = np.zeros((2, 2, 2), np.intp)
    for pair in pairs[:: step_for(len(pairs), _COPIED_PAIRS)]:
        scan, mask = drive.scans[pair.scan], drive.images[pair.image].mask
        uvs = drive.camera.project(transformed_points(guess.cTl, scan.lPs))
        for c in classes:
            counts += _beside_borders(mask, uvs, scan.classes, c)
    shares = (counts[..., 1] / np.maximum(counts[..., 0], 1)).max(axis=1)
    if counts[..., 0].min() < _LEAST_COPIED or shares.min() > _MOST_DIFFER:
        return None
    return Finding(
        "the labels of the clouds and of the pictures are copies of each other, made with the start (Tr)",
        f"of {counts[0, :, 0].sum()} points beside the borders of objects only {100.0 * shares.min():.1f} % "
        "are labelled otherwise than their pixel",
        "label clouds and pictures apart, for such labels only repeat the start; or take --method edges",
    )


def _beside_borders(
    mask: NDArray[np.uint8], uvs: FloatArray, classes: NDArray[np.uint8], c: SemanticClass
) -> NDArray[np.intp]:
    """(2, 2, 2) for either rounding, points whose pixel is outside of a class, or inside, near its border;
    all, and those labelled otherwise.

    Args:
        mask: (h, w) of the image.
        uvs: (n, 2) projections; NaN: none [px].
        classes: (n,) of the points.
    """
    within, square = (mask == c).astype(np.uint8), np.ones((2 * _COPIED_PX + 1,) * 2, np.uint8)
    near = (cv2.dilate(within, square) != cv2.erode(within, square)) & (mask != SemanticClass.IGNORE)
    counts = []
    for to_middle in (0.5, 0.0):
        with np.errstate(invalid="ignore"):
            seen = ((uvs + to_middle >= 0.0) & (uvs + to_middle < mask.shape[::-1])).all(axis=1)
        u, v = (uvs[seen] + to_middle).astype(np.intp).T
        inside, own = within[v, u][near[v, u]] > 0, classes[seen][near[v, u]] == c
        sides = ~inside, inside
        counts.append([[np.count_nonzero(side), np.count_nonzero(side & (own != inside))] for side in sides])
    return np.array(counts)


def shift(drives: Iterable[Drive]) -> MaskShift | None:
    """The shift of all masks against their pictures."""
    statistics_of_drives = [drive.statistics for drive in drives if drive.statistics is not None]
    return mask_shift(
        [p for statistics in statistics_of_drives for image in statistics.images for p in image.profiles]
    )


def shifted_masks(found: MaskShift | None) -> Finding | None:
    """Masks beside their pictures' edges."""
    if found is None or _are_foreign(found) or not found.within_reach:
        return None
    if found.length_px - _SIGMAS * found.sigma_along_px < _LEAST_SHIFT_PX:
        return None
    sideways = abs(found.right_px) > abs(found.down_px)
    amount, sigma = (found.right_px, found.sigma_px[0]) if sideways else (found.down_px, found.sigma_px[1])
    way = ("right" if amount > 0.0 else "left") if sideways else ("down" if amount > 0.0 else "up")
    return Finding(
        f"the masks are shifted {way} against their pictures",
        f"by {abs(amount):.1f} +- {sigma:.1f} px, along the contours of {count_of(found.objects, 'object')}",
        "look for a crop, a resize or a padding that only one of them went through",
    )


def foreign_masks(found: MaskShift | None) -> Finding | None:
    """Masks along whose contours their pictures show no edges."""
    if found is None or not _are_foreign(found):
        return None
    return Finding(
        "the masks are not those of these pictures (another drive, another order or numbering)",
        f"the pictures show no more edges along the contours of {count_of(found.objects, 'object')} "
        "than beside them",
        "lay a mask over the picture of the same number",
    )


def _are_foreign(found: MaskShift) -> bool:
    return found.contrast < _LEAST_CONTRAST or found.second_best > _MOST_RIVAL


_OVER_GROUND = (SemanticClass.SKY, SemanticClass.VEHICLE)


def _mean_row(statistics: InputStatistics, c: SemanticClass) -> float | None:
    """Over all pixels of a class, as a share of the height; None for a class that is seldom seen."""
    weights = [image.labelled.get(int(c), 0) for image in statistics.images]
    total = sum(weights)
    if total < 0.005 * sum(sum(image.labelled.values()) for image in statistics.images) or total == 0:
        return None
    rows = [image.rows.get(int(c), 0.0) for image in statistics.images]
    return sum(row * weight for row, weight in zip(rows, weights, strict=True)) / total


def _names(present: Iterable[int]) -> str:
    return ", ".join(SemanticClass(c).name.lower() for c in sorted(present)) or "none"
