"""What a new user of gtsam might give in place of an argument."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E, V

from sst_graph.errors import SstGraphError

POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3]))
UNIT = gtsam.noiseModel.Unit.Create(6)
PRIORS = gtsam.NonlinearFactorGraph()
PRIORS.add(gtsam.PriorFactorPose3(E(0), POSE, UNIT))
PRIOR = PRIORS.at(0)


def _of_another(this: gtsam.CustomFactor, values: gtsam.Values, H: list[np.ndarray] | None) -> np.ndarray:
    if H is not None:
        H[0] = np.eye(6, order="F")
    return np.asarray(values.atVector(V(0)))


WRONG: dict[str, Any] = {
    "array": np.zeros(3),
    "duration": np.timedelta64(7, "s"),
    "matrix": np.eye(4),
    "NaN points": np.full((5, 3), np.nan),
    "points of two": np.zeros((5, 2)),
    "complex": np.zeros(6, complex),
    "Pose2": gtsam.Pose2(),
    "Pose3": POSE,
    "Pose3 with NaN": gtsam.Pose3(gtsam.Rot3(), np.array([0.0, np.nan, 0.0])),
    "Rot3": gtsam.Rot3(),
    "noise model": gtsam.noiseModel.Isotropic.Sigma(6, 0.1),
    "factor": PRIOR,
    "other's factor": gtsam.CustomFactor(UNIT, [V(0)], _of_another),
    "graph": PRIORS,
    "no values": gtsam.Values(),
    "text": "E0",
    "bytes": b"E0",
    "int": 7,
    "negative": -7,
    "many digits": 10**5000,
    "float": 0.7,
    "NaN": float("nan"),
    "None": None,
    "True": True,
    "list": [1.0, 2.0, 3.0],
    "texts": ["1", "2", "3"],
    "ragged": [[1.0], [1.0, 2.0]],
    "empty": [],
    "dict": {},
    "set": {1.5},
    "class": gtsam.Pose3,
    "function": len,
    "object": object(),
}
"""By a word for each."""


def check_refusals(
    name: str,
    call: Callable[..., Any],
    arguments: dict[str, Any],
    fits_by_name: Mapping[str, set[str]],
    in_one_sentence: Callable[[str], None],
) -> None:
    """Call with arguments that fit, then with each of them replaced by each of the wrong objects.

    Args:
        fits_by_name: which of these fit, by name of the argument, or of function and argument.
        in_one_sentence: what an error must say.
    """
    call(**arguments)
    for argument in arguments:
        fits = fits_by_name.get(f"{name}.{argument}", fits_by_name.get(argument, set()))
        for kind, wrong in WRONG.items():
            try:
                call(**{**arguments, argument: wrong})
            except SstGraphError as error:
                said = str(error)
                assert kind not in fits, f"{name}({argument}={kind}): {said}"
                in_one_sentence(said)
            except Exception as error:
                pytest.fail(f"{name}({argument}={kind}): {type(error).__name__}: {error}")
            else:
                assert kind in fits, f"{name}({argument}={kind}) was taken"
