"""One image and one scan in a graph of the user's own: matched again at every estimate.

A term holds its data, and the keys of extrinsic, time offset and trajectory in the graph. At any values
it finds the two poses between which the image was taken in true time, stamp + offset, matches scan and image
there, and makes its factor (:func:`sst_graph.factors.pose_alignment_factor`). Matches are frozen in a
factor: it is valid near the values at which it was made, and :class:`TermMatches` measures how far they have
moved since. :mod:`sst_graph.slam.solving` swaps the factors of many terms in a solver.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import cast

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_graph.association.edge_matching import MatchConfig, level_sigmas
from sst_graph.batch.by_edges.positions import position_columns
from sst_graph.config import Settings, expect_settings, setting
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.drive.preparation import ImageFeatures, ScanFeatures
from sst_graph.errors import DataError, count_of
from sst_graph.factors.arguments import checked_array, checked_positive, checked_type
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.camera_motion import Between
from sst_graph.factors.pose_alignment import pose_alignment_factor
from sst_graph.factors.reprojection import residuals
from sst_graph.factors.robust import RobustKernel
from sst_graph.objects.occupancy import ObjectName
from sst_graph.slam.align import (
    SLAM_MATCHES,
    VEHICLES,
    CameraCalibration,
    FrameAlignments,
    FrameMatching,
    ScanMotion,
    align_frame,
    features_of,
)
from sst_graph.slam.alignment_keys import COLUMNS, POSITIONS, AlignmentKeys, bias_column, body_pose
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.types import CameraImage, FloatArray, Scan, SemanticClass

_LONGEST_S = 1e11
"""Offsets beyond this lie outside of every trajectory, as the nanoseconds of 64 bits do [s]."""


@dataclass(frozen=True)
class TermConfig(Settings):
    """How a term matches.

    Attributes:
        classes: to match, as of :class:`~sst_graph.slam.align.FrameMatching`: ``OBJECT`` needs no labels.
        match: how boundary points meet contours; its ``side_sigma_px`` bounds the information of a side.
        min_matches: fewer matches than this make no factor.
    """

    classes: tuple[SemanticClass, ...] = VEHICLES
    match: MatchConfig = SLAM_MATCHES
    min_matches: int = setting(10, at_least=1, at_most=1_000_000)


class TermState(Enum):
    """Why a term has a factor, or has none."""

    MATCHED = "matched"
    FEW_MATCHES = "fewer matches than the least"
    BEFORE_TRAJECTORY = "stamp + offset lies before the first pose"
    AFTER_TRAJECTORY = "stamp + offset lies after the last pose"
    NO_SCAN_POSE = "the trajectory has no pose at the scan's stamp"
    POSE_MISSING = "a pose at the scan's stamp, or around stamp + offset, is not among the values"


@dataclass(frozen=True)
class TermPlace:
    """Where an image falls in the trajectory, and which scan it is aligned with.

    Attributes:
        between: the poses before and after stamp + offset, and the scan's pose.
        stamp_a_ns: stamp of X_a [ns].
        position: of X_a in the trajectory.
        scan: position of the scan among the term's.
    """

    between: Between
    stamp_a_ns: int
    position: int
    scan: int

    @property
    def poses(self) -> set[int]:
        """Keys of the poses that the term's factor is on."""
        return {self.between.X_a, self.between.X_b, self.between.X_s}


