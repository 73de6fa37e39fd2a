"""Whether parts of the data agree: the difference of their own estimates against its covariance.

Every part (a drive, a stretch of a drive) has an estimate of its own, as a step from a common reference with
a cluster-robust covariance. The squared Mahalanobis length of the difference of two estimates would be
chi-squared if the covariances were known. They are estimated from a limited number of clusters (sides of
objects), which makes it Hotelling's T^2: an F with about as many degrees of freedom in the denominator as
clusters (Cameron and Miller, A practitioner's guide to cluster-robust inference, 2015, sec. VI). A direction
that a part does not determine has a large variance in the difference and so does not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, combinations

import gtsam
import numpy as np
from scipy.special import chdtrc, fdtrc

from sst_graph.graph.linear import scaled_inverse
from sst_graph.types import FloatArray

_LEAST_FREEDOM = 4.0
"""Least degrees of freedom of a covariance, however few clusters: part of it is the error model's."""
_WORTH, _WORTH_SHARE = 6.0, 0.05
"""A kind of step (rotation, translation, time offset) must lower the squared length by so much a number, and
by this share of all of it, to be named: three times Akaike's penalty, so that few are named; and a large step
disturbs all other estimates a little (odometry, dynamic objects)."""
_ONE_AXIS = 0.9
"""A step along one axis to this share (cosine) is named by that axis alone."""
_KINDS = {"rotation": slice(0, 3), "translation": slice(3, 6), "offset": slice(6, 7)}
"""Kinds of a step, and where its numbers stand."""
_TURNS = ("pitch", "yaw", "roll")
_WAYS = (("left", "right"), ("up", "down"), ("backward", "forward"))
"""What a turn about each of the camera's axes, and a shift against or along it, is called."""
_FORWARD = 2
"""The axis of a camera that looks along the road."""


@dataclass(frozen=True)
class PartEstimate:
    """The estimate of one part of the data.

    Attributes:
        step: (n,) from the common reference to the part's estimate, in the tangent space of the reference
            (right perturbation: rotation [rad], translation [m], offset [s]): 7 numbers, or 6 without the
            offset.
        covariance: (n, n) of it, cluster-robust.
        clusters: effective number of independent clusters (sides of objects) that the covariance rests on.
        common: (n,) shift of the estimate by one deviation of each error that all parts share, by its name,
            such as a principal point that is off; what shifts both parts alike is no contradiction, and does
            not hide one.
    """

    step: FloatArray
    covariance: FloatArray
    clusters: float = np.inf
    common: Mapping[str, FloatArray] = field(default_factory=dict)

    def shift(self, name: str) -> FloatArray:
        """(n,) by one deviation of a common error; 0 of one that the part does not have."""
        return self.common.get(name, np.zeros(len(self.step)))

    def extrinsic(self) -> PartEstimate:
        """The extrinsic alone, for parts that have a time offset of their own each."""
        common = {name: step[:6] for name, step in self.common.items()}
        return replace(self, step=self.step[:6], covariance=self.covariance[:6, :6], common=common)


@dataclass(frozen=True)
class Difference:
    """The difference between the estimates of two parts.

    Attributes:
        step: (n,) from the first to the second, as of the parts.
        covariance: (n, n) of it.
        freedom: degrees of freedom of the covariance; infinite where it is known.
    """

    step: FloatArray
    covariance: FloatArray
    freedom: float = np.inf

    @classmethod
    def of(cls, one: PartEstimate, other: PartEstimate) -> Difference:
        """From one part to another, as :meth:`from_others`."""
        return cls.from_others([one], other)

    @classmethod
    def from_others(cls, others: Sequence[PartEstimate], one: PartEstimate) -> Difference:
        """From what other parts say of one, with what they tell of the common errors, to that one.

        All parts are independent but for what they have in common. Where the covariances are known, the
        chi-squared is the :func:`disagreement` of all parts less that of the others. The degrees of freedom
        are Welch's, along the step: those of the side that is known worse count most (Nel and van der Merwe,
        A solution to the multivariate Behrens-Fisher problem, 1986).
        """
        sums = _Sums.joined(_Sums.of_each(others, _names(*others, one)))
        return cls._from_sums(sums, one)

    @classmethod
    def each_from_others(cls, parts: Sequence[PartEstimate]) -> list[Difference]:
        """:meth:`from_others` of every part: their equations are summed once from either end, not anew for
        each."""
        own = _Sums.of_each(parts, _names(*parts))
        before, after = (list(accumulate(each)) for each in (own, reversed(own)))
        others = (_Sums.joined([*before[:k][-1:], *after[: len(own) - k - 1][-1:]]) for k in range(len(own)))
        return [cls._from_sums(sums, one) for sums, one in zip(others, parts, strict=True)]

    @classmethod
    def _from_sums(cls, others: _Sums, one: PartEstimate) -> Difference:
        mean, covariance, _ = others.solved()
        J = _design(one, others.names)
        step, covariance = one.step - J @ mean, one.covariance + J @ covariance @ J.T
        along = np.linalg.solve(covariance, step)
        total = max(float(along @ covariance @ along), 1e-300)
        freedom = sum(
            (float(along @ each @ along) / total) ** 2 / max(clusters - 1.0, 1.0)
            for each, clusters in ((others.own_covariance, others.clusters), (one.covariance, one.clusters))
        )
        return cls(step, covariance, max(1.0 / freedom, _LEAST_FREEDOM) if freedom > 0.0 else np.inf)

    @property
    def chi2(self) -> float:
        """Squared Mahalanobis length."""
        return float(self.step @ np.linalg.solve(self.covariance, self.step))

    @property
    def p_value(self) -> float:
        """Probability of such a length or a larger one where the parts agree."""
        n = len(self.step)
        if not np.isfinite(self.freedom):
            return float(chdtrc(n, self.chi2))
        return float(fdtrc(n, self.freedom, self.chi2 / n))

    @property
    def rank(self) -> tuple[float, float]:
        """Sorts the least likely first, also where the probability is too small for a float."""
        return self.p_value, -self.chi2


