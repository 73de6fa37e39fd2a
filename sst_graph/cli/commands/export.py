"""``sst-graph export``: a result in the format of another program."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.inputs import refuse_drive
from sst_graph.cli.messages import complain, loudness, mention, say
from sst_graph.cli.output_places import check_apart
from sst_graph.data.kitti.calib import read_calibration
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.export import ExportOptions, export_text
from sst_graph.export.formats import replaced_joints
from sst_graph.export.text import heading
from sst_graph.files import output_file
from sst_graph.imports import read_tree
from sst_graph.result import RIG_NAME, CalibrationResult, read_result, result_file
from sst_graph.rig import RigResult, read_rig


def run(args: argparse.Namespace) -> int:
    """Write ``args.result`` as ``args.to`` to ``args.out``, or to stdout."""
    if args.calib is not None and args.to != "kitti":
        raise ConfigError(f"--calib goes with --to kitti, found --to {args.to}")
    inputs = {"RESULT": _file(args.result), "--calib": args.calib, "--tree": args.tree}
    check_apart(inputs, {"--out": args.out})
    if args.out is None:
        say(_text(args), end="")
        return 0
    with output_file(args.out, args.overwrite) as out:
        out.write_text(_text(args))
    mention(f"wrote {args.out}")
    return 0


def _reasons(result: CalibrationResult | RigResult) -> list[str]:
    """Why it is not ok; of a rig, its own reasons and those of its cameras."""
    found = list(result.reasons)
    if isinstance(result, RigResult):
        for name, camera in result.cameras.items():
            found += [f"{name}: {reason}" for reason in camera.reasons]
    return found


def _text(args: argparse.Namespace) -> str:
    """The result in its new format."""
    result = _result(args.result)
    if result.status != "ok" and not args.force:
        raise ConfigError(f"{args.result}: found status {result.status}, expected ok (or --force)")
    options = ExportOptions(
        args.camera_frame,
        args.camera_link,
        args.lidar_frame,
        args.parent,
        args.child,
        None if args.tree is None else read_tree(args.tree),
        None if args.calib is None else read_calibration(args.calib),
    )
    try:
        text = export_text(result, args.to, options)
    except EstimationError as error:
        raise EstimationError(f"{_file(args.result)}: {error}") from error
    for replaced in replaced_joints(result, args.to, options):
        complain(f"warning: {replaced}")
    if result.status != "ok":
        reasons = " ".join("; ".join(_reasons(result)).split())
        complain(f"warning: {result.status}, exported all the same" + (f": {reasons}" if reasons else ""))
    if args.to == "kitti" and isinstance(result, CalibrationResult) and not loudness.quiet:
        offset = heading(result, result.camera_name)[0]
        complain(f"note: calib.txt has no place for the time offset: {offset}")
    return text


def _result(path: Path) -> CalibrationResult | RigResult:
    """The result of a camera, or of a rig."""
    refuse_drive(path)
    return read_rig(path) if _file(path).name == RIG_NAME else read_result(path)


def _file(path: Path) -> Path:
    """The file that a path or its folder stands for."""
    rig = path / RIG_NAME
    return rig if path.is_dir() and rig.is_file() else result_file(path)
