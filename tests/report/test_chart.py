"""Charts: where marks land."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sst_graph.report.chart import HEIGHT, WIDTH, Chart


def _chart(**options: bool) -> Chart:
    return Chart((0.0, 10.0), (0.0, 1.0), ("x <m>", "y"), "what it shows", **options)


def test_marks_land_where_the_axes_say() -> None:
    chart = _chart()
    chart.dots([0.0, 10.0], [0.0, 1.0], "a", titles=["first", "a < b"])
    found = re.findall(r'<circle class="dot a" cx="([\d.]+)" cy="([\d.]+)"', chart.svg())
    (left, bottom), (right, top) = [(float(u), float(v)) for u, v in found]
    assert left < right <= WIDTH and top < bottom <= HEIGHT
    assert "a &lt; b" in chart.svg() and "x &lt;m&gt;" in chart.svg()


def test_y_grows_downwards_in_a_picture() -> None:
    chart = _chart(down=True)
    chart.dots([0.0, 0.0], [0.0, 1.0], "a")
    first, second = (float(v) for v in re.findall(r'cy="([\d.]+)"', chart.svg()))
    assert second > first


def test_units_are_equally_long_in_a_square_chart() -> None:
    chart = Chart((0.0, 1242.0), (0.0, 375.0), ("u", "v"), "", square=True)
    chart.dots([0.0, 100.0, 0.0], [0.0, 0.0, 100.0], "a")
    places = np.array(re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', chart.svg()), float)
    across, along = np.abs(places[1] - places[0]).max(), np.abs(places[2] - places[0]).max()
    assert across == pytest.approx(along, rel=0.02)


def test_values_that_are_not_finite_are_left_out_of_lines() -> None:
    chart = _chart()
    chart.line([0.0, 5.0, 10.0], [0.5, np.nan, 0.5], "a")
    (points,) = re.findall(r'points="([^"]*)"', chart.svg())
    assert len(points.split()) == 2 and "nan" not in chart.svg()


@pytest.mark.parametrize(
    "limits", [(1.0, 1.0), (np.nan, np.nan), (-np.inf, 2.0), (1e-12, 2e-12), (-1e9, 1e9)]
)
def test_any_limits_give_a_chart(limits: tuple[float, float]) -> None:
    svg = Chart(limits, limits, ("x", "y"), "").svg()
    assert "nan" not in svg and "inf" not in svg
