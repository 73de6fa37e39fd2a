"""Calibration by edges where a scene tells little: between walls, through a forest. Prints a table.

    OMP_NUM_THREADS=1 python studies/edges_poor_scenes.py [--seeds 2] [--frames 15]

No result that is off by more than a degree may be ``ok``. Starts are 4 deg and 7 cm off.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np

from sst_graph import CalibrationConfig, calibrate
from sst_graph.experiments.starts import errors_of
from sst_graph.simulator import SimulatedDrive, SimulationConfig, scenery, simulate
from sst_graph.simulator.mesh import box_triangles, soup
from sst_graph.simulator.street import Street, _assembled, _Builder
from sst_graph.simulator.surfaces import FaceKind, Material

START = np.array([*np.radians([2.0, -3.0, 2.0]), 0.04, -0.04, 0.04])
PROFILE = scenery.StreetProfile(3.2, (4.0, 4.0), 1.5, (6.0, 6.0))


def between_walls(builder: _Builder, rng: np.random.Generator, start: float, end: float) -> None:
    """Walls along both sides, of pieces that follow the road."""
    piece = box_triangles((-5.2, -0.3, -1.0), (5.2, 0.3, float(rng.uniform(2.5, 6.0))))
    for side in (-1.0, 1.0):
        for s in np.arange(start, end, 10.0):
            wall = soup(piece, FaceKind.BUILDING, int(Material.PAVING), (0.6, 0.6, 0.6))
            builder.put(wall, float(s), side * 6.0)


def forest(builder: _Builder, rng: np.random.Generator, start: float, end: float) -> None:
    """Trees and bushes on both sides, the nearest beside the road."""
    for side in (-1.0, 1.0):
        for s in np.arange(start, end, 1.5):
            at, left = float(s + rng.uniform(-0.7, 0.7)), side * float(rng.uniform(5.0, 16.0))
            builder.put(scenery.tree(rng), at, left, float(rng.uniform(-3.0, 3.0)))
            if rng.uniform() < 0.4:
                builder.put(
                    scenery.hedge(rng, float(rng.uniform(1.0, 3.0))), at, side * rng.uniform(5.0, 9.0)
                )


SCENES = {"wall": between_walls, "forest": forest}


def drive_through(scene: str, config: SimulationConfig) -> SimulatedDrive:
    """A simulated drive whose street has nothing but the scene."""
    drive = simulate(config)
    street: Street = drive.street
    reach = street.ego.s
    builder, rng = _Builder(street.path), np.random.default_rng([config.seed, 71])
    start, end = float(reach.min()) - 60.0, float(reach.max()) + 90.0
    step = 6 * scenery.STATION_M
    for at in np.arange(start, end - step, step):
        builder.add(scenery.ground(builder.path, PROFILE, np.linspace(at, at + step, 7), Material.GRASS))
    builder.add(scenery.plain(builder.path))
    SCENES[scene](builder, rng, start, end)
    built = _assembled(builder, street.path, street.ego, [], street.sun, street.sunlight)
    return replace(drive, street=built)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=15)
    options = parser.parse_args()
    print("| scene | seed | rotation [deg] | ATD [cm] | status |\n|---|---|---|---|---|")
    for scene in SCENES:
        for seed in range(options.seeds):
            config = SimulationConfig(
                seed=seed,
                frames=options.frames,
                motion="no_stop",
                azimuth_limit_deg=50.0,
                moving_fraction=0.0,
            )
            drive = drive_through(scene, config)
            result = calibrate(drive, drive.truth.cTl.retract(START), CalibrationConfig(method="edges"))
            errors = errors_of(result, drive.truth)
            found = f"{errors.qad_deg:.2f} | {100 * errors.atd_m:.1f} | {result.status}"
            print(f"| {scene} | {seed} | {found} |", flush=True)
            for reason in result.reasons:
                print(f"{scene} {seed}: {reason}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