@dataclass(frozen=True, eq=False)
class TermRows:
    """Matches of one term, linearized, over the columns :data:`~sst_graph.slam.alignment_keys.COLUMNS`.

    Attributes:
        J: (m, n) derivatives of the residuals, the trajectory held [px per unit].
        r: (m,) residuals, mask bias included [px].
        weights: (m,) robust weight times the match's own.
        sigmas_px: (m,) that the factor gives the residuals [px].
        sides: (m,) number of the side of an object that each match lies on, the same in every image.
        level: which of them lie on level edges; errors in pixels.
    """

    J: FloatArray
    r: FloatArray
    weights: FloatArray
    sigmas_px: FloatArray
    sides: NDArray[np.intp]
    level: LevelEdges

    @classmethod
    def none(cls) -> TermRows:
        none, numbers = np.zeros(0), np.zeros(0, dtype=np.intp)
        return cls(np.zeros((0, COLUMNS)), none, none, none, numbers, LevelEdges.none(0))

    @classmethod
    def joined(cls, parts: Sequence[TermRows]) -> TermRows:
        """One after the other."""
        every, names = (cls.none(), *parts), ("J", "r", "weights", "sigmas_px", "sides")
        columns = {name: np.concatenate([getattr(part, name) for part in every]) for name in names}
        return cls(**columns, level=LevelEdges.joined([part.level for part in every]))

    def __len__(self) -> int:
        return len(self.r)


@dataclass(frozen=True, eq=False)
class TermMatches:
    """A term at some values: its factor, or why there is none.

    Attributes:
        state: whether there is a factor.
        kernel_px: scale of the robust kernel under which the matches were made [px].
        outside_s: how far stamp + offset lies outside of the trajectory [s]; negative before it.
        pose_away_s: of ``NO_SCAN_POSE``, the least interval between a scan's stamp and a pose [s].
        place: poses around the image; None outside of the trajectory.
        found: the matches.
        factor: of them; None where the state is not ``MATCHED``.
        information: what the image counts in the factor, over what its matches would by themselves.
    """

    state: TermState
    kernel_px: float
    outside_s: float = 0.0
    place: TermPlace | None = None
    found: FrameAlignments = field(default_factory=lambda: FrameAlignments((), (), ()))
    factor: gtsam.CustomFactor | None = None
    information: float = 1.0
    term: AlignmentTerm | None = field(default=None, repr=False)
    made_at: tuple[FloatArray, ...] = field(default=(), repr=False)
    pose_away_s: float = 0.0

    def __len__(self) -> int:
        return len(self.found)

    @property
    def scale_px(self) -> float:
        """Widest kernel of any of the matches [px]."""
        return max((each.kernel.scale for each in self.found.alignments), default=self.kernel_px)

    def __str__(self) -> str:
        outside = f", by {1e3 * abs(self.outside_s):.0f} ms" if self.outside_s else ""
        if self.state is TermState.NO_SCAN_POSE:
            outside = f", the nearest is {1e3 * self.pose_away_s:.3g} ms away"
        found = count_of(len(self), "match", "matches")
        return f"{self.state.value}{outside}: {found}, kernel {self.kernel_px:.1f} px"

    def left_interval_s(self, values: gtsam.Values) -> float:
        """How far stamp + offset now lies outside of the two poses that the factor is on [s]; 0 within."""
        if self.term is None or self.place is None:
            return 0.0
        between = self.place.between
        late = between.image_after_a_s + self.term.keys.offset(values)
        return float(max(-late, late - between.seconds, 0.0))

    def moved_px(self, values: gtsam.Values) -> float:
        """How far the values have moved the matched points across the contours since matching, RMS [px]."""
        if self.term is None or not self.made_at:
            return 0.0
        now = [r for r, _ in self.term.residuals_of(self, values)]
        moved = np.concatenate([b - a for a, b in zip(self.made_at, now, strict=True)])
        return float(np.sqrt(np.mean(np.square(moved)))) if len(moved) else 0.0

    def predicted_sigma_px(self, values: gtsam.Values, covariance: ArrayLike) -> float:
        """What an uncertain calibration means in the image: sigma of the matched points across the contours,
        RMS [px].

        Args:
            values: where to linearize.
            covariance: (7, 7) of extrinsic and time offset; zeros for what is constant.

        Raises:
            FactorError: no such covariance, or no value for a key.
        """
        C = checked_array("covariance of predicted_sigma_px", covariance, (7, 7))
        if self.term is None or not len(self):
            return 0.0
        J = np.concatenate([J for _, J in self.term.residuals_of(self, values)])
        return float(np.sqrt(np.mean(np.einsum("ij,jk,ik->i", J, C, J))))


