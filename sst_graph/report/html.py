"""Pieces of HTML. What comes from data goes through :func:`text`."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable, Sequence
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

_JPEG_QUALITY = 82


def text(words: str) -> str:
    """Words as text of a page, or of an attribute in double quotes."""
    return html.escape(printable(words), quote=True)


_OPTION = re.compile(r"--[a-z][a-z-]*")


def prose(words: str) -> str:
    """Words as text of a page alone, in which no line ends within the name of an option."""
    return _OPTION.sub(r'<span class="option">\g<0></span>', text(words))


def printable(words: str) -> str:
    """Words that a file can hold: names of files may have bytes that are no text."""
    return words.encode("utf-8", "backslashreplace").decode("utf-8")


def packaged(name: str, package: str = "sst_graph.report") -> str:
    """A text file of a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def page(title: str, body: Iterable[str], style: str, script: str) -> str:
    """A whole page, which loads nothing from elsewhere."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{text(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<h1>{text(title)}</h1>\n<main>\n" + "\n".join(body) + "\n</main>\n"
        f"<script>\n{script}</script>\n</body>\n</html>\n"
    )


def section(name: str, title: str, *blocks: str) -> str:
    """A part of the page under a heading; empty where it has no block."""
    body = "\n".join(block for block in blocks if block)
    return f'<section id="{name}">\n<h2>{text(title)}</h2>\n{body}\n</section>' if body else ""


def paragraph(words: str, kind: str = "") -> str:
    return f'<p class="{kind}">{prose(words)}</p>' if kind else f"<p>{prose(words)}</p>"


def bullets(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{prose(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def numbered(items: Iterable[str]) -> str:
    """A list whose numbers are those of a chart's bars."""
    return '<ol class="numbered">' + "".join(f"<li>{text(item)}</li>" for item in items) + "</ol>"


def figure(content: str, title: str, caption: str, *, below: str = "", kind: str = "") -> str:
    """A chart or picture with its title above and, below, what to look for, and what else belongs to it.

    Of the kinds "wide" and "listed" it is as wide as the page, the latter with a list beside the chart.
    """
    opened = f'<figure class="{kind}">' if kind else "<figure>"
    return (
        f"{opened}<h3>{text(title)}</h3>{content}<figcaption>{text(caption)}</figcaption>{below}</figure>"
        if content
        else ""
    )


def grid(figures: Sequence[str], kind: str = "") -> str:
    """Figures beside each other where there is room."""
    shown = [one for one in figures if one]
    return f'<div class="{f"grid {kind}".strip()}">' + "\n".join(shown) + "</div>" if shown else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table; the first cell of a row is its name.

    Of the kind "stacked" its cells stand below each other on a narrow page, each with its column's head.
    """
    top = "".join(f'<th scope="col">{text(cell)}</th>' for cell in head)
    body = "".join(
        f'<tr><th scope="row">{text(first)}</th>'
        + "".join(
            (f'<td data-head="{text(name)}">' if kind == "stacked" else "<td>") + f"{prose(cell)}</td>"
            for name, cell in zip(head[1:], cells, strict=True)
        )
        + "</tr>"
        for first, *cells in rows
    )
    return (
        f'<div class="scroll"><table class="{kind}"><thead><tr>{top}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def lines(rows: Iterable[tuple[str, str]]) -> str:
    """Lines of a terminal: names, and texts whose spaces count; one without a name continues another."""
    body = "".join(
        f'<tr><th scope="row">{text(name)}</th><td>{prose(line)}</td></tr>'
        if line
        else f'<tr><th scope="row" colspan="2">{text(name)}</th></tr>'
        for name, line in rows
    )
    return f'<table class="lines"><tbody>{body}</tbody></table>'


def details(title: str, *blocks: str) -> str:
    """Blocks that are shown on a click."""
    body = "\n".join(block for block in blocks if block)
    return f"<details><summary>{text(title)}</summary>{body}</details>" if body else ""


def preformatted(words: str) -> str:
    return f"<pre>{text(words)}</pre>"


def jpeg(picture: NDArray[np.uint8]) -> str:
    """A picture (h, w, 3) BGR as a data URI."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(bytes(data)).decode("ascii")


def packed(array: NDArray[np.generic]) -> str:
    """The bytes of an array, little-endian, in base64."""
    return base64.b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode("ascii")
