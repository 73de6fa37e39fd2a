"""Hypotheses about the cause: simple changes of the data under which the labels would agree.

When a calibration fails or may be wrong, common mistakes are undone one by one, a start is searched each
time, and the agreement of the labels is compared with that of the data as given.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.diagnosis.finding import INVERTED, OF_LINK, Finding
from sst_graph.diagnosis.fit import (
    LEAST_CONCENTRATION,
    LEAST_EXPLAINED_GAIN,
    LEAST_GAIN,
    LEAST_QUALITY,
    THERE_DEG,
    THERE_GAIN,
    WELL,
    Fitter,
    LabelFit,
)
from sst_graph.diagnosis.poses import start_finding
from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.errors import count_of
from sst_graph.metrics import LINK_FROM_OPTICAL, quaternion_angle_deg
from sst_graph.types import FloatArray, Guess


@dataclass(frozen=True)
class Hypothesis:
    """A change that would put the data right.

    Attributes:
        finding: the cause that it undoes; its evidence is written by the comparison.
        drive: with the change.
        guess: to search around.
        start: as it was given, where it is what was changed.
    """

    finding: Finding
    drive: Drive
    guess: Guess
    start: gtsam.Pose3 | None = None


_MOST_SHIFTS = 4
"""Windows of time offsets that are searched before and after the first."""
_OVERLAP = 0.8
"""Farther than this share of the drive's length too few scans meet an image."""
_WINDOW_S = 0.9
"""Width of a window [s]: the search reaches half a second either way."""


def best_hypothesis(drive: Drive, guess: Guess, fit: Fitter, given: LabelFit | None) -> Finding | None:
    """The change under which the labels agree, where they clearly do; None where none helps.

    All changes are compared, for a wrong one may fit well by chance; shifts in time only where none does.
    """
    best = _best(hypotheses(drive, guess), guess, fit, given)
    if best is None or best[0] <= WELL:
        shifted = _best(_shifts(drive, guess), guess, fit, given, enough=WELL)
        best = max((b for b in (best, shifted) if b is not None), key=lambda b: b[0], default=None)
    return None if best is None else best[1]


def _best(
    tried: Iterator[Hypothesis], guess: Guess, fit: Fitter, given: LabelFit | None, enough: float = np.inf
) -> tuple[float, Finding] | None:
    """Quality, higher where the labels agree just there, and cause of the best change that is accepted; none
    is tried after one of ``enough``."""
    base = LabelFit(gtsam.Pose3(), 0.0, 0.0, 0.0) if given is None else given
    given_quality = base.quality * (THERE_GAIN if _is_there(base, guess) else 1.0)
    best: tuple[float, Finding] | None = None
    for hypothesis in tried:
        found = fit(hypothesis.drive, hypothesis.guess)
        if found is None:
            continue
        there = _is_there(found, hypothesis.guess)
        quality = found.quality * (THERE_GAIN if there else 1.0)
        if not there and found.concentration < LEAST_CONCENTRATION:
            continue
        if quality < max(LEAST_QUALITY, LEAST_GAIN * given_quality):
            continue
        if found.explained < LEAST_EXPLAINED_GAIN * base.explained:
            continue
        if best is None or quality > best[0]:
            before = 100.0 * base.explained
            evidence = (
                f"undone, {100.0 * found.explained:.0f} % of the outlines meet; as given, {before:.0f} %"
            )
            finding = replace(hypothesis.finding, evidence=evidence)
            if hypothesis.guess.time_offset_s != guess.time_offset_s:
                finding = replace(finding, evidence=f"{evidence}, time offset {found.time_offset_s:+.2f} s")
            if hypothesis.start is not None:
                finding = start_finding(hypothesis.start, found, finding)
            best = quality, finding
        if quality > enough:
            break
    return best


def _is_there(found: LabelFit, guess: Guess) -> bool:
    """Whether the labels agree just where a guess says."""
    if guess.cTl is None:
        return False
    return quaternion_angle_deg(guess.cTl.rotation(), found.cTl.rotation()) < THERE_DEG


def _shifts(drive: Drive, guess: Guess) -> Iterator[Hypothesis]:
    """Time offsets on either side of what was searched, as far as the drive reaches."""
    period, length = drive.image_period_s, (drive.scan_stamps_ns[-1] - drive.scan_stamps_ns[0]) * 1e-9
    windows = min(_MOST_SHIFTS, int(_OVERLAP * length / _WINDOW_S))
    for window in range(1, windows + 1):
        for sign in (1.0, -1.0):
            shift_s = sign * window * _WINDOW_S
            finding = Finding(
                "the images' numbers or stamps are off by "
                f"{count_of(round(abs(shift_s) / period), 'frame')} or so",
                "",
                "compare the first frames of both sensors, or give --image-shift",
            )
            shifted = Guess(guess.cTl, guess.time_offset_s + shift_s)
            if met := _that_meet_images(drive, shifted.time_offset_s):
                yield Hypothesis(finding, replace(drive, scans=met), shifted)


