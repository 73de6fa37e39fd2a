"""The summary of a batch as one page: nothing is loaded from elsewhere; links lead to the drives' reports."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from urllib.parse import quote

import numpy as np

from sst_graph.errors import count_of
from sst_graph.fleet.drives import file_name
from sst_graph.fleet.summary.tables import Row, own_reason
from sst_graph.fleet.vehicles.fused import Vehicle
from sst_graph.inspect.inspection import HUMAN
from sst_graph.inspect.reasons import cut
from sst_graph.report.chart import Chart
from sst_graph.report.html import bullets, details, figure, grid, packaged, page, paragraph, section, text
from sst_graph.types import IntArray

MOST_ROWS = 5000
"""Drives on the page; the tables have all of them. Those that need attention come first."""
MOST_CHARTS = 60
"""Vehicles with charts of their drift, those that need attention first."""
MOST_IN_A_CHART = 25
"""Drives of a vehicle in its charts, evenly over each stretch between two changes; each takes 4 kB."""
_SIGMA_HEADS = ("σ rotation", "σ translation", "σ time offset")
_SHOWN = ("drive", "vehicle", "date", "status", "reason", *_SIGMA_HEADS, "took")


def summary_html(
    rows: Sequence[Row], vehicle_rows: Sequence[Row], vehicles: Sequence[Vehicle], others: int = 0
) -> str:
    """The page.

    Args:
        rows: of the drives, in the order of the page.
        vehicle_rows: of the vehicles, in the order of the page.
        vehicles: all of them.
        others: how many drives of earlier runs were not given this time.
    """
    by_name = {one.name: one for one in vehicles}
    body = [
        _verdict(rows, vehicle_rows),
        paragraph(others_line(others), "note") if others else "",
        _vehicles(vehicle_rows),
        _drifts([by_name[str(row["vehicle"])] for row in vehicle_rows]),
        _drives(rows),
    ]
    title = f"Batch of {count_of(len(rows), 'drive')}"
    style, script = (packaged(name, "sst_graph.fleet.summary") for name in ("page.css", "page.js"))
    return page(title, filter(None, body), style=packaged("page.css") + style, script=script)


def counts_line(rows: Sequence[Row]) -> str:
    """How many drives there are of each status."""
    counts = Counter(str(row["status"]) for row in rows)
    return ", ".join(f"{count} {name}" for name, count in counts.most_common())


def others_line(others: int) -> str:
    """A sentence that says that results of drives which were not given this time count for nothing."""
    them = _verb(others, "it is", "they are")
    return (
        f"{count_of(others, 'drive')} of earlier runs {_verb(others, 'was', 'were')} not given this time: "
        f"{them} in no table and in no vehicle. Give all drives to have them in; those that are done are not "
        "run again."
    )


def _verdict(rows: Sequence[Row], vehicle_rows: Sequence[Row]) -> str:
    counts = Counter(str(row["status"]) for row in rows)
    bars = "".join(
        f'<span class="s-{name}" style="flex:{count}" title="{count} {name}"></span>'
        for name, count in counts.most_common()
    )
    failed = [row for row in rows if not row["report"]]
    state = "ok" if counts["ok"] == len(rows) else "not_converged" if failed else "unobservable"
    reasons = Counter(_kind_of(row) for row in rows if row["status"] != "ok")
    reasons.update("contradicts the other drives of its vehicle" for row in rows if row["contradicts"])
    wrong = [row for row in vehicle_rows if row["status"] != "ok"]
    return section(
        "verdict",
        "Verdict",
        f'<p class="verdict {state}">{counts["ok"]} of {count_of(len(rows), "drive")} '
        f"{_verb(counts['ok'], 'is', 'are')} "
        f"ok; {len(failed)} {_verb(len(failed), 'has', 'have')} no result"
        + (
            f"; {len(wrong)} of {count_of(len(vehicle_rows), 'vehicle')} "
            f"{_verb(len(wrong), 'needs', 'need')} attention"
            if vehicle_rows
            else ""
        )
        + "</p>",
        f'<div class="bars">{bars}</div>',
        paragraph(counts_line(rows)),
        paragraph(_cost_line(rows), "note"),
        bullets(f"{count} × {kind}" for kind, count in reasons.most_common(12)),
    )


def _verb(count: int, one: str, many: str) -> str:
    return one if count == 1 else many


def _cost_line(rows: Sequence[Row]) -> str:
    """What the drives took, the last attempt at each."""
    seconds, peak_mb, input_mb = (
        [float(row[name] or 0.0) for row in rows] for name in ("cpu_s", "peak_mb", "input_mb")
    )
    hours = sum(seconds) / 3600.0
    took = f"{hours:.1f} hours" if hours >= 1.0 else f"{60.0 * hours:.1f} minutes"
    return (
        f"Took {took} of processor time (the last attempt at each drive; median {np.median(seconds):.0f} s), "
        f"{max(peak_mb) / 1e3:.1f} GB of memory at most, and {sum(input_mb) / 1e3:.1f} GB of data."
    )


def _kind_of(row: Row) -> str:
    """A status and what drives have in common of its own reason: no numbers, no name of the drive."""
    reason = _MORE.sub("", own_reason(row))
    if row["report"]:
        reason = re.sub(rf"^{re.escape(str(row['drive']))}[^ ]*: ", "", reason)
        return cut(f"{row['status']}: {_NUMBER.sub('…', reason)}", _LONGEST_KIND)
    words = reason.split(": found ", 1)
    last = words[0].rsplit("/", 1)[-1] if len(words) == 2 else ""
    return cut(f"{row['status']}: {f'{last}: found {words[1]}' if last else reason}", _LONGEST_KIND)


_LONGEST_KIND = 160
_MORE, _NUMBER = re.compile(r" \(\d+ more [^()]*in its report\)$"), re.compile(r"\d+(?:\.\d+)?")


def _vehicles(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    lines = []
    for row in rows:
        name = str(row["vehicle"])
        link = f'<a href="vehicles/{quote(file_name(name))}.json">{text(name)}</a>'
        lines.append(
            f'<tr><th scope="row">{link}</th><td>{_tag(row)}</td>'
            f'<td class="why">{text(str(row["reason"]))}</td><td class="num">{row["drives"]}</td>'
            f'<td class="num">{_left_out(row)}</td>{_sigma_cells(row)}</tr>'
        )
    heads = ("vehicle", "status", "what happened", "drives", "not counted", *_SIGMA_HEADS)
    return section(
        "vehicles",
        "Vehicles",
        paragraph(
            "The calibration of each vehicle by all of its drives; σ is the largest of the three axes.",
            "note",
        ),
        _table("vehicles-table", heads, lines),
    )


def _left_out(row: Row) -> int:
    """Drives of a vehicle that do not count: without a result that can, or contradicting the others."""
    return int(row["without"] or 0) + int(row["contradicting"] or 0)


def _drives(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows[:MOST_ROWS]:
        name = text(str(row["drive"]))
        # A drive without result has the last lines of its stderr in its record.
        link = str(row["report"]) or (f"records/{row['drive']}.json" if row["attempts"] else "")
        if link:
            name = f'<a href="{quote(link)}">{name}</a>'
        seconds = float(row["wall_s"] or 0.0)
        lines.append(
            f'<tr data-status="{row["status"]}"><th scope="row">{name}</th>'
            f"<td>{text(str(row['vehicle']))}</td>"
            f'<td class="day">{text(str(row["date"])[:10])}</td><td>{_tag(row)}</td>'
            f'<td class="why">{text(str(row["reason"]))}</td>{_sigma_cells(row)}'
            f'<td class="num" data-value="{seconds}">{seconds:.0f} s</td></tr>'
        )
    statuses = sorted({str(row["status"]) for row in rows})
    choices = "".join(f'<option value="{name}">{name}</option>' for name in statuses)
    left_out = len(rows) - MOST_ROWS
    note = f"{left_out} more, which need less attention, are in summary.csv." if left_out > 0 else ""
    return section(
        "drives",
        "Drives",
        paragraph(
            "What needs attention comes first; a click on a head sorts. A name leads to a drive's report, "
            "or to the record of what went wrong.",
            "note",
        ),
        paragraph(note, "note") if note else "",
        '<div class="filters"><label>status <select id="status"><option value="">all</option>'
        f'{choices}</select></label><label>words <input id="words" type="search"></label>'
        '<span id="shown" class="note"></span></div>',
        _table("drives-table", _SHOWN, lines),
    )


def _table(name: str, heads: Sequence[str], lines: Sequence[str]) -> str:
    top = "".join(f'<th scope="col">{text(head)}</th>' for head in heads)
    return (
        f'<div class="scroll"><table id="{name}"><thead><tr>{top}</tr></thead><tbody>'
        + "\n".join(lines)
        + "</tbody></table></div>"
    )


def _tag(row: Row) -> str:
    return f'<span class="tag s-{row["status"]}">{text(str(row["status"]))}</span>'


def _sigma_cells(row: Row) -> str:
    """Largest sigma of the rotations and of the translations, and that of the offset."""
    cells = []
    for names, digits, unit in (
        (("rot_x_deg", "rot_y_deg", "rot_z_deg"), 2, "°"),
        (("trans_x_cm", "trans_y_cm", "trans_z_cm"), 1, " cm"),
        (("time_offset_ms",), 1, " ms"),
    ):
        values = [row[f"sigma_{name}"] for name in names]
        if any(value is None for value in values):
            cells.append('<td class="num" data-value=""></td>')
            continue
        largest = max(float(value) for value in values if value is not None)
        cells.append(f'<td class="num" data-value="{largest:.6g}">±{largest:.{digits}f}{unit}</td>')
    return "".join(cells)


def _drifts(vehicles: Sequence[Vehicle]) -> str:
    """Charts of those with two drives or more."""
    moving = [one for one in vehicles if len(one.drift) > 1]
    blocks = [
        details(f"{one.name}: {one.status}, {count_of(len(one.drives), 'drive')}", grid(_charts(one)))
        for one in moving[:MOST_CHARTS]
    ]
    note = (
        "The calibration at each drive by all drives of its stretch, against that of the first, along "
        "the LiDAR's axes; the bands are one σ. A line ends where the calibration changed. Errors that all "
        "drives have in common do not show."
    )
    if any(len(one.drives) > MOST_IN_A_CHART for one in moving):
        note += (
            f" Of many drives about {MOST_IN_A_CHART} are shown, with those on either side of a change; "
            "vehicles/NAME.json has all."
        )
    return section("drift", "Drift", paragraph(note, "note"), *blocks) if blocks else ""


def _charts(vehicle: Vehicle) -> list[str]:
    first, days = vehicle.drift[0], np.array(vehicle.days)
    human = np.array([first.local_coordinates(one) for one in vehicle.drift]) * HUMAN
    sigmas = np.sqrt([np.diag(one.covariance) for one in vehicle.drift]) * HUMAN
    stretches = _stretches(vehicle)
    marked = np.concatenate(stretches)
    span = (float(days[0]), float(days[-1]))
    unit = "days" if vehicle.dated else "drives"
    shown = []
    for title, columns, label in (
        ("Rotation", [0, 1, 2], "deg"),
        ("Translation", [3, 4, 5], "cm"),
        ("Time offset", [6], "ms"),
    ):
        values, sigma = human[:, columns], sigmas[:, columns]
        chart = Chart(
            span,
            (float((values - sigma).min()), float((values + sigma).max())),
            (f"{unit} from the first", label),
            f"{title} of {vehicle.name} over its drives",
        )
        for k, axis in enumerate("xyz"[: len(columns)]):
            colour, name = "abc"[k], axis if len(columns) == 3 else ""
            for number, part in enumerate(stretches):
                at, middle, wide = days[part], values[part, k], sigma[part, k]
                if len(at) > 1:
                    chart.band(at, middle - wide, middle + wide, colour)
                else:  # a band of no width would not show
                    chart.line([*at, *at], [*(middle - wide), *(middle + wide)], colour)
                chart.line(at, middle, colour, name if number == 0 else "")
            chart.dots(days[marked], values[marked, k], colour, titles=[vehicle.drives[n] for n in marked])
        shown.append(figure(chart.svg(), title, ""))
    return shown


def _stretches(vehicle: Vehicle) -> list[IntArray]:
    """Numbers of the drives between its changes that are shown; of many some, first and last among them."""
    total = len(vehicle.drives)
    begins = [0, *(vehicle.drives.index(change.before) for change in vehicle.changes), total]
    share = min(1.0, MOST_IN_A_CHART / total)
    found = []
    for first, end in pairwise(begins):
        count = max(min(2, end - first), round(share * (end - first)))
        found.append(np.linspace(first, end - 1, count).round().astype(np.intp))
    return found
