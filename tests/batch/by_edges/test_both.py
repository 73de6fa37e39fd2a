"""Labels and edges of different frames in one estimate."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from stored import simulated

from sst_graph import CalibrationConfig, calibrate
from sst_graph.batch.by_edges.both import fuse_parts
from sst_graph.batch.by_edges.choice import with_method_for, with_method_of
from sst_graph.batch.by_edges.fusion import Fused, state_of
from sst_graph.batch.by_edges.label_parts import split_by_labels
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.method_estimate import MethodEstimate, result_of
from sst_graph.batch.problem import CalibrationProblem, MatchedDrives
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.experiments.starts import errors_of
from sst_graph.factors.robust import RobustKernel
from sst_graph.fit import EDGES_QUALITY, FitQuality
from sst_graph.graph.matching import edges_of, match_all
from sst_graph.graph.outer_loop import JointSolution, solve_joint
from sst_graph.graph.state import EXTRINSIC, State, difference, time_offset_key
from sst_graph.inspect.verdict import fit_line, quality_line
from sst_graph.report import ReportInputs, report_html
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Frame, Guess, SemanticClass

FloatArray = NDArray[np.float64]
VEHICLE, OBJECT, IGNORE = SemanticClass.VEHICLE, SemanticClass.OBJECT, SemanticClass.IGNORE
SMALL = SimulationConfig(
    seed=504,
    frames=6,
    motion="no_stop",
    azimuth_limit_deg=50.0,
    width=621,
    height=188,
    time_offset_s=0.02,
    moving_fraction=0.0,
)
STREET = SimulationConfig(seed=506, frames=16, motion="no_stop", azimuth_limit_deg=50.0, time_offset_s=0.01)
AWAY = np.array([0.03, -0.04, 0.03, 0.05, -0.04, 0.06])


def bare(frame: Frame) -> Frame:
    """The frame without labels."""
    assert frame.scan is not None and frame.image is not None
    scan = replace(frame.scan, classes=np.full_like(frame.scan.classes, IGNORE), instances=None)
    image = replace(frame.image, mask=np.full_like(frame.image.mask, IGNORE), instances=None)
    return replace(frame, scan=scan, image=image)


def with_labels_in(config: SimulationConfig, every: int, *, name: str = "street") -> KeptDrive:
    """A street with labels in every so many frames."""
    kept = KeptDrive.of(simulated(config), sweep="known")
    frames = tuple(f if k % every == 0 else bare(f) for k, f in enumerate(kept.frames))
    return replace(kept, frames=frames, name=name)


def estimate(cTl: gtsam.Pose3, offset_s: float, sigmas: FloatArray, *reasons: str) -> MethodEstimate:
    covariance = np.diag(np.square(sigmas))
    return MethodEstimate(cTl, offset_s, covariance, (), reasons, by_static_objects=covariance)


# --- the frames


@cache
def prepared() -> Drive:
    config = CalibrationConfig(method="both", decide_sweep=False)
    return prepare_drives([with_labels_in(SMALL, 2)], config)[0]


@cache
def parts() -> tuple[Drive, Drive]:
    (by_labels,), (by_edges,) = split_by_labels([prepared()])
    return by_labels, by_edges


@pytest.mark.slow
def test_labels_and_edges_are_of_different_pairs() -> None:
    by_labels, by_edges = parts()
    state = State(simulated(SMALL).truth.cTl, (simulated(SMALL).truth.time_offset_s,))
    found = []
    for drive, c in ((by_labels, VEHICLE), (by_edges, OBJECT)):
        problem = CalibrationProblem.of([drive], Guess(state.cTl), CalibrationConfig())
        joint = problem.joint()
        edges = edges_of([drive], joint.motions, joint.config.graph)
        (matches,) = match_all(edges, state, RobustKernel("geman_mcclure", 5.0))
        assert set(matches.classes) == {c}
        found.append({(matches.pairs[p].scan, matches.pairs[p].image) for p in matches.paired})
    assert all(scan % 2 == 0 and image % 2 == 0 for scan, image in found[0])
    assert len(found[1]) >= 3 and not any(scan % 2 == 0 and image % 2 == 0 for scan, image in found[1])


@pytest.mark.slow
def test_a_whole_drive_goes_one_way() -> None:
    labelled = prepare_drives([with_labels_in(SMALL, 1)], CalibrationConfig(method="both"))
    by_labels, by_edges = split_by_labels(labelled)
    assert len(by_labels) == 1 and by_edges == []
    assert not any(OBJECT in image.contours for image in by_labels[0].images)
    assert any(by_labels[0].scans[0].lower_edges)
    by_labels, by_edges = split_by_labels([replace(prepared(), scans=parts()[1].scans)])
    assert by_labels == [] and by_edges[0].labelled_ns == (frozenset(), frozenset())


# --- the method that auto takes


@pytest.mark.slow
def test_auto_takes_both_where_some_drives_have_labels() -> None:
    config = CalibrationConfig()

    def auto(*sources: KeptDrive) -> str:
        return with_method_for(config, sources).method

    whole, some, none = (with_labels_in(SMALL, every) for every in (1, 3, 100))
    none = replace(none, frames=tuple(map(bare, none.frames)))
    assert (auto(whole), auto(some), auto(none)) == ("joint", "joint", "edges")
    assert auto(whole, none) == "both" and auto(none, none) == "edges"
    dark = some.with_images(lambda image: replace(image, pixels=np.zeros((0, 0, 3), np.uint8)))
    assert auto(dark) == "joint"
    # Masks of persons only are labels: joint says what is wrong.
    persons = whole.with_images(
        lambda image: replace(image, mask=np.where(image.mask == VEHICLE, SemanticClass.PERSON, image.mask))
    )
    assert auto(persons) == auto(whole, persons) == "joint"
    assert with_method_for(replace(config, time_offset_per_drive=True), [whole, none]).method == "edges"
    assert with_method_of(config, [prepared()]).method == "both"
    assert with_method_of(config, [parts()[0]]).method == "joint"
    assert with_method_of(config, [parts()[1]]).method == "edges"


# --- the product


def linear(solution: JointSolution) -> tuple[FloatArray, FloatArray, list[int]]:
    """Information and its vector of the last frozen graph at its values, extrinsic and offset first."""
    keys = sorted(solution.values.keys())
    sizes = {key: 6 if key == EXTRINSIC else solution.values.atVector(key).size for key in keys}
    starts = dict(zip(keys, np.cumsum([0, *(sizes[key] for key in keys)]).tolist(), strict=False))
    first = [EXTRINSIC, time_offset_key()]
    order = [*first, *(key for key in keys if key not in first)]
    columns = [starts[key] + k for key in order for k in range(sizes[key])]
    H, eta = solution.graph.linearize(solution.values).hessian()
    return H[np.ix_(columns, columns)], eta[columns], columns


SHARED = np.array([*np.radians([0.06] * 3), 0.01, 0.01, 0.01, 0.004])
"""(7,) deviations of what matches of one kind share [rad, m, s]."""


@pytest.mark.slow
def test_the_product_is_the_estimate_of_one_graph() -> None:
    """All variables of both kinds in one linear system, with a copy of the calibration for each kind."""
    truth = simulated(SMALL).truth
    start, config = State(truth.cTl, (truth.time_offset_s,)), CalibrationConfig()
    kinds, size = [], 7
    for drive, kernels, factor in zip(parts(), ((4.0, 3.0), (3.0, 2.0)), (0.2, 1.0), strict=True):
        problem = CalibrationProblem.of([drive], Guess(truth.cTl, truth.time_offset_s), config)
        solution = solve_joint(replace(problem.joint(), centre=start), start, kernels)
        H, eta, columns = linear(solution)
        P, mean = np.linalg.inv(H), np.linalg.solve(H, eta)
        shared = factor * SHARED.reshape(7, 1) * (np.eye(7) + 0.3) * SHARED
        covariance = P[:7, :7] + shared
        values = solution.values
        found = MethodEstimate(
            values.atPose3(EXTRINSIC).retract(mean[:6]),
            float(values.atVector(time_offset_key())[0] + mean[6]),
            covariance,
            (),
        )
        kinds.append((found, H, eta, shared, values, size))
        size += len(columns)
    # The calibration is expressed as a step from the first kind's estimate.
    first = kinds[0][0]
    system, vector = np.zeros((size, size)), np.zeros(size)
    for _, H, eta, between, values, place in kinds:
        own = slice(place, place + len(H))
        system[own, own] += H
        vector[own] += eta
        link = np.zeros((7, size))
        link[:, :7], link[:, place : place + 7] = np.eye(7), -np.eye(7)
        # calibration - copy: first + step - (values + own step)
        apart = np.append(
            gtsam.Pose3.Logmap(first.cTl.between(values.atPose3(EXTRINSIC))),
            values.atVector(time_offset_key())[0] - first.time_offset_s,
        )
        weight = np.linalg.inv(between)
        system += link.T @ weight @ link
        vector += link.T @ weight @ apart
    covariance = np.linalg.inv(system)[:7, :7]
    step = np.linalg.solve(system, vector)[:7]
    fused = Fused.of(first, kinds[1][0])
    moved = difference(state_of(first), fused.state)
    sigmas = np.sqrt(np.diag(covariance))
    assert (np.abs(moved) > 0.02 * sigmas).any()
    np.testing.assert_allclose(moved / sigmas, step / sigmas, atol=1e-3)
    scaled = fused.covariance / (fused.chi2 / 7.0 if fused.chi2 > 14.07 else 1.0)
    np.testing.assert_allclose(
        scaled / np.outer(sigmas, sigmas), covariance / np.outer(sigmas, sigmas), atol=1e-3
    )


def test_weights_follow_the_sigmas() -> None:
    """In closed form, of numbers that do not correlate."""
    rng = np.random.default_rng(3)
    a, b = rng.uniform(0.001, 0.01, (2, 7))
    pose = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -0.1, 0.2), np.array([0.1, 0.2, -0.3]))
    apart = 0.5 * np.hypot(a, b) * rng.choice([-1.0, 1.0], 7)
    second = estimate(pose.retract(apart[:6]), 0.02 + apart[6], b)
    first = replace(estimate(pose, 0.02, a), by_sweeps=np.diag((0.5 * a) ** 2))
    fused = Fused.of(first, second)
    share = a**2 / (a**2 + b**2)
    moved = np.append(gtsam.Pose3.Logmap(pose.between(fused.state.cTl)), fused.state.time_offsets_s[0] - 0.02)
    np.testing.assert_allclose(moved, share * apart, rtol=1e-6, atol=1e-12)
    variances = a**2 * b**2 / (a**2 + b**2) + ((1.0 - share) * 0.5 * a) ** 2
    np.testing.assert_allclose(fused.covariance, np.diag(variances), atol=1e-15)
    assert fused.chi2 == pytest.approx(7 * 0.25, rel=1e-6)


def test_what_moves_both_parts_alike_is_not_averaged() -> None:
    """A principal point that is off, drawn for both at once, among errors of their own."""
    rng = np.random.default_rng(5)
    sigmas, steps = np.full(7, 0.002), [{"cx": np.eye(7)[2] * size} for size in (0.01, 0.008)]
    covariances = [np.diag(sigmas**2) + np.outer(step["cx"], step["cx"]) for step in steps]
    errors, squared, claims = [], [], []
    for _ in range(400):
        shift = rng.normal()
        first, second = (
            replace(
                estimate(gtsam.Pose3.Expmap(error[:6]), error[6], sigmas),
                covariance=covariance,
                assumption_steps=step,
            )
            for covariance, step in zip(covariances, steps, strict=True)
            for error in [sigmas * rng.normal(size=7) + shift * step["cx"]]
        )
        fused = Fused.of(first, second)
        squared.append(fused.chi2)
        claims.append(fused.covariance[2, 2])
        errors.append(np.append(gtsam.Pose3.Logmap(fused.state.cTl), fused.state.time_offsets_s[0]))
    claimed = np.median(claims)
    assert np.var([error[2] for error in errors]) == pytest.approx(claimed, rel=0.2)
    assert np.mean(squared) == pytest.approx(7.0, rel=0.1)
    apart = Fused.of(*(replace(part, assumption_steps={}) for part in (first, second)))
    assert apart.covariance[2, 2] < 0.6 * claimed


def test_parts_that_contradict_each_other_are_not_trusted() -> None:
    sigmas = np.array([*np.radians([0.1] * 3), 0.01, 0.01, 0.01, 0.003])
    one = estimate(gtsam.Pose3(), 0.0, sigmas)
    near, far, farther = (estimate(gtsam.Pose3(), k * 0.003 * np.sqrt(2.0), sigmas) for k in (1, 4, 7))
    assert fuse_parts(one, near).reasons == () and fuse_parts(one, far).reasons == ()
    np.testing.assert_allclose(fuse_parts(one, near).covariance, np.diag(sigmas**2) / 2.0)
    np.testing.assert_allclose(fuse_parts(one, far).covariance, np.diag(sigmas**2) / 2.0 * 16.0 / 7.0)
    (reason,) = fuse_parts(one, farther).reasons
    assert "contradict each other" in reason and "+29.7 ms" in reason


def test_undecided_sweeps_are_judged_by_what_they_do_to_both() -> None:
    sigmas = np.full(7, 0.01)
    one = estimate(gtsam.Pose3(), 0.0, sigmas)
    for share, open_sweeps in ((0.05, ()), (0.9, ("sweep",))):
        part = replace(one, by_sweeps=share * one.covariance, open_sweeps=("sweep",))
        for other in (part, replace(part, open_sweeps=())):
            found = fuse_parts(part, other)
            assert found.open_sweeps == open_sweeps and found.reasons == ()


def test_what_is_not_sound_is_left_out() -> None:
    sigmas = np.full(7, 0.01)
    good, bad = estimate(gtsam.Pose3(), 0.01, sigmas), estimate(gtsam.Pose3(), 0.5, sigmas, "moved")
    for found, name in ((fuse_parts(good, bad), "edges"), (fuse_parts(bad, good), "labels")):
        assert found.time_offset_s == 0.01 and found.reasons == ()
        assert found.remarks == (f"{name} were left out: moved",)
    assert fuse_parts(good, "nothing in view").remarks == ("edges were left out: nothing in view",)
    assert fuse_parts(bad, bad).reasons == ("by labels: moved", "by edges: moved")
    with pytest.raises(EstimationError, match=r"by labels: none; by edges: nothing"):
        fuse_parts("none", "nothing")


# --- how both fit


@cache
def fused() -> tuple[MethodEstimate, Guess]:
    """Labels and edges that are each a little off, and their start."""
    truth = simulated(SMALL).truth
    assert truth is not None
    guess, sigmas = Guess(truth.cTl.retract(AWAY)), np.array([2e-3] * 3 + [0.02] * 3 + [0.003])
    found = []
    for drive, sign in zip(parts(), (1.0, -1.0), strict=True):
        step = sign * np.array([*np.radians([0.02, -0.05, 0.05]), 0.01, -0.01, 0.01])
        own = estimate(truth.cTl.retract(step), SMALL.time_offset_s, sigmas)
        problem = CalibrationProblem.of([drive], guess, CalibrationConfig(method="both"))
        own = replace(own, matched=MatchedDrives(problem, state_of(own)))
        found.append(replace(own, diagnostics={"kind": sign}))
    return fuse_parts(*found), guess


@pytest.mark.slow
def test_labels_and_edges_are_measured_apart_at_the_estimate_of_both() -> None:
    both, _ = fused()
    labels, edges = both.fit, both.edges_fit
    assert labels is not None and not labels.by_edges and edges is not None and edges.by_edges
    assert set(labels.points.classes.tolist()) == {VEHICLE} and set(edges.points.classes.tolist()) == {OBJECT}
    # Frames with labels have no edges.
    paired = {(frame.scan, frame.image) for frame in labels.frames}
    assert paired and not paired & {(frame.scan, frame.image) for frame in edges.frames}
    assert labels.profiles == edges.profiles == labels.iterations == edges.iterations == ()
    for fit, drive in ((labels, parts()[0]), (edges, parts()[1])):
        problem = CalibrationProblem.of([drive], fused()[1], CalibrationConfig(method="both"))
        own = problem.fit_at(State(both.cTl, (both.time_offset_s,)))
        assert own is not None and own.quality == fit.quality
        assert fit.quality.share_at_start is not None and fit.quality.share > fit.quality.share_at_start


def test_the_page_has_a_section_of_each() -> None:
    both, guess = fused()
    result = result_of(both, [prepared()], guess, CalibrationConfig(method="both"))
    of_labels, of_edges = (fit.quality for fit in result.fits)
    assert FitQuality.from_diagnostics(result.diagnostics) == of_labels
    assert FitQuality.from_diagnostics(result.diagnostics, EDGES_QUALITY) == of_edges
    assert fit_line(result) == (
        f"labels: {quality_line(of_labels)}; edges in frames without labels: {quality_line(of_edges)}"
    )
    page = report_html(ReportInputs(result, [with_labels_in(SMALL, 2)]))
    headings = re.findall(r"<h2>([^<]*)</h2>", page)
    assert headings[2:-1] == [
        "Before and after",
        "Close-ups of objects: labels",
        "Close-ups of objects: edges, in frames without labels",
        "Residuals: labels",
        "Residuals: edges, in frames without labels",
    ]
    names = re.findall(r'<section id="([^"]*)"', page)
    assert len(names) == len(set(names)) == len(headings)
    assert "% of the information of the labels. " in page and "% of the information of the edges. " in page
    of_edges_alone = page[page.index("residuals-edges") : page.index('id="background"')]
    assert "label" not in of_edges_alone.replace("frames without labels", "").replace("aria-label", "")


def test_a_part_that_is_used_alone_keeps_its_fit() -> None:
    both, _ = fused()
    labels = replace(both, fit=both.fit, edges_fit=None)
    assert fuse_parts(labels, "nothing in view").fit is both.fit
    assert fuse_parts(labels, "nothing in view").edges_fit is None


# --- the whole method


@pytest.mark.slow
def test_a_street_with_labels_in_every_second_frame() -> None:
    drive = with_labels_in(STREET, 2)
    assert drive.truth is not None
    result = calibrate(drive, drive.truth.cTl.retract(AWAY), CalibrationConfig(method="both"))
    assert result.method == "both" and result.status == "ok"
    errors = errors_of(result, drive.truth)
    assert errors.qad_deg < 0.2 and errors.atd_m < 0.03
    assert errors.nees is not None and errors.nees.joint < 2.5 * 7
    said = result.diagnostics["both"]
    sigmas = np.sqrt(np.diag(result.covariance))
    # Labels with motion know some axes so well that edges add nothing to them.
    assert all((sigmas < 1.01 * np.array(said[kind]["sigmas"])).all() for kind in ("labels", "edges"))
    assert 10 <= len(result.frames_used) <= 16
    labels, edges = result.fits
    assert edges.by_edges and not labels.by_edges and labels.quality.share > 0.6
    assert edges.quality.by_chance is not None and edges.quality.share > 1.5 * edges.quality.by_chance


@pytest.mark.slow
def test_frames_with_pictures_of_another_street_are_left_out() -> None:
    drive = with_labels_in(STREET, 2)
    others = list(simulated(dataclasses.replace(STREET, seed=77)))
    frames = []
    for k, (frame, other) in enumerate(zip(drive.frames, others, strict=True)):
        assert frame.image is not None and other.image is not None
        image = replace(frame.image, pixels=other.image.pixels) if k % 2 else frame.image
        frames.append(replace(frame, image=image))
    drive = replace(drive, frames=tuple(frames))
    assert drive.truth is not None
    result = calibrate(drive, drive.truth.cTl.retract(AWAY), CalibrationConfig(method="both"))
    # Labels in eight frames, by themselves: not wrong, if less sure.
    assert result.status != "not_converged"
    errors = errors_of(result, drive.truth)
    assert errors.nees is not None and errors.nees.joint < 2.5 * 7
    assert any(reason.startswith("edges were left out: ") for reason in result.reasons)
    assert all(used.frame % 2 == 0 for used in result.frames_used)
