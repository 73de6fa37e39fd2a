"""Global search for the extrinsic: candidates by label agreement over a grid of rotations.

Labelled points are scored on blurred masks (:mod:`~sst_graph.initialization.label_agreement`); they are
spread evenly over the sphere (a scan's own angular grid), so the score is a cross-correlation of two labelled
panoramas. A grid of rotations is scored on strongly blurred, coarse masks; the best are improved in pose and
time offset by the cross-entropy method (Rubinstein), stage by stage on ever sharper masks.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sst_graph.config import Settings, internal, setting
from sst_graph.factors.camera import PinholeCamera
from sst_graph.initialization.label_agreement import (
    CELLS,
    AgreementMap,
    LabelledPoints,
    LabelScore,
    SearchFrame,
    States,
)
from sst_graph.stepwise import Stepwise
from sst_graph.types import Calibration, FloatArray, Guess, IntArray, SemanticClass

_GRID_STEP = np.radians(7.5)
"""Spacing of the rotation grid over all of SO(3), about half the widest blur's reach [rad]; the cost grows
with its inverse cube."""
_BOX_STEP = np.radians(5.0)
"""Spacing within the box around a guess [rad]."""
_REACH = 1.4
"""Largest angle from a guess to a candidate, in half widths of the box: its corners, at 1.7, are cut off."""
_APART = np.radians(3.0)
"""Candidates closer than this count as one [rad]."""
_NEAR_TRANSLATION_M = 0.1
"""Half width of the translations of the first family of candidates [m]: with less freedom, they are more
robust to bad labels."""
FRAMES = 6
"""Frames that take part: more cost time; scans one after the other show much the same."""
POINTS_PER_CLASS = 250
"""Points of each class and frame that take part: the cost grows with them, the best candidates stay."""
_WITHOUT_GUESS = 4
"""Without a guess so many times more candidates are kept."""
_SCORES: tuple[LabelScore, ...] = ("votes", "dependence")
"""Scores that candidates are found by, each on its own. With one of them a search takes half the time; of 29
drives with bad labels or few objects, votes alone lose one more start without a guess."""


@dataclass(frozen=True)
class SearchConfig(Settings):
    """Whether and where a start is searched.

    Attributes:
        seed: of the sampler; the calibration's.
    """

    enabled: bool = setting(
        True,
        doc="Search globally for an initial extrinsic and time offset. Set to false where the guess "
        "is within a degree and ten centimetres, to save time.",
    )
    rotation_deg: float = setting(
        30.0,
        at_least=0.0,
        at_most=180.0,
        doc="Half width of the rotations searched around a guess. Raise it for a poorer guess, or give none.",
    )
    translation_m: float = setting(
        0.6,
        at_least=0.001,
        at_most=20.0,
        doc="Half width of the translations searched around a guess. Raise it where the guess may be "
        "off by more.",
    )
    free_translation_m: float = setting(
        2.0,
        at_least=0.001,
        at_most=20.0,
        doc="Half width of the translations searched without a guess. Raise it for sensors mounted "
        "farther apart.",
    )
    time_offset_s: float = setting(
        0.5,
        at_least=0.0,
        at_most=5.0,
        doc="Half width of the time offsets searched, by method motion too. Raise it where the clocks "
        "may differ by more.",
    )
    seed: int = internal(0)


@dataclass(frozen=True)
class SearchStage:
    """One stage of the search.

    Attributes:
        blur_px: width of the masks' blur, at an image width of 1242 [px].
        share: of the points that are used.
        candidates: most that are kept.
        samples, rounds: of the cross-entropy method, for each candidate.
    """

    blur_px: float
    share: float
    candidates: int
    samples: int
    rounds: int


COARSE = (SearchStage(45.0, 0.25, 80, samples=16, rounds=1),)
"""Stages for candidates that are then refined by silhouettes, whose convergence covers the rest."""
FINE = (
    SearchStage(45.0, 0.25, 80, samples=64, rounds=4),
    SearchStage(22.0, 0.5, 40, samples=64, rounds=4),
    SearchStage(10.0, 1.0, 20, samples=64, rounds=4),
    SearchStage(4.0, 1.0, 12, samples=64, rounds=4),
)
"""Stages up to the optimum of the label agreement itself."""


@dataclass(frozen=True, eq=False)
class Candidate(Calibration):
    """A calibration with its score per cell of the images (0 chance, higher better)."""

    score: float = 0.0


@dataclass(frozen=True)
class SearchProblem:
    """What is searched.

    Attributes:
        frames: that are looked at.
        camera: of all of them.
        classes: that are compared.
        guess: what is known beforehand; without a pose, rotations are from all of SO(3).
        config: where to search.
    """

    frames: Sequence[SearchFrame]
    camera: PinholeCamera
    classes: Sequence[SemanticClass]
    guess: Guess
    config: SearchConfig

    @property
    def spacing(self) -> float:
        """Step of the grid of rotations [rad]."""
        return float(_GRID_STEP if self.guess.cTl is None else _BOX_STEP)

    def grid(self) -> States:
        """Rotations to begin with, at the guess's translation."""
        rotations, translation = _so3_grid(_GRID_STEP), np.zeros(3)
        if self.guess.cTl is not None:
            box = np.radians(self.config.rotation_deg)
            axis = _BOX_STEP * np.arange(-round(box / _BOX_STEP), round(box / _BOX_STEP) + 1)
            vectors = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
            # Beyond half a turn are the same rotations again.
            vectors = vectors[np.linalg.norm(vectors, axis=1) <= min(_REACH * box, np.pi)]
            rotations = rotation_matrices(vectors) @ np.asarray(self.guess.cTl.rotation().matrix())
            translation = np.asarray(self.guess.cTl.translation(), dtype=np.float64)
        m = len(rotations)
        return States(rotations, np.tile(translation, (m, 1)), np.full(m, self.guess.time_offset_s))

    def in_reach(self, states: States) -> IntArray:
        """Indices of the states whose rotation is in reach of the guess; all of them where none is."""
        every = np.arange(len(states))
        if self.guess.cTl is None:
            return every
        reach = min(_REACH * np.radians(self.config.rotation_deg), np.pi)
        trace = np.einsum("mij,ij->m", states.rotations, np.asarray(self.guess.cTl.rotation().matrix()))
        inside = np.flatnonzero(trace >= 1.0 + 2.0 * np.cos(reach))
        return inside if len(inside) else every


