"""``sst-graph evaluate``: a result against the truth."""

from __future__ import annotations

import argparse
import dataclasses
import json

from sst_graph.cli.inputs import result_at
from sst_graph.cli.messages import complain, say
from sst_graph.cli.reading import reading_words
from sst_graph.metrics import calibration_errors
from sst_graph.reference import read_reference
from sst_graph.report import error_lines


def run(args: argparse.Namespace) -> int:
    """Print the errors of ``args.result`` against ``args.truth``."""
    result = result_at(args.result)
    truth = read_reference(args.truth, result.camera_name)
    if result.read_as.get("image_shift"):
        complain(
            f"warning: {args.result} was made with {reading_words(result.read_as)}: "
            "the truth's time offset must be that of the same pairs"
        )
    errors = calibration_errors(result.T_camera_lidar, result.time_offset_s, truth, result.covariance)
    if args.json:
        say(json.dumps({**dataclasses.asdict(errors), "status": result.status}, allow_nan=False))
    else:
        say("\n".join([*error_lines(errors), f"status       {result.status}"]))
    return 0
