"""Alignment factors: a frame's matches as ONE vectorised factor (see :mod:`sst_graph.factors.reprojection`).

The cost of a factor is the robust cost sum rho(|r_i| / sigma_i); its linearization carries the weights
w_i of each match. Condensed (the default) it has cols + 2 rows however many matches there are, with the
cost, gradient and Gauss-Newton Hessian of the stacked factor.

Variables are given by their key; a constant in place of a key fixes the quantity: ``offset_s=0.1`` or
``c_twist=np.zeros(6)``. Extrinsic Pose3, offset and bias ``Vector(1)`` or ``double``, twist ``Vector(6)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from .condensed import condense, condense_root, cost_rows
from .custom import custom_factor
from .errors import FactorError, checked_array, described
from .matches import Alignment
from .reprojection import Evaluated, alignment_cost, cost, evaluate, residuals, weigh, weighted_residuals
from .variables import Kind, Vector, checked_key, dimension, is_key, key_name, number_or_key, pose_or_key

__all__ = [
    "Alignment",
    "GroupedBias",
    "LinearTerm",
    "alignment_cost",
    "frame_factor",
    "pixel_to_point_factor",
    "point_to_pixel_factor",
    "residuals",
    "weighted_residuals",
]

FloatArray = NDArray[np.float64]
_COLUMNS = {"cTl": range(0, 6), "offset_s": range(6, 7), "c_twist": range(7, 13)}
"""Where each quantity stands among the Jacobian's columns; biases follow, the residual is last."""
_NAME = "frame_factor"


@dataclass(frozen=True, eq=False)
class GroupedBias:
    """Mask biases of the objects that one alignment's matches lie on.

    Attributes:
        biases: key of each object's bias, or a fixed bias [px].
        groups: (n,) position in ``biases`` for each match.
    """

    biases: tuple[int | float, ...]
    groups: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class LinearTerm:
    """A scalar that all silhouettes of one alignment depend on: r_i += coefficients_i (theta - at).

    For parameters whose column is known in closed form: a focal length, a distortion, a range bias.

    Attributes:
        key: of theta (``Vector(1)``).
        coefficients: (n,) derivative of each match's residual by theta [px per unit].
        at: value of theta at which the matches were made.
    """

    key: int
    coefficients: FloatArray
    at: float = 0.0


def point_to_pixel_factor(
    alignment: Alignment,
    cTl: int | gtsam.Pose3,
    offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
    *,
    condensed: bool = True,
) -> gtsam.CustomFactor:
    """r_i = uv(cP_i) - q_i, q_i the nearest pixel of the point's class; two rows a point [px].

    SST-Calib, eq. 2. See :func:`frame_factor` for the arguments.
    """
    _require_points(alignment)
    return frame_factor([alignment], cTl, offset_s, c_twist, condensed=condensed)


def pixel_to_point_factor(
    alignment: Alignment,
    cTl: int | gtsam.Pose3,
    offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
    *,
    condensed: bool = True,
) -> gtsam.CustomFactor:
    """r_j = uv(cP_j) - q_j, P_j the point that projects nearest to the mask pixel q_j; two rows a pixel [px].

    SST-Calib, eq. 3: the same residual as :func:`point_to_pixel_factor` over matches found the other
    way round (a point may occur many times); its weight w_l n_p / n_i is the alignment's ``weights``.
    """
    _require_points(alignment)
    return frame_factor([alignment], cTl, offset_s, c_twist, condensed=condensed)


def _require_points(alignment: Alignment) -> None:
    if alignment.normals is not None:
        raise FactorError("alignment", "normals", "none: silhouettes have silhouette_factor")


def frame_factor(
    alignments: Sequence[Alignment],
    cTl: int | gtsam.Pose3,
    offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
    biases_px: Sequence[int | float | GroupedBias | None] | int | float | None = None,
    *,
    terms: Sequence[Sequence[LinearTerm]] | None = None,
    condensed: bool = True,
) -> gtsam.CustomFactor:
    """All alignments of one image as one factor.

    Args:
        alignments: one or more, over the same image (one twist).
        cTl: key of the extrinsic, or a fixed pose.
        offset_s: key of the time offset, or a fixed offset [s] (a float: an int is a key, and 0 is refused).
        c_twist: key of the image's twist, a fixed twist (6,) [rad/s, m/s], or None for zero.
        biases_px: key of the mask bias, a fixed bias [px], or None; one for all silhouettes, or a sequence
            with one entry for each alignment (None for those that are point-to-pixel; a
            :class:`GroupedBias` where the objects of one alignment have a bias each).
        terms: of each alignment, scalars that its silhouettes depend on besides; None for none.
        condensed: False gives two rows a match and one more; for tests and for looking at residuals.

    Returns:
        A factor with unit noise on the distinct keys, in the order of the arguments.

    Raises:
        FactorError: no alignment, no key, or a bias for an alignment without normals.
    """
    frame = frame_residual(alignments, cTl, offset_s, c_twist, biases_px, terms)
    rows = frame.cols + 2 if condensed else sum(len(a) * a.rows_per_match for a in alignments) + 1
    function = _FrameError(frame, condensed, rows)
    return custom_factor(gtsam.noiseModel.Unit.Create(rows), frame.named, function, frame.kinds, rows, _NAME)


