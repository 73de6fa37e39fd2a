"""What is considered of a parameter that is off by some of its deviations, drawn at random. Prints tables.

    python studies/considered_sigma.py

An estimate of cx is drawn around its true value, its deviation is that of short drives or of long ones, and
the error of the answer along the direction that cx moves it is that of the matches and of cx. "Silent": the
estimate does not contradict cx = 0, and the answer is more than three sigmas off. Three ways to consider cx:
its prior deviation only, the root mean square of what it may be, and that or its tail as the program does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.covariance.broken_assumptions import Evidence, considered_sigmas

FloatArray = NDArray[np.float64]

SIZES = (0.0, 1.0, 2.0, 3.0, 4.0)
DEVIATIONS_PX = (0.84, 1.8, 6.4)
MATCHES_PX = 0.5
"""Deviation of the answer by matches and motion, as pixels of cx: 0.04 deg with KITTI's camera."""
STUDENT = 1.3
"""The test's deviation over that of the estimate: Student's factor of fifteen objects."""
_THRESHOLD, _SILENT_SIGMAS, _DRAWS, _GRID = 3.3, 3.0, 20_000, 200


def root_mean_square(evidence: Evidence) -> float:
    """The considered deviation without its tail."""
    broken = evidence.broken()
    odds = evidence.prevalence * broken.factor
    share = odds / (1.0 - evidence.prevalence + odds)
    return float(np.sqrt((1.0 - share) * evidence.prior**2 + share * broken.mean_square))


CONSIDERED: dict[str, Callable[[Evidence], float]] = {
    "prior only": lambda evidence: evidence.prior,
    "root mean square, by the test's deviation": lambda evidence: root_mean_square(
        replace(evidence, deviation=STUDENT * evidence.deviation)
    ),
    "root mean square": root_mean_square,
    "as it is: root mean square or tail": lambda evidence: considered_sigmas({"cx": evidence})["cx"],
}


def sigmas_of(estimates: FloatArray, deviation: float, considered: Callable[[Evidence], float]) -> FloatArray:
    """Considered deviation (n,) at estimates (n,) with a deviation [px]."""
    cx = ASSUMPTIONS["cx"]
    grid = np.linspace(0.0, float(np.abs(estimates).max()), _GRID)
    seen = [Evidence(float(each), deviation, cx.sigma, cx.span, cx.prevalence) for each in grid]
    return np.interp(np.abs(estimates), grid, [considered(each) for each in seen])


def rates(
    size: float, deviation: float, considered: Callable[[Evidence], float]
) -> tuple[float, float, float]:
    """Of a parameter of ``size`` of the test's deviations [px]: share contradicted, share silent, and NEES of
    what is not contradicted.
    """
    rng = np.random.default_rng(7)
    theta = size * deviation
    estimates = theta + deviation / STUDENT * rng.standard_normal(_DRAWS)
    errors = theta + MATCHES_PX * rng.standard_normal(_DRAWS)
    told = np.abs(estimates) > _THRESHOLD * deviation
    squares = errors**2 / (MATCHES_PX**2 + sigmas_of(estimates, deviation / STUDENT, considered) ** 2)
    silent = ~told & (squares > _SILENT_SIGMAS**2)
    return float(told.mean()), float(silent.mean()), float(squares[~told].mean())


def main() -> None:
    for title, considered in CONSIDERED.items():
        print(f"\n{title}\n")
        print("| cx known to | " + " | ".join(f"{size:g} σ" for size in SIZES) + " |")
        print("|---" * (1 + len(SIZES)) + "|")
        for deviation in DEVIATIONS_PX:
            rows = [rates(size, deviation, considered) for size in SIZES]
            cells = [f"{100 * told:.0f}, {100 * silent:.0f} %; {nees:.2f}" for told, silent, nees in rows]
            print(f"| {deviation:g} px | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
