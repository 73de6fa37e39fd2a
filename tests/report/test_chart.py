"""Charts: where marks land, what stands in the page, and what matplotlib's settings cannot change."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest

from sst_graph.report.chart import HEIGHT, WIDTH, Chart


def _chart(**options: bool) -> Chart:
    return Chart((0.0, 10.0), (0.0, 1.0), ("x <m>", "y"), 'what it "shows"', **options)


def _of_all_marks() -> Chart:
    chart = _chart()
    chart.level(0.5, "a level")
    chart.band([0.0, 5.0, 10.0], [0.1, 0.2, 0.3], [0.3, 0.4, 0.5], "a", "a band")
    chart.line([0.0, 10.0], [0.0, 1.0], "b", "a $line$")
    chart.dots([1.0, 2.0], [0.1, 0.2], "c", titles=["dot 1", "dot 2"])
    chart.bars([1.0, 2.0, 3.0], [0.5, -0.5, 0.0], 0.8, "good", ["bar 1", "bar 2", "bar 3"])
    chart.arrows([1.0, 5.0], [0.5, 0.5], [2.0, 0.0], [0.0, 0.0], ["arrow 1", "arrow 2"])
    return chart


def _places(svg: str) -> np.ndarray:
    """(n, 2) of the dots."""
    return np.array(re.findall(r"translate\(([-\d.]+) ([-\d.]+)\)", svg), float)


def test_marks_land_where_the_axes_say() -> None:
    chart = _chart()
    chart.dots([0.0, 10.0], [0.0, 1.0], "a", titles=["first", "a < b"])
    (left, bottom), (right, top) = _places(chart.svg())
    assert left < right <= WIDTH and top < bottom <= HEIGHT
    assert "a &lt; b" in chart.svg() and "x &lt;m&gt;" in chart.svg()


def test_y_grows_downwards_in_a_picture() -> None:
    chart = _chart(down=True)
    chart.dots([0.0, 0.0], [0.0, 1.0], "a")
    first, second = _places(chart.svg())[:, 1]
    assert second > first


def test_units_are_equally_long_in_a_square_chart() -> None:
    chart = Chart((0.0, 1242.0), (0.0, 375.0), ("u", "v"), "", square=True)
    chart.dots([0.0, 100.0, 0.0], [0.0, 0.0, 100.0], "a")
    places = _places(chart.svg())
    across, along = np.abs(places[1] - places[0]).max(), np.abs(places[2] - places[0]).max()
    assert across == pytest.approx(along, rel=0.02)


def test_values_that_are_not_finite_are_left_out_of_lines() -> None:
    chart = _chart()
    chart.line([0.0, 5.0, 10.0], [0.5, np.nan, 0.5], "a")
    (line,) = re.findall(r'class="line a".*? d="([^"]*)"', chart.svg(), re.DOTALL)
    assert len(re.findall("[ML]", line)) == 2 and "nan" not in chart.svg()


@pytest.mark.parametrize(
    "limits", [(1.0, 1.0), (np.nan, np.nan), (-np.inf, 2.0), (1e-12, 2e-12), (-1e9, 1e9)]
)
def test_any_limits_give_a_chart(limits: tuple[float, float]) -> None:
    svg = Chart(limits, limits, ("x", "y"), "").svg()
    assert "nan" not in svg and "inf" not in svg


def test_each_part_has_its_own_title() -> None:
    """In the order of the data, and inside the part: the pointer is over it."""
    root = ElementTree.fromstring(_of_all_marks().svg())
    for kind, name, count in (("dots c", "dot", 2), ("bars good", "bar", 3), ("arrows a", "arrow", 2)):
        (group,) = (one for one in root.iter() if one.get("class") == kind)
        titles = [path.findtext("title") for path in group.iter("path")]
        assert titles == [f"{name} {k + 1}" for k in range(count)]


def test_text_is_text() -> None:
    """The axes', the ticks' and the key's, with no font of its own and no formulas."""
    root = ElementTree.fromstring(_of_all_marks().svg())
    texts = [one.text for one in root.iter("text")]
    assert {"x <m>", "y", "0.4", "8", "a level", "a band", "a $line$"} <= set(texts)
    assert root.get("role") == "img" and root.get("aria-label") == 'what it "shows"'


def test_bands_end_at_the_axes() -> None:
    chart = _chart()
    chart.band([0.0, 10.0], [-5.0, -5.0], [5.0, 5.0], "a")
    (band,) = (one for one in ElementTree.fromstring(chart.svg()).iter() if one.get("class") == "band a")
    assert band.tag == "svg"
    assert float(band.get("y", "")) >= 0.0
    assert float(band.get("y", "")) + float(band.get("height", "")) < HEIGHT


@pytest.mark.parametrize("key", [False, True])
def test_nothing_is_cut_or_overlaps(key: bool) -> None:
    """Long labels of ticks: none reaches the axis's, at 8 units a sign."""
    chart = Chart((-1e5, 1e5), (-12345.0, 12345.0), ("x", "y"), "")
    chart.line([0.0], [0.0], "a", "named" * key)
    root = ElementTree.fromstring(chart.svg())
    width, height = (float(one) for one in root.get("viewBox", "").split()[2:])
    texts = [
        (one.text or "", float(one.get("x", "")), float(one.get("y", "")), one.get("style"))
        for one in root.iter("text")
    ]
    assert all(0.0 < x < width and 10.0 < y < height - 2.0 for _, x, y, _ in texts)
    (label,) = (x for word, x, _, _ in texts if word == "y")
    assert all(x - 8.0 * len(word) > label for word, x, _, style in texts if "end" in str(style))


def test_the_users_settings_of_matplotlib_neither_count_nor_change() -> None:
    expected = _of_all_marks().svg()
    with mpl.rc_context({"svg.fonttype": "path", "font.size": 40, "lines.linewidth": 9, "axes.grid": False}):
        before = dict(mpl.rcParams)
        assert _of_all_marks().svg() == expected
        assert dict(mpl.rcParams) == before


_PROGRAM = """
import sys
from sst_graph.report.chart import Chart
import sst_graph.report, sst_graph.fleet.summary.page
assert "matplotlib" not in sys.modules
chart = Chart((0, 1), (0, 1), ("x", "y"), "")
chart.dots([0.5], [0.5], "a")
print(chart.svg())
assert "matplotlib.pyplot" not in sys.modules
"""


def _printed(**variables: str) -> str:
    command = [sys.executable, "-c", _PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_matplotlib_is_imported_by_the_first_chart_and_bytes_are_the_same_in_another_process(
    tmp_path: Path,
) -> None:
    """Whatever the order of its sets, and whatever a settings file of the user says."""
    chart = Chart((0, 1), (0, 1), ("x", "y"), "")
    chart.dots([0.5], [0.5], "a")
    settings = tmp_path / "matplotlibrc"
    settings.write_text("text.usetex: True\nfont.size: 30\nbackend: TkAgg\n")
    assert _printed(PYTHONHASHSEED="1") == chart.svg() + "\n"
    assert _printed(PYTHONHASHSEED="2", MATPLOTLIBRC=str(settings)) == chart.svg() + "\n"


@pytest.mark.slow
def test_where_matplotlib_does_not_start_the_page_says_why() -> None:
    assert re.match(
        r'<p class="note">Not drawn: matplotlib does not start .*nonsense', _printed(MPLBACKEND="nonsense")
    )
