"""Short reasons: none that is known ends in the middle of a phrase, and a known cause stands before all."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import gtsam
import numpy as np
import pytest

import sst_graph
from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch.contradictions import advice
from sst_graph.batch.method_estimate import _CALIBRATE_APART
from sst_graph.cli.outputs import comparison, why_not_ok
from sst_graph.covariance.observability import MOTION, SILHOUETTES
from sst_graph.diagnosis.finding import Finding
from sst_graph.factors.camera import PinholeCamera
from sst_graph.fleet.record import reason_of
from sst_graph.inspect import reasons
from sst_graph.inspect.reasons import MOST_LETTERS, capitalized, leading_reasons, short_reason
from sst_graph.inspect.report import markdown_report, summary
from sst_graph.odometry.sweep import REMEDY
from sst_graph.report import ReportInputs, report_html
from sst_graph.result import LIKELY_CAUSES, CalibrationResult
from sst_graph.simulator import SimulationConfig, simulate

DRIVE = "kitti_2011_09_26_stop/00"
TURNED = "rotation by 0.52° ± 0.04° about the camera's y axis (yaw), time offset by +102 ms ± 3 ms"
SHARE = "(share of the sweep in the points -1.01 +- 0.02, -1 expected)"
MISFIT = (
    "the camera's motion fits the LiDAR's 12 times worse than their noise allows: check the stamps, and "
    "whether "
    "frames are missing; record a scene with more texture that does not move"
)
KINDS = [kinds for n in (1, 2, 3) for kinds in combinations(("rotation", "translation", "offset"), n)]
PARTS = "frames 0 to 29 and those from 30 on contradict each other: the later ones differ in"
SHIFTED = (
    "the LiDAR shifted forward cannot be distinguished from the image taken later: 1 m equals 91 ms of time "
    "offset (one sigma: 13.9 cm, 12.7 ms)"
)
TURN = (
    "the LiDAR turned about the axis [0.71, 0.00, 0.70] of the LiDAR's frame cannot be distinguished from "
    "the "
    "image taken earlier (one sigma: 0.40 deg, 12.1 ms)"
)
NO_MATCHES = (
    "no silhouette matches, expected 40 or more: no boundary point of a scan is near a contour of its "
    "class in "
    "the image of its time"
)
REASONS = [
    *(f"{DRIVE}: {PARTS} {TURNED}; {advice(kinds, by)}" for kinds in KINDS for by in (True, False)),
    f"{DRIVE}: frames 12 to 39 and the others contradict each other: they differ in {TURNED}; "
    f"{advice(KINDS[0])}",
    f"drive '{DRIVE}' contradicts drive '{DRIVE}1': it differs in {TURNED}; calibrate the drives apart, or "
    "check "
    "whether the mount was moved or a clock was set between them",
    f"{DRIVE}: the scans do not show whether they are compensated {SHARE}, and it matters: 0.30 deg, 4.1 cm, "
    f"3.2 ms; {REMEDY}",
    f"{DRIVE}: the points are neither as measured nor all moved to one instant {SHARE}: compensate them "
    "once, by "
    "the whole motion, or give their times",
    f"{DRIVE}: the times of the points say counterclockwise, 0.05 s a turn, the scans clockwise {SHARE}: "
    "correct "
    "the times, or say --sweep clockwise, which leaves them out",
    f"{DRIVE}: the scans are not as --sweep counterclockwise says, but as measured, clockwise {SHARE}; a "
    "turn "
    "begins at -180 deg: leave --sweep out, or say --sweep clockwise",
    f"{DRIVE}: at frame 12 the image stamps jumped by +203 ms against their own interval: {_CALIBRATE_APART}",
    f"{DRIVE}: at frame 12 the image stamps jumped by +203 ms against their own interval, but by the "
    "labels the "
    "time offset is the same before and after it (they differ by +1.2 +- 3.0 ms): the stamps are right, "
    "and the "
    "sensor has paused, or frames were picked from a faster one",
    f"motion alone gives another calibration, 1.20 deg and +12.3 ms away (chi-squared 812 of 4) ({MISFIT})",
    f"the motion was left out, for it contradicts the labels of {DRIVE}, frames 0 to 20: it differs from "
    "them in "
    f"{TURNED}",
    f"the motion was left out: {MISFIT}",
    "another start led to an estimate 12.03 deg, 44.1 cm and 120 ms away that explains the labels almost as "
    "well: record more varied scenes or give a closer guess",
    "the stamps of the images jitter by 12.1 ms (one sigma), or scans too far apart in time leave the motion "
    "between them open: stamp images by their trigger or exposure, not by their arrival, and scan at 10 Hz "
    "or "
    "more; it is in the sigmas",
    "the pictures shift against the cloud from image to image, by 2.1 px across and 3.2 px up or down (one "
    "sigma): look for a mount that vibrates, or pictures that are stabilised; it is in the sigmas",
    "solved again with edges farther away, and from there with near ones, the estimate ends 0.41 deg, 3.2 cm "
    "and 4 ms away: it has not settled on one set of edges",
    f"by labels: {NO_MATCHES}; by edges: without labels, a start is needed: a guess within 5 deg (--init)",
    "the known pose of image_3 in image_2 contradicts the estimates: they differ from it in "
    f"{TURNED} (chi-squared 77 of 6): check which camera moved, the cameras' names and the transform's "
    "direction",
    *(f"{SHIFTED}: {each.together}" for each in (SILHOUETTES, MOTION)),
    *(f"{TURN}: {each.offset}" for each in (SILHOUETTES, MOTION)),
    *(
        f"drive '{DRIVE}': by static objects alone, {SHIFTED}: {each.together}"
        for each in (SILHOUETTES, MOTION)
    ),
    *(f"{one.violation}: {one.figure(0.01234, 0.0023)}; {one.remedy}" for one in ASSUMPTIONS.values()),
]


def _text(node: ast.expr) -> str:
    """The text of an expression, with a number or a word for what is filled in."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join("12.5" if isinstance(one, ast.FormattedValue) else _text(one) for one in node.values)
    return _text(node.left) + _text(node.right) if isinstance(node, ast.BinOp) else "a dozen words of it"