def combined(parts: Sequence[PartEstimate]) -> PartEstimate:
    """The estimate of several independent parts together, weighted by their information."""
    information = [np.linalg.inv(part.covariance) for part in parts]
    covariance = np.asarray(np.linalg.inv(np.sum(information, axis=0)))

    def mean(of_parts: Sequence[FloatArray]) -> FloatArray:
        whole = np.sum([H @ each for H, each in zip(information, of_parts, strict=True)], axis=0)
        return np.asarray(covariance @ whole)

    common = {name: mean([part.shift(name) for part in parts]) for name in _names(*parts)}
    clusters = sum(part.clusters for part in parts)
    return PartEstimate(mean([part.step for part in parts]), covariance, clusters, common)


def _names(*parts: PartEstimate) -> list[str]:
    """Errors that parts have in common."""
    return list(dict.fromkeys(name for part in parts for name in part.common))


def disagreement(estimates: Sequence[PartEstimate]) -> float:
    """Chi-squared of estimates d_k = x + S_k a + own error, with common errors a of one deviation each.

    The least over x and a of sum (d_k - x - S_k a)' L_k (d_k - x - S_k a) + a' a.
    """
    return _Sums.joined(_Sums.of_each(estimates, _names(*estimates))).solved()[2]


@dataclass(frozen=True)
class _Sums:
    """Normal equations of x and the common errors a by the estimates of parts.

    Attributes:
        around: (n,) the step about which they are written.
        names: of the common errors.
        H, g, constant: (n + c, n + c), (n + c,) and number of the squared length of d_k - x - S_k a, without
            a' a.
        clusters: of all parts.
    """

    around: FloatArray
    names: Sequence[str]
    H: FloatArray
    g: FloatArray
    constant: float
    clusters: float

    @classmethod
    def of_each(cls, parts: Sequence[PartEstimate], names: Sequence[str]) -> list[_Sums]:
        """Sums of each part alone, all about their mean."""
        around, found = combined(parts).step, []
        for part in parts:
            J, d, L = _design(part, names), part.step - around, np.linalg.inv(part.covariance)
            found.append(cls(around, names, J.T @ L @ J, J.T @ L @ d, float(d @ L @ d), part.clusters))
        return found

    def __add__(self, other: _Sums) -> _Sums:
        return replace(
            self,
            H=self.H + other.H,
            g=self.g + other.g,
            constant=self.constant + other.constant,
            clusters=self.clusters + other.clusters,
        )

    @classmethod
    def joined(cls, parts: Sequence[_Sums]) -> _Sums:
        """Several sums as one, about one step."""
        return sum(parts[1:], parts[0])

    @property
    def own_covariance(self) -> FloatArray:
        """(n, n) of x where the common errors are zero."""
        n = len(self.around)
        return np.asarray(np.linalg.inv(self.H[:n, :n]))

    def solved(self) -> tuple[FloatArray, FloatArray, float]:
        """Mean (n + c,) and covariance of x and the common errors, and the least cost; an error that no
        estimate has keeps its one deviation."""
        count = len(self.names)
        covariance = scaled_inverse(self.H + np.diag([0.0] * len(self.around) + [1.0] * count))
        least = covariance @ self.g
        mean = least + np.concatenate([self.around, np.zeros(count)])
        return mean, covariance, self.constant - float(self.g @ least)


