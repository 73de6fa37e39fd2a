"""The report's page: whole, offline, readable by a browser."""

from __future__ import annotations

import html.parser
import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import stored
from streets import CROWDED_STREET, crowded_street

from sst_graph import CalibrationConfig, calibrate
from sst_graph.fit import Fit
from sst_graph.inspect.verdict import verdict
from sst_graph.report import ReportInputs, report_html
from sst_graph.report.close_ups import COUNT, telling_detections
from sst_graph.report.drawn_frame import DriveReader
from sst_graph.report.overlay import project_points
from sst_graph.result import CalibrationResult
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


def test_the_page_is_whole_and_in_order() -> None:
    checker = _checked(_page())
    assert checker.headings == [
        "Verdict",
        "What is weak, and what to record next",
        "Before and after",
        "Telling objects",
        "Residuals",
        "Likelihood",
        "Numbers and background",
    ]
    assert checker.without_alt == []
    assert verdict(_result()) in _page() and len(_page()) < 15e6


def test_nothing_is_loaded_from_elsewhere() -> None:
    checker = _checked(_page())
    assert all(address.startswith("data:") for address in checker.addresses)
    assert not re.search(r"https?:|@import|url\(|fetch\(|XMLHttp|WebSocket", _page())


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.parametrize("width", [400, 1400])
def test_a_browser_runs_the_page_without_an_error(tmp_path: Path, width: int) -> None:
    """And its script has made the controls of each picture; nothing is wider than the window."""
    probe = (
        "<script>addEventListener('load', () => setTimeout(() => { document.title = JSON.stringify({"
        "wide: document.documentElement.scrollWidth, window: innerWidth, "
        "drawn: [...document.querySelectorAll('canvas')].map(c => { const d = c.getContext('2d')"
        ".getImageData(0, 0, c.width, c.height).data; return new Set(d).size; })}); }, 500))</script>"
    )
    page = tmp_path / "report.html"
    page.write_text(_page() + probe, encoding="utf-8")
    command = [str(CHROMIUM), "--headless=new", "--no-sandbox", "--disable-gpu", f"--window-size={width},900"]
    command += [
        f"--user-data-dir={tmp_path}/profile",
        "--enable-logging=stderr",
        "--virtual-time-budget=5000",
    ]
    done = subprocess.run(
        [*command, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title, "the script of the page did not run"
    seen = json.loads(title[1])
    assert seen["wide"] <= seen["window"]
    assert len(seen["drawn"]) == 3 and min(seen["drawn"]) > 50
    assert done.stdout.count('type="range"') == 3


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


def test_without_a_fit_there_are_no_residuals() -> None:
    page = report_html(ReportInputs(replace(_result(), fit=None), [crowded_street()]))
    headings = _checked(page).headings
    assert "Verdict" in headings and "Residuals" not in headings and "Likelihood" not in headings


def test_frames_that_are_gone_are_left_out() -> None:
    fit = replace(_fit(), frames=tuple(replace(frame, image=10**6) for frame in _fit().frames))
    headings = _checked(report_html(ReportInputs(replace(_result(), fit=fit), [crowded_street()]))).headings
    assert "Before and after" not in headings and "Residuals" in headings


def test_points_are_drawn_where_their_residuals_say() -> None:
    """n . (uv - q) + bias is the residual: what is drawn and what was measured are the same projection."""
    fit, result = _fit(), _result()
    frame = int(np.bincount(fit.points.frames).argmax())
    points = fit.points.take(fit.points.frames == frame)
    drawn = DriveReader([crowded_street()]).frame(fit.frames[frame])
    assert drawn is not None
    uvs, depths = project_points(drawn, points, Calibration(result.T_camera_lidar, result.time_offset_s))
    across = ((uvs - points.pixels) * points.normals).sum(axis=1)
    assert np.ptp(points.residuals_px - across) < 0.05  # the mask bias, the same for all
    assert (depths > 0.0).all()
    # And so do their derivatives.
    step = np.array([2e-6, -1e-6, 3e-6, 1e-5, 2e-5, -1e-5, 1e-5])
    cTl = result.T_camera_lidar.compose(gtsam.Pose3.Expmap(step[:6]))
    moved, _ = project_points(drawn, points, Calibration(cTl, result.time_offset_s + step[6]))
    assert ((moved - uvs) * points.normals).sum(axis=1) == pytest.approx(points.J @ step, abs=1e-5)


def test_the_telling_objects_are_different_ones_first() -> None:
    fit = _fit()
    chosen = telling_detections(fit.points, _result().covariance)
    assert 3 <= len(chosen) <= COUNT
    strong = [one for one in chosen if not one.worst]
    tracks = [int(fit.points.tracks[one.points[0]]) for one in strong]
    several = len(set(tracks))
    assert len(set(tracks[:several])) == several
    assert all(len(np.unique(fit.points.frames[one.points])) == 1 for one in chosen)
    assert sum(one.share for one in chosen) < 1.0
