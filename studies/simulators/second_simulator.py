"""The joint method on streets of other simulators (second_street.py, third_street.py). Prints a table.

    OMP_NUM_THREADS=1 python studies/simulators/second_simulator.py --streets 6
    OMP_NUM_THREADS=1 python studies/simulators/second_simulator.py --streets 6 --simulator third

Starts are uniform within 12 deg by axis and 10 cm; ``--init none`` gives none.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import cv2
import numpy as np

# Streets are built here, as the directory of a script is on its path.
from second_street import SecondStreet, StreetConfig
from third_street import ThirdConfig, ThirdStreet

from sst_graph import CalibrationConfig, calibrate
from sst_graph.experiments.markdown import lines, median_worst, status_counts
from sst_graph.experiments.starts import error_of
from sst_graph.metrics import nees
from sst_graph.types import SemanticClass

HEAD = (
    "| scenario | off by more than 1° (`ok`) | rotation [deg] | ATD [cm] | time offset [ms] "
    "| NEES / dimension: rotation, translation, time offset, all | ok / unobservable / not converged |"
)
Street = SecondStreet | ThirdStreet
SIMULATORS: dict[str, Callable[..., Street]] = {
    "second": lambda **options: SecondStreet(StreetConfig(**options)),
    "third": lambda **options: ThirdStreet(ThirdConfig(**options)),
}
SCENARIOS: dict[str, Mapping[str, Any]] = {
    "stop, 100 ms": {},
    "stop, -300 ms": {"time_offset_s": -0.3},
    "stop, exact labels": {"label_noise": 0.0},
    "stop, labels twice as bad": {"label_noise": 2.0},
    "stop, 32 lasers": {"lasers": "32"},
    "stop, 128 lasers": {"lasers": "128"},
    "stop, wide 640x480 camera": {"width": 640, "height": 480, "focal_px": 420.0},
    "stop, half of the vehicles moving": {"moving_fraction": 0.5},
    "varied speed, 100 ms": {"motion": "vary"},
    "constant speed, 100 ms": {"motion": "constant"},
    "standing, 3 frames": {"motion": "standing", "frames": 3, "time_offset_s": 0.0, "density": 0.2},
}
CLASSES = {
    "vehicle": (SemanticClass.VEHICLE,),
    "all": (SemanticClass.VEHICLE, SemanticClass.BUILDING, SemanticClass.VEGETATION, SemanticClass.POLE),
}


def run(street: Street, classes: tuple[SemanticClass, ...], guess: bool) -> tuple[list[float], str]:
    """[rotation deg, ATD cm, time offset ms, NEES / dimension of rotation, translation, time offset, all]."""
    config, truth = street.config, street.truth
    rng = np.random.default_rng([config.seed, 99])
    away = np.concatenate([np.radians(rng.uniform(-12.0, 12.0, 3)), rng.uniform(-0.1, 0.1, 3)])
    result = calibrate(street, truth.cTl.retract(away) if guess else None, CalibrationConfig(classes=classes))
    error = error_of(result.calibration, truth)
    shift = result.T_camera_lidar.translation() - truth.cTl.translation()
    figures = [np.degrees(np.linalg.norm(error[:3])), 100 * np.abs(shift).mean(), 1e3 * abs(error[6])]
    for part in (slice(0, 3), slice(3, 6), slice(6, 7), slice(0, 7)):
        figures.append(nees(error[part], result.covariance[part, part]) / len(error[part]))
    return [float(figure) for figure in figures], result.status


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulator", choices=sorted(SIMULATORS), default="second")
    parser.add_argument("--streets", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--classes", choices=sorted(CLASSES), default="vehicle")
    parser.add_argument("--init", choices=("near", "none"), default="near")
    parser.add_argument("--scenario", action="append", choices=sorted(SCENARIOS))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    for line in lines(HEAD, rows(args)):
        print(line, flush=True)


def rows(args: argparse.Namespace) -> Iterator[list[str]]:
    """A row for each scenario: median and largest, over streets."""
    for name in args.scenario or SCENARIOS:
        figures, statuses = [], []
        for seed in range(args.seed, args.seed + args.streets):
            street = SIMULATORS[args.simulator](seed=seed, **SCENARIOS[name])
            figure, status = run(street, CLASSES[args.classes], args.init == "near")
            figures.append(figure)
            statuses.append(status)
        table = np.array(figures)
        lost = table[:, 0] > 1.0
        silent = sum(status == "ok" for status, wrong in zip(statuses, lost, strict=True) if wrong)
        cells = [name, f"{lost.sum()} ({silent}) of {len(lost)}", median_worst(list(table[:, 0]), 3)]
        cells += [median_worst(list(column), 2) for column in table.T[1:3]]
        cells.append(", ".join(f"{mean:.1f}" for mean in table[:, 3:].mean(axis=0)))
        yield [*cells, status_counts(statuses)]


if __name__ == "__main__":
    main()
