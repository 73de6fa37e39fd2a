"""Small charts: matplotlib draws them, as SVG that stands in the page and takes its colours and its font."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from sst_graph.errors import ConfigError, MissingDependencyError
from sst_graph.report.html import paragraph, printable
from sst_graph.viz.matplotlib_figure import figure_class

WIDTH, HEIGHT = 400, 260
"""Of a chart, in its own units: the page stretches it. Text is 13 units high, as in page.css."""
BROAD = 1000
"""Width of a chart of which one is as wide as a broad page, in the same units: in so many pixels its letters
are as large as those of charts that stand beside each other."""
_RIGHT, _TOP, _BOTTOM = 14, 12, 44
_TICKS, _WHOLE_TICKS = 5, 16
_COLOURS = {
    name: f"#0101{k:02x}" for k, name in enumerate(("a", "b", "c", "good", "bad", "muted", "rule"), 1)
}
"""What matplotlib draws in, for each colour of page.css; it becomes ``var(--name)``."""
_SETTINGS = {
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.size": 13,
    "text.color": _COLOURS["muted"],
    "axes.labelcolor": _COLOURS["muted"],
    "xtick.color": _COLOURS["muted"],
    "ytick.color": _COLOURS["muted"],
    "grid.color": _COLOURS["rule"],
    "grid.linewidth": 1,
    "axes.grid": True,
    "axes.axisbelow": True,
    "lines.linewidth": 2,
    "lines.dashed_pattern": (2.5, 2),
}
"""Of matplotlib while it draws."""
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


@dataclass(frozen=True)
class _Mark:
    """What is drawn together.

    Attributes:
        kind: its class in the page.
        draw: draws it on axes, under the id that is given.
        titles: of its parts, in the order in which they are drawn.
    """

    kind: str
    draw: Callable[[Any, str], None]
    titles: Sequence[str] = ()


class Chart:
    """Axes that marks are added to, in data units; :meth:`svg` is the picture.

    A colour is the name of one of page.css: a, b, c, good, bad, muted.

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
        self.labels, self.alt, self.down, self.square = labels, alt, down, square
        self._counted = False
        self._marks: list[_Mark] = []

    def line(self, x: ArrayLike, y: ArrayLike, colour: str, name: str = "", dashed: bool = False) -> None:
        """A line through points; a name is shown in the key."""
        xs, ys = _finite(x, y)
        style: dict[str, Any] = {"color": _COLOURS[colour], "label": name, "ls": "--" if dashed else "-"}
        self._add(f"line {colour}", lambda axes, gid: axes.plot(xs, ys, gid=gid, **style))

    def dots(
        self, x: ArrayLike, y: ArrayLike, colour: str, size: float = 2.5, titles: Sequence[str] = ()
    ) -> None:
        """Points, all finite, of a radius; titles are shown under the pointer."""
        style: dict[str, Any] = {"color": _COLOURS[colour], "s": (2.0 * size) ** 2, "lw": 0}
        style |= {"zorder": 3, "clip_on": False}
        self._add(f"dots {colour}", lambda axes, gid: axes.scatter(x, y, gid=gid, **style), titles)

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, name: str = "") -> None:
        """The area between two lines."""
        style: dict[str, Any] = {"color": _COLOURS[colour], "label": name, "lw": 0, "alpha": 0.18}
        self._add(f"band {colour}", lambda axes, gid: axes.fill_between(x, low, high, gid=gid, **style))

    def bars(
        self, x: ArrayLike, heights: ArrayLike, width: float, colour: str, titles: Sequence[str]
    ) -> None:
        """Bars from 0 to the heights, about x; width in data units."""
        xs, ys = np.asarray(x, np.float64), np.asarray(heights, np.float64)
        corners: Any = np.stack(
            [
                np.stack([xs + side * width, end], axis=-1)
                for side, end in ((-0.5, 0.0 * ys), (-0.5, ys), (0.5, ys), (0.5, 0.0 * ys))
            ],
            axis=1,
        )

        def draw(axes: Any, gid: str) -> None:
            from matplotlib.collections import PolyCollection

            style: dict[str, Any] = {"facecolors": _COLOURS[colour], "lw": 0}
            axes.add_collection(PolyCollection(corners, gid=gid, **style), autolim=False)

        self._add(f"bars {colour}", draw, titles)

    def arrows(self, x: ArrayLike, y: ArrayLike, dx: ArrayLike, dy: ArrayLike, titles: Sequence[str]) -> None:
        """Arrows from (x, y), in data units."""
        lengths: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "dots"}
        look: dict[str, Any] = {"color": _COLOURS["a"], "width": 2, "headwidth": 4, "headlength": 4}
        look |= {"headaxislength": 3.5, "minshaft": 1.2, "clip_on": False}
        self._add("arrows a", lambda axes, gid: axes.quiver(x, y, dx, dy, gid=gid, **lengths, **look), titles)

    def level(self, y: float, name: str = "", colour: str = "muted") -> None:
        """A horizontal line."""
        self.line(self.x, (y, y), colour, name, dashed=True)

    def count_along_x(self) -> None:
        """x is the number of a thing: ticks at 1, 2, 3, ..., or, of many, at every second or third."""
        self._counted = True

    def svg(self, width: int = WIDTH) -> str:
        """The chart; where matplotlib does not start, a sentence that says why.

        Args:
            width: in its own units.
        """
        try:
            figure_class()
        except (MissingDependencyError, ConfigError) as error:
            return paragraph(f"Not drawn: {error}", "note")
        return self._for_the_page(*self._drawn(width))

    def _add(self, kind: str, draw: Callable[[Any, str], None], titles: Sequence[str] = ()) -> None:
        self._marks.append(_Mark(kind, draw, titles))

    def _drawn(self, width: int) -> tuple[bytes, dict[str, str]]:
        """The SVG as matplotlib writes it, and the place of the axes in it."""
        import matplotlib as mpl
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        with mpl.rc_context(_settings()):
            figure = figure_class()(figsize=(width / 72, HEIGHT / 72), dpi=72)
            figure.patch.set_visible(False)
            axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False)
            axes.set(xlim=self.x, ylim=self.y[::-1] if self.down else self.y, xlabel=self.labels[0])
            axes.set_ylabel(self.labels[1], rotation_mode="anchor")
            for k, mark in enumerate(self._marks):
                mark.draw(axes, f"mark {k}")
            box = self._place(figure, axes, width)
            file = io.BytesIO()
            canvas: Any = FigureCanvasSVG(figure)
            canvas.print_svg(file, metadata=_NO_METADATA)
        return file.getvalue(), box

    def _place(self, figure: Any, axes: Any, width: int) -> dict[str, str]:
        """Ticks, the key, and room for all labels; the place that is left for the axes, as an SVG's."""
        axes.tick_params(length=0, pad=6)
        axes.locator_params(nbins=_TICKS, steps=(1, 2, 5, 10))
        if self._counted:
            last = int(self.x[1])
            axes.set_xticks(np.arange(1, last + 1, 1 + last // _WHOLE_TICKS))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        texts = axes.yaxis.get_major_formatter().format_ticks(axes.yaxis.get_majorticklocs())
        left = 28.0 + 8.0 * max(map(len, texts))
        handles, names = axes.get_legend_handles_labels()
        bottom = _BOTTOM + 20 * (len(names) > 0)
        wide, high = width - left - _RIGHT, float(HEIGHT - _TOP - bottom)
        if self.square:
            high = wide * (self.y[1] - self.y[0]) / (self.x[1] - self.x[0])
        height = high + _TOP + bottom
        figure.set_size_inches(width / 72, height / 72)
        axes.set_position((left / width, bottom / height, wide / width, high / height))
        axes.yaxis.set_label_coords((14 - left) / wide, 0.5)
        axes.xaxis.set_label_coords(0.5, -23 / high)
        if names:
            look: dict[str, Any] = {"frameon": False, "borderpad": 0.1, "borderaxespad": 0}
            look |= {"handlelength": 1.4, "handletextpad": 0.4, "columnspacing": 1.0}
            figure.legend(handles, names, loc="lower center", ncols=len(names), **look)
        # A unit wider all around: lines along the border stay whole.
        box = [f"{one:.1f}" for one in (left - 1, _TOP - 1, wide + 2, high + 2)]
        return {**dict(zip(("x", "y", "width", "height"), box, strict=True)), "viewBox": " ".join(box)}

    def _for_the_page(self, written: bytes, inside: dict[str, str]) -> str:
        """SVG without ids, references, fonts and colours of its own."""
        root = ElementTree.fromstring(written)
        paths: dict[str, str] = {}
        for group in root.iter():
            group.tag = group.tag.rpartition("}")[2]
            for child in [one for one in group if one.tag.endswith("}defs")]:
                paths |= {one.get("id", ""): one.get("d", "") for one in child}
                group.remove(child)
        for element in root.iter():
            name = element.attrib.pop("id", "")
            element.attrib.pop("clip-path", None)
            if element.tag == "use":
                element.tag = "path"
                at = element.attrib.pop("x"), element.attrib.pop("y")
                element.set("transform", "translate({} {})".format(*at))
                element.set("d", paths[element.attrib.pop("{http://www.w3.org/1999/xlink}href")[1:]])
            elif element.tag == "text":
                anchor = re.search(r"text-anchor: \w+", element.get("style", ""))
                element.set("style", anchor[0] if anchor else "")
            if name.startswith("mark "):
                mark = self._marks[int(name[5:])]
                element.set("class", mark.kind)
                parts = [one for one in element.iter() if one.tag in ("path", "use")]
                # Cut by an SVG of its own: a clip path needs an id, which the whole page has but once.
                if any(one.get("clip-path") for one in element.iter()):
                    element.tag = "svg"
                    element.attrib |= inside
                for part, title in zip(parts, mark.titles, strict=False):
                    ElementTree.SubElement(part, "title").text = printable(title)
        size = root.get("viewBox", "")
        root.attrib = {"class": "chart", "viewBox": size, "role": "img", "aria-label": printable(self.alt)}
        drawn = ElementTree.tostring(root, encoding="unicode")
        for name, colour in _COLOURS.items():
            drawn = drawn.replace(f": {colour}", f": var(--{name})")
        return drawn


@cache
def _settings() -> Any:
    """All of matplotlib's settings: its defaults, not the user's, and those of the charts."""
    import matplotlib as mpl

    default = {str(name): value for name, value in mpl.rcParamsDefault.items()}
    del default["backend"]
    return default | _SETTINGS


def _finite(x: ArrayLike, y: ArrayLike) -> tuple[Any, Any]:
    """The points whose x and y are known."""
    points = np.stack([np.asarray(x, np.float64), np.asarray(y, np.float64)])
    xs, ys = points[:, np.isfinite(points).all(axis=0)]
    return xs, ys


def _wide(limits: tuple[float, float]) -> tuple[float, float]:
    """Limits that differ and are finite."""
    low, high = (float(np.clip(np.nan_to_num(value), -1e100, 1e100)) for value in limits)
    return (low, high) if high > low else (low - 0.5, low + 0.5)
