"""How far the cloud may sit from the picture: in the middle, and in the corners with the lens."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.inspection import inspect_result
from sst_graph.inspect.inspection_text import inspection_text
from sst_graph.inspect.misfit import misfits
from sst_graph.inspect.pixels import covariance_of_given_lens, pixel_covariance, pose_pixel_covariance
from sst_graph.inspect.verdict import verdict
from sst_graph.result import CalibrationResult

CAMERA = PinholeCamera(700.0, 700.0, 620.0, 187.0, 1241, 375)
OPTICAL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.zeros(3))
DEG = np.radians(1.0)
TINY = 1e-9
CORNER = (np.hypot(620.0, 188.0) / 700.0) ** 2
"""Square of the distance of a corner from the principal point, over that of the focal length."""


def _result(sigmas: list[float], **values: object) -> CalibrationResult:
    given = {"status": "ok", "camera": CAMERA, **values}
    return CalibrationResult(OPTICAL, 0.1, np.diag(np.square(sigmas)), **given)  # type: ignore[arg-type]


def _with_k1(method: str = "joint", **entry: Any) -> CalibrationResult:
    """0.1 deg about each axis, and a k1 that no step of the estimate takes up."""
    k1 = {"sigma": 0.01, "sensitivity": [0.0] * 7, **entry}
    return _result([0.1 * DEG] * 3 + [TINY] * 4, method=method, diagnostics={"assumptions": {"k1": k1}})


def test_a_sideways_shift_in_pixels_and_centimetres() -> None:
    """1 cm along the LiDAR's y is 700 * 0.01 / depth pixels everywhere; the other sigmas are nothing."""
    for one in misfits(_result([TINY] * 4 + [0.01, TINY, TINY])):
        assert one.pixels == pytest.approx(7.0 / one.depth_m, rel=1e-4)
        assert one.cm == pytest.approx(1.0, rel=1e-4)


def test_a_turn_is_the_same_at_every_depth_and_largest_at_the_border() -> None:
    """A yaw of 0.1 deg: f (1 + x^2) times the angle at the border's x = 620 / 700."""
    near, _, far = misfits(_result([TINY, TINY, 0.1 * DEG] + [TINY] * 4))
    ratio = 1.0 + (620.0 / 700.0) ** 2
    # The vertical part at the corner adds x y.
    expected = 0.1 * DEG * 700.0 * np.hypot(ratio, 620.0 / 700.0 * 187.0 / 700.0)
    assert near.pixels == pytest.approx(0.1 * DEG * 700.0, rel=1e-6) == far.pixels
    assert near.corner_px == pytest.approx(expected, rel=1e-3) and far.corner_px == pytest.approx(
        near.corner_px
    )
    assert far.cm == pytest.approx(6.0 * near.cm)


def test_the_time_offset_counts_while_driving_only() -> None:
    """10 ms at 10 m/s are 10 cm ahead: f x dz / z^2 and the same in y, at the corner."""
    one = misfits(_result([TINY] * 6 + [0.010]))[0]
    assert one.corner_px < 1e-3
    corner = np.hypot(620.0, 188.0)
    assert one.corner_driving_px == pytest.approx(0.1 / 10.0 * corner, rel=5e-3)


def test_a_correlation_of_shift_and_time_offset_is_kept() -> None:
    """What cannot be told apart while driving cancels while driving."""
    direction = np.zeros(7)
    direction[3], direction[6] = 0.1, 0.01
    covariance = np.outer(direction, direction) + 1e-18 * np.eye(7)
    one = misfits(replace(_result([1.0] * 7), covariance=covariance))[0]
    assert one.corner_px > 1.0 and one.corner_driving_px < 1e-3


def test_pixels_and_centimetres_are_the_same_error() -> None:
    """cm = px depth / f, whatever the covariance and the lens."""
    root = np.random.default_rng(0).normal(size=(7, 7)) * np.array([1e-3] * 3 + [0.02] * 3 + [1e-3])[:, None]
    result = replace(_with_k1(), covariance=root @ root.T)
    for one in misfits(result):
        assert one.cm == pytest.approx(100.0 * one.pixels * one.depth_m / 700.0)
        assert one.pixels >= max(one.across_px, one.down_px)


