"""Small charts as inline SVG, whose colours follow the page's (light or dark)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_graph.report.html import text

FloatArray = NDArray[np.float64]

WIDTH, HEIGHT = 440, 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 12, 44
_TICKS = 5


class Chart:
    """Axes that marks are added to, in data units; :meth:`svg` is the picture.

    Args:
        x, y: least and greatest value on each axis.
        labels: of the axes, with units.
        alt: what the chart shows, for who cannot see it.
        down: whether y grows downwards, as in a picture.
        square: whether one unit is as long on both axes; the chart is then as high as it must be.
    """

    def __init__(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        labels: tuple[str, str],
        alt: str,
        *,
        down: bool = False,
        square: bool = False,
    ) -> None:
        self.x, self.y = _wide(x), _wide(y)
        self.labels, self.alt, self.down = labels, alt, down
        self.height = HEIGHT
        if square:
            span = (self.y[1] - self.y[0]) / (self.x[1] - self.x[0])
            self.height = round(_TOP + _BOTTOM + span * (WIDTH - _LEFT - _RIGHT))
        self._marks: list[str] = []
        self._key: list[tuple[str, str]] = []

    def line(self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "", dashed: bool = False) -> None:
        """A line through points; a name is shown in the key. ``colour``: a class of the style sheet."""
        us, vs = self._u(x), self._v(y)
        known = np.isfinite(us) & np.isfinite(vs)
        points = " ".join(f"{u:.1f},{v:.1f}" for u, v in zip(us[known], vs[known], strict=True))
        kind = f"line {colour}" + " dashed" * dashed
        self._marks.append(f'<polyline class="{kind}" points="{points}"/>')
        self._name(name, kind)

    def dots(
        self,
        x: ArrayLike,
        y: ArrayLike,
        colour: str,
        name: str = "",
        size: float = 2.5,
        titles: Sequence[str] = (),
    ) -> None:
        """Points; titles are shown under the pointer."""
        for k, (u, v) in enumerate(zip(self._u(x), self._v(y), strict=True)):
            title = f"<title>{text(titles[k])}</title>" if titles else ""
            self._marks.append(
                f'<circle class="dot {colour}" cx="{u:.1f}" cy="{v:.1f}" r="{size}">{title}</circle>'
            )
        self._name(name, f"dot {colour}")

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, name: str = "") -> None:
        """The area between two lines."""
        us = self._u(x)
        there = zip(us, self._v(high), strict=True)
        back = zip(us[::-1], self._v(low)[::-1], strict=True)
        points = " ".join(f"{u:.1f},{v:.1f}" for u, v in (*there, *back))
        self._marks.append(f'<polygon class="band {colour}" points="{points}"/>')
        self._name(name, f"band {colour}")

    def bars(
        self, x: ArrayLike, heights: ArrayLike, width: float, colour: str, titles: Sequence[str] = ()
    ) -> None:
        """Bars from 0 to the heights, about x; width in data units."""
        xs = np.asarray(x, np.float64)
        left, right, zero = self._u(xs - 0.5 * width), self._u(xs + 0.5 * width), float(self._v([0.0])[0])
        for k, (a, b, v) in enumerate(zip(left, right, self._v(heights), strict=True)):
            title = f"<title>{text(titles[k])}</title>" if titles else ""
            top, size = min(v, zero), abs(v - zero)
            self._marks.append(
                f'<rect class="bar {colour}" x="{a:.1f}" y="{top:.1f}" width="{max(b - a, 0.8):.1f}" '
                f'height="{size:.1f}">{title}</rect>'
            )

    def arrows(self, x: ArrayLike, y: ArrayLike, dx: ArrayLike, dy: ArrayLike, titles: Sequence[str]) -> None:
        """Arrows from (x, y), in data units."""
        us, vs, dxs, dys = self._u(x), self._v(y), np.asarray(dx, np.float64), np.asarray(dy, np.float64)
        ends_u, ends_v = self._u(np.asarray(x) + dxs), self._v(np.asarray(y) + dys)
        for u, v, a, b, title in zip(us, vs, ends_u, ends_v, titles, strict=True):
            self._marks.append(
                f'<g><title>{text(title)}</title><line class="arrow a" x1="{u:.1f}" y1="{v:.1f}" '
                f'x2="{a:.1f}" y2="{b:.1f}"/><circle class="dot a" cx="{u:.1f}" cy="{v:.1f}" r="2"/></g>'
            )

    def level(self, y: float, name: str = "", colour: str = "muted") -> None:
        """A horizontal line."""
        self.line(self.x, (y, y), colour, name, dashed=True)

    def svg(self) -> str:
        """The chart."""
        parts = [
            f'<svg class="chart" viewBox="0 0 {WIDTH} {self.height}" role="img" '
            f'aria-label="{text(self.alt)}">'
        ]
        bottom = self.height - _BOTTOM
        for value in _ticks(*self.x):
            u = float(self._u([value])[0])
            parts.append(f'<line class="rule" x1="{u:.1f}" x2="{u:.1f}" y1="{_TOP}" y2="{bottom}"/>')
            parts.append(f'<text x="{u:.1f}" y="{bottom + 15}" text-anchor="middle">{value:g}</text>')
        for value in _ticks(*self.y):
            v = float(self._v([value])[0])
            parts.append(f'<line class="rule" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{v:.1f}" y2="{v:.1f}"/>')
            parts.append(f'<text x="{_LEFT - 6}" y="{v + 4:.1f}" text-anchor="end">{value:g}</text>')
        parts += [
            f'<text x="{(_LEFT + WIDTH - _RIGHT) / 2}" y="{self.height - 8}" text-anchor="middle">'
            f"{text(self.labels[0])}</text>",
            f'<text transform="translate(13 {(_TOP + bottom) / 2}) rotate(-90)" text-anchor="middle">'
            f"{text(self.labels[1])}</text>",
            f'<svg x="{_LEFT}" y="{_TOP}" width="{WIDTH - _LEFT - _RIGHT}" height="{bottom - _TOP}" '
            f'viewBox="{_LEFT} {_TOP} {WIDTH - _LEFT - _RIGHT} {bottom - _TOP}">',
            *self._marks,
            "</svg>",
            "</svg>",
        ]
        return "".join(parts) + self._key_of_marks()

    def _key_of_marks(self) -> str:
        if not self._key:
            return ""
        entries = "".join(
            f'<span><svg viewBox="0 0 18 10" aria-hidden="true">{_sample(kind)}</svg>{text(name)}</span>'
            for name, kind in self._key
        )
        return f'<div class="key">{entries}</div>'

    def _name(self, name: str, kind: str) -> None:
        if name:
            self._key.append((name, kind))

    def _u(self, x: ArrayLike) -> FloatArray:
        share = (np.asarray(x, np.float64) - self.x[0]) / (self.x[1] - self.x[0])
        return np.asarray(_LEFT + share * (WIDTH - _LEFT - _RIGHT))

    def _v(self, y: ArrayLike) -> FloatArray:
        share = (np.asarray(y, np.float64) - self.y[0]) / (self.y[1] - self.y[0])
        size = self.height - _TOP - _BOTTOM
        return np.asarray(_TOP + (share if self.down else 1.0 - share) * size)


def _sample(kind: str) -> str:
    if kind.startswith("dot"):
        return f'<circle class="{kind}" cx="9" cy="5" r="3"/>'
    if kind.startswith("band"):
        return f'<rect class="{kind}" x="1" y="1" width="16" height="8"/>'
    return f'<line class="{kind}" x1="1" y1="5" x2="17" y2="5"/>'


def _wide(limits: tuple[float, float]) -> tuple[float, float]:
    """Limits that differ and are finite."""
    low, high = (float(np.nan_to_num(value)) for value in limits)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers within limits, about :data:`_TICKS` of them."""
    rough = (high - low) / _TICKS
    unit = 10.0 ** np.floor(np.log10(rough))
    step = unit * next(m for m in (1.0, 2.0, 5.0, 10.0) if m * unit >= 0.999 * rough)
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [float(f"{k * step:.10g}") for k in range(first, last + 1)]
