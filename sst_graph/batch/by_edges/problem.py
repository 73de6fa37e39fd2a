"""Drives to be calibrated by edges: what motion says, where starts are searched, and what is known beside the
edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.batch.by_edges.parts import thinned, thinned_together
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.drive.edges_of_frames import with_edges
from sst_graph.drive.preparation import Drive, PrepareConfig, Progress
from sst_graph.edges.search import KnownRotation, SearchRegion
from sst_graph.errors import EstimationError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.known import KnownCalibration, motion_steps
from sst_graph.graph.matching import MOST_POINTS, DriveEdges, edges_of
from sst_graph.graph.outer_loop import JointProblem
from sst_graph.graph.state import State, difference
from sst_graph.hand_eye.solution import MotionSolution, alternative, solve_motion
from sst_graph.metrics import turn_rad
from sst_graph.sampling import evenly_spread
from sst_graph.types import FloatArray, Guess

SEARCH_SCANS = 12
"""Scans of each drive that starts are compared on."""
POINTS_A_SCAN = 1000
"""Most boundary points of a scan that are matched: neighbours on one edge tell the same."""
_SOME_SCANS = 20
"""Scans of all drives that are read again for their edges: two to four seconds."""
_APART_S = 0.3
"""Scans come in pairs so far apart, so that objects are tracked from one to the other [s]."""
_GUESS_SIGMA_DEG = 3.5
"""Sigma, by axis, of the rotation of a guess that starts are searched around [deg]."""
_REACH_SIGMAS, _MOST_DEG = 2.2, 25.0
"""The search covers so many sigmas to either side, and this at most [deg]."""
_KNOWN_OFFSET_S = 0.03
"""Motion tells the time offset where its sigma is smaller than this [s]."""
_OFFSETS_S = np.arange(-3, 4) * 0.1
"""Time offsets around the guess that are tried where motion does not tell and the vehicle moves [s]."""
_MOVING_MPS = 0.2
"""Mean speed from which it counts as moving [m/s]: 100 ms are then 2 cm."""
_MOTION_FLOOR = np.array([*np.radians([0.5] * 3), 0.1, 0.1, 0.1, 0.004])
"""(7,) sigmas added to motion's as a factor: odometry errs by this much in ways that its covariance leaves
out [rad, m, s]."""
_TRANSLATION_SIGMA_M, _FREE_TRANSLATION_SIGMA_M = 0.1, 0.3
"""Prior sigma of the translation around the guess, or around 0 without one: unbounded, weak scenes run away
along the road [m]."""


@dataclass(frozen=True)
class EdgesProblem:
    """Drives to be calibrated by edges.

    Attributes:
        whole: all scans, with no more points than are needed.
        some: a few scans of each drive.
        region: where starts are searched.
        centre: what the weak priors are centred on.
        known: what is known beside the edges: motion, and the weak priors.
    """

    whole: JointProblem
    some: JointProblem
    region: SearchRegion
    centre: State
    known: KnownCalibration

    @cached_property
    def subset_edges(self) -> list[DriveEdges]:
        """Boundary points of the few scans."""
        return edges_of(self.some.drives, self.some.motions, self.some.config.graph)


@dataclass(frozen=True)
class LabelEstimate:
    """What labels of other frames estimate.

    Attributes:
        state: their estimate; edges begin there, without a search. None where it is not known well enough.
        has_motion: motion is in their estimate, and must not count twice.
    """

    state: State | None = None
    has_motion: bool = False


def motion_alone(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> MotionSolution | None:
    """What motion says; None where it says nothing, two things, or what the guess rules out."""
    reach_s = config.search.time_offset_s
    try:
        solutions = solve_motion(drives, guess, reach_s, progress)
    except EstimationError:
        return None
    possible = [
        one
        for one in solutions
        if abs(one.state.time_offsets_s[0] - guess.time_offset_s) <= reach_s
        and (guess.cTl is None or np.degrees(turn_rad(one.state.cTl, guess.cTl)) < _MOST_DEG)
    ]
    if not possible or not possible[0].converged or alternative(possible) is not None:
        return None
    return possible[0]


def with_fewer_points(calibration: CalibrationProblem) -> CalibrationProblem:
    """The problem with no more boundary points than are matched with edges."""
    return replace(calibration, drives=[thinned(drive, POINTS_A_SCAN) for drive in calibration.drives])


def problem_of_some_frames(
    drives: Sequence[Drive], time_offsets_s: Sequence[float], guess: Guess, config: CalibrationConfig
) -> tuple[CalibrationProblem, list[float]] | None:
    """The edges of some frames of drives that were prepared without, read again, and the time offset of each
    drive that has some; None where none has. In so few scans objects have no bias of their own, and are
    taken for static.

    Args:
        time_offsets_s: of each drive.

    Raises:
        DataError: a frame cannot be read again.
    """
    some = _with_some_edges(drives, time_offsets_s, config.prepare)
    if not some:
        return None
    config = replace(config, noise=replace(config.noise, object_bias_sigma_px=0.0))
    problem = CalibrationProblem.of([*some.values()], guess, config)
    return problem, [time_offsets_s[number] for number in some]


def _with_some_edges(
    drives: Sequence[Drive], time_offsets_s: Sequence[float], config: PrepareConfig
) -> dict[int, Drive]:
    """By position, the drives with edges of some scans each, spread over it (:func:`with_edges`); without
    those that have none.

    Args:
        time_offsets_s: of each drive.

    Raises:
        DataError: a frame cannot be read, or cannot be used.
    """
    share = max(2, _SOME_SCANS // max(1, len(drives)))
    found = {
        number: with_edges(drive, _some_pairs(drive, offset_s, share), config)
        for number, (drive, offset_s) in enumerate(zip(drives, time_offsets_s, strict=True))
    }
    return {number: drive for number, drive in found.items() if drive is not None}


def _some_pairs(drive: Drive, time_offset_s: float, most: int) -> list[tuple[int, int]]:
    """Scans with their images in true time: pairs of scans, spread over the drive."""
    found = pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, time_offset_s, drive.image_period_s)
    apart = max(1, round(_APART_S / drive.scan_period_s))
    firsts = evenly_spread(range(max(1, len(found) - apart)), most // 2)
    chosen = sorted({k for first in firsts for k in (first, first + apart) if k < len(found)})
    return [(found[k].scan, found[k].image) for k in chosen]


def edges_problem(
    calibration: CalibrationProblem, motion: MotionSolution | None, labels: LabelEstimate
) -> EdgesProblem:
    """The problem, with the search around what guess and motion say together.

    Raises:
        EstimationError: neither says anything.
    """
    guess = calibration.guess
    if labels.state is not None:
        guess = Guess(*labels.state.calibration())
    if guess.cTl is None and motion is None:
        raise EstimationError(
            "without labels, a start is needed: a guess within 5 deg (--init), or a drive whose motion "
            "tells the rotation (turns and changes of speed)"
        )
    joint = with_fewer_points(calibration).joint()
    drives = joint.drives
    region = _region(guess, motion, _time_offsets(calibration, motion))
    if labels.state is not None:
        region = replace(region, cTl=labels.state.cTl, time_offsets_s=labels.state.time_offsets_s)
    translation = np.zeros(3) if guess.cTl is None else np.asarray(guess.cTl.translation())
    pose = gtsam.Pose3(region.cTl.rotation(), translation)
    offset_known = labels.state is None and motion is not None and _tells_offset(motion)
    centre = State(pose, (region.time_offsets_s[0] if offset_known else guess.time_offset_s,))
    guessed = labels.state is None and guess.cTl is not None
    checking = None if labels.has_motion else checking_motion(motion, calibration.config)
    known = _prior(centre, checking, guessed, drives[0].camera)
    whole = replace(joint, drives=thinned_together(drives, MOST_POINTS), centre=centre, prior=known)
    scans = [_some_scans(drive, guess.time_offset_s) for drive in drives]
    parts = [drive.part(own) for drive, own in zip(drives, scans, strict=True)]
    motions = [motion.part(own) for motion, own in zip(joint.motions, scans, strict=True)]
    some = replace(whole, drives=parts, motions=motions)
    return EdgesProblem(whole, some, replace(region, cTl=pose), centre, known)


def checking_motion(motion: MotionSolution | None, config: CalibrationConfig) -> MotionSolution | None:
    """What motion says, where the result should agree with it: not where a parameter is estimated that
    misleads it."""
    return None if config.assumptions.misleading_motion else motion


def _some_scans(drive: Drive, time_offset_s: float) -> list[int]:
    """Scans that starts are compared on, of those without labels beside their images."""
    found = pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, time_offset_s, drive.image_period_s)
    scans = sorted({pair.scan for pair in found if not drive.have_labels(pair.scan, pair.image)})
    scans = scans or list(range(len(drive.scans)))
    return evenly_spread(scans, SEARCH_SCANS)


def _tells_offset(motion: MotionSolution) -> bool:
    return bool(np.sqrt(motion.covariance[6, 6]) < _KNOWN_OFFSET_S)


def _time_offsets(calibration: CalibrationProblem, motion: MotionSolution | None) -> tuple[float, ...]:
    """Time offsets at which starts are searched."""
    guess = calibration.guess.time_offset_s
    if motion is not None and _tells_offset(motion):
        return (motion.state.time_offsets_s[0],)
    speeds = [
        float(np.linalg.norm(each.mean_twist[3:]))
        for drive in calibration.drives
        for each in drive.lidar_motions
        if each.ok
    ]
    moving = bool(speeds) and float(np.mean(speeds)) > _MOVING_MPS
    return tuple((guess + _OFFSETS_S).tolist()) if moving else (guess,)


def _region(guess: Guess, motion: MotionSolution | None, time_offsets_s: tuple[float, ...]) -> SearchRegion:
    """Guess and motion together; where one says nothing, what the other says."""
    if motion is None:
        assert guess.cTl is not None
        half = (_REACH_SIGMAS * _GUESS_SIGMA_DEG,) * 3
        return SearchRegion(guess.cTl, time_offsets_s, half)
    known = KnownRotation(motion.state.cTl.rotation(), motion.covariance[:3, :3])
    # Both as Gaussians in the tangent space of the guess, or of motion alone.
    information = np.linalg.inv(known.covariance + np.radians(0.7) ** 2 * np.eye(3))
    middle = motion.state.cTl
    covariance = np.linalg.inv(information)
    if guess.cTl is not None:
        step = gtsam.Rot3.Logmap(guess.cTl.rotation().between(known.cRl))
        total = information + np.eye(3) / np.radians(_GUESS_SIGMA_DEG) ** 2
        covariance = np.linalg.inv(total)
        middle = gtsam.Pose3(
            guess.cTl.rotation().retract(covariance @ information @ step), guess.cTl.translation()
        )
    R = middle.rotation().matrix()
    sigmas_deg = np.degrees(np.sqrt(np.diag(R @ covariance @ R.T)))
    half = tuple(np.minimum(_REACH_SIGMAS * sigmas_deg, _MOST_DEG).tolist())
    return SearchRegion(middle, time_offsets_s, (half[0], half[1], half[2]), known)


def _prior(
    centre: State, motion: MotionSolution | None, guessed: bool, camera: PinholeCamera
) -> KnownCalibration:
    """Motion, and the translation's prior."""
    sigma_m = _TRANSLATION_SIGMA_M if guessed else _FREE_TRANSLATION_SIGMA_M
    sigmas = np.array([10.0] * 3 + [sigma_m] * 3 + [1.0])
    information, state = np.diag(sigmas**-2.0), centre
    steps: dict[str, FloatArray] = {}
    if motion is not None:
        own = np.linalg.inv(motion.covariance + np.diag(_MOTION_FLOOR**2))
        total = information + own
        # Both Gaussians in the tangent space of motion's estimate.
        step = np.linalg.solve(total, information @ difference(motion.state, centre))
        state = motion.state.moved(np.asarray(step, np.float64))
        information = total
        share = np.linalg.solve(total, own)
        steps = {name: share @ step for name, step in motion_steps(camera, state.cTl).items()}
    return KnownCalibration(state, np.asarray(np.linalg.inv(information), np.float64), steps)