@dataclass(frozen=True, eq=False)
class AlignmentTerm:
    """One image and one scan, to be aligned in a graph of the user's own.

    Attributes:
        scans, image: as the data have them, kept as their features: one scan or several of the poses around.
            Of several that one is taken which is nearest to the image in true time.
        camera: of the image.
        keys: of extrinsic, offset and the poses in the graph; the trajectory needs a pose at a
            scan's stamp.
        config: how to match.
        l_velocities: for each scan (3,) over ground of objects that move, in the scan's LiDAR frame [m/s], by
            class and number within the scan.

    Raises:
        DataError: no scan, no image, or such as have a flaw; not one set of velocities for each scan.
        FactorError: no camera, no keys, no velocities.
        ConfigError: no settings.
    """

    scans: Scan | ScanFeatures | Sequence[Scan | ScanFeatures]
    image: CameraImage | ImageFeatures
    camera: PinholeCamera
    keys: AlignmentKeys
    config: TermConfig = field(default_factory=TermConfig)
    l_velocities: Sequence[Mapping[ObjectName, FloatArray]] = ()

    def __post_init__(self) -> None:
        checked_type("camera of AlignmentTerm", self.camera, PinholeCamera, "a PinholeCamera")
        checked_type("keys of AlignmentTerm", self.keys, AlignmentKeys, "an AlignmentKeys")
        object.__setattr__(self, "config", expect_settings(self.config, TermConfig))
        given = [self.scans] if isinstance(self.scans, Scan | ScanFeatures) else self.scans
        checked_type("scans of AlignmentTerm", given, (list, tuple), "a Scan, or a list of them")
        if not given:
            raise DataError("AlignmentTerm", "no scan", "one scan or more")
        features = [features_of(scan, self.image, self.config.classes, self.camera) for scan in given]
        expected = "a list with a dict for each scan, from (SemanticClass, number) to a velocity"
        checked_type("l_velocities of AlignmentTerm", self.l_velocities, (list, tuple), expected)
        for own in self.l_velocities:
            checked_type("l_velocities of AlignmentTerm", own, Mapping, expected)
        velocities = tuple(self.l_velocities) or ({},) * len(given)
        if len(velocities) != len(given):
            raise DataError(
                "l_velocities of AlignmentTerm", f"{len(velocities)}", f"{len(given)}, one a scan"
            )
        object.__setattr__(self, "scans", tuple(scan for scan, _ in features))
        object.__setattr__(self, "image", features[0][1])
        object.__setattr__(self, "l_velocities", velocities)

    @property
    def features(self) -> tuple[ScanFeatures, ...]:
        """Features of the scans."""
        return cast(tuple[ScanFeatures, ...], self.scans)

    @property
    def stamp_ns(self) -> int:
        """The image's own stamp [ns]."""
        return self.image.stamp_ns

    @property
    def measured(self) -> set[tuple[int, int, SemanticClass]]:
        """What it may count: stamps of image and scan [ns], and class."""
        scans, classes = {each.stamp_ns for each in self.features}, self.config.classes
        return {(self.stamp_ns, scan_ns, c) for scan_ns in scans for c in classes}

    def place(self, values: gtsam.Values) -> TermPlace | TermMatches:
        """The poses between which the image was taken under the present offset, or why there are none.

        Raises:
            FactorError: no value for a key, or one of another kind.
        """
        trajectory = self.keys.trajectory
        # whole: a float of 64 bits has steps of 256 ns in our century
        late_s = min(max(self.keys.offset(values), -_LONGEST_S), _LONGEST_S)
        true_ns = self.stamp_ns + round(1e9 * late_s)
        outside_s = trajectory.outside_s(true_ns)
        a = trajectory.interval(true_ns)
        if a is None:
            after = outside_s > 0.0 or len(trajectory) < 2
            state = TermState.AFTER_TRAJECTORY if after else TermState.BEFORE_TRAJECTORY
            return TermMatches(state, 0.0, outside_s)
        scan, of_scan = self._nearest_scan(true_ns, values)
        if of_scan is None:
            if any(trajectory.position(each.stamp_ns) is not None for each in self.features):
                return TermMatches(TermState.POSE_MISSING, 0.0)
            away_s = min(trajectory.nearest_s(each.stamp_ns) for each in self.features)
            return TermMatches(TermState.NO_SCAN_POSE, 0.0, pose_away_s=away_s)
        (X_a, stamp_a_ns), (X_b, stamp_b_ns) = trajectory.at(a), trajectory.at(a + 1)
        poses = X_a, X_b, trajectory.at(of_scan)[0]
        if not all(values.exists(key) for key in poses):
            return TermMatches(TermState.POSE_MISSING, 0.0)
        seconds, after_a_s = 1e-9 * (stamp_b_ns - stamp_a_ns), 1e-9 * (self.stamp_ns - stamp_a_ns)
        between = Between(X_a, X_b, seconds, after_a_s, X_scan=poses[2], bTl=self.keys.bTl)
        return TermPlace(between, stamp_a_ns, a, scan)

    def _nearest_scan(self, true_ns: int, values: gtsam.Values) -> tuple[int, int | None]:
        """Which scan is nearest in true time of those whose pose is known, and where in the trajectory."""
        trajectory, found = self.keys.trajectory, []
        for scan, features in enumerate(self.features):
            at = trajectory.position(features.stamp_ns)
            if at is not None and values.exists(trajectory.at(at)[0]):
                found.append((abs(features.stamp_ns - true_ns), scan, at))
        return min(found)[1:] if found else (0, None)

    def matched(self, values: gtsam.Values, kernel_px: float, information: float = 1.0) -> TermMatches:
        """Match at the values, and make the factor.

        Args:
            values: with extrinsic, offset, biases and the poses around the image.
            kernel_px: scale of the robust kernel of contours [px]; ``GATE`` times it is the search range.
            information: what the image counts, over what its matches would by themselves.

        Raises:
            FactorError: no value for a key, one of another kind, or numbers that are not above 0.
        """
        where = "AlignmentTerm.matched"
        kernel_px = checked_positive(f"kernel_px of {where}", kernel_px)
        information = checked_positive(f"information of {where}", information)
        checked_type(f"values of {where}", values, gtsam.Values, "a gtsam.Values")
        place = self.place(values)
        if isinstance(place, TermMatches):
            return place
        found = self._align(values, place, kernel_px)
        if len(found) < self.config.min_matches:
            return TermMatches(TermState.FEW_MATCHES, kernel_px, place=place, found=found)
        factor = self._factor(place, found, information)
        matches = TermMatches(TermState.MATCHED, kernel_px, 0.0, place, found, factor, information, self)
        return replace(matches, made_at=tuple(r for r, _ in self.residuals_of(matches, values)))

    def rows(self, matches: TermMatches, sides: ObjectSides, values: gtsam.Values) -> TermRows:
        """The matches as rows of the linear problem at the values, with the sides that they lie on."""
        place = matches.place
        if matches.factor is None or place is None:
            return TermRows.none()
        scan_ns, wTl = self.features[place.scan].stamp_ns, self._wTl(values, place.between.X_s)
        found, parts = matches.found, []
        near = sides.near(wTl)
        for c, alignment, of_object, numbers, (r, J) in zip(
            found.classes,
            found.alignments,
            found.sides,
            sides.of(scan_ns, found, wTl),
            self.residuals_of(matches, values),
            strict=True,
        ):
            r = r + self.keys.bias(values, c)
            weights = alignment.weights * alignment.kernel.weight(r / alignment.sigmas_px)
            columns = np.zeros((len(r), COLUMNS))
            columns[:, :7], columns[:, bias_column(c)] = J, 1.0
            if c == SemanticClass.OBJECT:
                beams = position_columns(of_object, alignment.sigmas_px, self.config.match)
                columns[:, POSITIONS] = beams[:, :2]
            own = level_sigmas(of_object, alignment.sigmas_px, self.config.match)
            level_px = own if c != SemanticClass.OBJECT else np.zeros(len(own))
            level = replace(LevelEdges.of(alignment, level_px, near), errors=level_px)
            parts.append(TermRows(columns, r, weights, alignment.sigmas_px, numbers, level))
        return TermRows.joined(parts)

    def _wTl(self, values: gtsam.Values, X: int) -> gtsam.Pose3:
        wTb = body_pose(values, X)
        return wTb if self.keys.bTl is None else wTb * self.keys.bTl

    def _factor(self, place: TermPlace, found: FrameAlignments, information: float) -> gtsam.CustomFactor:
        return pose_alignment_factor(
            found.alignments,
            place.between,
            self.keys.cTl,
            self.keys.time_offset_s,
            [self.keys.biases_px.get(c) for c in found.classes],
            gtsam.noiseModel.Isotropic.Sigma(1, information**-0.5),
        )

    def residuals_of(self, matches: TermMatches, values: gtsam.Values) -> list[tuple[FloatArray, FloatArray]]:
        """For each alignment, (rows,) residuals at the values [px] and their Jacobian (rows, 7) by extrinsic
        and offset, the trajectory and the camera's twist held."""
        place = matches.place
        if place is None:
            return []
        cTl, time_offset_s = self.keys.calibration(values)
        between = place.between
        a, b = body_pose(values, between.X_a), body_pose(values, between.X_b)
        c_twist = cTl.AdjointMap() @ self._in_lidar(
            np.asarray(gtsam.Pose3.Logmap(a.between(b))) / between.seconds
        )
        lTs = self._lTs(values, place)
        moved = cTl if lTs is None else cTl * lTs
        late_s = time_offset_s + between.image_after_a_s - 0.5 * between.seconds
        found = []
        for alignment in matches.found.alignments:
            twist = c_twist + late_s * alignment.c_acceleration
            r, J = residuals(alignment, moved, time_offset_s, twist)
            # cTl Exp(d) lTs = cTl lTs Exp(Ad(lTs^-1) d)
            by_cTl = J[:, :6] if lTs is None else J[:, :6] @ lTs.inverse().AdjointMap()
            found.append((r, np.column_stack([by_cTl, J[:, 6]])))
        return found

    def _align(self, values: gtsam.Values, place: TermPlace, kernel_px: float) -> FrameAlignments:
        trajectory, keys = self.keys.trajectory, self.keys
        twist = trajectory.twist(values, place.position)
        assert twist is not None  # place() has looked
        acceleration = trajectory.acceleration(values, place.position)
        between = place.between
        late_s = keys.offset(values) + between.image_after_a_s - 0.5 * between.seconds
        lTs = self._lTs(values, place)
        scan, moving = self.features[place.scan], self.l_velocities[place.scan]
        biases_px = {c: keys.bias(values, c) for c in keys.biases_px}
        calibration = CameraCalibration(self.camera, keys.extrinsic(values), keys.offset(values), biases_px)
        l_twist, l_acceleration = self._in_lidar(twist + late_s * acceleration), self._in_lidar(acceleration)
        from_ns = None if lTs is None else place.stamp_a_ns
        motion = ScanMotion(l_twist, l_acceleration, moving, lTs, from_ns)
        kernel = RobustKernel("geman_mcclure", kernel_px)
        matching = FrameMatching(self.config.classes, kernel, self.config.match)
        return align_frame(scan, self.image, calibration, motion, matching)

    def _in_lidar(self, b_twist: FloatArray) -> FloatArray:
        if self.keys.bTl is None:
            return b_twist
        return np.asarray(self.keys.bTl.inverse().AdjointMap() @ b_twist)

    def _lTs(self, values: gtsam.Values, place: TermPlace) -> gtsam.Pose3 | None:
        """Pose of the scan in the LiDAR's frame at X_a; None where it was taken there."""
        between = place.between
        if between.X_s == between.X_a:
            return None
        aTs = body_pose(values, between.X_a).between(body_pose(values, between.X_s))
        bTl = self.keys.bTl
        return aTs if bTl is None else bTl.inverse() * aTs * bTl