@dataclass(frozen=True)
class _FrameError:
    """The error of a frame's factor; a plain object, so that it copies and pickles."""

    frame: FrameResidual
    condensed: bool
    rows: int

    def __call__(self, *values: Any, jacobians: bool) -> tuple[FloatArray, list[FloatArray] | None]:
        frame = self.frame
        if not jacobians:
            return cost_rows(frame.cost(values), self.rows) if self.condensed else frame.stacked_error(
                values
            ), None
        error, J = frame.condensed(values) if self.condensed else frame.stacked(values)
        return error, [J[:, start:end] for start, end in frame.bounds]


@dataclass(frozen=True)
class _Source:
    """Where a quantity comes from: variable number ``slot`` of the factor, or a constant."""

    slot: int | None
    constant: Any = None

    def value(self, values: Sequence[Any]) -> Any:
        return self.constant if self.slot is None else values[self.slot]


@dataclass(frozen=True)
class _Part:
    """One alignment, its biases, and how its columns stand among those of the factor.

    Attributes:
        biases: none, one for all matches, or one for each group of them.
        groups: (n,) the bias of each match, or None where all share one.
        columns: columns of the alignment's [J r] that belong to variables, the residual last.
        targets: the same columns in the factor's [J r].
        terms: scalars that the residuals depend on besides, and where their values come from.
    """

    alignment: Alignment
    biases: list[_Source]
    groups: NDArray[np.intp] | None
    columns: list[int]
    targets: list[int]
    terms: tuple[tuple[LinearTerm, _Source], ...] = ()

    def evaluated(
        self, values: Sequence[Any], state: tuple[gtsam.Pose3, float, FloatArray], jacobians: bool
    ) -> Evaluated:
        """Residuals, and derivatives with a column for each term where ``jacobians`` is true."""
        found = evaluate(self.alignment, *state, self.bias_px(values), jacobians)
        if not self.terms:
            return found
        coefficients = np.stack([term.coefficients for term, _ in self.terms])
        steps = np.array([_scalar(source.value(values)) - term.at for term, source in self.terms])
        return found.with_terms(coefficients, steps, jacobians)

    def bias_px(self, values: Sequence[Any]) -> float | FloatArray | None:
        if not self.biases:
            return None
        biases = [_scalar(bias.value(values)) for bias in self.biases]
        return biases[0] if self.groups is None else np.array(biases)[self.groups]

    def weighted(self, evaluated: Evaluated) -> tuple[Evaluated, float]:
        """Its rows weighted, with a column for each bias, and its constant."""
        constant = weigh(self.alignment, evaluated)
        if self.groups is not None:
            evaluated = evaluated.by_group(self.groups, len(self.biases))
        return evaluated, constant


