"""Arrays in every layout that NumPy has: the result of the plain array of these numbers, or a FactorError.

Every public constructor and function of ``sst_graph.factors`` is called with each of its arrays in each
layout. What it makes is then used: a factor is linearized, a dataclass goes into the factor that it is for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import gtsam
import numpy as np
import pytest
from factor_arguments import CAMERA, CAMERA_MOTION, LIDAR_MOTION, OUTLINE, RIGHT, TWIST
from gtsam.symbol_shorthand import B, D, E, T, V, X
from wrong_objects import POSE

from sst_graph import factors
from sst_graph.factors import FactorError

VALUES = gtsam.Values()
for _k in range(3):
    VALUES.insert(X(_k), gtsam.Pose3(gtsam.Rot3.Rz(0.01 * _k), np.array([0.5 * _k, 0.0, 0.0])))
    VALUES.insert(V(_k), TWIST + 0.1 * _k)
for _k in range(2):
    VALUES.insert(E(_k), POSE)
    VALUES.insert(B(_k), np.array([0.3 + _k]))
    VALUES.insert(D(_k), np.array([0.1]))
VALUES.insert(T(0), np.array([0.2]))


def _unaligned(array: np.ndarray) -> np.ndarray:
    held = np.zeros(array.nbytes + 1, np.uint8)[1:].view(np.uint8)
    view = np.ndarray(array.shape, np.float64, buffer=held.data)
    view[...] = array
    assert not view.flags.aligned
    return view


def _spaced(array: np.ndarray) -> np.ndarray:
    held = np.full((*(2 * n for n in array.shape), 2), 9e9)
    view = held[(*(slice(None, None, 2) for _ in array.shape), 0)]
    view[...] = array
    return view


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.copy()
    view.flags.writeable = False
    return view


def _backwards(array: np.ndarray) -> np.ndarray:
    every = (slice(None, None, -1),) * array.ndim
    return np.ascontiguousarray(array[every])[every]


SAME: dict[str, Callable[[np.ndarray], Any]] = {
    "Fortran": np.asfortranarray,
    "spaced": _spaced,
    "backwards": _backwards,
    "transposed": lambda a: a.T.copy().T,
    "read-only": _read_only,
    "unaligned": _unaligned,
    "big-endian": lambda a: a.astype(">f8"),
    "long double": lambda a: a.astype(np.longdouble),
    "list": lambda a: a.tolist(),
    "tuple": lambda a: tuple(map(tuple, a.tolist())) if a.ndim == 2 else tuple(a.tolist()),
    "list of arrays": list,
    "a subclass": lambda a: a.view(type("Own", (np.ndarray,), {})),
}
"""Other homes of the same numbers."""
OTHER: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "float32": lambda a: a.astype(np.float32),
    "float16": lambda a: a.astype(np.float16),
    "int64": lambda a: np.rint(a).astype(np.int64),
    "int32": lambda a: np.rint(a).astype(np.int32),
    "uint8": lambda a: np.abs(np.rint(a)).astype(np.uint8),
    "one number, spread": lambda a: np.broadcast_to(a.flat[0], a.shape),
}
"""Layouts of coarser numbers: the plain array of these is the other side."""
SHAPES: dict[str, Callable[[np.ndarray], Any]] = {
    "column": lambda a: a.reshape(-1, 1),
    "row": lambda a: a.reshape(1, -1),
    "one more axis": lambda a: a[None],
    "one more axis, last": lambda a: a[..., None],
    "flat": np.ravel,
    "turned": np.transpose,
    "a matrix": lambda a: np.asmatrix(a.reshape(len(a), -1)),
    "a memory's view": lambda a: memoryview(np.ascontiguousarray(a)),
    "True and False": lambda a: a.astype(bool),
    "objects": lambda a: a.astype(object),
    "empty": lambda a: a[:0],
    "masked": lambda a: np.ma.array(a, mask=np.ones(a.shape, bool)),
    "zero-dimensional": lambda a: np.array(a.flat[0]),
    "records": lambda a: np.zeros(a.shape, [("x", float)]),
}
"""Other arrays, which are refused or, where they have no more and no fewer numbers, taken for the same."""

pytestmark = pytest.mark.filterwarnings("ignore:the matrix subclass")


FIVE = np.linspace(0.8, 1.2, 5)
TWISTS = np.linspace(0.9, 1.1, 5) * TWIST[:, None]
ARRAYS: dict[tuple[str, str], np.ndarray] = {
    **{
        (name, argument): value
        for name, right in RIGHT.items()
        for argument, value in right.items()
        if isinstance(value, np.ndarray)
    },
    ("Alignment", "base_taus_s"): 0.1 * FIVE,
    ("Alignment", "sigmas_px"): FIVE,
    ("move_points", "taus_s"): 0.1 * FIVE,
    ("twist_jerk_factor", "seconds"): np.array([0.1, 0.2]),
    **{
        (name, "c_twist"): TWIST
        for name in ("frame_factor", "pixel_to_point_factor", "point_to_pixel_factor", "silhouette_factor")
    },
}
"""The arrays among the arguments that fit, and arrays in the place of others."""
WIDE: dict[tuple[str, str], np.ndarray] = {
    ("Alignment", "c_acceleration"): TWISTS.T,
    ("CameraTwist", "c_twist"): TWISTS,
    ("CameraTwist", "c_acceleration"): TWISTS,
    **{(name, "c_twist"): TWISTS for name in ("residuals", "weighted_residuals", "alignment_cost")},
}
"""The same arguments where they have a column, or row, for each match."""
CASES = [(*place, plain) for place, plain in (*ARRAYS.items(), *WIDE.items())]


def numbers_of(made: Any) -> list[np.ndarray]:
    """All numbers that a result leads to."""
    if isinstance(made, gtsam.NonlinearFactor):
        linear = made.linearize(VALUES)
        return [np.array(made.error(VALUES)), linear.augmentedInformation()]
    if made is None or isinstance(made, str | bool | gtsam.noiseModel.Base):
        return []
    if isinstance(made, gtsam.Pose3):
        return [made.matrix()]
    if isinstance(made, list | tuple):
        return [number for each in made for number in numbers_of(each)]
    if isinstance(made, factors.RigidlyMoved | factors.PointwiseMoved):
        out = np.zeros((13 if made.lift is None else made.lift.shape[1], 2, made.cPs.shape[1]))
        made.write_rows(np.ones((3, 2, made.cPs.shape[1])), out)
        return [made.cPs, out, *numbers_of(made.lift)]
    if type(made) in USED:
        return numbers_of(USED[type(made)](made))
    if is_dataclass(made):
        return numbers_of([getattr(made, each.name) for each in fields(made)])
    return [np.array(made, np.float64)]


USED: dict[type, Callable[[Any], Any]] = {
    factors.Alignment: lambda a: (
        factors.residuals(a, POSE, 0.1, TWIST, 0.5),
        a.c_acceleration.ndim > 1 or factors.frame_factor([a], E(0), D(0), V(0)),
        a.c_acceleration.ndim > 1 or factors.stacked(factors.frame_factor([a], E(0), D(0), V(0))),
    ),
    factors.GroupedBias: lambda b: factors.frame_factor([OUTLINE], E(0), D(0), V(0), [b]),
    factors.LinearTerm: lambda t: factors.frame_factor([OUTLINE], E(0), D(0), V(0), terms=[[t]]),
    factors.CameraTwist: lambda m: factors.move_points(POSE, OUTLINE.lPs.T, np.full(5, 0.1), m),
    factors.CameraMotion: lambda m: factors.hand_eye_factor(E(0), D(0), m, LIDAR_MOTION),
    factors.LidarMotion: lambda m: factors.hand_eye_factor(E(0), D(0), CAMERA_MOTION, m),
    factors.LidarTwist: lambda m: factors.twist_transfer_factor(V(0), E(0), D(0), m, np.eye(6)),
}


def outcome(name: str, argument: str, value: Any) -> list[np.ndarray] | None:
    """The numbers of what is made with this argument; None where it is refused."""
    try:
        return numbers_of(getattr(factors, name)(**{**RIGHT[name], argument: value}))
    except FactorError as error:
        assert "\n" not in str(error)
        return None


def same(found: list[np.ndarray] | None, wanted: list[np.ndarray] | None) -> bool:
    if found is None or wanted is None:
        return found is wanted
    return len(found) == len(wanted) and all(
        a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True)
        for a, b in zip(found, wanted, strict=True)
    )


@pytest.mark.parametrize(("name", "argument", "plain"), CASES)
def test_the_layout_of_an_array_changes_nothing(name: str, argument: str, plain: np.ndarray) -> None:
    wanted = outcome(name, argument, np.array(plain, order="C"))
    assert wanted is not None
    for layout, change in SAME.items():
        assert same(outcome(name, argument, change(plain)), wanted), layout
    for layout, coarser in OTHER.items():
        array = coarser(plain)
        kind = np.float64 if plain.dtype.kind == "f" else plain.dtype
        of_plain = outcome(name, argument, array.astype(kind).copy())
        assert same(outcome(name, argument, array), of_plain), layout
    for layout, change in SHAPES.items():
        array = change(plain)
        found = outcome(name, argument, array)
        if layout == "zero-dimensional":  # one number for all, where that fits
            wanted = outcome(name, argument, float(array))
        assert found is None or same(found, wanted), layout


NUMBERS: dict[str, Callable[[float], Any]] = {
    "0-d": np.array,
    "0-d float32": lambda x: np.array(np.float32(x)),
    "float32": np.float32,
    "float16": np.float16,
    "long double": np.longdouble,
    "array of one": lambda x: np.array([x]),
    "list of one": lambda x: [x],
    "matrix of one": lambda x: np.array([[x]]),
}


@pytest.mark.parametrize(
    ("name", "argument"), [(n, a) for n, right in RIGHT.items() for a in right if isinstance(right[a], float)]
)
def test_numbers_may_be_those_of_numpy(name: str, argument: str) -> None:
    for layout, change in NUMBERS.items():
        with np.errstate(over="ignore"):  # past all numbers of 16 bits: inf
            number = change(RIGHT[name][argument])
        found = outcome(name, argument, number)
        assert found is None or same(found, outcome(name, argument, float(np.ravel(number)[0]))), layout
    for missing in (np.ma.masked, np.ma.array(0.5, mask=True), np.zeros(0)):
        assert outcome(name, argument, missing) is None


POINTS_IN_CAMERA = np.array([[1.0 + k, 2.0, 8.0 - k] for k in range(5)])
METHODS: dict[str, tuple[Callable[[Any], Any], np.ndarray]] = {
    "in_front": (CAMERA.in_front, POINTS_IN_CAMERA),
    "in_image": (CAMERA.in_image, OUTLINE.pixels),
    "project": (CAMERA.project, POINTS_IN_CAMERA),
    "uv_H_cP": (CAMERA.uv_H_cP, POINTS_IN_CAMERA),
    **{
        f"{name} of {kind}": (getattr(factors.RobustKernel(kind, 2.0), name), POINTS_IN_CAMERA)
        for name in ("weight", "loss", "curvature")
        for kind in ("none", "huber", "cauchy", "geman_mcclure", "tukey")
    },
}


@pytest.mark.parametrize("name", METHODS)
def test_the_layout_changes_nothing_for_methods(name: str) -> None:
    call, plain = METHODS[name]
    for layout, change in SAME.items():
        assert np.allclose(call(change(plain)), call(plain), rtol=1e-9, atol=1e-9), layout
    for layout, coarser in OTHER.items():
        array = coarser(plain)
        assert np.allclose(call(array), call(array.astype(np.float64).copy()), rtol=1e-9, atol=1e-9), layout


RETURNED = {**SAME, **OTHER, **SHAPES}


@pytest.mark.parametrize("layout", RETURNED)
@pytest.mark.parametrize("part", ["error", "first Jacobian", "last Jacobian"])
@pytest.mark.parametrize("dims", [(6, 1), (1, 6)])
def test_what_a_function_returns_may_have_any_layout(layout: str, part: str, dims: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    plain = {
        "error": rng.normal(size=4),
        "first Jacobian": rng.normal(size=(4, dims[0])),
        "last Jacobian": rng.normal(size=(4, dims[1])),
    }
    kinds = {6: (E(0), 6), 1: (D(0), 1)}

    def factor(parts: dict[str, Any]) -> gtsam.CustomFactor:
        def function(*values: Any, jacobians: bool) -> tuple[Any, Any]:
            return parts["error"], [parts["first Jacobian"], parts["last Jacobian"]] if jacobians else None

        keys = [kinds[dim][0] for dim in dims]
        return factors.custom_factor(gtsam.noiseModel.Unit.Create(4), keys, function, dims, 4)

    changed = RETURNED[layout](plain[part])
    try:
        found = factor({**plain, part: changed}).linearize(VALUES)
    except FactorError:
        assert layout in SHAPES
        return
    wanted = factor({**plain, part: np.array(changed, np.float64)}).linearize(VALUES)
    for a, b in zip(found.jacobian(), wanted.jacobian(), strict=True):
        assert np.allclose(a, b, rtol=1e-12, atol=1e-12)
