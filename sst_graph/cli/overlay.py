"""``sst-graph overlay``: the LiDAR in the image, before and after."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.cli.inputs import open_drive, result_at
from sst_graph.cli.pictures import overlay, position_of
from sst_graph.errors import ConfigError
from sst_graph.files import atomic_write_bytes
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.reference import load_initial
from sst_graph.result import CalibrationResult
from sst_graph.types import Source
from sst_graph.viz import Placement


def run(args: argparse.Namespace) -> int:
    """Write the picture of one frame to ``args.out``."""
    if args.out.suffix.lower() != ".png":
        raise ConfigError(f"--out {args.out}: expected a name that ends in .png")
    if args.out.exists() and not args.overwrite:
        raise ConfigError(f"{args.out}: exists already (give --overwrite to replace it)")
    result = result_at(args.result)
    source = with_sweep_of(open_drive(args, args.data), result.diagnostics)
    position = len(source) // 2 if args.frame is None else position_of(source, args.frame)
    before = _before(args.before, result, source)
    atomic_write_bytes(args.out, png(overlay(source, position, result, before)))
    print(f"wrote {args.out}: frame {source[position].index} of {source.name}")
    return 0


def png(picture: NDArray[np.uint8]) -> bytes:
    """The picture (h, w, 3) BGR as the bytes of a PNG file."""
    _, data = cv2.imencode(".png", picture)
    return bytes(data)


def _before(choice: str, result: CalibrationResult, source: Source) -> Placement | None:
    """What to compare with; None for a result that had no start."""
    if choice == "initial":
        if result.initial is None:
            return None
        return Placement(result.initial, result.initial_offset_s, "before (start)")
    if choice == "dataset":
        if source.nominal is None:
            raise ConfigError(f"{source.name} brings no nominal calibration to compare with")
        return Placement(source.nominal, 0.0, "before (nominal)")
    cTl, offset_s = load_initial(Path(choice), result.camera_name)
    return Placement(cTl, offset_s, f"before ({Path(choice).name})")
