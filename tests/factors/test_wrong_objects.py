"""Every public constructor and function refuses what is no argument of it, in one sentence.

Each is called once with arguments that fit, then with each of them replaced by each of the wrong objects that
a new user of gtsam might give. What does not fit is answered with a FactorError; what fits is listed.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest
from factor_arguments import RIGHT
from wrong_objects import WRONG

from sst_graph import factors
from sst_graph.factors import FactorError

MADE_HERE = {"RigidlyMoved", "PointwiseMoved", "JacobianBlock", "JacobianReport", "GncSolution"}
"""Results: the package makes them, a caller reads them."""
NO_CALLABLES = {"Kind", "KernelKind", "MotionModel", "MIN_DEPTH_M", "FactorError"}

KEY, NUMBER, POSITIVE = {"int"}, {"int", "negative", "float"}, {"int", "float"}
KEY_OR_NUMBER, KEY_OR_POSE = {"int", "float"}, {"int", "Pose3"}
BY_NAME: list[tuple[str, set[str]]] = [
    ("X_a X_b key E E_a E_b E_c V_a V_b V_c V_key E_key D_key D_a D_b", KEY),
    ("at base_taus_s cx cy image_after_a_s speed_mps taus_s time_offset_0_s", NUMBER),
    ("fx fy omega direction_rad lambda_t lambda_r low_speed_mps constant inlier_cost tolerance", POSITIVE),
    ("scale seconds sigma_rot sigma_trans sigma_s sigmas_px sigma_s_per_sqrt_s weights", POSITIVE),
    ("sigma_rot_acc sigma_lin_acc sigma_rot_jerk sigma_lin_jerk", POSITIVE),
    ("width height size max_iterations mu_step", {"int"}),
    ("c1Tc2 cTb cTl_static l1Tl2", {"Pose3"}),
    ("X_scan D c_twist", KEY | {"None"}),
    ("l_velocities stretches terms", {"None"}),
]
FITS: dict[str, set[str]] = {
    **{name: fits for names, fits in BY_NAME for name in names.split()},
    "G": {"matrix"},
    "bTl": {"Pose3", "None"},
    "bias_px": NUMBER | {"None"},
    "biases": {"array", "list"},
    "biases_px": KEY_OR_NUMBER | {"None"},
    "c1Rc2": {"Rot3"},
    "cTl": KEY_OR_POSE,
    "coefficients": {"array", "list", "empty"},
    "factor": {"factor"},
    "function": {"function", "class"},
    "custom_factor.function": {"class"},
    "graph": {"graph"},
    "groups": {"array", "empty"},
    "known_inliers": {"empty"},
    "name": {"text"},
    "new_keys": {"dict"},
    "noise": {"noise model"},
    "pixels": {"points of two"},
    "time_offset_s": KEY_OR_NUMBER,
    "CameraTwist.c_twist": set(),
    "DirectionSigmas.speed_mps": POSITIVE,
    "GncParams.inlier_cost": POSITIVE | {"function", "class"},
    "LidarTwist.l_twist": set(),
    "check_gradient.factor": {"factor", "other's factor"},
    "check_jacobians.factor": {"factor", "other's factor"},
    "check_jacobians.step": {"float"},  # a step that is right for the linear factor
    "mean_velocity_factor.mean_twist": set(),
    "move_points.cTl": {"Pose3"},
    "pose_alignment_factor.noise": {"None"},
    "recipe_of.factor": {"factor", "other's factor"},
    "stacked.factor": set(),
    "time_offset_prior.time_offset_s": NUMBER,
    "twist_jerk_factor.seconds": set(),
    "velocity_direction_factor.direction": {"list"},
    "velocity_direction_factor.omega": {"array", "list"},
    "silhouette_factor.bias_px": KEY_OR_NUMBER | {"None"},
    "velocity_factor.c_twist": set(),
}
"""Which of these are right after all: by name of the argument, or by name of the function and argument."""
for _name in ("residuals", "weighted_residuals", "alignment_cost"):
    FITS |= {f"{_name}.cTl": {"Pose3"}, f"{_name}.time_offset_s": NUMBER, f"{_name}.c_twist": set()}


def fitting(name: str, argument: str) -> set[str]:
    """Which of the wrong objects are right for this argument."""
    return FITS.get(f"{name}.{argument}", FITS.get(argument, set()))


def test_all_public_names_are_called_here() -> None:
    assert set(RIGHT) | MADE_HERE | NO_CALLABLES == set(factors.__all__)
    for name, right in RIGHT.items():
        flags = {"double", "scale_known", "jacobians"}
        assert set(inspect.signature(getattr(factors, name)).parameters) - flags == set(right), name


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_no_argument_is_refused_in_one_sentence(name: str) -> None:
    call: Callable[..., Any] = getattr(factors, name)
    call(**RIGHT[name])
    for argument in RIGHT[name]:
        fits = fitting(name, argument)
        for kind, wrong in WRONG.items():
            try:
                call(**{**RIGHT[name], argument: wrong})
            except FactorError as error:
                said = str(error)
                assert kind not in fits, f"{name}({argument}={kind}): {said}"
                assert ": found " in said and ", expected " in said and "\n" not in said, said
                assert len(said) < 300 or argument == "step", said  # which are reports on a Jacobian
            except Exception as error:
                pytest.fail(f"{name}({argument}={kind}): {type(error).__name__}: {error}")
            else:
                assert kind in fits, f"{name}({argument}={kind}) was taken"
