"""The report's page: whole, offline, readable by a browser."""

from __future__ import annotations

import html
import html.parser
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from edge_fits import SIGMAS, fit_at, fit_by_edges, result_by_edges, solution_by_edges, street_by_edges
from stored import stored
from streets import CROWDED_STREET, crowded_street

from sst_graph import CalibrationConfig, calibrate
from sst_graph.assumptions.of_camera import FOCAL
from sst_graph.fit import Fit
from sst_graph.inspect.inspection import inspect_result
from sst_graph.inspect.verdict import verdict
from sst_graph.report import ReportInputs, report_html
from sst_graph.report.close_ups import COUNT, ZOOM, telling_detections
from sst_graph.report.drawn_frame import DriveReader
from sst_graph.report.overlay import project_points
from sst_graph.result import CalibrationResult, WeakDirection
from sst_graph.types import Calibration, Source

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))),
    None,
)
VOID = {"meta", "link", "img", "input", "br"}


@cache
def _result() -> CalibrationResult:
    street = crowded_street()
    assert street.truth is not None
    start = street.truth.cTl.compose(gtsam.Pose3(gtsam.Rot3.Rz(np.radians(1.0)), [0.02, 0.0, 0.0]))
    config = CalibrationConfig(check_contradictions=False, use_motion="never")
    return stored((CROWDED_STREET, "report"), lambda: calibrate(street, start, config))


def _fit() -> Fit:
    fit = _result().fit
    assert fit is not None
    return fit


@cache
def _page() -> str:
    return report_html(ReportInputs(_result(), [crowded_street()]))


@cache
def _page_by_edges() -> str:
    return report_html(ReportInputs(result_by_edges(), [street_by_edges()]))


PAGES = {"labels": _page, "edges": _page_by_edges}


