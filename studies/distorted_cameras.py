"""Calibration through distorted lenses against a pinhole of the same place, field and resolution.

Each street is driven through once a lens. Its images are rectified, and calibrated; so are the images that a
pinhole with the rectified camera's intrinsics takes of the same street. The table has the median errors of
both, and their ratio.

    python studies/distorted_cameras.py --streets 4

A rectified fisheye has fewer raw pixels than its pinhole: towards the rim the pinhole is up to three times as
fine as the lens. With ``--pinhole pixels`` the pinhole has as many pixels as the lens spends on that field.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sst_graph.batch import calibrate_prepared, prepare_drives
from sst_graph.batch.config import CalibrationConfig
from sst_graph.cameras import BrownConradyCamera, CameraModel, FisheyeCamera, Rectification
from sst_graph.data.rectified import RectifiedSource
from sst_graph.factors.camera import PinholeCamera
from sst_graph.metrics import CalibrationErrors, calibration_errors
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.types import Source
from studies.simulators.lens import LensDrive

FISHEYE_DEG = 190.0


def lenses(camera: PinholeCamera) -> dict[str, CameraModel]:
    """The lenses by name, on the sensor of a camera."""
    focal = camera.width / np.deg2rad(FISHEYE_DEG)
    centre = (0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
    fisheye = PinholeCamera(focal, focal, *centre, camera.width, camera.height)
    return {
        "k1 = -0.3": BrownConradyCamera(camera, (-0.3, 0.1, 0.0, 0.0, 0.0)),
        "fisheye 190": FisheyeCamera(fisheye, field_of_view_deg=FISHEYE_DEG),
    }


def errors_of(source: Source, street: SimulatedDrive) -> CalibrationErrors:
    """Errors of the calibration of a source, from the street's nominal extrinsic."""
    config = CalibrationConfig()
    result = calibrate_prepared(prepare_drives([source], config), street.nominal, config)
    return calibration_errors(result.T_camera_lidar, result.time_offset_s, street.truth, result.covariance)


def of_equal_pixels(rectification: Rectification) -> PinholeCamera:
    """The rectified camera's field with as many pixels as the lens has in it."""
    camera, model = rectification.camera, rectification.model
    u, v = np.meshgrid(np.arange(model.width), np.arange(model.height))
    rays, valid = model.unproject(np.column_stack([u.ravel(), v.ravel()]))
    used = int(camera.in_image(np.nan_to_num(camera.project(rays[valid]), nan=-99.0)).sum())
    scale = np.sqrt(used / (camera.width * camera.height))
    fx, fy, cx, cy = (float(scale * x) for x in (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5))
    return PinholeCamera(fx, fy, cx - 0.5, cy - 0.5, int(scale * camera.width), int(scale * camera.height))


def compare(
    lens: str, seeds: Sequence[int], options: argparse.Namespace
) -> tuple[list[CalibrationErrors], ...]:
    """Errors on each street through a lens, and of the pinhole in its place."""
    through, pinhole = [], []
    for seed in seeds:
        street = simulate(SimulationConfig(seed=seed, frames=options.frames))
        rectification = Rectification.of(lenses(street.camera)[lens])
        source = RectifiedSource(LensDrive(street, rectification.model), rectification)
        through.append(errors_of(source, street))
        camera = rectification.camera if options.pinhole == "axis" else of_equal_pixels(rectification)
        pinhole.append(errors_of(replace(street, camera=camera), street))
        for name, errors in ((lens, through[-1]), ("pinhole", pinhole[-1])):
            print(f"{seed} {name}: {values(errors).round(3).tolist()}", flush=True)
    return through, pinhole


def values(errors: CalibrationErrors) -> np.ndarray:
    """(3,) rotation [deg], translation [cm], time offset [ms]."""
    return np.array([errors.qad_deg, 100.0 * errors.atd_m, 1e3 * abs(errors.time_offset_s or 0.0)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--streets", type=int, default=4)
    parser.add_argument("--seed", type=int, default=700, help="of the first street")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--lens", nargs="*", default=["k1 = -0.3", "fisheye 190"])
    parser.add_argument(
        "--pinhole",
        choices=("axis", "pixels"),
        default="axis",
        help="as fine as the lens at its axis, or on the whole",
    )
    options = parser.parse_args()
    print("| lens | rotation [deg] | ATD [cm] | time offset [ms] | of the pinhole | ratio |")
    print("|---|---|---|---|---|---|")
    for lens in options.lens:
        seeds = range(options.seed, options.seed + options.streets)
        through, pinhole = compare(lens, seeds, options)
        ours, theirs = (np.median([values(e) for e in errors], axis=0) for errors in (through, pinhole))
        cells = [f"{ours[0]:.3f}", f"{ours[1]:.2f}", f"{ours[2]:.2f}"]
        cells += [", ".join(f"{x:.3f}" for x in theirs), ", ".join(f"{x:.2f}" for x in ours / theirs)]
        print(f"| {lens} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