def _design(estimate: PartEstimate, names: Sequence[str]) -> FloatArray:
    """(n, n + c) derivative of an estimate by x and the common errors."""
    return np.column_stack([np.eye(len(estimate.step)), *(estimate.shift(name) for name in names)])


@dataclass(frozen=True)
class NamedStep:
    """A step between two parts, by the fewest of rotation, translation and time offset that explain it.

    Attributes:
        kinds: which of "rotation", "translation", "offset" take part.
        sentence: how large they are, in words: "rotation by 1.10° ± 0.05° about ..., time offset by ...".
        possible_kinds: these, and "offset" beside a translation forward or backward: at a steady speed both
            look alike.
    """

    kinds: tuple[str, ...]
    sentence: str
    possible_kinds: tuple[str, ...]


def name_step(difference: Difference, cTl: gtsam.Pose3) -> NamedStep:
    """The step between two parts, in words.

    Where speed and direction are steady, a time offset and a translation look alike, and one number is
    preferred to three.

    Args:
        cTl: extrinsic, for the camera's axes.
    """
    n = len(difference.step)
    kinds = [kind for kind, where in _KINDS.items() if where.stop <= n]
    subsets = [subset for size in range(1, len(kinds) + 1) for subset in combinations(kinds, size)]
    information = np.asarray(np.linalg.inv(difference.covariance), np.float64)
    least = _WORTH_SHARE * difference.chi2

    def price(subset: tuple[str, ...]) -> float:
        step, _ = _restricted(difference.step, information, subset)
        rest = difference.step - step
        worth = _WORTH * len(_columns(subset)) + least * len(subset)
        return float(rest @ information @ rest) + worth

    best = min(subsets, key=price)
    step, covariance = _restricted(difference.step, information, best)
    along = _only_axis(cTl.rotation().matrix() @ step[_KINDS["translation"]]) == _FORWARD
    return NamedStep(
        best,
        ", ".join(_words(kind, step[_KINDS[kind]], covariance, cTl) for kind in best),
        (*best, "offset") if along and "offset" not in best else best,
    )


def _columns(subset: Sequence[str]) -> list[int]:
    return [i for kind in subset for i in range(_KINDS[kind].start, _KINDS[kind].stop)]


def _restricted(
    step: FloatArray, information: FloatArray, subset: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """(n,) the step if only some kinds of unknowns changed, and its covariance (n, n), 0 elsewhere."""
    columns, n = _columns(subset), len(step)
    inner = np.linalg.inv(information[np.ix_(columns, columns)])
    found, covariance = np.zeros(n), np.zeros((n, n))
    found[columns] = inner @ (information @ step)[columns]
    covariance[np.ix_(columns, columns)] = inner
    return found, covariance


def _only_axis(c_step: FloatArray) -> int | None:
    """The axis of the camera that a step (3,) is along, or about; None where it is along no single one."""
    axis = int(np.abs(c_step).argmax())
    return axis if abs(c_step[axis]) > _ONE_AXIS * float(np.linalg.norm(c_step)) else None


def _words(kind: str, step: FloatArray, covariance: FloatArray, cTl: gtsam.Pose3) -> str:
    own = covariance[_KINDS[kind], _KINDS[kind]]
    if kind == "offset":
        return f"time offset by {1e3 * step[0]:+.0f} ms ± {1e3 * float(np.sqrt(own[0, 0])):.0f} ms"
    R = np.asarray(cTl.rotation().matrix())
    c_step, size = R @ step, float(np.linalg.norm(step))
    unit = c_step / max(size, 1e-12)
    sigma = float(np.sqrt(unit @ R @ own @ R.T @ unit))
    axis = _only_axis(c_step)
    if kind == "rotation":
        amount = f"rotation by {np.degrees(size):.2f}° ± {np.degrees(sigma):.2f}°"
        if axis is not None:
            return f"{amount} about the camera's {'xyz'[axis]} axis ({_TURNS[axis]})"
        each = ", ".join(
            f"{name} {value:+.2f}°" for name, value in zip(_TURNS, np.degrees(c_step), strict=True)
        )
        return f"{amount} ({each})"
    amount = f"translation by {100.0 * size:.1f} cm ± {100.0 * sigma:.1f} cm"
    if axis is not None:
        return f"{amount} {_WAYS[axis][int(c_step[axis] > 0.0)]}"
    each = ", ".join(f"{name} {100.0 * value:+.1f} cm" for name, value in zip("xyz", c_step, strict=True))
    return f"{amount} ({each} along the camera's axes)"
