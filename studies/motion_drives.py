"""Real drives by motion alone, without a start, at several shifts of the images. Prints a table.

OMP_NUM_THREADS=1 python -m studies.motion_drives STOP PARKED
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.experiments.markdown import lines
from sst_graph.experiments.starts import error_of, truth_of
from studies.edges_streets import cells, sigma_cells

HEAD = (
    "| drive | `--image-shift` | rotation about LiDAR x, y, z [deg] | translation [cm] | time offset [ms] "
    "| sigma: rotation | translation | time offset | status |"
)


def rows(data: Sequence[str], shifts: Sequence[int]) -> Iterator[list[str]]:
    """Errors against the published calibration and the nominal stamps, and their sigmas."""
    for path in data:
        for shift in shifts:
            source = open_source(path, image_shift=shift)
            result = calibrate(source, None, CalibrationConfig(method="motion"))
            errors = cells(error_of(result.calibration, truth_of(source)))
            yield [source.name, str(shift), *errors, *sigma_cells(result.covariance), result.status]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("data", nargs="+", help="folders of drives")
    parser.add_argument("--shifts", type=int, nargs="+", default=[0, 1, 2, 3])
    args = parser.parse_args()
    for line in lines(HEAD, rows(args.data, args.shifts)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