def _findings() -> list[str]:
    """The sentences of all findings that the package makes."""
    found = []
    for path in Path(sst_graph.__file__).parent.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)) if "Finding(" in source else ():
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Finding":
                found.append(Finding(*(_text(one) for one in node.args[:3])).sentence)
    return found


def test_no_known_reason_is_cut() -> None:
    findings = _findings()
    assert len(findings) > 30
    for reason in (*REASONS, *findings):
        short = short_reason(reason)
        assert len(short) <= MOST_LETTERS and "…" not in short, short


def _texts() -> str:
    """What the package says, formatted values and parentheses left out, a text a line."""
    found: list[str] = []
    for path in Path(sst_graph.__file__).parent.rglob("*.py"):
        if path == Path(reasons.__file__):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                values = (one.value if isinstance(one, ast.Constant) else "0" for one in node.values)
                found.append("".join(map(str, values)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return reasons._PARENTHESES.sub("", "\n".join(found))


def test_every_phrase_that_is_shortened_is_said() -> None:
    """Of each pattern its literal parts, in the package's texts or in what a pattern before it makes."""
    said = _texts()
    for pattern, shorter in reasons._SHORTER:
        parts = re.split(r"\\[ds][+*]?|\.\*\??|\[[^]]*\][+*]?|\\w\+|[()|?]", pattern)
        literal = [part for part in parts if len(part) > 3]
        assert literal, pattern
        assert all(part in said for part in literal), pattern
        said += f"\n{shorter}"


def test_the_short_form_keeps_what_and_remedy() -> None:
    lost = short_reason(f"{DRIVE}: {PARTS} {TURNED}; {advice(['offset'])}")
    assert lost == (
        f"{DRIVE}: frames 0 to 29 contradict those from 30 on: check whether a frame was lost or a clock was "
        "set, and calibrate both apart"
    )
    assert short_reason(REASONS[-1]).endswith(ASSUMPTIONS[[*ASSUMPTIONS][-1]].remedy)
    (by_labels,) = (short_reason(one) for one in REASONS if one.startswith("by labels"))
    assert by_labels == f"by labels: {NO_MATCHES}"


INVERTED = "the start (Tr) is inverted (the labels agree around its inverse): give T_camera_lidar"
FOLLOWS = ["no silhouette matches", "the time offset is known to 90 ms only: record motion", "one more"]


def _result(causes: list[str], others: list[str]) -> CalibrationResult:
    return CalibrationResult(
        T_camera_lidar=gtsam.Pose3(),
        time_offset_s=0.0,
        covariance=np.eye(7),
        status="not_converged",
        camera=PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360),
        reasons=(*causes, *others),
        diagnostics={LIKELY_CAUSES: causes} if causes else {},
    )


def test_behind_a_known_cause_the_others_are_counted() -> None:
    result = _result([INVERTED], FOLLOWS)
    short, line = (
        "the start is inverted: give T_camera_lidar",
        "3 more reasons, mostly consequences of it",
    )
    assert leading_reasons(result) == ((short,), line)
    assert leading_reasons(_result([INVERTED], FOLLOWS[:1]))[1] == "1 more reason, a consequence of it"
    assert leading_reasons(_result([INVERTED], [])) == ((short,), "")
    assert leading_reasons(_result([], FOLLOWS)) == (tuple(FOLLOWS), "")
    assert line in summary(result) and "record motion" not in summary(result)
    assert why_not_ok(result) == f"not_converged: {short} ({line}; in the report)"
    listed, _, in_full = report_html(ReportInputs(result, [])).partition("The reasons in full")
    assert f"{line}." in listed and "record motion" not in listed and "record motion" in in_full
    listed, _, in_full = markdown_report(result, None, []).partition("## All reasons")
    assert line in listed and "record motion" not in listed and f"- {FOLLOWS[1]}" in in_full


RIG = "one trigger of all cameras contradicts their time offsets: check whether the cameras are triggered"
MASKS = "the masks are not those of these pictures: lay a mask over the picture of the same number"


def test_what_stands_before_the_last_cause_is_no_consequence_of_it() -> None:
    """In a rig the contradiction between its cameras does."""
    cause = "the start is inverted: give T_camera_lidar"
    result = replace(_result([INVERTED], FOLLOWS[:1]), reasons=(RIG, INVERTED, FOLLOWS[0]))
    consequence = "1 more reason, a consequence of them"
    assert leading_reasons(result) == ((cause, RIG), consequence)
    more = f"1 more in the summary and {consequence}; in the report"
    assert why_not_ok(result) == f"not_converged: {cause} ({more})"
    assert reason_of(result) == f"{cause} (1 more and {consequence}; in its report)"
    shown = summary(result)
    assert all(one in shown for one in (cause, RIG, consequence)) and FOLLOWS[0] not in shown
    head, _, in_full = markdown_report(result, None, []).partition("## All reasons")
    assert f"{INVERTED}; {RIG}; {consequence} (below)" in head and f"- {FOLLOWS[0]}" in in_full
    listed, _, _ = report_html(ReportInputs(result, [])).partition("The reasons in full")
    assert all(f"<li>{capitalized(one)}.</li>" in listed for one in (cause, RIG, consequence))
    assert FOLLOWS[0] not in listed


def test_a_second_cause_is_no_consequence_of_the_first() -> None:
    result = _result([INVERTED, MASKS], [])
    shown = tuple(map(short_reason, (INVERTED, MASKS)))
    assert leading_reasons(result) == (shown, "")
    assert why_not_ok(result) == f"not_converged: {shown[0]} (1 more in the summary; in full in the report)"
    assert reason_of(result) == f"{shown[0]} (1 more in its report)"
    others = leading_reasons(_result([INVERTED, MASKS], FOLLOWS))
    assert others == (shown, "3 more reasons, mostly consequences of them")


@pytest.mark.parametrize("stored", [None, 5, "no silhouette matches", {}, [None, 5]])
def test_stored_causes_that_are_no_list_of_reasons_are_none(stored: object) -> None:
    result = replace(_result([], FOLLOWS), diagnostics={LIKELY_CAUSES: stored})
    assert leading_reasons(result) == (tuple(FOLLOWS), "")
    assert f"Status: **not_converged**: {'; '.join(FOLLOWS)}\n" in markdown_report(result, None, [])


def test_a_start_is_not_compared_with_itself() -> None:
    source = simulate(SimulationConfig(seed=1, frames=1))
    start = replace(_result([INVERTED], FOLLOWS), T_camera_lidar=source.truth.cTl, initial=source.truth.cTl)
    assert comparison(start, [source]) is None
    other = gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.zeros(3)) * source.truth.cTl
    compared = comparison(replace(start, T_camera_lidar=other, initial=other), [source])
    assert compared is not None and compared.errors.qad_deg > 5.0


@pytest.mark.parametrize("kinds", KINDS)
def test_advice_after_a_step_is_one_clause(kinds: tuple[str, ...]) -> None:
    assert (
        advice(kinds).startswith("check whether ") and ":" not in advice(kinds) and ";" not in advice(kinds)
    )
