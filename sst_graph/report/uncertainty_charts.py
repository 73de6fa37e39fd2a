"""Charts of the estimation: convergence, profile likelihood, ellipses, correlations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sst_graph.fit import Fit, Profile
from sst_graph.inspect.gained_text import SHORT
from sst_graph.inspect.inspection import HUMAN, NAMES, UNITS, Correlation, correlation_matrix, sigma_ellipse
from sst_graph.inspect.reasons import capitalized
from sst_graph.report.chart import Chart
from sst_graph.report.html import figure, table, text
from sst_graph.result import CalibrationResult

_LEAST_SIGMAS = 1e-3
"""Distances below are drawn at it: they are nothing beside the uncertainty."""
_ELLIPSES = 3
_HARDLY_SEPARATE = 0.8
"""Correlation above which an ellipse's caption says what it means."""


def convergence_chart(fit: Fit, result: CalibrationResult) -> str:
    """Distance to the last estimate, iteration by iteration; empty with fewer than two."""
    iterations = fit.iterations
    if len(iterations) < 2:
        return ""
    last, sigmas = iterations[-1], np.sqrt(np.diag(result.covariance))
    steps = np.array([last.local_coordinates(one) for one in iterations])
    parts = np.abs(steps) / np.maximum(sigmas, 1e-12)
    curves = (
        ("rotation", parts[:, :3].max(axis=1), "a"),
        ("translation", parts[:, 3:6].max(axis=1), "b"),
        ("time offset", parts[:, 6], "c"),
    )
    logs = [np.log10(np.maximum(values, _LEAST_SIGMAS)) for _, values, _ in curves]
    top = max(0.5, max(float(one.max()) for one in logs))
    chart = Chart(
        (1, len(iterations)),
        (np.log10(_LEAST_SIGMAS), top),
        ("outer iteration", "distance, log10 of sigmas"),
        "Distance to the result in each outer iteration",
    )
    chart.level(0.0, "one sigma")
    for (name, _, colour), values in zip(curves, logs, strict=True):
        chart.line(np.arange(1, len(iterations) + 1), values, colour, name)
    return figure(
        chart.svg(),
        "Convergence",
        f"Each iteration {'pairs motions' if result.fit_is_check else 'matches'} again and solves. "
        "The curves should fall below one sigma and stay there."
        + " The first ones are on a few scans, the last on all."
        * (fit.by_edges and not result.fit_is_check),
    )


def profile_charts(profiles: Sequence[Profile], result: CalibrationResult) -> list[str]:
    """Likelihood along each unknown beside the Gaussian of the result's sigma."""
    sigmas = np.sqrt(np.diag(result.covariance))
    return [_profile(profile, float(sigmas[profile.unknown])) for profile in profiles]


def _profile(profile: Profile, sigma: float) -> str:
    unit, scale = UNITS[profile.unknown], float(HUMAN[profile.unknown])
    # The cost counts matches as independent, the covariance does not: the cost is scaled to its width.
    tempered = profile.costs * (profile.sigma / sigma) ** 2
    x = np.linspace(profile.steps[0], profile.steps[-1], 81)
    chart = Chart(
        (scale * profile.steps[0], scale * profile.steps[-1]),
        (0.0, 1.05),
        (f"{NAMES[profile.unknown]}, from the result [{unit}]", "likelihood, 1 at its best"),
        f"Likelihood along {NAMES[profile.unknown]}",
    )
    chart.line(scale * x, np.exp(-0.5 * (x / sigma) ** 2), "muted", "Gaussian", dashed=True)
    # Interpolated as a root of the cost, which is a straight line where the profile is a Gaussian.
    best = profile.steps[int(np.argmin(tempered))]
    roots = np.interp(x, profile.steps, np.sign(profile.steps - best) * np.sqrt(tempered))
    chart.line(scale * x, np.exp(-(roots**2)), "a", "profile")
    chart.dots(scale * profile.steps, np.exp(-tempered), "a")
    title = capitalized(_full_name(profile.unknown))
    caption = f"One sigma of the result: {scale * sigma:.2g} {unit}."
    if profile.best_score is not None:
        low, high = (100.0 * profile.costs[[0, -1]] / max(profile.best_score, 1e-9)).tolist()
        caption += f" At the ends the score is {low:.1f} and {high:.1f} % below its best."
    return figure(chart.svg(), title, caption)


def ellipse_charts(result: CalibrationResult, pairs: Sequence[Correlation]) -> list[str]:
    """1 and 2 sigma of the pairs of unknowns that are correlated most."""
    covariance = result.covariance * np.outer(HUMAN, HUMAN)
    found = []
    for pair in pairs[:_ELLIPSES]:
        i, j = pair.first, pair.second
        ellipse = sigma_ellipse(covariance[np.ix_((i, j), (i, j))], 91)
        reach = 2.2 * np.sqrt(covariance[[i, j], [i, j]])
        first, second = _full_name(i), _full_name(j)
        chart = Chart(
            (-reach[0], reach[0]),
            (-reach[1], reach[1]),
            (f"{first} [{UNITS[i]}]", f"{second} [{UNITS[j]}]"),
            f"Ellipses of {first} and {second}, correlation {pair.value:+z.2f}",
        )
        chart.line(2.0 * ellipse[0], 2.0 * ellipse[1], "a", "2 sigma", dashed=True)
        chart.line(ellipse[0], ellipse[1], "a", "1 sigma")
        chart.dots([0.0], [0.0], "a")
        caption = f"Correlation {pair.value:+z.2f}" + (
            ": the ellipse is narrow and slanted, so the data hardly tell the two apart."
            if abs(pair.value) > _HARDLY_SEPARATE
            else "."
        )
        found.append(figure(chart.svg(), capitalized(f"{first} against {second}"), caption))
    return found


def _full_name(unknown: int) -> str:
    """Name of an unknown where no axis says that x, y and z are translations."""
    return f"translation {NAMES[unknown]}" if 3 <= unknown < 6 else NAMES[unknown]


def correlation_table(result: CalibrationResult) -> str:
    """The seven by seven correlations, strong ones marked."""
    values = correlation_matrix(result.covariance)
    plain = table(
        ("", *SHORT),
        [(name, *(f"{value:+z.2f}" for value in row)) for name, row in zip(SHORT, values, strict=True)],
        "numbers",
    )
    for strong in {f"{value:+z.2f}" for value in values.flat if 0.6 <= abs(value) < 1.0}:
        plain = plain.replace(f"<td>{text(strong)}</td>", f'<td class="strong">{text(strong)}</td>')
    return plain