@dataclass(frozen=True)
class FrameResidual:
    """The frozen data behind a frame's factor; ``values`` are those of ``keys``, in their order."""

    parts: tuple[_Part, ...]
    cTl: _Source
    offset_s: _Source
    c_twist: _Source
    keys: tuple[int, ...]
    kinds: tuple[Kind, ...]
    names: tuple[str, ...]

    @cached_property
    def dims(self) -> tuple[int, ...]:
        return tuple(dimension(kind) for kind in self.kinds)

    @cached_property
    def bounds(self) -> list[tuple[int, int]]:
        """Where each variable's columns begin and end."""
        return list(pairwise(accumulate(self.dims, initial=0)))

    @property
    def named(self) -> dict[str, int]:
        """Keys by the argument that each came as."""
        return dict(zip(self.names, self.keys, strict=True))

    @property
    def cols(self) -> int:
        return sum(self.dims)

    def _state(self, values: Sequence[Any]) -> tuple[gtsam.Pose3, float, FloatArray]:
        return self.cTl.value(values), _scalar(self.offset_s.value(values)), self.c_twist.value(values)

    def _weighted(self, part: _Part, values: Sequence[Any]) -> tuple[Evaluated, float]:
        """Weighted [J r] of one alignment and its constant."""
        return part.weighted(part.evaluated(values, self._state(values), True))

    def cost(self, values: Sequence[Any]) -> float:
        total = 0.0
        for part in self.parts:
            state = self._state(values)
            total += cost(part.alignment, part.evaluated(values, state, False))
        return total

    def gram(self, values: Sequence[Any]) -> tuple[FloatArray, float]:
        """Gram matrix (cols + 1, cols + 1) of the weighted [J r] of all matches, and their constant."""
        return self._gram([self._weighted(part, values) for part in self.parts])

    def _gram(self, weighted: Sequence[tuple[Evaluated, float]]) -> tuple[FloatArray, float]:
        G = np.zeros((self.cols + 1, self.cols + 1))
        for part, (evaluated, _) in zip(self.parts, weighted, strict=True):
            G[np.ix_(part.targets, part.targets)] += evaluated.gram()[np.ix_(part.columns, part.columns)]
        return G, sum(constant for _, constant in weighted)

    def condensed(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        weighted = [self._weighted(part, values) for part in self.parts]
        evaluated, constant = weighted[0]
        if len(weighted) > 1 or len(evaluated.rows) > self.cols + 1:
            return condense(*self._gram(weighted))
        # Of a single alignment there is a root at once: that of its rows' short form.
        R = np.zeros((len(evaluated.rows), self.cols + 1))
        R[:, self.parts[0].targets] = evaluated.root()[:, self.parts[0].columns]
        return condense_root(R, constant)

    def stacked(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        blocks, constant = [], 0.0
        for part in self.parts:
            evaluated, part_constant = self._weighted(part, values)
            rows = evaluated.system()
            block = np.zeros((rows.shape[1], self.cols + 1))
            block[:, part.targets] = rows[part.columns].T
            blocks.append(block)
            constant += part_constant
        last = np.zeros((1, self.cols + 1))
        last[0, -1] = np.sqrt(constant)
        system = np.concatenate([*blocks, last])
        return system[:, -1], system[:, :-1]

    def stacked_error(self, values: Sequence[Any]) -> FloatArray:
        """The error of :meth:`stacked`, without the work for its Jacobian."""
        blocks, constant = [], 0.0
        for part in self.parts:
            evaluated = part.evaluated(values, self._state(values), False)
            constant += weigh(part.alignment, evaluated)
            blocks.append(evaluated.rows[-1].reshape(-1))
        return np.concatenate([*blocks, [np.sqrt(constant)]])


def frame_residual(
    alignments: Sequence[Alignment],
    cTl: Any,
    offset_s: Any,
    c_twist: Any,
    biases_px: Any,
    terms: Sequence[Sequence[LinearTerm]] | None = None,
    name: str = _NAME,
) -> FrameResidual:
    """The residual behind :func:`frame_factor`, whose arguments these are; ``name`` is for errors."""
    if not alignments:
        raise FactorError(f"alignments of {name}", "none", "one or more")
    for alignment in alignments:
        if not isinstance(alignment, Alignment):
            raise FactorError(f"alignments of {name}", described(alignment), "sst_graph.factors.Alignment")
        if alignment.c_acceleration.ndim > 1:
            found = f"shape {alignment.c_acceleration.shape}"
            raise FactorError(f"c_acceleration of {name}", found, "shape (6,): the matches of one image")
    variables = _Variables(name)
    pose = variables.source("cTl", pose_or_key(name, "cTl", cTl), gtsam.Pose3)
    offset = variables.source("offset_s", number_or_key(name, "offset_s", offset_s), Vector(1))
    twist = variables.source("c_twist", _twist_or_key(name, c_twist), Vector(6))
    biases = [_bias_sources(bias, variables) for bias in _bias_of_each(alignments, biases_px)]
    scalars = [
        tuple(
            (term, variables.source("term", checked_key(name, "terms", term.key), Vector(1)))
            for term in of_one
        )
        for of_one in _terms_of_each(alignments, terms)
    ]
    if not variables.keys:
        raise FactorError(f"keys of {name}", "constants only", "the key of one variable or more")
    cols = sum(variables.dims)
    parts = []
    for alignment, (sources, groups), own_terms in zip(alignments, biases, scalars, strict=True):
        columns, targets = [], []
        named = [(pose, _COLUMNS["cTl"]), (offset, _COLUMNS["offset_s"]), (twist, _COLUMNS["c_twist"])]
        singles = [*(source for _, source in own_terms), *sources]
        named += [(source, range(13 + i, 14 + i)) for i, source in enumerate(singles)]
        for source, own in named:
            if source.slot is not None:
                columns += list(own)
                start = sum(variables.dims[: source.slot])
                targets += list(range(start, start + len(own)))
        columns, targets = [*columns, 13 + len(singles)], [*targets, cols]
        parts.append(_Part(alignment, sources, groups, columns, targets, own_terms))
    kinds, names = tuple(variables.kinds), tuple(variables.names)
    return FrameResidual(tuple(parts), pose, offset, twist, tuple(variables.keys), kinds, names)


def _twist_or_key(name: str, c_twist: Any) -> int | FloatArray:
    if is_key(c_twist):
        return checked_key(name, "c_twist", c_twist)
    return checked_array(f"c_twist of {name}", np.zeros(6) if c_twist is None else c_twist, (6,))


def _bias_sources(
    bias: int | float | GroupedBias | None, variables: _Variables
) -> tuple[list[_Source], NDArray[np.intp] | None]:
    def source(each: int | float) -> _Source:
        return variables.source("bias", number_or_key(variables.factor, "biases_px", each), Vector(1))

    if isinstance(bias, GroupedBias):
        return [source(each) for each in bias.biases], bias.groups
    return ([] if bias is None else [source(bias)]), None


def _bias_of_each(alignments: Sequence[Alignment], biases_px: Any) -> list[int | float | GroupedBias | None]:
    """The bias of each alignment; a single one belongs to the silhouettes."""
    if isinstance(biases_px, list | tuple):
        if len(biases_px) != len(alignments):
            raise FactorError(
                "biases_px", f"{len(biases_px)} entries", f"{len(alignments)}, one an alignment"
            )
        biases = list(biases_px)
    else:
        biases = [None if alignment.normals is None else biases_px for alignment in alignments]
    for alignment, bias in zip(alignments, biases, strict=True):
        if alignment.normals is None and bias is not None:
            raise FactorError(
                "biases_px", "a bias for point-to-pixel matches", "None: only silhouettes have one"
            )
        if isinstance(bias, GroupedBias) and (
            bias.groups.shape != (len(alignment),)
            or not np.isin(bias.groups, np.arange(len(bias.biases))).all()
        ):
            raise FactorError(
                "groups of a GroupedBias",
                f"shape {bias.groups.shape}, up to {bias.groups.max(initial=-1)}",
                f"({len(alignment)},), positions in {len(bias.biases)} biases",
            )
    return biases


def _terms_of_each(
    alignments: Sequence[Alignment], terms: Sequence[Sequence[LinearTerm]] | None
) -> list[Sequence[LinearTerm]]:
    """The terms of each alignment, their shapes checked."""
    if terms is None:
        return [()] * len(alignments)
    if len(terms) != len(alignments):
        raise FactorError("terms", f"{len(terms)} entries", f"{len(alignments)}, one an alignment")
    for alignment, own in zip(alignments, terms, strict=True):
        if own and alignment.normals is None:
            raise FactorError("terms", "one for point-to-pixel matches", "none: only silhouettes have them")
        for term in own:
            checked_array("coefficients of a linear term", term.coefficients, (len(alignment),))
    return list(terms)


_SEVERAL = ("bias", "term")
"""Arguments that a factor may have more than one of."""


class _Variables:
    """Collects the keys of a factor, their kinds, and the arguments that they came as."""

    def __init__(self, factor: str) -> None:
        self.factor = factor
        self.keys: list[int] = []
        self.kinds: list[Kind] = []
        self.names: list[str] = []

    @property
    def dims(self) -> list[int]:
        return [dimension(kind) for kind in self.kinds]

    def source(self, name: str, key_or_value: Any, kind: Kind) -> _Source:
        """Of a key or constant that has been checked; biases may share a key, and terms, others may not."""
        if not isinstance(key_or_value, int):
            return _Source(None, key_or_value)
        key = key_or_value
        if key in self.keys:
            before = self.names[self.keys.index(key)]
            if name not in _SEVERAL or not before.startswith(name):
                both = f"{key_name(key)} for {before} and {name}"
                raise FactorError(f"keys of {self.factor}", both, "distinct keys")
        else:
            count = sum(each.startswith(name) for each in self.names)
            self.keys.append(key)
            self.kinds.append(kind)
            self.names.append(f"{name} {count + 1}" if name in _SEVERAL else name)
        return _Source(self.keys.index(key))


def _scalar(value: Any) -> float:
    """The number in a float or a ``Vector(1)``."""
    return float(np.asarray(value, dtype=np.float64).reshape(()) if np.ndim(value) == 0 else value[0])
