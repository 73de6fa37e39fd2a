"""``sst-graph export``: a result in the format of another program."""

from __future__ import annotations

import argparse
import sys

from sst_graph.cli.inputs import result_at
from sst_graph.data.calib import read_calibration
from sst_graph.errors import ConfigError
from sst_graph.export import ExportOptions, export_text
from sst_graph.files import atomic_write_text


def run(args: argparse.Namespace) -> int:
    """Write ``args.result`` as ``args.to`` to ``args.out``, or to stdout."""
    if args.calib is not None and args.to != "kitti":
        raise ConfigError(f"--calib goes with --to kitti, found --to {args.to}")
    if args.out is not None and args.out.exists() and not args.overwrite:
        raise ConfigError(f"{args.out}: exists already (give --overwrite to replace it)")
    result = result_at(args.result)
    if result.status != "ok":
        if not args.force:
            raise ConfigError(f"{args.result}: found status {result.status}, expected ok (or --force)")
        reasons = " ".join("; ".join(result.reasons).split())
        print(f"sst-graph: warning: {result.status}, exported all the same: {reasons}", file=sys.stderr)
    calibration = None if args.calib is None else read_calibration(args.calib)
    options = ExportOptions(args.camera_frame, args.lidar_frame, calibration)
    text = export_text(result, args.to, options)
    if args.out is None:
        print(text, end="")
    else:
        atomic_write_text(args.out, text)
        print(f"wrote {args.out}")
    return 0
