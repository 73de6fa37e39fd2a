"""Global search for the extrinsic: no local step before a start that sees the whole problem.

Labelled points are scored on blurred masks (:mod:`~sst_graph.initialization.label_agreement`); they are
spread evenly over the sphere (a scan's own angular grid), so the score is a cross-correlation of two labelled
panoramas. A grid of rotations is scored on strongly blurred, coarse masks; the best are refined in pose and
time offset by the cross-entropy method on ever sharper ones.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.errors import ConfigError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.initialization.label_agreement import CELLS, Judge, Level, SearchFrame, States, Votes
from sst_graph.stepwise import Stepwise, whole
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_MOST_STEPS = 40
"""Widest box in steps to either side: (2 * 40 + 1)^3 rotations take a second a score, and 100 MB."""


@dataclass(frozen=True)
class SearchConfig(Settings):
    """How the start is searched.

    Attributes:
        frames: most frames that take part.
        points_per_class: most points of a class in one frame.
        grid_step_deg: spacing of the rotation grid over all of SO(3) [deg].
        box_deg: half width of the box of rotation vectors around a guess [deg].
        box_step_deg: spacing within the box [deg].
        reach_deg: largest angle from a guess to an answer [deg].
        apart_deg: candidates closer than this count as one [deg].
        held_translation_m: half width of the translations while they are held near the guess [m].
        translation_m: half width of the translations around a guess [m].
        free_translation_m: half width of the translations without a guess [m].
        delay_s: half width of the time offsets [s].
        blurs_px: widths of the mask's blur, coarse to fine, at an image width of 1242 [px].
        judges: scores that candidates are found by, each on its own.
        candidates: poses refined at the first, second, ... blur.
        free_breadth: so many times more of them where nothing is known.
        shares: share of the points that votes at the first, second, ... blur.
        population, rounds: samples and rounds of the cross-entropy method at each blur.
        seed: of the sampler.
    """

    frames: int = setting(6, at_least=1, at_most=50)
    points_per_class: int = setting(250, at_least=1, at_most=5000)
    grid_step_deg: float = setting(7.5, at_least=3.0, at_most=60.0)
    box_deg: float = setting(30.0, at_least=0.0, at_most=180.0)
    box_step_deg: float = setting(5.0, at_least=0.5, at_most=60.0)
    reach_deg: float = setting(42.0, at_least=0.0, at_most=180.0)
    apart_deg: float = setting(3.0, at_least=0.1, at_most=180.0)
    held_translation_m: float = setting(0.1, at_least=0.0, at_most=20.0)
    translation_m: float = setting(0.6, at_least=0.001, at_most=20.0)
    free_translation_m: float = setting(2.0, at_least=0.001, at_most=20.0)
    delay_s: float = setting(0.5, at_least=0.0, at_most=5.0)
    blurs_px: tuple[float, ...] = setting(
        (45.0, 22.0, 10.0, 4.0), at_least=0.5, at_most=500.0, length=(1, 10)
    )
    judges: tuple[Judge, ...] = setting(("votes", "dependence"), length=(1, 2))
    candidates: tuple[int, ...] = setting((80, 40, 20, 12), at_least=1, at_most=2000, length=(1, 10))
    free_breadth: int = setting(4, at_least=1, at_most=20)
    shares: tuple[float, ...] = setting((0.25, 0.5, 1.0, 1.0), at_least=0.001, at_most=1.0, length=(1, 10))
    population: int = setting(64, at_least=1, at_most=1000)
    rounds: int = setting(4, at_least=0, at_most=50)
    seed: int = setting(0, at_least=0, at_most=10**15)

    def __post_init__(self) -> None:
        blurs, shares = len(self.blurs_px), len(self.shares)
        if blurs != shares:
            raise ConfigError(f"blurs_px: found {blurs} of them, expected {shares}, as many as shares")
        self.expect_at_most("box_deg", _MOST_STEPS * self.box_step_deg, f"{_MOST_STEPS} box_step_deg")


@dataclass(frozen=True)
class Candidate:
    """A pose and time offset with its score per cell of the images (0 chance, higher better)."""

    cTl: gtsam.Pose3
    offset_s: float
    score: float


def search_start(
    frames: Sequence[SearchFrame],
    camera: PinholeCamera,
    classes: Sequence[SemanticClass],
    guess: gtsam.Pose3 | None,
    offset_s: float = 0.0,
    config: SearchConfig | None = None,
) -> list[Candidate]:
    """All steps of :func:`searching_start`."""
    return whole(searching_start(frames, camera, classes, guess, offset_s, config))


def searching_start(
    frames: Sequence[SearchFrame],
    camera: PinholeCamera,
    classes: Sequence[SemanticClass],
    guess: gtsam.Pose3 | None,
    offset_s: float = 0.0,
    config: SearchConfig | None = None,
) -> Stepwise[list[Candidate]]:
    """Refined candidates of several families in turn, best first in each.

    A family is one score with the translation held or free.

    Args:
        guess: a rough pose, or None when nothing is known: rotations from all of SO(3).

    Raises:
        EstimationError: no frame has a point and a pixel of one of the classes.
    """
    config = config or SearchConfig()
    rng = np.random.default_rng(config.seed)
    votes = Votes.gather(frames, camera, classes, config.points_per_class, rng)
    yield 5
    families = []
    for judge in config.judges:
        levels = []
        for blur_px, share in zip(config.blurs_px, config.shares, strict=True):
            levels.append(votes.level(blur_px, share, judge))
            yield 5
        families += yield from _families(levels, guess, offset_s, votes.moving, config, rng)
    found = [c for several in itertools.zip_longest(*families) for c in several if c is not None]
    cells = len(frames) * CELLS[0] * CELLS[1]
    return [replace(candidate, score=candidate.score / cells) for candidate in found]


def _families(
    levels: Sequence[Level],
    guess: gtsam.Pose3 | None,
    offset_s: float,
    moving: bool,
    config: SearchConfig,
    rng: np.random.Generator,
) -> Stepwise[list[list[Candidate]]]:
    """Candidates under one score: with the translation held near the guess, and free."""
    # 1. A grid of rotations on the most blurred masks.
    rotations, translation = _grid(guess, config)
    states = States(rotations, np.tile(translation, (len(rotations), 1)), np.full(len(rotations), offset_s))
    breadth = config.free_breadth if guess is None else 1
    apart = np.radians(config.grid_step_deg if guess is None else config.box_step_deg)
    scores = yield from levels[0].scoring(states)
    best, _ = _peaks(states, scores, breadth * config.candidates[0], 1.5 * apart)
    # 2. Refined at every blur, fewer surviving each: with the translation held near the guess, and free.
    #    The first is hard to mislead, for it has less to give way with; the second reaches farther.
    spread_r = np.radians(config.grid_step_deg if guess is None else config.box_step_deg)
    free_t = config.free_translation_m if guess is None else config.translation_m
    families = []
    for spread_t in (config.held_translation_m, free_t):
        scale = np.array([spread_r] * 3 + [0.5 * spread_t] * 3 + [0.5 * config.delay_s * moving])
        limits = _Limits(translation, spread_t, offset_s, config.delay_s)
        families.append((yield from _refined(best, levels, guess, scale, limits, config, rng)))
    return families


def _refined(
    best: States,
    levels: Sequence[Level],
    guess: gtsam.Pose3 | None,
    scale: FloatArray,
    limits: _Limits,
    config: SearchConfig,
    rng: np.random.Generator,
) -> Stepwise[list[Candidate]]:
    """Candidates after all blurs, the best first, with their plain scores."""
    breadth = config.free_breadth if guess is None else 1
    scores = np.zeros(len(best))
    for number, (level, blur) in enumerate(zip(levels, config.blurs_px, strict=True)):
        shrunk = scale * (blur / config.blurs_px[0]) ** 0.7
        moved = yield from _cross_entropy(level, best, shrunk, limits, config, rng)
        near = moved.take(_within(moved, guess, np.radians(config.reach_deg)))
        keep = breadth * config.candidates[min(number + 1, len(config.candidates) - 1)]
        found = yield from level.scoring(near)
        best, scores = _peaks(near, found, keep, np.radians(config.apart_deg))
    return [
        Candidate(gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t), float(offset), float(score))
        for R, t, offset, score in zip(best.rotations, best.translations, best.offsets, scores, strict=True)
    ]


def _grid(guess: gtsam.Pose3 | None, config: SearchConfig) -> tuple[FloatArray, FloatArray]:
    """Rotations (m, 3, 3) to begin with, and the translation they share."""
    if guess is None:
        return _so3_grid(np.radians(config.grid_step_deg)), np.zeros(3)
    n = round(config.box_deg / config.box_step_deg)
    axis = np.radians(config.box_step_deg) * np.arange(-n, n + 1)
    vectors = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= np.radians(config.reach_deg)]
    rotations = rotation_matrices(vectors) @ np.asarray(guess.rotation().matrix())
    return rotations, np.asarray(guess.translation(), dtype=np.float64)


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
class _Limits:
    """Box that translations [m] and time offsets [s] stay in."""

    translation: FloatArray
    half_width_m: float
    offset_s: float
    half_width_s: float

    def clip(self, states: States) -> States:
        return States(
            states.rotations,
            self.translation
            + np.clip(states.translations - self.translation, -self.half_width_m, self.half_width_m),
            self.offset_s + np.clip(states.offsets - self.offset_s, -self.half_width_s, self.half_width_s),
        )


def _within(states: States, guess: gtsam.Pose3 | None, reach_rad: float) -> IntArray:
    """Indices of the states whose rotation is in reach of the guess; all of them where none is."""
    if guess is None:
        return np.arange(len(states))
    trace = np.einsum("mij,ij->m", states.rotations, np.asarray(guess.rotation().matrix()))
    inside = np.flatnonzero(trace >= 1.0 + 2.0 * np.cos(reach_rad))
    return inside if len(inside) else np.arange(len(states))


_PEAKS_AT_ONCE = 512


def _peaks(states: States, scores: FloatArray, count: int, apart_rad: float) -> tuple[States, FloatArray]:
    """The best ``count`` states, no two closer in rotation than ``apart_rad``, and their scores."""
    chosen: list[int] = []
    order = np.argsort(-scores, kind="stable")
    flat = states.rotations.reshape(len(scores), 9)
    largest_trace = 1.0 + 2.0 * np.cos(apart_rad)
    # Some at a time, for the best are mostly enough.
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


def _cross_entropy(
    level: Level,
    states: States,
    scale: FloatArray,
    limits: _Limits,
    config: SearchConfig,
    rng: np.random.Generator,
) -> Stepwise[States]:
    """Each state moved to a better one nearby, sorted by score."""
    elite = max(4, config.population // 8)
    m, n = len(states), config.population
    sigmas = np.tile(scale, (m, 1))
    incumbent, scores = states, (yield from level.scoring(states))
    for _ in range(config.rounds):
        delta = rng.standard_normal((m, n, 7)) * sigmas[:, None, :]
        delta[:, 0] = 0.0
        samples = limits.clip(_perturbed(incumbent, delta))
        values = (yield from level.scoring(samples)).reshape(m, n)
        order = np.argsort(-values, axis=1, kind="stable")[:, :elite]
        chosen = np.take_along_axis(delta, order[:, :, None], axis=1)
        mean = limits.clip(_perturbed(incumbent, chosen.mean(axis=1, keepdims=True)))
        mean_scores = yield from level.scoring(mean)
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