def test_the_lens_counts_in_the_corners_only() -> None:
    """k1 = 0.01 stretches by 0.01 r^2: 5.5 px at a corner, nothing in the middle."""
    alone, with_lens = misfits(_result([0.1 * DEG] * 3 + [TINY] * 4))[1], misfits(_with_k1())[1]
    assert with_lens.pixels == alone.pixels and not alone.lens_counts and with_lens.lens_counts
    assert with_lens.corner_pose_px == alone.corner_px
    lens_px = 0.01 * CORNER * 700.0 * np.sqrt(CORNER)
    # The worst direction of the two together is nearly that of the lens.
    assert np.hypot(lens_px, alone.pixels) < with_lens.corner_px < np.hypot(lens_px, alone.corner_px)
    said = verdict(_with_k1())
    assert "0.1" in said and "1.2 px off in the middle" in said
    assert f"in the corners, where the lens counts, {with_lens.corner_px:.1f} px" in said
    assert "corners" not in verdict(_result([TINY] * 3 + [0.01] * 3 + [TINY]))
    # And what to do about it, of what is not estimated already and where the method can.
    assert said.endswith("calibrate the lens, or estimate it too: --estimate focal,k1.")
    diagnostics = {**_with_k1().diagnostics, "estimated": {"focal": {"value": 0.0, "sigma": 1e-3}}}
    assert verdict(replace(_with_k1(), diagnostics=diagnostics)).endswith(": --estimate k1.")
    # A sweep that the scans leave open would make up more of sigmas that are smaller.
    sweep = {"a/00": {"kind": "undecided"}, "b/00": {"kind": "clockwise"}}
    swept = {**_with_k1().diagnostics, "sweep": sweep}
    said = verdict(replace(_with_k1(), diagnostics=swept))
    assert said.endswith("--estimate focal,k1, and give --sweep, which the scans leave open.")
    assert verdict(_with_k1("motion")).endswith("For better corners calibrate the lens.")
    assert "lens" not in verdict(_result([TINY, TINY, 0.1 * DEG] + [TINY] * 4))


def test_inspect_says_the_same_as_the_report() -> None:
    result = _with_k1()
    inspection = inspect_result(result)
    assert [one.range_m for one in inspection.pixels] == [10.0, 30.0, 60.0]
    for pixel, one in zip(inspection.pixels, misfits(result), strict=True):
        assert (pixel.across_px, pixel.down_px) == (one.across_px, one.down_px)
        assert pixel.corner_px == one.corner_px
    lines = inspection_text(inspection).splitlines()
    assert "  straight ahead, across x down         1.2 x 1.2, 1.2 x 1.2, 1.2 x 1.2 px" in lines
    assert any(line.startswith("  in the corners, where the lens counts ") for line in lines)


def test_a_lens_that_is_known_to_be_off_counts_with_its_estimate() -> None:
    """By edges its step is in the covariance of a result that stands; the picture is off all the same."""
    off = {"sigma": 0.001, "estimate": 0.0154, "estimate_sigma": 0.0042, "contradicted": True}
    by_edges, by_labels = _with_k1("edges", **off), _with_k1(**off)
    lens_px = 0.0154 * CORNER * 700.0 * np.sqrt(CORNER)
    assert misfits(by_edges)[1].corner_px > lens_px > 2.0 * misfits(by_labels)[1].corner_px
    refused = replace(by_edges, status="not_converged")
    assert misfits(refused)[1].corner_px == misfits(by_labels)[1].corner_px


def test_parameters_of_the_lens_that_are_off_together_may_take_each_other_back() -> None:
    """A focal length too long by as much as k1 stretches the corner: nothing is off there."""
    parts = {
        name: {"sigma": 1e-6, "sensitivity": [0.0] * 7, "estimate": value, "contradicted": True}
        for name, value in (("focal", -0.01), ("k1", 0.01 / CORNER))
    }
    sigmas = [0.1 * DEG] * 3 + [TINY] * 4
    result = _result(sigmas, method="edges", diagnostics={"assumptions": parts})
    at_corner = 30.0 * np.array([-620.0 / 700.0, 188.0 / 700.0, 1.0])
    given, lens = (
        covariance_of(result, at_corner, np.eye(6, 7))
        for covariance_of in (pose_pixel_covariance, pixel_covariance)
    )
    np.testing.assert_allclose(lens, given, atol=0.05)
    alone = replace(result, diagnostics={"assumptions": {"focal": parts["focal"]}})
    assert np.trace(pixel_covariance(alone, at_corner, np.eye(6, 7)) - given) > 6.0**2


def test_the_covariance_with_the_lens_that_is_given() -> None:
    own, step = np.diag(np.square([1e-3] * 7)), np.array([0.0, 0.0, 0.1, 0.2, 0.0, 0.0, 0.0])
    parts = {name: {"sigma": 0.01, "sensitivity": step.tolist()} for name in ("k1", "elevation")}
    result = _result([1.0] * 7, diagnostics={"assumptions": parts})
    part = 1e-4 * np.outer(step, step)
    found = covariance_of_given_lens(replace(result, covariance=own + 2.0 * part))
    np.testing.assert_allclose(found, own + part, atol=1e-15)
    # More than the whole covariance, as a file may say.
    np.testing.assert_allclose(covariance_of_given_lens(replace(result, covariance=own / 100)), own / 100)
