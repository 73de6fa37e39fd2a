"""Votes of labelled points for a pose: log-likelihood ratios of their classes on blurred masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.errors import EstimationError
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
IntArray = NDArray[np.intp]

CELLS = (10, 32)
"""Rows and columns of the cells of an image whose votes share one voice."""

_DOUBT = 0.1
"""Share of labels that are no better than chance: a vote against a pose is never below its logarithm."""
_BATCH_POINTS = 400_000


@dataclass(frozen=True)
class SearchFrame:
    """One scan and its image, as the search sees them.

    Attributes:
        lPs: (n, 3) points [m].
        classes: (n,) uint8 of SemanticClass; points of a class that is not searched count as the rest.
        mask: (h, w) uint8 of SemanticClass.
        base_tau_s: image stamp minus scan stamp [s].
        c_twist: (6,) camera twist [rad/s, m/s] under the guess, or l_twist where there is none.
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

    def take(self, index: IntArray | slice) -> States:
        return States(self.rotations[index], self.translations[index], self.offsets[index])

    def __len__(self) -> int:
        return len(self.offsets)


@dataclass(frozen=True)
class Level:
    """Log-likelihood ratios of all frames at one blur, ready to be looked up."""

    camera: PinholeCamera
    lPs: Float32
    starts: IntArray
    frame_of: IntArray
    twists: FloatArray
    base_taus: FloatArray
    tables: Float32
    weights: Float32
    shrink: float
    shape: tuple[int, int]

    @property
    def voice(self) -> float:
        """Weight of the votes that give a cell half a voice."""
        return 0.5 * float(self.weights.mean())

    def score(self, states: States) -> FloatArray:
        """(m,) scores of poses."""
        chunk = max(1, _BATCH_POINTS // max(1, len(self.lPs)))
        scores = [
            self._score(states.take(slice(start, start + chunk))) for start in range(0, len(states), chunk)
        ]
        return np.concatenate(scores)

    def _score(self, states: States) -> FloatArray:
        camera, shrink = self.camera, self.shrink
        R = states.rotations.astype(np.float32)
        lPs = self._moved(states)
        X, Y, Z = (
            (lPs @ R[:, row, :, None])[..., 0] + states.translations[:, row, None].astype(np.float32)
            for row in range(3)
        )
        front = Z > 0.5
        inverse = 1.0 / np.where(front, Z, 1.0)
        u = (camera.fx * X * inverse + (camera.cx + 0.5)) / shrink
        v = (camera.fy * Y * inverse + (camera.cy + 0.5)) / shrink
        rows, cols = self.shape
        inside = front & (u >= 0) & (u < cols) & (v >= 0) & (v < rows)
        index = np.where(inside, v, 0).astype(np.intp) * cols + np.where(inside, u, 0).astype(np.intp)
        votes = np.where(inside, self.tables[self.starts + index], 0.0)
        shares = self._shares(u.astype(np.float32), v.astype(np.float32), inside)
        return np.asarray((votes * shares).sum(axis=1), dtype=np.float64)

    def _shares(self, u: Float32, v: Float32, inside: NDArray[np.bool_]) -> Float32:
        """(m, n) weight of each vote: the votes of one cell of one image share one voice.

        Without this a pose gains by crowding all points into one large mask.
        """
        rows, cols = self.shape
        down, across = CELLS
        cell = (v * (down / rows)).astype(np.intp) * across + (u * (across / cols)).astype(np.intp)
        frames = len(self.base_taus)
        cell = np.where(inside, cell + self.frame_of * (down * across), frames * down * across)
        size = frames * down * across + 1
        flat = (cell + np.arange(len(cell))[:, None] * size).reshape(-1)
        weights = np.broadcast_to(self.weights, cell.shape).reshape(-1)
        crowd = np.bincount(flat, weights, len(cell) * size)[flat].reshape(cell.shape)
        return np.asarray(self.weights / (self.voice + crowd), dtype=np.float32)

    def _moved(self, states: States) -> Float32:
        """(m, n, 3) points in the LiDAR frame, moved to their image's instant (first order)."""
        taus = states.offsets[:, None] + self.base_taus
        omega = self.twists[self.frame_of, :3].astype(np.float32)
        v = self.twists[self.frame_of, 3:].astype(np.float32)
        velocity = np.cross(omega, self.lPs) + v
        if not velocity.any():
            return self.lPs[None]
        return np.asarray(self.lPs - taus[:, self.frame_of, None].astype(np.float32) * velocity)


@dataclass(frozen=True)
class Votes:
    """Sampled points of all frames and the masks they vote on."""

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
    def gather(
        cls,
        frames: Sequence[SearchFrame],
        camera: PinholeCamera,
        classes: Sequence[SemanticClass],
        points_per_class: int,
        rng: np.random.Generator,
    ) -> Votes:
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

    def level(self, blur_px: float, share: float) -> Level:
        """A share of the votes, on masks blurred by a width [px at 1242 px image width]."""
        some = np.arange(len(self.lPs)) % round(1.0 / share) == 0
        blur = blur_px * self.camera.width / 1242.0
        shrink = max(1.0, blur / 3.0)
        size = (max(8, round(self.camera.width / shrink)), max(8, round(self.camera.height / shrink)))
        shrink = self.camera.width / size[0]
        tables = [_vote_tables(frame.mask, self.classes, size, blur / shrink) for frame in self.frames]
        channels = len(self.classes) + 1
        starts = (self.frame_of * channels + self.class_of) * (size[0] * size[1])
        return Level(
            self.camera,
            self.lPs[some],
            starts[some].astype(np.intp),
            self.frame_of[some],
            np.stack([frame.l_twist for frame in self.frames]),
            np.array([frame.base_tau_s for frame in self.frames]),
            np.concatenate([table.reshape(-1) for table in tables]),
            self.weights[some],
            shrink,
            (size[1], size[0]),
        )


def _channels(labels: NDArray[np.uint8], classes: Sequence[SemanticClass]) -> IntArray:
    """Number of the searched class, len(classes) for the rest, -1 for IGNORE."""
    table = np.full(256, len(classes), dtype=np.intp)
    table[SemanticClass.IGNORE] = -1
    for number, c in enumerate(classes):
        table[c] = number
    return np.asarray(table[labels])


def _vote_tables(
    mask: NDArray[np.uint8], classes: Sequence[SemanticClass], size: tuple[int, int], blur: float
) -> Float32:
    """(classes + 1, h, w) log-likelihood ratios of each class on a shrunk, blurred mask."""
    channel = _channels(mask, classes)
    known = cv2.resize((channel >= 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    known = cv2.GaussianBlur(known, (0, 0), max(blur, 0.3), borderType=cv2.BORDER_REPLICATE)
    tables = []
    for c in range(len(classes) + 1):
        share = cv2.resize((channel == c).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        share = cv2.GaussianBlur(share, (0, 0), max(blur, 0.3), borderType=cv2.BORDER_REPLICATE)
        prior = float(share.mean() / max(float(known.mean()), 1e-6))
        p = np.where(known > 0.05, share / np.maximum(known, 0.05), prior)
        prior = max(prior, 0.02)
        votes = np.log(_DOUBT + (1.0 - _DOUBT) * p / prior)
        # Background on background is no evidence: a pose must not gain by seeing more of it.
        tables.append(np.minimum(votes, 0.0) if c == len(classes) else votes)
    return np.stack(tables).astype(np.float32)