def _that_meet_images(drive: Drive, time_offset_s: float) -> tuple[ScanFeatures, ...]:
    """The scans beside which there is an image at this offset: the search samples the scans that it is given,
    and two or three that have an image agree somewhere by chance."""
    pairs = pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, time_offset_s, drive.image_period_s)
    return tuple(drive.scans[pair.scan] for pair in pairs)


def mirrored(drive: Drive, guess: Guess, fit: Fitter, given: LabelFit, sideways: bool) -> Finding | None:
    """Clouds or pictures that are mirrored: the only mistake with which an estimate may still have the status
    ``ok``.

    Args:
        sideways: left and right only: with a given start, no estimate is ``ok`` where the cloud is also
            turned by 180 degrees.
    """
    tried = itertools.islice(_mirrorings(drive, guess), 1 if sideways else None)
    best = _best(tried, guess, fit, given)
    return None if best is None else best[1]


def hypotheses(drive: Drive, guess: Guess) -> Iterator[Hypothesis]:
    """The common mistakes, each undone."""
    for name, check, start in _starts(guess.cTl):
        yield Hypothesis(Finding(name, "", check), drive, replace(guess, cTl=start), guess.cTl)
    yield from _mirrorings(drive, guess)
    for factor, name in ((0.5, "half"), (2.0, "twice")):
        camera = drive.camera
        focal = replace(camera, fx=camera.fx / factor, fy=camera.fy / factor)
        finding = Finding(
            f"the focal length is {name} the pictures' (intrinsics of another camera or image size)",
            "",
            f"compare fx = {camera.fx:.0f} px with the camera that took the pictures",
        )
        yield Hypothesis(finding, replace(drive, camera=focal), guess)


def _mirrorings(drive: Drive, guess: Guess) -> Iterator[Hypothesis]:
    changed = with_points(drive, np.diag([1.0, -1.0, 1.0]))
    for name, turned in _mirrored_starts(guess.cTl):
        check = "look at a cloud from above and at its picture: is what is left in one left in the other?"
        yield Hypothesis(Finding(name, "", check), changed, replace(guess, cTl=turned))


def _starts(guess: gtsam.Pose3 | None) -> Iterator[tuple[str, str, gtsam.Pose3]]:
    if guess is None:
        return
    check = "turn the clouds, or correct the start (Tr)"
    half = np.pi
    yield *INVERTED, guess.inverse()
    yield *OF_LINK, LINK_FROM_OPTICAL.inverse() * guess
    yield "the clouds are turned by 180 deg about their z axis", check, _turned(guess, gtsam.Rot3.Rz(half))
    yield "the clouds are upside down", check, _turned(guess, gtsam.Rot3.Rx(half))
    yield (
        "the clouds are in the camera's axes (x right, y down, z forward), the start is not",
        "give clouds in the LiDAR's axes, or a start that is nearly the identity",
        gtsam.Pose3(gtsam.Rot3(), np.zeros(3)),
    )


def _mirrored_starts(guess: gtsam.Pose3 | None) -> Iterator[tuple[str, gtsam.Pose3 | None]]:
    if guess is None:
        yield "the clouds or the pictures are mirrored", None
        return
    yield "the clouds' y axis or the pictures are mirrored (left and right exchanged)", guess
    yield "the clouds' x axis is flipped", _turned(guess, gtsam.Rot3.Rz(np.pi))
    yield "the clouds' z axis is flipped", _turned(guess, gtsam.Rot3.Rx(np.pi))


def _turned(guess: gtsam.Pose3, rotation: gtsam.Rot3) -> gtsam.Pose3:
    return guess * gtsam.Pose3(rotation, np.zeros(3))


def with_points(drive: Drive, M: FloatArray) -> Drive:
    """The drive with every LiDAR point p replaced by M p, M (3, 3) orthogonal, and its motion with it."""

    def moved(points: FloatArray) -> FloatArray:
        return np.asarray(points @ M.T)

    def scan(s: ScanFeatures) -> ScanFeatures:
        edges = {c: replace(b, lPs=moved(b.lPs), outward=moved(b.outward)) for c, b in s.boundaries.items()}
        return replace(s, boundaries=edges, lower_edges={}, lPs=moved(s.lPs))

    def motion(pose: gtsam.Pose3) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Rot3.ClosestTo(M @ pose.rotation().matrix() @ M.T), M @ pose.translation())

    return replace(
        drive,
        scans=tuple(scan(s) for s in drive.scans),
        lidar_motions=tuple(replace(m, aTb=motion(m.aTb)) for m in drive.lidar_motions),
    )
