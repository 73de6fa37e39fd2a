"""Alignment factors: a frame's matches as ONE vectorised factor (see :mod:`sst_graph.factors.reprojection`).

The cost of a factor is the robust cost sum rho(|r_i| / sigma_i); its linearization carries the weights
w_i of each match. It is condensed: it has cols + 2 rows however many matches there are, with the cost,
gradient and Gauss-Newton Hessian of the :func:`stacked` factor.

Variables are given by their key; a constant in place of a key fixes the quantity: ``time_offset_s=0.1`` or
``c_twist=np.zeros(6)``. Extrinsic Pose3, offset and bias ``Vector(1)`` or ``double``, twist ``Vector(6)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from .arguments import (
    FloatArray,
    checked_array,
    checked_number,
    checked_positive,
    checked_type,
    described,
    is_several,
)
from .condensed import condense_gram, condense_root, cost_rows
from .custom.factor import own_factor, recipe_of
from .custom.variables import Argument, Variables, Vector, checked_key, is_key, number_or_key, pose_or_key
from .errors import FactorError, count_of
from .matches import Alignment, joined_points
from .reprojection import Evaluated, alignment_cost, cost, evaluate, residuals, weigh, weighted_residuals

__all__ = [
    "Alignment",
    "GroupedBias",
    "LinearTerm",
    "alignment_cost",
    "frame_factor",
    "pixel_to_point_factor",
    "point_to_pixel_factor",
    "residuals",
    "silhouette_factor",
    "stacked",
    "weighted_residuals",
]

_COLUMNS = {"cTl": range(0, 6), "time_offset_s": range(6, 7), "c_twist": range(7, 13)}
"""Where each quantity stands among the Jacobian's columns; biases follow, the residual is last."""
_NAME = "frame_factor"
_AN_ALIGNMENT = "a sst_graph.factors.Alignment"


@dataclass(frozen=True, eq=False)
class GroupedBias:
    """Mask biases of the objects that one alignment's matches lie on.

    Attributes:
        biases: key of each object's bias, or a fixed bias [px].
        groups: (n,) position in ``biases`` for each match.

    Raises:
        FactorError: something else than keys or numbers, or positions that are none.
    """

    biases: tuple[int | float, ...]
    groups: NDArray[np.intp]

    def __post_init__(self) -> None:
        expected = "a sequence of keys or of numbers"
        checked_type("biases of a GroupedBias", self.biases, (list, tuple, np.ndarray), expected)
        if not is_several(self.biases):
            raise FactorError("biases of a GroupedBias", described(self.biases), expected)
        for bias in self.biases:
            number_or_key("a GroupedBias", "biases", bias)
        groups = checked_array("groups of a GroupedBias", self.groups, (None,))
        positions = np.asarray(self.groups, dtype=np.intp)
        least, most = positions.min(initial=0), positions.max(initial=-1)
        if (positions != groups).any() or least < 0 or most >= len(self.biases):
            found = f"{groups.min():g} to {groups.max():g}"
            expected = f"positions in {count_of(len(self.biases), 'bias', 'biases')}"
            raise FactorError("groups of a GroupedBias", found, expected)
        object.__setattr__(self, "groups", positions)
        object.__setattr__(self, "biases", tuple(self.biases))


@dataclass(frozen=True, eq=False)
class LinearTerm:
    """A scalar that all silhouettes of one alignment depend on: r_i += coefficients_i (theta - at).

    For parameters whose column is known in closed form: a focal length, a distortion, a range bias.

    Attributes:
        key: of theta (``Vector(1)``).
        coefficients: (n,) derivative of each match's residual by theta [px per unit].
        at: value of theta at which the matches were made.

    Raises:
        FactorError: no key, or no numbers.
    """

    key: int
    coefficients: FloatArray
    at: float = 0.0

    def __post_init__(self) -> None:
        store = object.__setattr__
        store(self, "key", checked_key("a linear term", "key", self.key))
        checked = checked_array("coefficients of a linear term", self.coefficients, (None,))
        store(self, "coefficients", checked)
        store(self, "at", checked_number("at of a linear term", self.at))


