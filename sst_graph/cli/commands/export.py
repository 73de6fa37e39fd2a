"""``sst-graph export``: a result in the format of another program."""

from __future__ import annotations

import argparse

from sst_graph.cli.inputs import result_at, result_file
from sst_graph.cli.messages import complain, mention, say
from sst_graph.cli.outputs import check_apart
from sst_graph.data.kitti.calib import read_calibration
from sst_graph.errors import ConfigError
from sst_graph.export import ExportOptions, export_text
from sst_graph.files import output_file


def run(args: argparse.Namespace) -> int:
    """Write ``args.result`` as ``args.to`` to ``args.out``, or to stdout."""
    if args.calib is not None and args.to != "kitti":
        raise ConfigError(f"--calib goes with --to kitti, found --to {args.to}")
    check_apart({"RESULT": result_file(args.result), "--calib": args.calib}, {"--out": args.out})
    if args.out is None:
        say(_text(args), end="")
        return 0
    with output_file(args.out, args.overwrite) as out:
        out.write_text(_text(args))
    mention(f"wrote {args.out}")
    return 0


def _text(args: argparse.Namespace) -> str:
    """The result in its new format."""
    result = result_at(args.result)
    if result.status != "ok":
        if not args.force:
            raise ConfigError(f"{args.result}: found status {result.status}, expected ok (or --force)")
        reasons = " ".join("; ".join(result.reasons).split())
        complain(f"warning: {result.status}, exported all the same: {reasons}")
    calibration = None if args.calib is None else read_calibration(args.calib)
    options = ExportOptions(args.camera_frame, args.lidar_frame, calibration)
    return export_text(result, args.to, options)