class _Checker(html.parser.HTMLParser):
    """Opened and closed tags, headings, and addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.addresses: list[str] = []
        self.without_alt: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        given = dict(attrs)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "data", "action")]
        if (
            tag == "svg"
            and not (given.get("aria-label") or given.get("aria-hidden"))
            and "svg" not in self.open[:-1]
        ):
            self.without_alt.append(tag)
        if tag in ("img", "canvas") and given.get("alt") is None and not given.get("aria-label"):
            self.without_alt.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def _checked(page: str) -> _Checker:
    checker = _Checker()
    checker.feed(page)
    assert checker.open == []
    return checker


@pytest.mark.parametrize("by", PAGES)
@pytest.mark.slow
def test_the_page_is_whole_and_in_order(by: str) -> None:
    page = PAGES[by]()
    checker = _checked(page)
    assert checker.headings == [
        "Verdict",
        "What is weak, and what to record next",
        "Before and after",
        "Close-ups of objects",
        "Residuals",
        "Likelihood",
        "Numbers and background",
    ]
    assert checker.without_alt == []
    assert verdict(_result() if by == "labels" else result_by_edges()) in page and len(page) < 15e6


@pytest.mark.parametrize("by", PAGES)
def test_nothing_is_loaded_from_elsewhere(by: str) -> None:
    checker = _checked(PAGES[by]())
    assert all(address.startswith("data:") for address in checker.addresses)
    assert not re.search(r"https?:|@import|url\(|fetch\(|XMLHttp|WebSocket", PAGES[by]())


@pytest.mark.parametrize("by", PAGES)
def test_charts_have_no_ids_and_take_their_colours_from_the_page(by: str) -> None:
    page = PAGES[by]()
    charts = re.findall(r'<svg class="chart".*?</figure>', page, re.DOTALL)
    assert len(charts) == 17
    style = page[page.index("<style>") : page.index("</style>")]
    for chart in charts:
        assert not re.search(r" id=|href=|xmlns|<style|<defs|<metadata|#[0-9a-f]{6}|rgb\(|font", chart)
        used = set(re.findall(r"(?:fill|stroke): ([^;\"]+)", chart))
        assert used - {"none"} == {one for one in used if re.fullmatch(r"var\(--[a-z]+\)", one)}
        assert all(f"{one[4:-1]}: #" in style for one in used - {"none"})
    assert "<?xml" not in page and page.count("<!DOCTYPE") == 1


PROBE = (
    "<script>addEventListener('load', () => setTimeout(() => { parent.document.title = JSON.stringify({"
    "wide: document.documentElement.scrollWidth, window: innerWidth, "
    "cut: [...document.querySelectorAll('pre, .lines, .stacked, .numbers')]"
    ".filter(e => e.getBoundingClientRect().right > innerWidth).length, "
    "back: getComputedStyle(document.body).backgroundColor, "
    "drawn: [...document.querySelectorAll('canvas')].map(c => { const d = c.getContext('2d')"
    ".getImageData(0, 0, c.width, c.height).data; return new Set(d).size; }), "
    "sliders: document.querySelectorAll('input[type=range]').length}); }, 500))</script>"
)
"""Tells the outer page what the report has become."""


def _opened(
    folder: Path, page: str, width: int, dark: bool, probe: str = PROBE
) -> tuple[dict[str, Any], str]:
    """What the probe found in a browser, and the browser's log.

    The report stands in a frame: a window is 500 px wide at least.
    """
    outer = folder / "outer.html"
    style, inner = f"width:{width}px;height:900px;border:0", html.escape(page + probe)
    outer.write_text(f'<iframe style="{style}" srcdoc="{inner}"></iframe>', encoding="utf-8")
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1500,1000"]
    command += [f"--user-data-dir={folder}/profile", "--enable-logging=stderr", "--virtual-time-budget=5000"]
    command += ["--blink-settings=preferredColorScheme=0"] if dark else []
    done = subprocess.run(
        [*command, "--dump-dom", outer.as_uri()], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title, f"the script of the page did not run\n{done.stderr}"
    return json.loads(title[1]), done.stderr


def test_a_browser_is_there_where_it_must_be() -> None:
    """``.ci/run`` installs one and says so: there the next test cannot be skipped."""
    assert CHROMIUM is not None or os.environ.get("SST_GRAPH_BROWSER") != "required"


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.parametrize("by", PAGES)
@pytest.mark.parametrize(("width", "dark"), [(400, True), (1400, False)])
def test_a_browser_runs_the_page_without_an_error(tmp_path: Path, by: str, width: int, dark: bool) -> None:
    """And its script has made the controls of each picture; nothing is wider than the window."""
    seen, log = _opened(tmp_path, PAGES[by](), width, dark)
    assert [line for line in log.splitlines() if "CONSOLE" in line] == []
    assert seen["window"] == width and seen["wide"] <= width
    assert seen["back"] == ("rgb(20, 23, 27)" if dark else "rgb(255, 255, 255)")
    assert seen["cut"] == 0
    assert len(seen["drawn"]) == seen["sliders"] == 3 and min(seen["drawn"]) > 50


PULLED = (
    "<script>addEventListener('load', () => setTimeout(() => { const bar = document.querySelector('.bar');"
    "const slider = bar.querySelector('input'), canvas = document.querySelector('canvas');"
    "const pen = canvas.getContext('2d'), shown = pen.fillText.bind(pen); let words = [];"
    "pen.fillText = (text, ...at) => { words.push(text); shown(text, ...at); };"
    "const at = value => { words = []; slider.value = value; slider.dispatchEvent(new Event('input')); "
    "return words; };"
    "const option = document.querySelector('.option');"
    "parent.document.title = JSON.stringify({left: at(0), middle: at(50), right: at(100), "
    "wrap: option && getComputedStyle(option).whiteSpace}); }, 500))</script>"
)
"""Pulls the first slider to its ends, and tells what is written over the picture."""


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.slow
def test_the_picture_says_what_is_shown_on_each_side(tmp_path: Path) -> None:
    page = report_html(ReportInputs(replace(_result(), reasons=("say --sweep",)), [crowded_street()]))
    seen, _ = _opened(tmp_path, page, 1400, False, PULLED)
    assert seen["middle"] == ["before", "after"]
    assert [seen["left"], seen["right"]] == [["after"], ["before"]]
    assert seen["wrap"] == "nowrap"


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
def test_an_error_of_a_script_would_be_seen(tmp_path: Path) -> None:
    page = tmp_path / "broken.html"
    page.write_text("<script>nothing.such()</script>")
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command += [f"--user-data-dir={tmp_path}/profile", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "CONSOLE" in done.stderr and "nothing is not defined" in done.stderr


def test_names_of_the_data_are_text() -> None:
    evil = "</script><script>alert(1)</script>"
    fit = replace(_fit(), frames=tuple(replace(frame, drive=evil) for frame in _fit().frames))
    frames = tuple(replace(frame, drive=evil) for frame in _result().frames_used)
    result = replace(_result(), fit=fit, frames_used=frames, reasons=("<b>",), camera_name='"><i>')

    class Renamed:
        name = evil

        def __getattr__(self, item: str) -> object:
            return getattr(crowded_street(), item)

        def __len__(self) -> int:
            return len(crowded_street())

        def __getitem__(self, position: int) -> object:
            return crowded_street()[position]

    source: Source = Renamed()  # type: ignore[assignment]
    page = report_html(ReportInputs(result, [source]))
    assert (
        _checked(page).headings
        and "alert(1)</script>" not in page
        and "<b>" not in page
        and "<i>" not in page
    )


def test_a_reason_is_listed_once() -> None:
    """A weak direction that a reason names is not repeated behind the reasons."""
    named, other = (
        WeakDirection(np.eye(7)[k], 1.0, f"the {what} is hardly known", f"record {what}")
        for k, what in enumerate(("roll", "pitch"))
    )
    reasons = ("the roll is hardly known: record roll",)
    weak = replace(
        _result(), fit=None, status="unobservable", reasons=reasons, weak_directions=(named, other)
    )
    page = report_html(ReportInputs(weak, [crowded_street()]))
    full = page[page.index("The reasons in full") :]
    full = full[: full.index("</details>")]
    assert (
        full.count("the roll is hardly known") == full.count("the pitch is hardly known: record pitch") == 1
    )


def test_a_result_not_to_be_used_predicts_nothing() -> None:
    """Neither what is still to record nor how far off it may be: its sigmas are not to be trusted."""
    good = replace(_result(), fit=None)
    bad = replace(good, status="not_converged", reasons=("the clock jumps: check it",))
    said, refused = (report_html(ReportInputs(one, [crowded_street()])) for one in (good, bad))
    for words in ("19 times in 20", "driving at 10 m/s", "each at another place:", "The weakest, at "):
        assert words in said and words not in refused


def test_the_weakest_direction_is_named_beside_a_remark() -> None:
    """By edges, whose remark stands where reasons do; unless a reason names it."""
    weakest = inspect_result(result_by_edges()).weakest.sentence
    for reasons, expected in (((), 1), (("the lens is a little off",), 1), ((f"{weakest}: record more",), 0)):
        result = replace(result_by_edges(), fit=None, reasons=reasons)
        page = report_html(ReportInputs(result, [street_by_edges()]))
        assert page.count(f"its limit: {html.escape(weakest)}") == expected


def test_without_predictions_the_page_gives_a_rule() -> None:
    """By edges no view of a frame is kept: what to record follows from the weakest direction."""
    page = _page_by_edges()
    section = page[page.index("What is weak, and what to record next") : page.index("Before and after")]
    rule = html.escape(inspect_result(result_by_edges()).weakest.advice)
    assert f"by the rule for the weakest direction: {rule}." in section and "method joint only" in section
    assert "by the rule for" not in _page()


def test_without_a_start_there_is_no_before() -> None:
    page = report_html(ReportInputs(replace(_result(), initial=None), [crowded_street()]))
    assert "The cloud in the pictures" in _checked(page).headings
    assert "Before and after" not in page and "move the slider" not in page


def test_a_lens_that_is_off_and_covered_is_not_called_contradicted() -> None:
    k1 = {"sigma": 0.001, "sensitivity": [0.0] * 7, "estimate": 0.0154, "estimate_sigma": 0.0042}
    result = replace(
        result_by_edges(), fit=None, diagnostics={"assumptions": {"k1": k1 | {"contradicted": True}}}
    )

    def row(result: CalibrationResult) -> list[str]:
        page = report_html(ReportInputs(result, [street_by_edges()]))
        (found,) = re.findall(r'<th scope="row">k1</th>(.*?)</tr>', page)
        return re.findall(r'data-head="([^"]*)">([^<]*)<', found)

    assert result.method == "edges" and result.status == "ok"
    cells = dict(row(result))
    assert cells["by the data"] == "k1 = 0.0154 ± 0.0042" and cells["considered"] == "±0.015"
    assert cells["verdict"].startswith("off; its step is in the sigmas. To take it out, undistort")
    refused = dict(row(replace(result, status="not_converged", reasons=("the pictures look distorted",))))
    assert refused["verdict"].startswith("contradicted: undistort") and refused["considered"] == "±0.001"


@pytest.mark.parametrize("by", PAGES)
def test_bars_of_objects_have_names_under_their_numbers(by: str) -> None:
    (chart,) = re.findall(r"<h3>By object</h3>.*?</figure>", PAGES[by](), re.DOTALL)
    names = re.findall(r"<li>(.*?)</li>", chart)
    assert names == re.findall(r"<title>(.*?)</title>", chart) and len(names) >= 2
    assert all(
        re.fullmatch(r"[a-z ]+ at \d+ m, .*, \d+ points in \d+ frames?: [+-]\d\.\d\d px", one)
        for one in names
    )
    assert (
        ">1</text>" in chart
        and ">0.5</text>" not in chart[chart.index(">1</text>") : chart.index("object, ")]
    )


@pytest.mark.parametrize("by", PAGES)
def test_no_arrow_leaves_its_chart(by: str) -> None:
    (chart,) = re.findall(r"<h3>Over the picture</h3>.*?</figure>", PAGES[by](), re.DOTALL)
    for drawn in re.findall(r"<svg.*?</svg>", chart, re.DOTALL):
        box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawn)
        arrows = re.search(r'class="arrows a".*?</g>', drawn, re.DOTALL)
        assert box and arrows
        tips = np.array(re.findall(r"[ML] ([-\d.]+) ([-\d.]+)", arrows[0]), np.float64)
        assert len(tips) and tips.min() > 0.0 and (tips < [float(box[1]), float(box[2])]).all()


def test_what_is_considered_is_explained() -> None:
    page = _page()
    assert "Considered: how far it may be off" in page[page.index("<h3>Assumptions") :]


def test_the_parts_of_the_page_are_told() -> None:
    told: list[tuple[int, int]] = []
    result = replace(_result(), fit=None)
    report_html(ReportInputs(result, [crowded_street()]), lambda *steps: told.append(steps))
    assert told == [(k, len(told)) for k in range(len(told))] and len(told) > 3


@pytest.mark.parametrize("by", PAGES)
def test_close_ups_have_the_numbers_of_the_bars(by: str) -> None:
    page = PAGES[by]()
    (chart,) = re.findall(r"<h3>By object</h3>.*?</figure>", page, re.DOTALL)
    names = re.findall(r"<li>(.*?)</li>", chart)
    titles = re.findall(r"<h3>([a-z ]+?) (\d+) at (\d+) m, [^<]*</h3>", page)
    assert len(titles) >= 2 and "with + the points lie outside" in page
    assert all(names[int(number) - 1].startswith(f"{kind} at ") for kind, number, _ in titles)


@pytest.mark.parametrize("by", PAGES)
def test_the_first_picture_has_the_most_near_points(by: str) -> None:
    fit = _fit() if by == "labels" else fit_by_edges()
    assert fit is not None
    near = fit.points.weights / np.linalg.norm(fit.points.lPs, axis=1)
    best = fit.frames[int(np.bincount(fit.points.frames, near).argmax())]
    shown = re.findall(r'aria-label="Image (\d+) of', PAGES[by]())
    assert len(shown) == 3 and int(shown[0]) == best.image


@pytest.mark.parametrize("by", PAGES)
def test_no_zero_has_a_minus_sign(by: str) -> None:
    words = re.sub(r"<script.*?</script>|<style>.*?</style>| d=\"[^\"]*\"", "", PAGES[by](), flags=re.DOTALL)
    assert not re.search(r"-0\.0+(?!\d)", words)


def test_an_ellipse_says_what_it_means_where_the_two_hardly_separate() -> None:
    covariance = np.diag(np.square(SIGMAS))
    for value in (0.4, -0.9):
        covariance[3, 6] = covariance[6, 3] = value * SIGMAS[3] * SIGMAS[6]
        result = replace(_result(), fit=None, covariance=covariance.copy())
        page = report_html(ReportInputs(result, [crowded_street()]))
        (caption,) = re.findall(r"Correlation [+-]0.[49]0[^<]*", page)
        assert ("hardly tell the two apart" in caption) == (value == -0.9)
        assert "Translation x against time offset" in page


def test_without_a_fit_there_are_no_residuals() -> None:
    page = report_html(ReportInputs(replace(_result(), fit=None), [crowded_street()]))
    headings = _checked(page).headings
    assert "Verdict" in headings and "Residuals" not in headings and "Likelihood" not in headings


def test_frames_that_are_gone_are_left_out() -> None:
    fit = replace(_fit(), frames=tuple(replace(frame, image=10**6) for frame in _fit().frames))
    headings = _checked(report_html(ReportInputs(replace(_result(), fit=fit), [crowded_street()]))).headings
    assert "Before and after" not in headings and "Residuals" in headings


@pytest.mark.parametrize("by", PAGES)
def test_points_are_drawn_where_their_residuals_say(by: str) -> None:
    """n . (uv - q) + bias is the residual: what is drawn and what was measured are the same projection."""
    fit, result, source = _fit(), _result(), crowded_street()
    if by == "edges":
        fit, result, source = fit_by_edges(), result_by_edges(), street_by_edges()
    frame = int(np.bincount(fit.points.frames).argmax())
    points = fit.points.take(fit.points.frames == frame)
    drawn = DriveReader([source]).frame(fit.frames[frame])
    assert drawn is not None
    uvs, depths = project_points(drawn, points, result.calibration)
    across = ((uvs - points.pixels) * points.normals).sum(axis=1)
    assert np.ptp(points.residuals_px - across) < 0.05  # the mask bias, the same for all
    assert (depths > 0.0).all()
    # And so do their derivatives.
    step = np.array([2e-6, -1e-6, 3e-6, 1e-5, 2e-5, -1e-5, 1e-5])
    cTl = result.T_camera_lidar.compose(gtsam.Pose3.Expmap(step[:6]))
    moved, _ = project_points(drawn, points, Calibration(cTl, result.time_offset_s + step[6]))
    assert ((moved - uvs) * points.normals).sum(axis=1) == pytest.approx(points.J @ step, abs=1e-5)


@pytest.mark.parametrize("by", PAGES)
def test_the_telling_objects_are_different_ones_first(by: str) -> None:
    fit, covariance = _fit(), _result().covariance
    if by == "edges":
        fit, covariance = fit_by_edges(), np.diag(SIGMAS**2)
    chosen = telling_detections(fit.points, covariance)
    assert 3 <= len(chosen) <= COUNT
    strong = [one for one in chosen if not one.worst]
    tracks = [int(fit.points.tracks[one.points[0]]) for one in strong]
    several = len(set(tracks))
    assert len(set(tracks[:several])) == several
    assert all(len(np.unique(fit.points.frames[one.points])) == 1 for one in chosen)
    assert sum(one.share for one in chosen) < 1.0


def test_an_object_that_agrees_as_well_as_others_is_not_called_the_least() -> None:
    """Eight of one size of residual and two that are off: only these two agree least."""
    rng, each, sizes = np.random.default_rng(0), 20, [1.0] * 8 + [3.0, 4.0]
    chosen_from = _fit().points
    points = chosen_from.take(rng.integers(0, len(chosen_from), each * len(sizes)))
    objects = np.repeat(np.arange(len(sizes)), each)
    points = replace(
        points,
        frames=objects,
        tracks=objects,
        pixels=np.column_stack([150.0 * objects, np.full(len(objects), 100.0)]),
        residuals_px=np.repeat(sizes, each),
        # what determines most comes first
        weights=np.repeat(np.linspace(1.0, 0.1, len(sizes)), each),
        J=np.ones_like(points.J),
        sigmas_px=np.ones(len(objects)),
    )
    chosen = telling_detections(points, np.eye(7))
    of = [int(objects[one.points[0]]) for one in chosen]
    assert of == [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]
    assert [one.worst for one in chosen] == [False] * 8 + [True] * 2


def test_close_ups_are_eight_times_enlarged() -> None:
    """52 by 39 pixels of the picture, each 8 px of the page, which a column of the page has room for."""
    found = re.findall(r'class="closeup" viewBox="0 0 (\d+) (\d+)"', _page())
    assert len(found) >= 3 and set(found) == {("416", "312")}
    for picture in re.findall(r'class="closeup".*?</svg>', _page(), re.DOTALL):
        at = np.array(re.findall(r'cx="([-\d.]+)" cy="([-\d.]+)"', picture), np.float64)
        assert ((at >= 0.0) & (at <= [416.0, 312.0])).all(axis=1).sum() >= 5


def test_close_ups_without_labels_show_the_edge_that_each_point_is_compared_with() -> None:
    """Yellow: across the residual, at its end; the residual is as long as its number says, but for the bias
    that all have."""
    page = _page_by_edges()
    figures = re.findall(
        r'<figure><h3>(object(?: \d+)? at [^<]*)</h3><svg class="closeup"(.*?)</figure>', page, re.DOTALL
    )
    assert len(figures) == COUNT and "label" not in " ".join(title for title, _ in figures)
    bias_px = abs(float(next(iter(solution_by_edges().state.biases_px.values()))))
    for _, figure in figures:
        (edges,) = re.findall(r'class="contour" d="([^"]*)"', figure)
        ends = _numbers(r"M([-\d.]+) ([-\d.]+)L([-\d.]+) ([-\d.]+)", edges)
        residuals = _numbers(r'class="residual" d="M([-\d.]+) ([-\d.]+)L([-\d.]+) ([-\d.]+)"', figure)
        written = _numbers(r"<title>([-+\d.]+) px</title>", figure)[:, 0]
        assert len(ends) == len(residuals) == len(written) >= 12
        assert 0.5 * (ends[:, :2] + ends[:, 2:]) == pytest.approx(residuals[:, 2:], abs=0.11)
        across, along = residuals[:, 2:] - residuals[:, :2], ends[:, 2:] - ends[:, :2]
        lengths = np.linalg.norm(across, axis=1)
        assert np.abs((across * along).sum(axis=1)) == pytest.approx(0.0, abs=0.06 * lengths.max() + 3.0)
        assert lengths / ZOOM == pytest.approx(np.abs(written), abs=bias_px + 0.1)
        assert re.search(r"±2 sigma of the calibration moves it by ±\d+\.\d px", figure)


def test_bars_of_close_ups_are_of_the_lens_that_is_given() -> None:
    """What a k1 that may be off adds to the covariance is not in the bars; the caption says what it adds."""
    step = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    k1 = {"sigma": 0.05, "sensitivity": step.tolist()}
    plain = replace(result_by_edges(), diagnostics={})
    wider = replace(
        plain,
        covariance=plain.covariance + 0.05**2 * np.outer(step, step),
        diagnostics={"assumptions": {"k1": k1}},
    )

    def found(result: CalibrationResult) -> tuple[set[str], int]:
        page = report_html(ReportInputs(result, [street_by_edges()]))
        moves = re.findall(r"moves it by ±(\d+\.\d) px", page)
        return set(moves), page.count("where the lens is off, too")

    (moves, none), (others, many) = found(plain), found(wider)
    # The objects that are shown are chosen by the whole covariance: some are the same.
    assert moves & others and none == 0 and many >= 3


def test_a_wrong_calibration_is_seen_on_the_page() -> None:
    """0.3 deg of yaw: the top of its curve is where it is taken back."""
    fit = fit_at(np.array([0.0, 0.0, np.radians(0.3), 0.0, 0.0, 0.0, 0.0]))
    page = report_html(ReportInputs(replace(result_by_edges(), fit=fit), [street_by_edges()]))
    assert _checked(page).headings[3:6] == ["Close-ups of objects", "Residuals", "Likelihood"]

    def tops(page: str) -> list[float]:
        charts = re.findall(r'aria-label="Likelihood along.*?</figure>', page, re.DOTALL)
        assert len(charts) == 7
        found = []
        for chart in charts:
            (line,) = re.findall(r'class="line a".*? d="([^"]*)"', chart, re.DOTALL)
            points = _numbers(r"[ML] ([-\d.]+) ([-\d.]+)", line)
            middle = 0.5 * (points[0, 0] + points[-1, 0])
            found.append(6.0 * (points[points[:, 1].argmin(), 0] - middle) / np.ptp(points[:, 0]))
        return found

    right, wrong = tops(_page_by_edges()), tops(page)
    assert max(map(abs, right)) <= 1.0  # all within one of the three sigmas that are drawn to either side
    assert -2.5 < wrong[2] < -1.0


def _numbers(pattern: str, words: str) -> np.ndarray:
    """(n, groups) of every match."""
    found = [[float(one) for one in match.groups()] for match in re.finditer(pattern, words)]
    assert found
    return np.array(found)


def test_three_ellipses_and_the_meaning_of_each_assumption() -> None:
    assert len(re.findall(r"Ellipses of ", _page())) == 3
    (table,) = re.findall(r"<h3>Assumptions</h3>.*?</table>", _page(), re.DOTALL)
    assert FOCAL.violation in table and len(re.findall(r"<tr>", table)) >= 10