def point_to_pixel_factor(
    alignment: Alignment,
    cTl: int | gtsam.Pose3,
    time_offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
) -> gtsam.CustomFactor:
    """r_i = uv(cP_i) - q_i, q_i the nearest pixel of the point's class; two rows a point [px].

    SST-Calib, eq. 2. See :func:`frame_factor` for the arguments.
    """
    _require_points("point_to_pixel_factor", alignment)
    return frame_factor([alignment], cTl, time_offset_s, c_twist)


def pixel_to_point_factor(
    alignment: Alignment,
    cTl: int | gtsam.Pose3,
    time_offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
) -> gtsam.CustomFactor:
    """r_j = uv(cP_j) - q_j, P_j the point that projects nearest to the mask pixel q_j; two rows a pixel [px].

    SST-Calib, eq. 3: the same residual as :func:`point_to_pixel_factor` over matches found the other
    way round (a point may occur many times); its weight w_l n_p / n_i is the alignment's ``weights``.
    """
    _require_points("pixel_to_point_factor", alignment)
    return frame_factor([alignment], cTl, time_offset_s, c_twist)


def silhouette_factor(
    alignment: Alignment,
    cTl: int | gtsam.Pose3,
    time_offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
    bias_px: int | float | None = None,
) -> gtsam.CustomFactor:
    """r_i = n_i . (uv(cP_i) - q_i) + bias: signed distance to the true outline [px].

    q_i is the contour's point nearest to the predicted pixel and n_i its outward unit normal; frozen,
    they are the contour's tangent line. ``bias_px`` is how far a class's masks reach outside the true
    outline (dilation positive): the outline lies that far inside the contour. The arguments are those of
    :func:`sst_graph.factors.frame_factor`.

    Raises:
        FactorError: the alignment has no normals.
    """
    checked_type("alignment of silhouette_factor", alignment, Alignment, _AN_ALIGNMENT)
    if alignment.normals is None:
        raise FactorError("alignment of a silhouette", "no normals", "unit normals (n, 2)")
    return frame_factor([alignment], cTl, time_offset_s, c_twist, bias_px)


def _require_points(factor: str, alignment: Alignment) -> None:
    checked_type(f"alignment of {factor}", alignment, Alignment, _AN_ALIGNMENT)
    if alignment.normals is not None:
        raise FactorError("alignment", "normals", "none: silhouettes have silhouette_factor")


def frame_factor(
    alignments: Sequence[Alignment],
    cTl: int | gtsam.Pose3,
    time_offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
    biases_px: Sequence[int | float | GroupedBias | None] | int | float | None = None,
    *,
    terms: Sequence[Sequence[LinearTerm]] | None = None,
) -> gtsam.CustomFactor:
    """1/2 |error|^2 = sum_i weight_i rho(|r_i| / sigma_i), r_i of all alignments of one image [px].

    Args:
        alignments: one or more, over the same image (one twist).
        cTl: key of the extrinsic, or a fixed pose.
        time_offset_s: its key, or a fixed one [s] (a float: an int is a key, and 0 is refused).
        c_twist: key of the image's twist, a fixed twist (6,) [rad/s, m/s], or None for zero.
        biases_px: key of the mask bias, a fixed bias [px], or None; one for all silhouettes, or a sequence
            with one entry for each alignment (None for those that are point-to-pixel; a
            :class:`GroupedBias` where the objects of one alignment have a bias each).
        terms: of each alignment, scalars that its silhouettes depend on besides; None for none.

    Returns:
        A factor with unit noise on the distinct keys, in the order of the arguments.

    Raises:
        FactorError: no alignment, no key, or a bias for an alignment without normals.
    """
    quantities = Quantities(cTl, time_offset_s, c_twist)
    return image_factor(frame_residual(alignments, quantities, biases_px, terms), None, _NAME)


