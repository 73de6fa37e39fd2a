"""Draws the figures of the documentation: ``python docs/figures/make.py [NAME ...]``.

``--measure`` first calibrates, and tracks, the simulated drives that three of them show (drives.csv,
alarm.csv); ``--demo OUT/demo`` takes the pictures of a demo that ``make demo`` has written. ``--into DIR``
writes elsewhere.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent

STYLE = {
    "svg.hashsalt": "sst-graph",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def figures() -> dict[str, Callable[[], Figure]]:
    """All figures by name."""
    import drawings
    import plots

    return {
        "frames": drawings.frames,
        "clocks": drawings.clocks,
        "matches": drawings.matches,
        "observability": plots.observability,
        "sigma": plots.sigma,
        "knock": plots.knock,
    }


def main() -> None:
    known = figures()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(known)} (default: all)")
    parser.add_argument(
        "--measure", action="store_true", help="measure the simulated drives first"
    )
    parser.add_argument("--demo", type=Path, metavar="DIR", help="take the pictures of this demo")
    parser.add_argument("--into", type=Path, default=HERE, metavar="DIR", help="folder for the figures")
    args = parser.parse_args()
    unknown = set(args.names) - set(known)
    if unknown:
        parser.error(f"found {', '.join(sorted(unknown))}, expected some of {', '.join(known)}")
    if args.measure:
        import alarm
        import drives

        drives.measure(print)
        alarm.measure(print)
    if args.demo:
        import demo

        demo.take(args.demo, args.into)
    with mpl.rc_context(STYLE):
        for name in args.names or known:
            path = args.into / f"{name}.svg"
            known[name]().savefig(path, metadata={"Date": None, "Creator": None})
            print(path)


if __name__ == "__main__":
    main()
