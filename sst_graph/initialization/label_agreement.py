"""Agreement of labelled points with blurred masks under a pose, by two scores that fail in different cases.

*Votes* adds log-likelihood ratios of each point's class at its pixel. It is sharp, but prefers poses that
bring many points of a class onto a large mask. *Dependence* is the likelihood-ratio statistic (G-test) of
the table of point class against mask class over what the image shows: a pose under which only one class is in
view scores 0, however well it fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import EstimationError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.stepwise import Stepwise
from sst_graph.types import Calibration, FloatArray, IntArray, SemanticClass

Float32 = NDArray[np.float32]

CELLS = (10, 32)
"""Rows and columns of the cells of an image; the votes of a cell share one weight."""

_WRONG_LABELS = 0.1
"""Share of labels that are no better than chance: a vote against a pose is never below its logarithm."""
_STEP_POINTS = 400_000
"""Points, times poses, that are projected in a step."""
_BATCH_POINTS = 100_000
"""Points, times poses, that are projected at once: arrays fit into a core's cache, and products are small
enough that BLAS, where it may use several threads, takes one. Both make a step several times faster."""


@dataclass(frozen=True)
class SearchFrame:
    """One scan and its image, with the data that the search needs.

    Attributes:
        lPs: (n, 3) points [m].
        classes: (n,) uint8 of SemanticClass; points of a class that is not searched count as the rest.
        mask: (h, w) uint8 of SemanticClass.
        base_tau_s: image stamp minus scan stamp [s].
        l_twist: (6,) LiDAR twist at the image's instant under the guessed time offset; 0 without odometry
            [rad/s, m/s].
    """

    lPs: FloatArray
    classes: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    base_tau_s: float
    l_twist: FloatArray


@dataclass(frozen=True)
class States:
    """Poses as rotations (m, 3, 3) and translations (m, 3) [m], with offsets (m,) [s]."""

    rotations: FloatArray
    translations: FloatArray
    offsets: FloatArray

    def take(self, index: IntArray | slice) -> Self:
        """Some of them, by position."""
        return type(self)(*(column[index] for column in vars(self).values()))

    def __len__(self) -> int:
        return len(self.offsets)

    @property
    def calibrations(self) -> list[Calibration]:
        """As single ones."""
        return [
            Calibration(gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t), float(offset))
            for R, t, offset in zip(self.rotations, self.translations, self.offsets, strict=True)
        ]


LabelScore = Literal["votes", "dependence"]


@dataclass(frozen=True)
class AgreementMap:
    """All points and masks at one blur: what scores poses.

    Attributes:
        camera: of the images at full size.
        lPs: (n, 3) points at their image's instant when the time offset is 0 [m].
        velocities: (n, 3) of the LiDAR past each point, minus the velocity that it sees the point move with
            [m/s]; first order in the offset.
        starts: (n,) where the table of the point's frame and class begins in ``tables``.
        cells: (rows * columns,) cell of a pixel within its image.
        first_cells: (n,) number of the first cell of the point's image.
        tables: of all frames and classes: log-likelihood ratios for votes, shares for dependence.
        weights: (n,) of the votes.
        classes: (n,) number of each point's class; ``class_count`` for the rest.
        class_count: classes that are searched.
        cell_count: cells of all images.
        shrink, shape: the tables are so many times smaller than the images; their rows and columns.
        kind: which score.
    """

    camera: PinholeCamera
    lPs: Float32
    velocities: Float32
    starts: IntArray
    cells: IntArray
    first_cells: IntArray
    tables: Float32
    weights: Float32
    classes: IntArray
    class_count: int
    cell_count: int
    shrink: float
    shape: tuple[int, int]
    kind: LabelScore

    def score_steps(self, states: States) -> Stepwise[FloatArray]:
        """(m,) scores of poses, some of them a step."""
        step, batch = (max(1, most // max(1, len(self.lPs))) for most in (_STEP_POINTS, _BATCH_POINTS))
        scores = []
        for first in range(0, len(states), step):
            some = states.take(slice(first, first + step))
            scores += [
                self._score(some.take(slice(start, start + batch))) for start in range(0, len(some), batch)
            ]
            yield 2
        return np.concatenate(scores)

    def _score(self, states: States) -> FloatArray:
        """The votes of one cell of one image share one weight.

        Without this a pose gains by crowding all points into one large mask. A single mean vote gives a cell
        two thirds of its full weight.
        """
        state, point, pixel = self._in_image(states)
        weights = self.weights[point]
        cell = state * self.cell_count + self.first_cells[point] + self.cells[pixel]
        in_cell = np.bincount(cell, weights, len(states) * self.cell_count)[cell]
        weights = weights / (0.5 * float(self.weights.mean()) + in_cell)
        first = self.starts[point] + pixel
        if self.kind == "dependence":
            return self._dependence(state, point, first, weights, len(states))
        votes = self.tables[first + self.classes[point] * self._size]
        return np.bincount(state, votes * weights, len(states)).astype(np.float64, copy=False)

    def _dependence(
        self, state: IntArray, point: IntArray, first: IntArray, weights: FloatArray, states: int
    ) -> FloatArray:
        """(states,) sum over the classes of the signed G statistic of (is the class, shows the class)."""
        total = np.zeros(states)
        for c in range(self.class_count):
            share = self.tables[first + c * self._size]
            own = self.classes[point] == c
            hit = weights * share
            sums = [np.bincount(state, w, states) for w in (hit * own, weights * own, hit, weights)]
            total += _g_statistic(*(part.astype(np.float64, copy=False) for part in sums))
        return total

    @property
    def _size(self) -> int:
        return self.shape[0] * self.shape[1]

    def _in_image(self, states: States) -> tuple[IntArray, IntArray, IntArray]:
        """State, point and pixel of the shrunk mask of every projection that falls into its image."""
        camera, shrink = self.camera, np.float32(self.shrink)
        R = states.rotations.astype(np.float32)
        t = states.translations.astype(np.float32)
        X, Y, Z = (R[:, row] @ self.lPs.T + t[:, row, None] for row in range(3))
        if self.velocities.any():
            late = states.offsets.astype(np.float32)[:, None]
            for row, axis in enumerate((X, Y, Z)):
                axis -= late * (R[:, row] @ self.velocities.T)
        half_x, half_y = self.camera.cx + 0.5, self.camera.cy + 0.5
        rows, cols = self.shape
        ahead = np.flatnonzero((Z > 0.5) & (np.abs(X) < Z * _reach(half_x, camera.width, camera.fx)))
        inverse = 1.0 / Z.ravel()[ahead]
        u = (np.float32(camera.fx) * X.ravel()[ahead] * inverse + np.float32(half_x)) / shrink
        v = (np.float32(camera.fy) * Y.ravel()[ahead] * inverse + np.float32(half_y)) / shrink
        inside = np.flatnonzero((u >= 0) & (u < cols) & (v >= 0) & (v < rows))
        pixel = v[inside].astype(np.intp) * cols + u[inside].astype(np.intp)
        state, point = np.divmod(ahead[inside], len(self.lPs))
        return state, point, pixel


def _g_statistic(both: FloatArray, rows: FloatArray, columns: FloatArray, total: FloatArray) -> FloatArray:
    """Likelihood-ratio statistic of 2x2 tables with margins; negative where the two avoid each other."""
    tiny = 1e-9
    score = np.zeros_like(total)
    for count, row, column in (
        (both, rows, columns),
        (rows - both, rows, total - columns),
        (columns - both, total - rows, columns),
        (total - rows - columns + both, total - rows, total - columns),
    ):
        safe = np.maximum(count, tiny)
        score += safe * np.log(safe * np.maximum(total, tiny) / np.maximum(row * column, tiny))
    return np.where(both * total > rows * columns, score, -score)


def _reach(centre: float, width: int, focal: float) -> np.float32:
    """Largest |X| / Z that an image shows."""
    return np.float32(max(centre, width - centre) / focal)


@dataclass(frozen=True)
class LabelledPoints:
    """Sampled points of all frames, and the masks that they are compared with.

    Attributes:
        camera: of the images.
        frames: that the points are from.
        classes: that are searched.
        lPs: (n, 3) points [m].
        frame_of: (n,) number of each point's frame.
        class_of: (n,) number of its class; ``len(classes)`` for the rest.
        weights: (n,) of its vote.
    """

    camera: PinholeCamera
    frames: Sequence[SearchFrame]
    classes: Sequence[SemanticClass]
    lPs: Float32
    frame_of: IntArray
    class_of: IntArray
    weights: Float32

    @property
    def moving(self) -> bool:
        """Whether the motion is fast enough for the time offset to matter."""
        return any(float(np.linalg.norm(frame.l_twist[3:])) > 0.3 for frame in self.frames)

    @classmethod
    def sampled(
        cls,
        frames: Sequence[SearchFrame],
        camera: PinholeCamera,
        classes: Sequence[SemanticClass],
        points_per_class: int,
        rng: np.random.Generator,
    ) -> LabelledPoints:
        lPs, frame_of, class_of, weights = [], [], [], []
        for number, frame in enumerate(frames):
            channel = _channels(frame.classes, classes)
            for c in range(len(classes) + 1):
                members = np.flatnonzero(channel == c)
                if len(members) == 0:
                    continue
                chosen = rng.permutation(members)[:points_per_class]
                lPs.append(frame.lPs[chosen])
                frame_of.append(np.full(len(chosen), number))
                class_of.append(np.full(len(chosen), c))
                weights.append(np.full(len(chosen), (len(members) / len(chosen)) ** 0.25))
        if not lPs or all(bool((c == len(classes)).all()) for c in class_of):
            raise EstimationError("no labelled point of a searched class in any frame")
        return cls(
            camera,
            frames,
            classes,
            np.concatenate(lPs).astype(np.float32),
            np.concatenate(frame_of),
            np.concatenate(class_of),
            np.concatenate(weights).astype(np.float32),
        )

    def agreement_map(self, blur_px: float, share: float, kind: LabelScore = "votes") -> AgreementMap:
        """A share of the points, on masks blurred by a width [px at 1242 px image width]."""
        some = np.arange(len(self.lPs)) % round(1.0 / share) == 0
        blur = blur_px * self.camera.width / 1242.0
        shrink = max(1.0, blur / 3.0)
        size = (max(8, round(self.camera.width / shrink)), max(8, round(self.camera.height / shrink)))
        shrink = self.camera.width / size[0]
        table_of = _vote_tables if kind == "votes" else _share_tables
        tables = [table_of(frame.mask, self.classes, size, blur / shrink) for frame in self.frames]
        starts = self.frame_of * ((len(self.classes) + 1) * size[0] * size[1])
        velocities = self._velocities()
        taus = np.array([frame.base_tau_s for frame in self.frames])[self.frame_of, None]
        down, across = (np.arange(n) * c // n for n, c in zip(size[::-1], CELLS, strict=True))
        return AgreementMap(
            self.camera,
            (self.lPs - taus * velocities)[some].astype(np.float32),
            velocities[some].astype(np.float32),
            starts[some].astype(np.intp),
            (down[:, None] * CELLS[1] + across).ravel(),
            self.frame_of[some].astype(np.intp) * (CELLS[0] * CELLS[1]),
            np.concatenate([table.reshape(-1) for table in tables]),
            self.weights[some],
            self.class_of[some].astype(np.intp),
            len(self.classes),
            len(self.frames) * CELLS[0] * CELLS[1],
            shrink,
            (size[1], size[0]),
            kind,
        )

    def _velocities(self) -> FloatArray:
        """(n, 3) as ``velocities`` of :class:`AgreementMap`: omega x p + v."""
        twists = np.stack([frame.l_twist for frame in self.frames])[self.frame_of]
        return np.cross(twists[:, :3], self.lPs) + twists[:, 3:]


def _channels(labels: NDArray[np.uint8], classes: Sequence[SemanticClass]) -> IntArray:
    """Number of the searched class, len(classes) for the rest, -1 for IGNORE."""
    table = np.full(256, len(classes), dtype=np.intp)
    table[SemanticClass.IGNORE] = -1
    for number, c in enumerate(classes):
        table[c] = number
    return np.asarray(table[labels])


def _share_tables(
    mask: NDArray[np.uint8], classes: Sequence[SemanticClass], size: tuple[int, int], blur: float
) -> Float32:
    """(classes + 1, h, w) share of each class, of the rest last, on a shrunk, blurred mask."""
    channel = _channels(mask, classes)
    known = _blurred(channel >= 0, size, blur)
    shares = []
    for c in range(len(classes) + 1):
        share = _blurred(channel == c, size, blur)
        mean = float(share.mean() / max(float(known.mean()), 1e-6))
        shares.append(np.where(known > 0.05, share / np.maximum(known, 0.05), mean))
    return np.stack(shares).astype(np.float32)


def _blurred(inside: NDArray[np.bool_], size: tuple[int, int], blur: float) -> Float32:
    small = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(
        cv2.GaussianBlur(small, (0, 0), max(blur, 0.3), borderType=cv2.BORDER_REPLICATE), np.float32
    )


def _vote_tables(
    mask: NDArray[np.uint8], classes: Sequence[SemanticClass], size: tuple[int, int], blur: float
) -> Float32:
    """(classes + 1, h, w) log-likelihood ratios of each class on a shrunk, blurred mask."""
    tables = []
    for c, p in enumerate(_share_tables(mask, classes, size, blur)):
        votes = np.log(_WRONG_LABELS + (1.0 - _WRONG_LABELS) * p / max(float(p.mean()), 0.02))
        # Background on background is no evidence: a pose must not gain by seeing more of it.
        tables.append(np.minimum(votes, 0.0) if c == len(classes) else votes)
    return np.stack(tables).astype(np.float32)