class ImageResidual(Protocol):
    """All matches of an image as a function of a factor's variables; ``values`` are in their order."""

    @property
    def variables(self) -> Variables: ...

    @property
    def match_rows(self) -> int:
        """Rows of all matches."""
        ...

    def cost(self, values: Sequence[Any]) -> float: ...

    def condensed(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        """(cols + 2,) error and its Jacobian."""
        ...

    def stacked(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        """(match_rows + 1,) error, the constant last, and its Jacobian."""
        ...

    def stacked_error(self, values: Sequence[Any]) -> FloatArray:
        """The error of :meth:`stacked`, without the work for its Jacobian."""
        ...


def image_factor(
    residual: ImageResidual, noise: gtsam.noiseModel.Base | None, name: str
) -> gtsam.CustomFactor:
    """A condensed factor.

    Args:
        noise: of one dimension, for the whole image; None for the unit's.
        name: of the factor, for errors.
    """
    rows = residual.variables.cols + 2
    function = _ImageError(residual, True, rows)
    variables = residual.variables
    return own_factor(_over_rows(noise, rows), variables.named, function, variables.kinds, rows, name)


def stacked(factor: gtsam.CustomFactor) -> gtsam.CustomFactor:
    """The same alignment factor with its matches' own rows, one or two each, and a last one that completes
    the cost: for tests, and for looking at residuals.

    Args:
        factor: a :func:`frame_factor`, :func:`silhouette_factor`, :func:`point_to_pixel_factor`,
            :func:`pixel_to_point_factor` or :func:`sst_graph.factors.pose_alignment_factor`.

    Raises:
        FactorError: another factor.
    """
    recipe = recipe_of(factor)
    if recipe is None or not isinstance(recipe.function, _ImageError):
        found = described(factor) if recipe is None else recipe.name
        raise FactorError("factor to be stacked", found, "an alignment factor of sst_graph.factors")
    residual = recipe.function.residual
    rows = residual.match_rows + 1
    function = _ImageError(residual, False, rows)
    return replace(recipe, noise=_over_rows(recipe.noise, rows), function=function, rows=rows).build()


def _over_rows(noise: gtsam.noiseModel.Base | None, rows: int) -> gtsam.noiseModel.Base:
    """A model of a whole image, which is the same in every row, in so many rows."""
    if noise is None:
        return gtsam.noiseModel.Unit.Create(rows)
    if isinstance(noise, gtsam.noiseModel.Robust):
        return gtsam.noiseModel.Robust.Create(noise.robust(), _over_rows(noise.noise(), rows))
    sigma = checked_positive("sigma of the noise of an image", float(noise.sigmas()[0]))
    return gtsam.noiseModel.Isotropic.Sigma(rows, sigma)


@dataclass(frozen=True)
class _ImageError:
    """The error of an image's factor; a plain object, so that it copies and pickles."""

    residual: ImageResidual
    condensed: bool
    rows: int

    def __call__(self, *values: Any, jacobians: bool) -> tuple[FloatArray, list[FloatArray] | None]:
        residual = self.residual
        if jacobians:
            error, J = residual.condensed(values) if self.condensed else residual.stacked(values)
            return error, residual.variables.blocks(J)
        if self.condensed:
            return cost_rows(residual.cost(values), self.rows), None
        return residual.stacked_error(values), None


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
        sums: (columns, distinct targets) by which columns of one variable are added up, where biases or terms
            share a key; else None.
        terms: scalars that the residuals depend on besides, and where their values come from.
    """

    alignment: Alignment
    biases: list[_Source]
    groups: NDArray[np.intp] | None
    columns: list[int]
    targets: list[int]
    sums: FloatArray | None = None
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

    def of_variables(self, rows: FloatArray) -> FloatArray:
        """(k, len(targets)) rows of the alignment's [J r] by variables, the residual last."""
        chosen = rows[:, self.columns]
        return chosen if self.sums is None else chosen @ self.sums

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
    """The frozen data behind a frame's factor; ``values`` are those of the variables, in their order."""

    parts: tuple[_Part, ...]
    cTl: _Source
    time_offset_s: _Source
    c_twist: _Source
    variables: Variables

    @property
    def cols(self) -> int:
        return self.variables.cols

    @property
    def match_rows(self) -> int:
        """Rows of all matches."""
        return sum(len(part.alignment) * part.alignment.rows_per_match for part in self.parts)

    def _state(self, values: Sequence[Any]) -> tuple[gtsam.Pose3, float, FloatArray]:
        return self.cTl.value(values), _scalar(self.time_offset_s.value(values)), self.c_twist.value(values)

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
            G[np.ix_(part.targets, part.targets)] += part.of_variables(part.of_variables(evaluated.gram()).T)
        return G, sum(constant for _, constant in weighted)

    def condensed(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        weighted = [self._weighted(part, values) for part in self.parts]
        counts = [len(evaluated.rows) for evaluated, _ in weighted]
        if sum(counts) > self.cols + 1:
            return condense_gram(*self._gram(weighted))
        # There are roots at once: those of the rows' short forms.
        R, end = np.zeros((sum(counts), self.cols + 1)), 0
        for part, (evaluated, _), count in zip(self.parts, weighted, counts, strict=True):
            R[end : end + count, part.targets] = part.of_variables(evaluated.root())
            end += count
        return condense_root(R, sum(constant for _, constant in weighted))

    def stacked(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        blocks, constant = [], 0.0
        for part in self.parts:
            evaluated, part_constant = self._weighted(part, values)
            rows = evaluated.system()
            block = np.zeros((rows.shape[1], self.cols + 1))
            block[:, part.targets] = part.of_variables(rows.T)
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


@dataclass(frozen=True)
class Quantities:
    """What the matches of an image depend on besides biases and terms: keys or constants, as
    :func:`frame_factor` takes them."""

    cTl: Any
    time_offset_s: Any
    c_twist: Any


def frame_residual(
    alignments: Sequence[Alignment],
    quantities: Quantities,
    biases_px: Any,
    terms: Sequence[Sequence[LinearTerm]] | None = None,
    name: str = _NAME,
) -> FrameResidual:
    """The residual behind :func:`frame_factor`, whose arguments these are; ``name`` is for errors."""
    checked_type(f"alignments of {name}", alignments, (list, tuple), f"a list, each {_AN_ALIGNMENT}")
    if not alignments:
        raise FactorError(f"alignments of {name}", "none", "one or more")
    for alignment in alignments:
        checked_type(f"alignments of {name}", alignment, Alignment, _AN_ALIGNMENT)
        if alignment.c_acceleration.ndim > 1:
            found = f"shape {alignment.c_acceleration.shape}"
            raise FactorError(f"c_acceleration of {name}", found, "shape (6,): the matches of one image")
    pose = pose_or_key(name, "cTl", quantities.cTl)
    offset = number_or_key(name, "time_offset_s", quantities.time_offset_s)
    twist = _twist_or_key(name, quantities.c_twist)
    biases = [_biases_and_groups(name, bias) for bias in _bias_of_each(alignments, biases_px)]
    terms_of_each = _terms_of_each(alignments, terms)
    if not any(own for own, _ in biases) and not any(terms_of_each):
        alignments = joined_points(alignments)
        biases, terms_of_each = biases[: len(alignments)], terms_of_each[: len(alignments)]
    arguments = [
        Argument("cTl", pose, gtsam.Pose3),
        Argument("time_offset_s", offset, Vector(1)),
        Argument("c_twist", twist, Vector(6)),
        *_numbered("bias", [bias for own, _ in biases for bias in own]),
        *_numbered("term", [checked_key(name, "terms", term.key) for own in terms_of_each for term in own]),
    ]
    variables = Variables.of(name, arguments)
    if not variables.keys:
        raise FactorError(f"keys of {name}", "constants only", "the key of one variable or more")

    def source(value: Any) -> _Source:
        return _Source(variables.keys.index(value)) if isinstance(value, int) else _Source(None, value)

    parts = []
    for alignment, (own_biases, groups), own_terms in zip(alignments, biases, terms_of_each, strict=True):
        columns, targets = [], []
        named = [(pose, _COLUMNS["cTl"]), (offset, _COLUMNS["time_offset_s"]), (twist, _COLUMNS["c_twist"])]
        singles = [*(term.key for term in own_terms), *own_biases]
        named += [(value, range(13 + i, 14 + i)) for i, value in enumerate(singles)]
        for value, own in named:
            if isinstance(value, int):
                columns += list(own)
                place = variables.columns[value]
                targets += list(range(place.start, place.stop))
        columns, targets = [*columns, 13 + len(singles)], [*targets, variables.cols]
        distinct, sums = _summed(targets)
        terms_here = tuple((term, source(term.key)) for term in own_terms)
        sources = [source(each) for each in own_biases]
        parts.append(_Part(alignment, sources, groups, columns, distinct, sums, terms_here))
    return FrameResidual(tuple(parts), source(pose), source(offset), source(twist), variables)


def _summed(targets: list[int]) -> tuple[list[int], FloatArray | None]:
    """The distinct targets, and (targets, distinct) the sums into them; None where all are distinct."""
    distinct = list(dict.fromkeys(targets))
    if len(distinct) == len(targets):
        return targets, None
    return distinct, np.equal.outer(targets, distinct).astype(np.float64)


def _numbered(name: str, values: Sequence[int | float]) -> list[Argument]:
    """Arguments of which a factor may have several, and which may share a key."""
    return [
        Argument(f"{name} {i}", value, Vector(1), shared_with=name) for i, value in enumerate(values, start=1)
    ]


def _twist_or_key(name: str, c_twist: Any) -> int | FloatArray:
    if is_key(c_twist):
        return checked_key(name, "c_twist", c_twist)
    return checked_array(f"c_twist of {name}", np.zeros(6) if c_twist is None else c_twist, (6,))


def _biases_and_groups(
    name: str, bias: int | float | GroupedBias | None
) -> tuple[list[int | float], NDArray[np.intp] | None]:
    if isinstance(bias, GroupedBias):
        return [number_or_key(name, "biases_px", each) for each in bias.biases], bias.groups
    return ([] if bias is None else [number_or_key(name, "biases_px", bias)]), None


def _bias_of_each(alignments: Sequence[Alignment], biases_px: Any) -> list[int | float | GroupedBias | None]:
    """The bias of each alignment; a single one belongs to the silhouettes."""
    if isinstance(biases_px, list | tuple):
        if len(biases_px) != len(alignments):
            raise FactorError(
                "biases_px",
                count_of(len(biases_px), "entry", "entries"),
                f"{len(alignments)}, one an alignment",
            )
        biases = list(biases_px)
    else:
        biases = [None if alignment.normals is None else biases_px for alignment in alignments]
    for alignment, bias in zip(alignments, biases, strict=True):
        if alignment.normals is None and bias is not None:
            raise FactorError(
                "biases_px", "a bias for point-to-pixel matches", "None: only silhouettes have one"
            )
        if isinstance(bias, GroupedBias) and len(bias.groups) != len(alignment):
            found = f"shape {bias.groups.shape}"
            raise FactorError("groups of a GroupedBias", found, f"shape ({len(alignment)},), one a match")
    return biases


def _terms_of_each(
    alignments: Sequence[Alignment], terms: Sequence[Sequence[LinearTerm]] | None
) -> list[Sequence[LinearTerm]]:
    """The terms of each alignment, their shapes checked."""
    if terms is None:
        return [()] * len(alignments)
    checked_type("terms", terms, (list, tuple), "a list of LinearTerm for each alignment")
    if len(terms) != len(alignments):
        raise FactorError(
            "terms", count_of(len(terms), "entry", "entries"), f"{len(alignments)}, one an alignment"
        )
    for alignment, own in zip(alignments, terms, strict=True):
        checked_type("terms of an alignment", own, (list, tuple), "a list of LinearTerm")
        if own and alignment.normals is None:
            raise FactorError("terms", "one for point-to-pixel matches", "none: only silhouettes have them")
        for term in own:
            checked_type("terms of an alignment", term, LinearTerm, "a sst_graph.factors.LinearTerm")
            checked_array("coefficients of a linear term", term.coefficients, (len(alignment),))
    return list(terms)


def _scalar(value: Any) -> float:
    """The number in a float or a ``Vector(1)``."""
    return float(np.asarray(value, dtype=np.float64).reshape(()) if np.ndim(value) == 0 else value[0])
