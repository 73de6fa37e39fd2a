"""All checks, the most certain first."""

from __future__ import annotations

from collections.abc import Sequence

from sst_graph.diagnosis import cameras, clocks, labels, repeats, units
from sst_graph.diagnosis.finding import Finding
from sst_graph.diagnosis.fit import LEAST_QUALITY, THERE_DEG, WELL, Fitter, LabelFit
from sst_graph.diagnosis.hypotheses import best_hypothesis, mirrored
from sst_graph.diagnosis.poses import wrong_start
from sst_graph.drive.preparation import Drive
from sst_graph.metrics import quaternion_angle_deg
from sst_graph.types import Guess, SemanticClass

_FREE_QUALITY = 0.15
"""Least quality of a pose found among all, by a drive and by its halves: the KITTI drives have 0.19 and 0.32,
clouds of another drive 0.48, by chance, and halves that are 18 and 40 deg away from it."""
_LEAST_HALF, _SHORT_QUALITY = 8, 0.3
"""Fewest scans in a half that is searched by itself, and the least quality in shorter drives: foreign images
reach 0.2."""


def preflight(drives: Sequence[Drive], guess: Guess, classes: Sequence[SemanticClass]) -> tuple[Finding, ...]:
    """What is certainly wrong, whatever the calibration says.

    Args:
        guess: where the calibration starts.
        classes: that are aligned; empty where labels are not used.
    """
    found = [units.start_unit(guess.cTl), repeats.shared_scans(drives)]
    for drive in drives:
        # Repeated scans make stamps seem to run too slowly: the cause is said first.
        found += [cameras.image_size(drive.camera), repeats.repeats(drive), clocks.stamps(drive)]
        found += [clocks.two_clocks(drive), clocks.apart(drive, guess.time_offset_s)]
        found += [clocks.point_times(drive), units.rounding(drive)]
        if classes:
            found += [labels.ground_points(drive), labels.mask_rows(drive, guess), units.clouds(drive)]
            found.append(labels.copied(drive, guess, classes))
        else:
            found.append(cameras.black_pictures(drive))
    if classes:
        found.append(labels.searched_classes(drives, classes))
        found.append(labels.shifted_masks(labels.shift(drives)))
    return tuple(dict.fromkeys(finding for finding in found if finding is not None))


def likely_causes(
    drives: Sequence[Drive], guess: Guess, fit: Fitter, result: LabelFit | None = None
) -> tuple[Finding, ...]:
    """Why the labels do not agree, for a result that is missing or may be wrong; empty where they do agree.

    Args:
        guess: where the calibration started.
        fit: how well labels agree, by the calibration's own search.
        result: how well they agree in the result, where there is one.
    """
    drive = max(drives, key=lambda one: len(one.scans))
    certain = labels.foreign_masks(labels.shift(drives)) or units.axes(drive, guess.cTl)
    if certain is not None:
        return (certain,)
    given = fit(drive, guess)
    if given is not None and given.quality > WELL:
        return ()
    cause = best_hypothesis(drive, guess, fit, given)
    if cause is None and guess.cTl is not None:
        cause = wrong_start(guess.cTl, _found_by_halves(drive, Guess(None, guess.time_offset_s), fit))
    best = max(0.0 if one is None else one.quality for one in (given, result))
    if cause is None and best < LEAST_QUALITY and any(image.contours for image in drive.images):
        cause = _nothing_in_common(given)
    return () if cause is None else (cause,)


def mirror(drives: Sequence[Drive], guess: Guess, fit: Fitter, result: LabelFit) -> tuple[Finding, ...]:
    """Whether mirrored data would agree better, for a result without any other reason against it.

    Args:
        result: how well the labels agree in the result.
    """
    drive = max(drives, key=lambda one: len(one.scans))
    around = Guess(guess.cTl or result.cTl, guess.time_offset_s)
    cause = mirrored(drive, around, fit, result, sideways=guess.cTl is not None)
    return () if cause is None else (cause,)


def _found_by_halves(drive: Drive, anywhere: Guess, fit: Fitter) -> LabelFit | None:
    """What a search without a start finds, where either half of the drive finds it by itself.

    Foreign data, too, agree best somewhere, by chance; each half has another such place. Halves of a short
    drive show too little, and its own agreement has to be better.
    """
    found, middle = fit(drive, anywhere), len(drive.scans) // 2
    halves = [range(middle), range(middle, len(drive.scans))] if middle >= _LEAST_HALF else []
    if found is None or found.quality < (_FREE_QUALITY if halves else _SHORT_QUALITY):
        return None
    for half in halves:
        again = fit(drive.part(half), anywhere)
        if again is None or quaternion_angle_deg(again.cTl.rotation(), found.cTl.rotation()) > THERE_DEG:
            return None
    return found


def _nothing_in_common(given: LabelFit | None) -> Finding:
    found = (
        "nothing" if given is None else f"a place where {100.0 * given.explained:.0f} % of the outlines meet"
    )
    return Finding(
        "the clouds and the images hardly show the same scene (another drive, numbers that are far off, or "
        "the intrinsics of other pictures, such as those before rectification)",
        f"the search found {found}, and no start, mirroring, shift in time, half or twice the focal length "
        "does better",
        "look at a cloud and at the picture of the same number, and compare the intrinsics with the camera",
    )
