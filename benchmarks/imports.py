"""Processor time of a process that only starts, imports or prints its help. Prints a table.

python -m benchmarks.imports
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence

from sst_graph.experiments.markdown import table

CASES = {
    "python -c pass": ("-c", "pass"),
    "import sst_graph": ("-c", "import sst_graph"),
    "python -m sst_graph --help": ("-m", "sst_graph", "--help"),
    "import numpy, scipy.spatial, scipy.ndimage, gtsam, cv2": (
        "-c",
        "import numpy, scipy.spatial, scipy.ndimage, gtsam, cv2",
    ),
    "from sst_graph import calibrate, Tracker": ("-c", "from sst_graph import calibrate, Tracker"),
}


def seconds(arguments: Sequence[str]) -> float:
    """User and system seconds of one process."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"python {' '.join(arguments)}: exit code {process.returncode}, expected 0")
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=3, help="of which the fastest counts")
    runs = parser.parse_args().runs
    rows = [
        [f"`{name}`", f"{min(seconds(arguments) for _ in range(runs)):.2f}"]
        for name, arguments in CASES.items()
    ]
    print(table("| | processor [s] |", rows))


if __name__ == "__main__":
    main()