def search_steps(problem: SearchProblem, stages: Sequence[SearchStage]) -> Stepwise[list[Candidate]]:
    """Candidates of several families in turn, best first in each.

    A family is one score with the translation near the guess's, or wherever it may be.

    Raises:
        EstimationError: no frame has a point and a pixel of one of the classes.
    """
    config = problem.config
    rng = np.random.default_rng(config.seed)
    points = LabelledPoints.sampled(problem.frames, problem.camera, problem.classes, POINTS_PER_CLASS, rng)
    yield 5
    free_m = config.free_translation_m if problem.guess.cTl is None else config.translation_m
    families = []
    for score in _SCORES:
        # 1. A grid of rotations on the most blurred masks.
        maps = []
        for stage in stages:
            maps.append(points.agreement_map(stage.blur_px, stage.share, score))
            yield 5
        grid = problem.grid()
        scores = yield from maps[0].score_steps(grid)
        best, _ = _peaks(grid, scores, _kept(stages[0], problem), 1.5 * problem.spacing)
        # 2. The best improved on ever sharper masks.
        for half_width_m in (_NEAR_TRANSLATION_M, free_m):
            region = _Region.of(problem, half_width_m, points.moving)
            families.append(
                (yield from _improve_steps(best, list(zip(stages, maps, strict=True)), problem, region, rng))
            )
    found = [c for several in itertools.zip_longest(*families) for c in several if c is not None]
    cells = len(problem.frames) * CELLS[0] * CELLS[1]
    return [replace(candidate, score=candidate.score / cells) for candidate in found]


def _kept(stage: SearchStage, problem: SearchProblem) -> int:
    return stage.candidates * (_WITHOUT_GUESS if problem.guess.cTl is None else 1)


def _improve_steps(
    best: States,
    stages: Sequence[tuple[SearchStage, AgreementMap]],
    problem: SearchProblem,
    region: _Region,
    rng: np.random.Generator,
) -> Stepwise[list[Candidate]]:
    """Candidates after all stages, the best first, with their plain scores."""
    scores = np.zeros(len(best))
    for number, (stage, agreement) in enumerate(stages):
        scale = region.scale * (stage.blur_px / stages[0][0].blur_px) ** 0.7
        moved = yield from _cross_entropy_steps(agreement, best, scale, region, stage, rng)
        near = moved.take(problem.in_reach(moved))
        found = yield from agreement.score_steps(near)
        following = stages[min(number + 1, len(stages) - 1)][0]
        best, scores = _peaks(near, found, _kept(following, problem), _APART)
    scored = zip(best.calibrations, scores.tolist(), strict=True)
    return [Candidate(**vars(calibration), score=score) for calibration, score in scored]


