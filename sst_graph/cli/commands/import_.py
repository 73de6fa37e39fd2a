"""``sst-graph import``: a calibration of another program as a start."""

from __future__ import annotations

import argparse
from typing import Any

from sst_graph.cli.messages import complain, mention, say
from sst_graph.cli.output_places import check_apart
from sst_graph.files import output_file
from sst_graph.files.strict_json import strict_json
from sst_graph.imports import ImportedCalibration, ImportOptions, import_calibration, read_tree

FORMAT, VERSION = "sst-graph/start", 1


def run(args: argparse.Namespace) -> int:
    """Write the calibration in ``args.file`` as JSON to ``args.out``, or to stdout."""
    check_apart({"FILE": args.file, "--tree": args.tree}, {"--out": args.out})
    if args.out is None:
        imported = _imported(args)
        complain(f"note: {args.file}: {imported.words()}")
        say(_text(args, imported), end="")
        return 0
    with output_file(args.out, args.overwrite) as out:
        imported = _imported(args)
        out.write_text(_text(args, imported))
    complain(f"note: {args.file}: {imported.words()}")
    mention(f"wrote {args.out}")
    return 0


def _imported(args: argparse.Namespace) -> ImportedCalibration:
    tree = None if args.tree is None else read_tree(args.tree)
    options = ImportOptions(
        args.camera, args.camera_frame, args.camera_link, args.lidar_frame, args.parent, tree
    )
    return import_calibration(args.file, options, args.form)


def _text(args: argparse.Namespace, imported: ImportedCalibration) -> str:
    """What ``--init`` reads; camera only where one was named."""
    document: dict[str, Any] = {"format": FORMAT, "version": VERSION, "T_camera_lidar": imported.cTl.matrix()}
    document["time_offset_s"] = imported.time_offset_s
    if args.camera is not None:
        document["camera"] = args.camera
    document["read_from"] = {"file": args.file.name, "format": imported.format, "taken": imported.taken}
    return strict_json(document) + "\n"