def _so3_grid(step: float) -> FloatArray:
    """Rotations that cover SO(3) evenly at about a spacing [rad]: super-Fibonacci (Alexa, CVPR 2022)."""
    n = int(8.0 * np.pi**2 / step**3)
    i = np.arange(n) + 0.5
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    r, big_r = np.sqrt(i / n), np.sqrt(1.0 - i / n)
    alpha, beta = 2.0 * np.pi * i / phi, 2.0 * np.pi * i / psi
    x, y, z, w = r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def rotation_matrices(vectors: FloatArray) -> FloatArray:
    """(m, 3, 3) rotation matrices of rotation vectors (m, 3) [rad] (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    K = np.zeros((len(vectors), 3, 3))
    K[:, 2, 1], K[:, 0, 2], K[:, 1, 0] = vectors.T
    K[:, 1, 2], K[:, 2, 0], K[:, 0, 1] = -vectors.T
    return np.asarray(np.eye(3) + a[:, None, None] * K + b[:, None, None] * (K @ K))


@dataclass(frozen=True)
class _Region:
    """Box that translations [m] and time offsets [s] stay in.

    Attributes:
        translation, time_offset_s: its centre.
        half_width_m, half_width_s: half its width.
        scale: (7,) standard deviations of the first samples: rotation vector, translation, offset.
    """

    translation: FloatArray
    time_offset_s: float
    half_width_m: float
    half_width_s: float
    scale: FloatArray

    @classmethod
    def of(cls, problem: SearchProblem, half_width_m: float, moving: bool) -> _Region:
        """Around a problem's guess; the time offset is sampled where something moves."""
        cTl, time_offset_s = problem.guess.cTl, problem.guess.time_offset_s
        translation = np.zeros(3) if cTl is None else np.asarray(cTl.translation())
        half_width_s = problem.config.time_offset_s
        scale = [problem.spacing] * 3 + [0.5 * half_width_m] * 3 + [0.5 * half_width_s * moving]
        return cls(translation, time_offset_s, half_width_m, half_width_s, np.array(scale))

    def clip(self, states: States) -> States:
        return States(
            states.rotations,
            self.translation
            + np.clip(states.translations - self.translation, -self.half_width_m, self.half_width_m),
            self.time_offset_s
            + np.clip(states.offsets - self.time_offset_s, -self.half_width_s, self.half_width_s),
        )


_PEAKS_AT_ONCE = 512
"""States that are compared with the chosen ones at once."""


def _peaks(states: States, scores: FloatArray, count: int, apart_rad: float) -> tuple[States, FloatArray]:
    """The best ``count`` states, no two closer in rotation than ``apart_rad``, and their scores."""
    chosen: list[int] = []
    order = np.argsort(-scores, kind="stable")
    flat = states.rotations.reshape(len(scores), 9)
    largest_trace = 1.0 + 2.0 * np.cos(apart_rad)
    # In batches from the best down: the first one mostly has enough.
    for start in range(0, len(order), _PEAKS_AT_ONCE):
        remaining = order[start : start + _PEAKS_AT_ONCE]
        near = flat[remaining] @ flat[chosen].T >= largest_trace
        remaining = remaining[~near.any(axis=1)]
        while len(remaining) and len(chosen) < count:
            best = remaining[0]
            chosen.append(int(best))
            remaining = remaining[flat[remaining] @ flat[best] < largest_trace]
        if len(chosen) == count:
            break
    index = np.array(chosen, dtype=np.intp)
    return states.take(index), scores[index]


def _cross_entropy_steps(
    agreement: AgreementMap,
    states: States,
    scale: FloatArray,
    region: _Region,
    stage: SearchStage,
    rng: np.random.Generator,
) -> Stepwise[States]:
    """Each state moved to a better one nearby, sorted by score."""
    elite = max(4, stage.samples // 8)
    m, n = len(states), stage.samples
    sigmas = np.tile(scale, (m, 1))
    incumbent, scores = states, (yield from agreement.score_steps(states))
    for _ in range(stage.rounds):
        delta = rng.standard_normal((m, n, 7)) * sigmas[:, None, :]
        delta[:, 0] = 0.0
        samples = region.clip(_perturbed(incumbent, delta))
        values = (yield from agreement.score_steps(samples)).reshape(m, n)
        order = np.argsort(-values, axis=1, kind="stable")[:, :elite]
        chosen = np.take_along_axis(delta, order[:, :, None], axis=1)
        mean = region.clip(_perturbed(incumbent, chosen.mean(axis=1, keepdims=True)))
        mean_scores = yield from agreement.score_steps(mean)
        top = samples.take(np.arange(m) * n + order[:, 0])
        top_scores = np.take_along_axis(values, order[:, :1], axis=1)[:, 0]
        use_mean = mean_scores >= top_scores
        incumbent = States(
            np.where(use_mean[:, None, None], mean.rotations, top.rotations),
            np.where(use_mean[:, None], mean.translations, top.translations),
            np.where(use_mean, mean.offsets, top.offsets),
        )
        scores = np.where(use_mean, mean_scores, top_scores)
        sigmas = np.maximum(chosen.std(axis=1), 0.25 * sigmas)
    return incumbent.take(np.argsort(-scores, kind="stable"))


def _perturbed(states: States, delta: FloatArray) -> States:
    """(m * n) states: camera-side rotation vector, translation and offset steps delta (m, n, 7)."""
    m, n, _ = delta.shape
    turn = rotation_matrices(delta[..., :3].reshape(-1, 3)).reshape(m, n, 3, 3)
    rotations = turn @ states.rotations[:, None]
    translations = states.translations[:, None] + delta[..., 3:6]
    offsets = states.offsets[:, None] + delta[..., 6]
    return States(rotations.reshape(-1, 3, 3), translations.reshape(-1, 3), offsets.reshape(-1))
